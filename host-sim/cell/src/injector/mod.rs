//! Random faults from a seed: the faults of a soak run.
//!
//! A [`FaultInjector`] injects faults at random times and ends each of them after a while. The caller can inspect the
//! cell at any time; [`FaultInjector::end_all`] ends all faults.

mod kind;

use std::collections::BTreeMap;

use proto_core::engine::LinkId;
use proto_core::modbus::Exception;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use proto_core::wire::dialect::Dialect;

use super::network::{Network, Way};
use super::rng::Rng;
use super::{BusId, Cell, LineId};
pub use kind::FaultKind;
use recipe_config::CommandClients;
use recipe_controller::Link;

/// How a fault is ended.
#[derive(Debug, Clone, Copy)]
enum Repair {
    Admit(LinkId),
    Release(LinkId),
    Datagrams(LinkId),
    Ways(LinkId, [bool; 2]),
    Cable(Option<LinkId>),
    Unmute(Link),
    Answers(Link),
    NoException,
    ManyClients,
    Variable(SysVar),
    Quiet(LineId),
    Line(LineId),
    PlugIn(LineId),
    Bus(BusId),
    BusOn(BusId),
    Power,
    Dialect(&'static str),
    Wake,
}

/// Injects faults and ends them.
#[derive(Debug)]
pub struct FaultInjector {
    rng: Rng,
    kinds: Vec<FaultKind>,
    pause: Duration,
    next: Instant,
    repairs: Vec<(Instant, FaultKind, Repair)>,
    counts: BTreeMap<FaultKind, u64>,
    /// The network settings without faults.
    networks: BTreeMap<LinkId, Network>,
}

impl FaultInjector {
    /// Injects faults of these kinds from now on, one per `pause` on average. Most faults last up to `pause`, outages
    /// up to 20 times as long.
    pub fn new(cell: &mut Cell, kinds: &[FaultKind], pause: Duration) -> Self {
        let mut injector = Self {
            rng: cell.fork_rng(),
            kinds: kinds.to_vec(),
            pause,
            next: Instant::ZERO,
            repairs: Vec::new(),
            counts: BTreeMap::new(),
            networks: cell.networks(),
        };
        injector.next = cell.now() + injector.rng.up_to(pause.saturating_mul(2));
        injector
    }

    /// Number of faults of each kind so far.
    pub fn counts(&self) -> &BTreeMap<FaultKind, u64> {
        &self.counts
    }

    /// Advances time in the cell and injects faults.
    pub fn run(&mut self, cell: &mut Cell, span: Duration) {
        let end = cell.now() + span;
        loop {
            let repair = self.repairs.iter().map(|repair| repair.0).min().unwrap_or(Instant::NEVER);
            let next = self.next.min(repair).min(end);
            cell.run(next.saturating_since(cell.now()));
            // Time stops after a violation.
            if next >= end || cell.violation().is_some() {
                return;
            }
            self.poll(cell);
        }
    }

    /// Ends all current faults.
    pub fn end_all(&mut self, cell: &mut Cell) {
        for (_, kind, repair) in std::mem::take(&mut self.repairs) {
            cell.remark(format_args!("ends: {}", kind.name()));
            apply(cell, repair, &self.networks);
        }
        cell.wake_gateway();
    }

    fn poll(&mut self, cell: &mut Cell) {
        let now = cell.now();
        while let Some(nth) = self.repairs.iter().position(|repair| repair.0 <= now) {
            let (_, kind, repair) = self.repairs.remove(nth);
            cell.remark(format_args!("ends: {}", kind.name()));
            apply(cell, repair, &self.networks);
        }
        if now >= self.next {
            // Some pauses are long enough for everything to recover.
            let pause = if self.rng.below(LONG_PAUSE_IN) == 0 { 12 } else { 2 };
            self.next = now + Duration::from_micros(1) + self.rng.up_to(self.pause.saturating_mul(pause));
            if let Some(kind) = self.pick_kind()
                && self.begin(cell, kind).is_some()
            {
                *self.counts.entry(kind).or_default() += 1;
                cell.remark(format_args!("begins: {}", kind.name()));
            }
        }
    }

    fn pick_kind(&mut self) -> Option<FaultKind> {
        let mut nth = self.rng.below(self.kinds.iter().map(|kind| kind.weight()).sum());
        self.kinds.iter().copied().find(|kind| {
            let is_it = nth < kind.weight();
            nth = nth.saturating_sub(kind.weight());
            is_it
        })
    }

    /// Injects a fault; `None` if it applies to nothing in the cell.
    fn begin(&mut self, cell: &mut Cell, kind: FaultKind) -> Option<()> {
        let rng = &mut self.rng;
        let server = [Link::Command, Link::State, Link::Modbus][rng.below(3) as usize];
        let way = if rng.below(2) == 0 { Way::Up } else { Way::Down };
        let most = self.pause.saturating_mul(MAX_PAUSES);
        let mut lasts = None;
        let repair = match kind {
            FaultKind::Refused
            | FaultKind::BlackHole
            | FaultKind::Reset
            | FaultKind::ResetMidPacket
            | FaultKind::HalfOpen
            | FaultKind::Stall
            | FaultKind::Datagrams
            | FaultKind::Burst
            | FaultKind::Unacknowledged
            | FaultKind::Cable
            | FaultKind::Stranger => link_fault(rng, cell, kind, way, &mut lasts)?,
            FaultKind::Mute
            | FaultKind::SlowAnswers
            | FaultKind::Exception
            | FaultKind::OneClient
            | FaultKind::HalfStatePacket
            | FaultKind::StateBytesLost
            | FaultKind::Unreadable => server_fault(rng, cell, kind, server, &mut lasts)?,
            FaultKind::Noise
            | FaultKind::Garbage
            | FaultKind::Cut
            | FaultKind::Unplugged
            | FaultKind::BusOff => field_fault(rng, cell, kind)?,
            FaultKind::ControllerRestart => {
                cell.restart_controller();
                None
            }
            FaultKind::PowerCut => {
                lasts = Some(mostly_short(rng, Duration::from_millis(200), 4));
                cell.power_cut();
                Some(Repair::Power)
            }
            FaultKind::Dialect => {
                let before = cell.controller().dialect();
                // One at a time, because with several the repairs would restore the wrong dialect.
                if self.repairs.iter().any(|(.., repair)| matches!(repair, Repair::Dialect(_))) {
                    return None;
                }
                let others = Dialect::NAMES.into_iter().filter(|name| *name != before);
                cell.replace_controller(pick(rng, others)?);
                Some(Repair::Dialect(before))
            }
            FaultKind::GatewayRestart => {
                cell.restart_gateway();
                None
            }
            FaultKind::GatewayStall => {
                let span = Duration::from_micros(rng.between(50_000, 499_999));
                lasts = Some(span);
                cell.stall_gateway(span);
                Some(Repair::Wake)
            }
            FaultKind::GatewaySleep => {
                let longest = Duration::from_secs(20);
                let shortest = Duration::from_millis(501);
                let span = mostly_short(rng, shortest, 5).min(longest.min(most)).max(shortest);
                lasts = Some(span);
                cell.stall_gateway(span);
                Some(Repair::Wake)
            }
        };
        if let Some(repair) = repair {
            let lasts = lasts.map_or_else(|| self.rng.up_to(self.pause), |lasts| lasts.min(most));
            let until = cell.now() + lasts;
            self.repairs.push((until, kind, repair));
        }
        Some(())
    }
}

/// A fault of a link: how it is repaired, if at all. `lasts` is its duration, if it is not the usual one.
fn link_fault(
    rng: &mut Rng,
    cell: &mut Cell,
    kind: FaultKind,
    way: Way,
    lasts: &mut Option<Duration>,
) -> Option<Option<Repair>> {
    let tcp: Vec<LinkId> = cell.tcp_links().collect();
    let mut tcp = || pick(rng, tcp.iter().copied());
    Some(match kind {
        FaultKind::Refused => {
            let link = tcp()?;
            cell.refuse(link);
            cell.reset(link);
            Some(Repair::Admit(link))
        }
        FaultKind::BlackHole => {
            let link = tcp()?;
            cell.black_hole(link);
            cell.half_open(link);
            Some(Repair::Admit(link))
        }
        FaultKind::Reset => {
            cell.reset(tcp()?);
            None
        }
        FaultKind::ResetMidPacket => {
            let link = tcp()?;
            cell.reset_after(link, way, rng.between(1, 2_000) as usize);
            None
        }
        FaultKind::HalfOpen => {
            cell.half_open(tcp()?);
            None
        }
        FaultKind::Stall => {
            let link = tcp()?;
            cell.hold(link, way);
            Some(Repair::Release(link))
        }
        FaultKind::Datagrams => {
            let link = pick(rng, cell.datagram_links())?;
            let network = cell.network(link);
            network.loss_ppm = rng.between(0, 500_000) as u32;
            network.duplicate_ppm = rng.between(0, 200_000) as u32;
            network.jitter = rng.up_to(Duration::from_millis(20));
            Some(Repair::Datagrams(link))
        }
        FaultKind::Burst => {
            let link = pick(rng, cell.datagram_links())?;
            *lasts = Some(mostly_short(rng, Duration::from_millis(50), 6).min(Duration::from_secs(5)));
            cut_ways(cell, link, rng.below(3))
        }
        FaultKind::Unacknowledged => {
            let link = tcp()?;
            *lasts = Some(mostly_short(rng, Duration::from_millis(50), 6).min(Duration::from_secs(5)));
            cut_ways(cell, link, rng.below(2))
        }
        FaultKind::Cable => {
            let link = pick(rng, cell.link_ids()).filter(|_| rng.below(2) == 0);
            *lasts = Some(mostly_short(rng, Duration::from_millis(100), 7).min(Duration::from_secs(20)));
            cables(cell, link).into_iter().for_each(|link| cell.cut_cable(link));
            Some(Repair::Cable(link))
        }
        FaultKind::Stranger => {
            let links: Vec<(LinkId, Option<usize>)> = cell.listening_for_datagrams();
            let (link, frame) = pick(rng, links.into_iter())?;
            // Never the length of a frame, as the gateway would then answer the sender.
            let len = Some(rng.below(64) as usize).filter(|len| Some(*len) != frame).unwrap_or(100);
            let bytes = rng.bytes(len);
            cell.stranger_sends(link, &bytes);
            None
        }
        _ => return None,
    })
}

/// Injects a fault of one of the controller's servers, or of its data.
fn server_fault(
    rng: &mut Rng,
    cell: &mut Cell,
    kind: FaultKind,
    server: Link,
    lasts: &mut Option<Duration>,
) -> Option<Option<Repair>> {
    Some(match kind {
        FaultKind::Mute => {
            *lasts = fault_length(rng, server);
            cell.server_fault_begins(server);
            cell.controller_mut().mute(server);
            Some(Repair::Unmute(server))
        }
        FaultKind::SlowAnswers => {
            *lasts = fault_length(rng, server);
            let delay = rng.up_to(lasts.unwrap_or(Duration::from_millis(1_500)));
            cell.server_fault_begins(server);
            cell.controller_mut().delay_answers(server, delay);
            Some(Repair::Answers(server))
        }
        FaultKind::Exception => {
            let exceptions = [Exception::DeviceFailure, Exception::DeviceBusy, Exception::IllegalDataAddress];
            let exception = pick(rng, exceptions.into_iter());
            cell.server_fault_begins(Link::Modbus);
            cell.controller_mut().answer_modbus_with(exception);
            Some(Repair::NoException)
        }
        FaultKind::OneClient => {
            *lasts = Some(mostly_short(rng, Duration::from_millis(500), 5));
            let clients = [CommandClients::RefuseSecond, CommandClients::DropFirst][rng.below(2) as usize];
            cell.controller_mut().command_clients(clients);
            Some(Repair::ManyClients)
        }
        FaultKind::HalfStatePacket => {
            let len = rng.between(0, 1_467) as usize;
            cell.controller_mut().cut_next_state_packet(len);
            None
        }
        FaultKind::StateBytesLost => {
            cell.link_ids().find(|link| *link == LinkId::STATE)?;
            cell.lose_state_bytes(rng.between(1, 1_467) as usize);
            None
        }
        FaultKind::Unreadable => {
            let var = pick(rng, cell.floats().into_iter())?;
            let value = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][rng.below(3) as usize];
            cell.corrupt_float(var, value);
            Some(Repair::Variable(var))
        }
        _ => return None,
    })
}

/// A fault of a line, a bus or a device.
fn field_fault(rng: &mut Rng, cell: &mut Cell, kind: FaultKind) -> Option<Option<Repair>> {
    Some(match kind {
        FaultKind::Noise => {
            let line = pick(rng, cell.lines())?;
            cell.line(line).noise_ppm = rng.between(100, 100_000) as u32;
            Some(Repair::Quiet(line))
        }
        FaultKind::Garbage => {
            let line = pick(rng, cell.lines())?;
            let len = rng.between(1, 300) as usize;
            let bytes = rng.bytes(len);
            cell.send(line, &bytes);
            None
        }
        FaultKind::Cut => match (pick(rng, cell.lines()), pick(rng, cell.buses())) {
            (Some(line), bus) if bus.is_none() || rng.below(2) == 0 => {
                cell.cut(line);
                Some(Repair::Line(line))
            }
            (_, bus) => {
                let bus = bus?;
                cell.cut_bus(bus);
                Some(Repair::Bus(bus))
            }
        },
        FaultKind::Unplugged => {
            let line = pick(rng, cell.lines())?;
            cell.unplug(line);
            Some(Repair::PlugIn(line))
        }
        FaultKind::BusOff => {
            let bus = pick(rng, cell.buses())?;
            cell.bus_off(bus);
            Some(Repair::BusOn(bus))
        }
        _ => return None,
    })
}

fn apply(cell: &mut Cell, repair: Repair, networks: &BTreeMap<LinkId, Network>) {
    match repair {
        Repair::Admit(link) => cell.admit(link),
        Repair::Release(link) => {
            cell.release(link, Way::Up);
            cell.release(link, Way::Down);
        }
        Repair::Datagrams(link) => *cell.network(link) = networks.get(&link).copied().unwrap_or_default(),
        Repair::Ways(link, ways) => {
            for way in [Way::Up, Way::Down].into_iter().filter(|way| ways[*way as usize]) {
                cell.repair_way(link, way);
            }
        }
        Repair::Cable(link) => cables(cell, link).into_iter().for_each(|link| cell.repair_cable(link)),
        Repair::Unmute(server) => {
            cell.controller_mut().unmute(server);
            cell.server_fault_ends(server);
        }
        Repair::Answers(server) => {
            cell.controller_mut().delay_answers(server, Duration::ZERO);
            cell.server_fault_ends(server);
        }
        Repair::NoException => {
            cell.controller_mut().answer_modbus_with(None);
            cell.server_fault_ends(Link::Modbus);
        }
        Repair::ManyClients => cell.controller_mut().command_clients(CommandClients::Many),
        Repair::Variable(var) => cell.heal(var),
        Repair::Quiet(line) => cell.line(line).noise_ppm = 0,
        Repair::Line(line) => cell.repair(line),
        Repair::PlugIn(line) => cell.plug_in(line),
        Repair::Bus(bus) => cell.repair_bus(bus),
        Repair::BusOn(bus) => cell.bus_on(bus),
        Repair::Power => cell.power_up(),
        Repair::Dialect(name) => cell.replace_controller(name),
        // The cell wakes the gateway by itself, and another stall may have begun since.
        Repair::Wake => {}
    }
}

/// The links that use the cable; all links if `None`.
fn cables(cell: &Cell, link: Option<LinkId>) -> Vec<LinkId> {
    link.map_or_else(|| cell.link_ids().collect(), |link| vec![link])
}

/// Cuts the link in direction up, down, or both.
fn cut_ways(cell: &mut Cell, link: LinkId, which: u64) -> Option<Repair> {
    let ways = [which != 1, which != 0];
    for way in [Way::Up, Way::Down].into_iter().filter(|way| ways[*way as usize]) {
        cell.cut_way(link, way);
    }
    Some(Repair::Ways(link, ways))
}

/// The gateway waits 10 s for replies to commands, so faults of the command server may last longer.
fn fault_length(rng: &mut Rng, server: Link) -> Option<Duration> {
    (server == Link::Command).then(|| mostly_short(rng, Duration::from_millis(400), 4))
}

/// From `shortest` to twice `shortest * 2^doublings`; each number of doublings is equally likely.
fn mostly_short(rng: &mut Rng, shortest: Duration, doublings: u64) -> Duration {
    let least = shortest.saturating_mul(1 << rng.between(0, doublings));
    least + rng.up_to(least)
}

/// Maximum length of a fault, in pauses.
const MAX_PAUSES: u64 = 20;
/// One pause in this many is a long one.
const LONG_PAUSE_IN: u64 = 20;

fn pick<T>(rng: &mut Rng, all: impl Iterator<Item = T>) -> Option<T> {
    let mut all: Vec<T> = all.collect();
    let nth = rng.below(all.len() as u64) as usize;
    (nth < all.len()).then(|| all.swap_remove(nth))
}
