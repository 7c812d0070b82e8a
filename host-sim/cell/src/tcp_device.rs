//! Devices of field ports that are TCP connections: the far end of such a connection.
//!
//! The gateway's end, and all faults of the network, work as on every link ([`super::network`], [`super::faults`]).

use proto_core::engine::LinkId;
use proto_core::time::{Duration, Instant};

use super::Cell;
use super::connection::Peer;
use super::device::{Act, Done, Served, Server};
use super::due::Due;
use super::network::{ConnectPolicy, Gate, Item, Way};

/// The device of a link.
#[derive(Default)]
pub(super) struct TcpDevice {
    server: Option<Box<dyn Server>>,
    /// Its current connection.
    conn: Option<u64>,
    is_off: bool,
    /// Since when the gateway has had no connection although it could; `None` if it has one, or could have none.
    missed_since: Option<Instant>,
}

impl std::fmt::Debug for TcpDevice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { conn, is_off, .. } = self;
        f.debug_struct("TcpDevice").field("conn", conn).field("is_off", is_off).finish_non_exhaustive()
    }
}

impl TcpDevice {
    pub(super) fn deadline(&self) -> Instant {
        self.server.as_ref().map_or(Instant::NEVER, |server| server.deadline())
    }
}

impl Cell {
    /// Attaches a device to a Modbus TCP link; it replaces the previous device. Without a device, connections are
    /// accepted but never answered.
    ///
    /// # Panics
    /// If the link does not lead to a device.
    #[track_caller]
    pub fn attach_server(&mut self, link: LinkId, server: impl Server + 'static) {
        match self.servers.get_mut(&link) {
            Some(device) => device.server = Some(Box::new(server)),
            None => panic!("{link:?} is to no device"),
        }
        self.note_deadlines();
    }

    /// Lets `act` use the device of a link, then reads the device's log.
    fn with_server(&mut self, link: LinkId, act: impl FnOnce(&mut dyn Server)) {
        let device = self.servers.get_mut(&link).and_then(|device| device.server.as_mut());
        let Some(server) = device else { return };
        act(server.as_mut());
        let done = server.take_done();
        self.note_deadlines();
        let now = self.now;
        if let Some(judge) = &mut self.judge {
            for done in done {
                if let Done::Acted(act) = done.what {
                    judge.did(act, now);
                }
            }
        }
    }

    /// The link of a connection, if it is the current connection of its device.
    fn device_of(&self, id: u64) -> Option<LinkId> {
        let link = self.conns.get(&id).map(|conn| conn.link);
        link.filter(|link| self.servers.get(link).is_some_and(|device| device.conn == Some(id)))
    }

    pub(super) fn device_accepts(&mut self, id: u64) {
        let Some(link) = self.conns.get(&id).map(|conn| conn.link) else { return };
        let Some(device) = self.servers.get_mut(&link) else { return };
        device.missed_since = None;
        if let Some(before) = device.conn.replace(id) {
            // The gateway has one connection at a time, so it has left this one.
            self.drop_conn(before);
            let now = self.now;
            self.with_server(link, |server| server.closed(now));
        }
        let now = self.now;
        self.with_server(link, |server| server.opened(now));
    }

    /// The device loses its end of a connection.
    pub(super) fn device_loses(&mut self, id: u64) {
        let Some((&link, device)) = self.servers.iter_mut().find(|(_, device)| device.conn == Some(id))
        else {
            return;
        };
        device.conn = None;
        let now = self.now;
        self.with_server(link, |server| server.closed(now));
    }

    pub(super) fn device_receives(&mut self, id: u64, bytes: &[u8]) {
        let now = self.now;
        if let Some(link) = self.device_of(id) {
            self.with_server(link, |server| server.receive(now, bytes));
        }
    }

    pub(super) fn poll_servers(&mut self) {
        let now = self.now;
        let links: Vec<LinkId> = self.servers.keys().copied().collect();
        for link in links {
            if self.servers.get(&link).is_none_or(|device| device.deadline() > now) {
                continue;
            }
            let mut served = Vec::new();
            self.with_server(link, |server| served = server.poll(now));
            served.into_iter().for_each(|served| self.device_serves(link, served));
        }
    }

    fn device_serves(&mut self, link: LinkId, served: Served) {
        let Some(device) = self.servers.get_mut(&link) else { return };
        let conn = device.conn;
        match served {
            Served::PowerOff if !device.is_off => {
                device.is_off = true;
                Way::BOTH.into_iter().for_each(|way| self.gate(link).cuts[way as usize] += 1);
                let conns = self.conns.iter().filter(|(_, conn)| conn.link == link);
                let conns = conns.map(|(&id, _)| (id, Peer::Device)).collect();
                self.lose_power(conns);
            }
            Served::PowerOn if device.is_off => {
                device.is_off = false;
                for way in Way::BOTH {
                    let cuts = &mut self.gate(link).cuts[way as usize];
                    *cuts = cuts.saturating_sub(1);
                }
            }
            Served::PowerOff | Served::PowerOn => {}
            Served::Bytes(bytes, act) => {
                let (Some(id), now) = (conn, self.now) else { return };
                self.send_item(id, Way::Down, Item::Bytes(bytes));
                if let (Some(conn), Some(act)) = (self.conns.get_mut(&id), act) {
                    conn.acts.push_back((conn.down.sent, now, act));
                }
            }
            Served::Close => {
                let Some(id) = conn else { return };
                self.controller_closes(id);
                self.device_loses(id);
            }
            Served::HalfClose => {
                if let Some(id) = conn {
                    self.send_item(id, Way::Down, Item::Closed);
                }
            }
            Served::Reset => {
                let Some(id) = conn else { return };
                let back = self.now + self.gate(link).network.delay;
                if let Some(conn) = self.conns.get_mut(&id) {
                    conn.forgotten = true;
                    conn.down.forget();
                    self.queue.push(back, Due::ResetDown { conn: id });
                }
                self.device_loses(id);
            }
        }
    }

    /// The far end has closed its direction, which the gateway has noticed: it closes its end.
    pub(super) fn gateway_hears_end(&mut self, id: u64) {
        let delay = self.conns.get(&id).map(|conn| conn.link).map(|link| self.gate(link).network.delay);
        let Some(conn) = self.conns.get_mut(&id) else { return };
        if conn.closing || conn.forgotten {
            self.drop_conn(id);
            return;
        }
        // The far end is not closed yet: data on its way arrives there before the reset.
        conn.abandoned = true;
        self.queue.push(self.now + delay.unwrap_or_default(), Due::ResetUp { conn: id });
    }

    /// The gateway reads bytes from a device's connection: the replies in them have arrived.
    pub(super) fn report_acts(&mut self, id: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let link = conn.link;
        let mut acts = Vec::new();
        while let Some((_, left, act)) = conn.acts.pop_front_if(|(upto, ..)| *upto <= conn.down.arrived) {
            acts.push((left, act));
        }
        if acts.is_empty() {
            return;
        }
        let is_sound = self.gates.get(&link).is_some_and(|gate| self.is_sound(gate));
        let Some(judge) = &mut self.judge else { return };
        for (left, act) in acts {
            let act = match act {
                Act::Replied { order, tells, is_whole, in_time } => Act::Replied {
                    order,
                    tells,
                    is_whole,
                    in_time: in_time && is_sound && now.saturating_since(left) <= ON_ITS_WAY,
                },
                act => act,
            };
            judge.did(act, now);
        }
    }

    /// A fault of a link begins or ends. It may have made a connection attempt fail.
    pub(super) fn device_link_fault(&mut self, link: LinkId) {
        if let Some(device) = self.servers.get_mut(&link) {
            device.missed_since = None;
        }
        self.device_link_changed(link);
    }

    /// The state of a link changes: tells the judge if the link leads to a device.
    pub(super) fn device_link_changed(&mut self, link: LinkId) {
        if let Some(judge) = self.judge.as_mut().filter(|_| self.servers.contains_key(&link)) {
            judge.note_fault(self.now);
        }
    }

    /// Whether a connection to a device is affected by a fault.
    pub(super) fn is_device_faulty(&self) -> bool {
        self.servers.keys().filter_map(|link| self.gates.get(link)).any(|gate| !self.is_sound(gate))
    }

    /// How long the gateway has had no connection to a device although it could.
    pub(super) fn misses_device_for(&mut self) -> Duration {
        let (now, is_asleep) = (self.now, self.is_asleep());
        let mut longest = Duration::ZERO;
        for (link, device) in &mut self.servers {
            let Some(gate) = self.gates.get(link) else { continue };
            let is_dead = |id: &u64| {
                let conn = self.conns.get(id);
                conn.is_none_or(|conn| conn.up.dead || conn.down.dead || conn.forgotten)
            };
            let has_one = gate.is_up && !gate.conn.as_ref().is_none_or(is_dead);
            if has_one || is_asleep || device.is_off || !admits(gate) {
                device.missed_since = None;
                continue;
            }
            let since = *device.missed_since.get_or_insert(now);
            longest = longest.max(now.saturating_since(since));
        }
        longest
    }
}

fn admits(gate: &Gate) -> bool {
    gate.connect_policy == ConnectPolicy::Open && !Way::BOTH.into_iter().any(|way| gate.is_cut(way))
}

/// Without faults, a reply arrives at the gateway within this time.
const ON_ITS_WAY: Duration = Duration::from_millis(15);
