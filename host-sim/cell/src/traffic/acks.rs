//! TCP acknowledgements and retransmissions.

use proto_core::engine::{Input, LinkId};

use crate::Cell;
use crate::due::Due;
use crate::network::Way;
use crate::tcp::{Retransmission, TCP_TIMEOUT, USER_TIMEOUT};

impl Cell {
    /// The gateway's transport gives up a connection on which nothing was acknowledged for too long. The controller is
    /// not told.
    pub(crate) fn user_timeout(&mut self, id: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let Some(gate) = self.gates.get_mut(&conn.link) else { return };
        let (link, generation) = (conn.link, gate.generation);
        if gate.conn != Some(id) || conn.up.unacked() == 0 {
            conn.is_watched = false;
            return;
        }
        let at = conn.up.unacked_since + USER_TIMEOUT;
        if now < at {
            self.queue.push(at, Due::UserTimeout { conn: id });
            return;
        }
        conn.up.forget();
        conn.abandoned = true;
        let is_gone = conn.closing || conn.forgotten;
        if is_gone {
            self.drop_conn(id);
        } else {
            self.queue.push(now + TCP_TIMEOUT, Due::TimedOut { conn: id });
        }
        self.queue.push(now, Due::LinkDown { link, generation });
    }

    /// An acknowledgement for the bytes up to `upto` has reached the gateway's transport.
    pub(crate) fn acknowledged(&mut self, id: u64, upto: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        if !conn.up.acknowledge(now, upto) {
            return;
        }
        let (link, unacked) = (conn.link, conn.up.unacked());
        let gate = self.gate(link);
        if gate.conn != Some(id) {
            return;
        }
        let generation = gate.generation;
        if gate.is_full && unacked <= gate.network.send_buffer {
            gate.is_full = false;
            self.queue.push(now, Due::LinkSent { link, generation });
        }
        let gate = self.gate(link);
        if !std::mem::replace(&mut gate.reads_acks, true) {
            let at = now + gate.network.ack_report;
            self.queue.push(at, Due::ReadAcks { link, generation });
        }
    }

    /// The gateway's driver reports what was acknowledged since its last report.
    pub(crate) fn report_acked(&mut self, link: LinkId) {
        if self.is_asleep() {
            return;
        }
        let gate = self.gate(link);
        if !gate.is_up || !std::mem::take(&mut gate.reads_acks) {
            return;
        }
        let Some(conn) = gate.conn.and_then(|id| self.conns.get(&id)) else { return };
        let left = u32::try_from(conn.up.unacked()).unwrap_or(u32::MAX);
        self.engine_input(Input::LinkAcked { link, left });
    }

    /// Retransmits unacknowledged data.
    pub(crate) fn retransmit(&mut self, id: u64, way: Way) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let Some(gate) = self.gates.get_mut(&conn.link) else { return };
        match conn.pipe(way).retransmit(now, gate, way) {
            Retransmission::Nothing => {}
            Retransmission::Arrives(at) => self.queue.push(at, Due::Arrival { conn: id, way }),
            Retransmission::Acked(at) => {
                let upto = conn.up.arrived;
                self.queue.push(at, Due::Ack { conn: id, upto });
            }
            Retransmission::Later(at) => self.queue.push(at, Due::Retransmit { conn: id, way }),
            Retransmission::GivenUp => self.reset_conn(id),
        }
    }

    /// An acknowledgement of the controller's TCP reaches the gateway's host.
    pub(crate) fn ack(&mut self, id: u64, upto: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        if conn.down.dead || conn.down.held {
            return;
        }
        if self.gates.get(&conn.link).is_some_and(|gate| gate.is_cut(Way::Down)) {
            if let Some(at) = conn.up.schedule_retransmission(now, now) {
                self.queue.push(at, Due::Retransmit { conn: id, way: Way::Up });
            }
            return;
        }
        self.acknowledged(id, upto);
    }

    /// The controller's TCP acknowledges received data, unless data sent in the meantime carried the acknowledgement.
    pub(crate) fn ack_leaves(&mut self, id: u64) {
        let Some(conn) = self.conns.get_mut(&id) else { return };
        if std::mem::take(&mut conn.owes_ack) {
            let (link, upto) = (conn.link, conn.up.arrived);
            let at = self.now + self.gate(link).network.delay;
            self.queue.push(at, Due::Ack { conn: id, upto });
        }
    }

    /// The controller received bytes and has to acknowledge them.
    pub(super) fn owe_ack(&mut self, id: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let Some(gate) = self.gates.get(&conn.link) else { return };
        if !std::mem::replace(&mut conn.owes_ack, true) {
            // If the controller replies at once, the reply carries the acknowledgement.
            self.queue.push(now + gate.network.ack_delay, Due::AckLeaves { conn: id });
        }
    }
}
