//! Determines which paths to the controller work at present, because the model has to know what should have arrived.

use proto_core::engine::{LinkId, LinkKind};
use proto_core::time::Duration;

use super::Cell;
use super::connection::Connection;
use super::due::Due;
use super::network::{ConnectPolicy, Gate, Way};
use super::oracle::{Path, inputs_of};
use recipe_controller::Link;

impl Cell {
    /// Announces that a server of the controller has a fault, such as [`recipe_controller::Controller::mute`], so the
    /// model expects less of the gateway. Call [`Self::server_fault_ends`] once for each call.
    pub fn server_fault_begins(&mut self, server: Link) {
        self.server_faults[server as usize] += 1;
        self.note_fault(None);
    }

    /// Announces that a fault of a server has ended.
    pub fn server_fault_ends(&mut self, server: Link) {
        let server_faults = &mut self.server_faults[server as usize];
        *server_faults = server_faults.saturating_sub(1);
        self.note_fault(None);
    }

    /// Records that a fault began or ended, on one link or on all links.
    pub(super) fn note_fault(&mut self, link: Option<LinkId>) {
        if let Some(oracle) = &mut self.oracle {
            oracle.note_fault(link, self.now);
        }
    }

    pub(super) fn survey(&mut self) {
        if self.judge.is_some() {
            self.survey_device();
            self.queue.push(self.now + SURVEY_EVERY, Due::Survey);
        }
        if self.oracle.is_none() {
            return;
        }
        let (paths, now) = (self.paths(), self.now);
        if let Some(oracle) = &mut self.oracle {
            oracle.survey(&paths, inputs_of(self.controller.registers().image()), now);
        }
        self.queue.push(now + SURVEY_EVERY, Due::Survey);
    }

    /// Checks data that the controller sends on a connection for its reply to an unknown command.
    pub(super) fn replied(&mut self, conn: u64, bytes: &[u8]) {
        if let Some(judge) = &mut self.judge {
            judge.answered(conn, bytes, self.now);
        }
        let Some(oracle) = &mut self.oracle else { return };
        let link = self.conns.get(&conn).map(|conn| conn.link);
        if let Some(link @ (LinkId::COMMAND | LinkId::URGENT)) = link
            && bytes.starts_with(b"unknown command")
        {
            oracle.not_understood(link, self.now);
        }
    }

    pub(super) fn paths(&self) -> Vec<Path> {
        let path = |gate: &Gate| {
            let server = match gate.kind {
                LinkKind::Command | LinkKind::Urgent => Some(Link::Command),
                LinkKind::State => Some(Link::State),
                LinkKind::Modbus => Some(Link::Modbus),
                _ => None,
            };
            Path {
                link: gate.id,
                conn: gate.conn,
                is_sound: !self.is_asleep() && self.is_sound(gate),
                is_served: server.is_none_or(|server| self.server_faults[server as usize] == 0),
            }
        };
        self.gates.values().map(path).collect()
    }

    pub(super) fn is_sound(&self, gate: &Gate) -> bool {
        let is_whole = |conn: &Connection| {
            let is_free = |way: &super::tcp::Pipe| {
                !way.held && !way.dead && way.retransmit_at.is_none() && way.reset_after.is_none()
            };
            let is_there = conn.accepted && !conn.closing && !conn.abandoned && !conn.forgotten;
            is_there && is_free(&conn.up) && is_free(&conn.down)
        };
        let has_path = gate.is_up
            && gate.connect_policy == ConnectPolicy::Open
            && !Way::BOTH.into_iter().any(|way| gate.is_cut(way));
        match gate.kind {
            LinkKind::RecipeUdp | LinkKind::RecipeUdpListen { .. } => {
                has_path && gate.network.loss_ppm < MUCH_LOSS && gate.network.jitter < MUCH_JITTER
            }
            _ => has_path && gate.conn.and_then(|id| self.conns.get(&id)).is_some_and(is_whole),
        }
    }
}

const SURVEY_EVERY: Duration = Duration::from_millis(100);
/// The model expects nothing of a network with at least this loss (per million) or jitter.
const MUCH_LOSS: u32 = 10_000;
const MUCH_JITTER: Duration = Duration::from_millis(5);
