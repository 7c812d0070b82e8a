//! Everything that can go wrong, at random and seeded: the faults of a soak run.
//!
//! A [`Trouble`] injects a fault now and then and ends it again after a while. Between two faults a
//! caller can inspect the cell as usual; at the end [`Trouble::mend`] ends all faults.

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
pub use kind::TroubleKind;
use recipe_config::CommandClients;
use recipe_controller::Link;

/// What ends a fault.
#[derive(Debug, Clone, Copy)]
enum Remedy {
    Admit(LinkId),
    Release(LinkId),
    Datagrams(LinkId),
    Ways(LinkId, [bool; 2]),
    Cable(Option<LinkId>),
    Unmute(Link),
    Answers(Link),
    NoException,
    ManyClients,
    Heal(SysVar),
    Quiet(LineId),
    Mend(LineId),
    PlugIn(LineId),
    MendBus(BusId),
    BusOn(BusId),
    Power,
    Dialect(&'static str),
    Wake,
}

/// Breaks and mends.
#[derive(Debug)]
pub struct Trouble {
    rng: Rng,
    kinds: Vec<TroubleKind>,
    pause: Duration,
    next: Instant,
    remedies: Vec<(Instant, TroubleKind, Remedy)>,
    counts: BTreeMap<TroubleKind, u64>,
    /// What the networks are like without faults.
    networks: BTreeMap<LinkId, Network>,
}

impl Trouble {
    /// Faults of these kinds, one per `pause` on average, from now on. A lasting fault lasts up to
    /// `pause`, an outage up to twenty times as long.
    pub fn new(cell: &mut Cell, kinds: &[TroubleKind], pause: Duration) -> Self {
        let mut trouble = Self {
            rng: cell.fork_rng(),
            kinds: kinds.to_vec(),
            pause,
            next: Instant::ZERO,
            remedies: Vec::new(),
            counts: BTreeMap::new(),
            networks: cell.networks(),
        };
        trouble.next = cell.now() + trouble.rng.up_to(pause.saturating_mul(2));
        trouble
    }

    /// Number of faults of each kind so far.
    pub fn counts(&self) -> &BTreeMap<TroubleKind, u64> {
        &self.counts
    }

    /// Advances time in the cell, with faults.
    pub fn run(&mut self, cell: &mut Cell, span: Duration) {
        let end = cell.now() + span;
        loop {
            let remedy = self.remedies.iter().map(|remedy| remedy.0).min().unwrap_or(Instant::NEVER);
            let next = self.next.min(remedy).min(end);
            cell.run(next.saturating_since(cell.now()));
            // After a violation time stops.
            if next >= end || cell.violation().is_some() {
                return;
            }
            self.poll(cell);
        }
    }

    /// Ends all present faults.
    pub fn mend(&mut self, cell: &mut Cell) {
        for (_, kind, remedy) in std::mem::take(&mut self.remedies) {
            cell.remark(format_args!("ends: {}", kind.name()));
            apply(cell, remedy, &self.networks);
        }
        cell.wake_gateway();
    }

    fn poll(&mut self, cell: &mut Cell) {
        let now = cell.now();
        while let Some(nth) = self.remedies.iter().position(|remedy| remedy.0 <= now) {
            let (_, kind, remedy) = self.remedies.remove(nth);
            cell.remark(format_args!("ends: {}", kind.name()));
            apply(cell, remedy, &self.networks);
        }
        if now >= self.next {
            // Now and then there are no faults for long enough that everything must work again.
            let pause = if self.rng.below(CALM) == 0 { 12 } else { 2 };
            self.next = now + Duration::from_micros(1) + self.rng.up_to(self.pause.saturating_mul(pause));
            if let Some(kind) = self.pick_kind()
                && self.begin(cell, kind).is_some()
            {
                *self.counts.entry(kind).or_default() += 1;
                cell.remark(format_args!("begins: {}", kind.name()));
            }
        }
    }

    fn pick_kind(&mut self) -> Option<TroubleKind> {
        let mut nth = self.rng.below(self.kinds.iter().map(|kind| kind.weight()).sum());
        self.kinds.iter().copied().find(|kind| {
            let is_it = nth < kind.weight();
            nth = nth.saturating_sub(kind.weight());
            is_it
        })
    }

    /// Injects a fault; `None` if the cell has nothing of this kind.
    fn begin(&mut self, cell: &mut Cell, kind: TroubleKind) -> Option<()> {
        let rng = &mut self.rng;
        let server = [Link::Command, Link::State, Link::Modbus][rng.below(3) as usize];
        let way = if rng.below(2) == 0 { Way::Up } else { Way::Down };
        let tcp: Vec<LinkId> = cell.tcp_links().collect();
        let mut tcp = || pick(rng, tcp.iter().copied());
        let mut lasts = None;
        let most = self.pause.saturating_mul(LONGEST);
        let remedy = match kind {
            TroubleKind::Refused => {
                let link = tcp()?;
                cell.refuse(link);
                cell.reset(link);
                Some(Remedy::Admit(link))
            }
            TroubleKind::BlackHole => {
                let link = tcp()?;
                cell.black_hole(link);
                cell.half_open(link);
                Some(Remedy::Admit(link))
            }
            TroubleKind::Reset => {
                cell.reset(tcp()?);
                None
            }
            TroubleKind::ResetMidPacket => {
                let link = tcp()?;
                cell.reset_after(link, way, rng.between(1, 2_000) as usize);
                None
            }
            TroubleKind::HalfOpen => {
                cell.half_open(tcp()?);
                None
            }
            TroubleKind::Stall => {
                let link = tcp()?;
                cell.hold(link, way);
                Some(Remedy::Release(link))
            }
            TroubleKind::Datagrams => {
                let link = pick(rng, cell.datagram_links())?;
                let network = cell.network(link);
                network.loss_ppm = rng.between(0, 500_000) as u32;
                network.duplicate_ppm = rng.between(0, 200_000) as u32;
                network.jitter = rng.up_to(Duration::from_millis(20));
                Some(Remedy::Datagrams(link))
            }
            TroubleKind::Burst => {
                let link = pick(rng, cell.datagram_links())?;
                lasts = Some(longer_and_rarer(rng, Duration::from_millis(50), 6).min(Duration::from_secs(5)));
                cut_ways(cell, link, rng.below(3))
            }
            TroubleKind::Unacknowledged => {
                let link = tcp()?;
                lasts = Some(longer_and_rarer(rng, Duration::from_millis(50), 6).min(Duration::from_secs(5)));
                cut_ways(cell, link, rng.below(2))
            }
            TroubleKind::Cable => {
                let link = pick(rng, cell.link_ids()).filter(|_| rng.below(2) == 0);
                lasts =
                    Some(longer_and_rarer(rng, Duration::from_millis(100), 7).min(Duration::from_secs(20)));
                cables(cell, link).into_iter().for_each(|link| cell.cut_cable(link));
                Some(Remedy::Cable(link))
            }
            TroubleKind::Stranger => {
                let links: Vec<(LinkId, Option<usize>)> = cell.listening_for_datagrams();
                let (link, frame) = pick(rng, links.into_iter())?;
                // Not as long as a frame: who sends frames is answered.
                let len = Some(rng.below(64) as usize).filter(|len| Some(*len) != frame).unwrap_or(100);
                let bytes = rng.bytes(len);
                cell.stranger_sends(link, &bytes);
                None
            }
            TroubleKind::Mute => {
                lasts = patience(rng, server);
                cell.ails(server);
                cell.controller_mut().mute(server);
                Some(Remedy::Unmute(server))
            }
            TroubleKind::SlowAnswers => {
                lasts = patience(rng, server);
                let delay = rng.up_to(lasts.unwrap_or(Duration::from_millis(1_500)));
                cell.ails(server);
                cell.controller_mut().delay_answers(server, delay);
                Some(Remedy::Answers(server))
            }
            TroubleKind::Exception => {
                let exceptions =
                    [Exception::DeviceFailure, Exception::DeviceBusy, Exception::IllegalDataAddress];
                let exception = pick(rng, exceptions.into_iter());
                cell.ails(Link::Modbus);
                cell.controller_mut().answer_modbus_with(exception);
                Some(Remedy::NoException)
            }
            TroubleKind::OneClient => {
                lasts = Some(longer_and_rarer(rng, Duration::from_millis(500), 5));
                let clients =
                    [CommandClients::RefuseSecond, CommandClients::DropFirst][rng.below(2) as usize];
                cell.controller_mut().command_clients(clients);
                Some(Remedy::ManyClients)
            }
            TroubleKind::HalfStatePacket => {
                let len = rng.between(0, 1_467) as usize;
                cell.controller_mut().cut_next_state_packet(len);
                None
            }
            TroubleKind::StateBytesLost => {
                cell.link_ids().find(|link| *link == LinkId::STATE)?;
                cell.lose_state_bytes(rng.between(1, 1_467) as usize);
                None
            }
            TroubleKind::Unreadable => {
                let var = pick(rng, cell.floats().into_iter())?;
                let value = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][rng.below(3) as usize];
                cell.spoil(var, value);
                Some(Remedy::Heal(var))
            }
            TroubleKind::Noise => {
                let line = pick(rng, cell.lines())?;
                cell.line(line).noise_ppm = rng.between(100, 100_000) as u32;
                Some(Remedy::Quiet(line))
            }
            TroubleKind::Garbage => {
                let line = pick(rng, cell.lines())?;
                let len = rng.between(1, 300) as usize;
                let bytes = rng.bytes(len);
                cell.send(line, &bytes);
                None
            }
            TroubleKind::Cut => match (pick(rng, cell.lines()), pick(rng, cell.buses())) {
                (Some(line), bus) if bus.is_none() || rng.below(2) == 0 => {
                    cell.cut(line);
                    Some(Remedy::Mend(line))
                }
                (_, bus) => {
                    let bus = bus?;
                    cell.cut_bus(bus);
                    Some(Remedy::MendBus(bus))
                }
            },
            TroubleKind::Unplugged => {
                let line = pick(rng, cell.lines())?;
                cell.unplug(line);
                Some(Remedy::PlugIn(line))
            }
            TroubleKind::BusOff => {
                let bus = pick(rng, cell.buses())?;
                cell.bus_off(bus);
                Some(Remedy::BusOn(bus))
            }
            TroubleKind::ControllerRestart => {
                cell.restart_controller();
                None
            }
            TroubleKind::PowerCut => {
                lasts = Some(longer_and_rarer(rng, Duration::from_millis(200), 4));
                cell.power_cut();
                Some(Remedy::Power)
            }
            TroubleKind::Dialect => {
                let before = cell.controller().dialect();
                // One at a time, or the remedies would bring back the wrong one.
                if self.remedies.iter().any(|(.., remedy)| matches!(remedy, Remedy::Dialect(_))) {
                    return None;
                }
                let others = Dialect::NAMES.into_iter().filter(|name| *name != before);
                cell.replace_controller(pick(rng, others)?);
                Some(Remedy::Dialect(before))
            }
            TroubleKind::GatewayRestart => {
                cell.restart_gateway();
                None
            }
            TroubleKind::GatewayStall => {
                let span = Duration::from_micros(rng.between(50_000, 499_999));
                lasts = Some(span);
                cell.stall_gateway(span);
                Some(Remedy::Wake)
            }
            TroubleKind::GatewaySleep => {
                let longest = Duration::from_secs(20);
                let shortest = Duration::from_millis(501);
                let span = longer_and_rarer(rng, shortest, 5).min(longest.min(most)).max(shortest);
                lasts = Some(span);
                cell.stall_gateway(span);
                Some(Remedy::Wake)
            }
        };
        if let Some(remedy) = remedy {
            let lasts = lasts.map_or_else(|| self.rng.up_to(self.pause), |lasts| lasts.min(most));
            let until = cell.now() + lasts;
            self.remedies.push((until, kind, remedy));
        }
        Some(())
    }
}

fn apply(cell: &mut Cell, remedy: Remedy, networks: &BTreeMap<LinkId, Network>) {
    match remedy {
        Remedy::Admit(link) => cell.admit(link),
        Remedy::Release(link) => {
            cell.release(link, Way::Up);
            cell.release(link, Way::Down);
        }
        Remedy::Datagrams(link) => *cell.network(link) = networks.get(&link).copied().unwrap_or_default(),
        Remedy::Ways(link, ways) => {
            for way in [Way::Up, Way::Down].into_iter().filter(|way| ways[*way as usize]) {
                cell.mend_way(link, way);
            }
        }
        Remedy::Cable(link) => cables(cell, link).into_iter().for_each(|link| cell.mend_cable(link)),
        Remedy::Unmute(server) => {
            cell.controller_mut().unmute(server);
            cell.recovers(server);
        }
        Remedy::Answers(server) => {
            cell.controller_mut().delay_answers(server, Duration::ZERO);
            cell.recovers(server);
        }
        Remedy::NoException => {
            cell.controller_mut().answer_modbus_with(None);
            cell.recovers(Link::Modbus);
        }
        Remedy::ManyClients => cell.controller_mut().command_clients(CommandClients::Many),
        Remedy::Heal(var) => cell.heal(var),
        Remedy::Quiet(line) => cell.line(line).noise_ppm = 0,
        Remedy::Mend(line) => cell.mend(line),
        Remedy::PlugIn(line) => cell.plug_in(line),
        Remedy::MendBus(bus) => cell.mend_bus(bus),
        Remedy::BusOn(bus) => cell.bus_on(bus),
        Remedy::Power => cell.power_up(),
        Remedy::Dialect(name) => cell.replace_controller(name),
        // One that is shorter ends by itself; another may have begun meanwhile.
        Remedy::Wake => {}
    }
}

/// The links that a cable is for.
fn cables(cell: &Cell, link: Option<LinkId>) -> Vec<LinkId> {
    link.map_or_else(|| cell.link_ids().collect(), |link| vec![link])
}

/// What goes up, what comes down, or both.
fn cut_ways(cell: &mut Cell, link: LinkId, which: u64) -> Option<Remedy> {
    let ways = [which != 1, which != 0];
    for way in [Way::Up, Way::Down].into_iter().filter(|way| ways[*way as usize]) {
        cell.cut_way(link, way);
    }
    Some(Remedy::Ways(link, ways))
}

/// Replies to commands are waited for for ten seconds; the other servers' faults last as most do.
fn patience(rng: &mut Rng, server: Link) -> Option<Duration> {
    (server == Link::Command).then(|| longer_and_rarer(rng, Duration::from_millis(400), 4))
}

/// From `shortest` to twice `shortest * 2^doublings`; each doubling is as likely as the one before.
fn longer_and_rarer(rng: &mut Rng, shortest: Duration, doublings: u64) -> Duration {
    let least = shortest.saturating_mul(1 << rng.between(0, doublings));
    least + rng.up_to(least)
}

/// No fault lasts longer than so many pauses.
const LONGEST: u64 = 20;
/// One pause of so many is a long one.
const CALM: u64 = 20;

fn pick<T>(rng: &mut Rng, all: impl Iterator<Item = T>) -> Option<T> {
    let mut all: Vec<T> = all.collect();
    let nth = rng.below(all.len() as u64) as usize;
    (nth < all.len()).then(|| all.swap_remove(nth))
}
