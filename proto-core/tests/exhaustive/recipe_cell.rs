//! A port with a float and a bit, which go to the controller over a recipe link. By RS-485 both come in
//! one frame, and the device is shown a float of the controller's and its own bit; by CAN each comes in a
//! frame of its own, so that one can be missing beside the other.

use proto_core::config::{Bus, GatewayConfig, InputBinding, OnStale, OutputBinding, Parts, SendOn};
use proto_core::engine::{Input, LinkId, PortId};
use proto_core::recipe::model::Mode;
use proto_core::time::Instant;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType;

use crate::driver::{Broken, Conns, Gateway, Is, PORT, STEADY, Small};
use crate::recipe_judge::{
    BIT, BITS_AT, CYCLE, FLOATS_AT, Facts, LONGEST_AGE, OUTPUTS_AT, REPEAT_FAST_FOR, SAFE_BIT, SAFE_FLOAT,
    SHOWN, STALE_AFTER,
};
use crate::rig::{Cell, user_in, user_out, var};
use crate::scribe::{LookBack, Scribe};
use crate::search::World;
use crate::values::{DOUBT, TIMEOUT};

/// Which recipe link it is, and what is beside it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// UDP 2011 with a third variable, which is read back from the state stream, as is the bit.
    Udp,
    /// The same, and frames come back.
    UdpBoth,
    /// The controller's TCP client: nothing shows what it has, and frames come back.
    Tcp,
    /// UDP 2011 and frames back: a float that nothing shows is held while the controller is there. The
    /// bit is read back from the state stream.
    Held,
}

const FLOAT: &str = "FloatInputReg[1]";
/// One that cannot be read back.
const FORCE: &str = "ForceEnd[1]";
/// A neighbour in the link's frame, which nobody here sends.
const NEIGHBOUR: &str = "FloatInputReg[2]";
/// The device's frames: by RS-485 with both values, by CAN with one.
const FRAMES: [(Option<f32>, Option<u8>); 3] =
    [(Some(1.0), Some(0)), (Some(2.0), Some(1)), (Some(f32::NAN), Some(1))];
const CAN_FRAMES: [(Option<f32>, Option<u8>); 4] =
    [(Some(1.0), None), (None, Some(1)), (None, Some(0)), (Some(f32::NAN), None)];
/// The controller's state packets: bit, float, neighbour and what the device is shown.
const PACKETS: [(u8, [f32; 3]); 3] =
    [(0, [7.0, 5.0, 8.0]), (SAFE_BIT, [7.5, 5.5, 8.5]), (SAFE_BIT, [f32::NAN; 3])];
/// What the controller's own recipe frames show.
const VALUES: [f32; 2] = [9.0, f32::INFINITY];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// The device sends one of its frames.
    Frame(u8),
    /// The device repeats its newest frame with the bit for a while, often enough, and the driver keeps its
    /// time.
    Steady,
    /// The engine is called when it wants to be.
    Tick,
    /// That instant comes, and the driver has something else to tell first.
    Late,
    /// The driver is late, but not so late that it was asleep.
    Step,
    /// The gateway was asleep; the driver finds a frame first, or what a link brought.
    SleepPort,
    SleepLink,
    Up(LinkId),
    Down(LinkId),
    Taken,
    /// All of what is under way is acknowledged, or only the first of it.
    Acked,
    AckedFirst,
    /// One of [`PACKETS`] comes.
    State(u8),
    /// Three packets come that are out of step.
    Garbage,
    /// A recipe frame with one of [`VALUES`] comes.
    Shown(u8),
    Gone,
    Back,
}
use Event::*;

#[derive(Debug, Clone)]
pub struct RecipeCell {
    gateway: Gateway,
    judge: Facts,
}

fn config(way: Way) -> GatewayConfig {
    let mut cell = Cell::new();
    let shown = if way == Way::Udp { "FloatOutputReg[1]" } else { SHOWN };
    let link = match way {
        Way::Udp => cell.stream(&[FLOAT, BIT, NEIGHBOUR], &[]),
        Way::UdpBoth => cell.stream(&[FLOAT, BIT, NEIGHBOUR], &[shown]),
        Way::Tcp => cell.stream(&[FLOAT, BIT], &[shown]),
        Way::Held => cell.stream(&[FORCE, BIT], &[shown]),
    };
    if way == Way::Held {
        let recipe = cell.can(&[(1, &[FORCE]), (2, &[BIT])], &[]);
        cell.can_port(recipe);
    } else {
        let recipe = both(&mut cell, way, shown);
        cell.rs485(recipe);
    }
    cell.last_port().timeout = TIMEOUT;
    cell.last_port().stale_after = STALE_AFTER;
    cell.last_port().cycle = CYCLE;
    cell.safe(BIT, f64::from(SAFE_BIT));
    match way {
        Way::Udp | Way::UdpBoth | Way::Held => cell.recipe_link(link),
        Way::Tcp => {
            cell.safe(FLOAT, f64::from(SAFE_FLOAT));
            let listen = heapless::String::try_from("0.0.0.0:50000").expect("short");
            cell.port(Bus::TcpListen { listen }, link);
        }
    }
    cell.0
}

/// The recipe of the port that has both values in one frame.
fn both(cell: &mut Cell, way: Way, shown: &str) -> u8 {
    let bound = |name| InputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 };
    let fields = [user_in(ScalarType::Float, bound(FLOAT)), user_in(ScalarType::Byte, bound(BIT))];
    let fields = cell.fields(fields);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let from = OutputBinding::Variable { var: var(shown), scale: 1.0, offset: 0.0 };
    let own = OutputBinding::Variable { var: var(BIT), scale: 1.0, offset: 0.0 };
    let fields = [user_out(ScalarType::Float, from), user_out(ScalarType::Byte, own)];
    let fields = cell.fields(fields);
    let output = cell.part(&[255, 255], &[254, 254], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output });
    cell.last_recipe().on_stale = OnStale::Stop;
    if way != Way::Tcp {
        cell.last_recipe().send = SendOn::Frame;
    }
    recipe
}

impl Way {
    pub fn link(self) -> LinkId {
        if self == Way::Tcp { LinkId::of_port(PortId(1)) } else { LinkId::RECIPE_UDP }
    }

    pub fn has_state(self) -> bool {
        self != Way::Tcp
    }

    /// Whether the state stream brings the float, and another one beside it.
    pub fn has_neighbour(self) -> bool {
        matches!(self, Way::Udp | Way::UdpBoth)
    }

    pub fn shows(self) -> bool {
        self != Way::Udp
    }

    pub fn greets(self) -> bool {
        matches!(self, Way::UdpBoth | Way::Held)
    }

    /// Whether each of the device's frames is answered.
    pub fn answers(self) -> bool {
        matches!(self, Way::Udp | Way::UdpBoth)
    }

    fn frames(self) -> &'static [(Option<f32>, Option<u8>)] {
        if self == Way::Held { &CAN_FRAMES } else { &FRAMES }
    }
}

impl RecipeCell {
    pub fn new(way: Way, now: Instant) -> Self {
        let engine = Small::new(&config(way)).unwrap_or_else(|error| panic!("{error}: {error:?}"));
        let conns = match way {
            Way::Tcp => Conns::new(&[(way.link(), true)]),
            _ => Conns::new(&[(LinkId::STATE, false), (way.link(), false)]),
        };
        let judge = Facts::new(way);
        Self { gateway: Gateway::new(engine, conns, now), judge }
    }

    fn steady(&mut self) -> Result<(), Broken> {
        let nth = self.judge.repeats.expect("the device has sent something");
        for _ in 0..5 {
            let next = self.gateway.now + STEADY;
            while self.gateway.until < next {
                self.gateway.wait_until_due();
                self.tell(Input::Tick)?;
            }
            self.gateway.now = next;
            self.frame(nth)?;
        }
        self.tell(Input::Tick)
    }

    fn tell(&mut self, input: Input<'_>) -> Result<(), Broken> {
        self.gateway.tell(input, &mut self.judge)
    }

    fn frame(&mut self, nth: u8) -> Result<(), Broken> {
        let (float, bits) = self.judge.way.frames()[usize::from(nth)];
        // The held float's owner is not the one that goes on.
        if float.is_none_or(f32::is_finite) && bits.is_some() {
            self.judge.repeats = Some(nth);
        }
        let float = float.map(f32::to_le_bytes);
        if let (Some([a, b, c, d]), Some(bits)) = (float, bits) {
            let bytes = [255, 255, a, b, c, d, bits, 238, 238];
            return self.tell(Input::PortBytes { port: PORT, bytes: &bytes });
        }
        let id = CanId::Standard(if float.is_some() { 1 } else { 2 });
        let data = float.as_ref().map_or(bits.as_slice(), |float| float.as_slice());
        let frame = CanFrame::new(id, data).expect("short");
        self.tell(Input::PortCan { port: PORT, frame })
    }

    fn state(&mut self, nth: u8) -> Result<(), Broken> {
        let (bits, floats) = PACKETS[usize::from(nth)];
        let mut packet = [0; 1468];
        packet[BITS_AT..][..8].copy_from_slice(&std::array::from_fn::<u8, 8, _>(|bit| bits >> bit & 1));
        for (at, value) in [FLOATS_AT, FLOATS_AT + 4, OUTPUTS_AT].into_iter().zip(floats) {
            packet[at..][..4].copy_from_slice(&value.to_le_bytes());
        }
        self.tell(Input::LinkBytes { link: LinkId::STATE, bytes: &packet })
    }

    fn shown(&mut self, nth: u8) -> Result<(), Broken> {
        let [a, b, c, d] = VALUES[usize::from(nth)].to_le_bytes();
        let bytes = [255, 255, a, b, c, d, 254, 254];
        self.tell(Input::LinkBytes { link: self.judge.way.link(), bytes: &bytes })
    }
}

impl World for RecipeCell {
    type Event = Event;

    fn events(&self) -> Vec<Event> {
        let (gateway, judge) = (&self.gateway, &self.judge);
        let mut events = Vec::with_capacity(32);
        let mut add = |event, is_possible: bool| {
            if is_possible {
                events.push(event);
            }
        };
        for nth in 0..judge.way.frames().len() {
            add(Frame(nth as u8), judge.is_up);
        }
        add(Steady, judge.is_up && judge.repeats.is_some());
        add(Tick, true);
        add(Late, !gateway.is_late());
        add(Step, true);
        add(SleepPort, judge.is_up);
        let link = gateway.conns.of(judge.way.link());
        let is_stated = judge.way.has_state() && gateway.conns.is_open(LinkId::STATE);
        let is_shown = judge.way.shows() && link.is == Is::Open;
        // What has nothing to do with held values is left to the other cells.
        let is_held = judge.way == Way::Held;
        add(SleepLink, !judge.is_up || is_stated || is_shown);
        for conn in &gateway.conns.0 {
            add(Up(conn.link), conn.is == Is::Opening);
            add(Down(conn.link), matches!(conn.is, Is::Opening | Is::Open));
        }
        add(Taken, link.unsent);
        add(Acked, !link.unsent && !link.under_way.is_empty());
        add(AckedFirst, !link.unsent && link.under_way.len() > 1);
        for (nth, (_, floats)) in PACKETS.iter().enumerate() {
            let is_for_floats = floats.iter().any(|float| float.is_nan());
            add(State(nth as u8), is_stated && !(is_for_floats && is_held));
        }
        add(Garbage, is_stated && !is_held);
        for nth in 0..VALUES.len() {
            add(Shown(nth as u8), is_shown);
        }
        add(Gone, judge.is_up && !is_held);
        add(Back, !judge.is_up);
        events
    }

    fn happen(&mut self, event: Event) -> Result<(), Broken> {
        let (port, link) = (PORT, self.judge.way.link());
        match event {
            Frame(nth) => self.frame(nth),
            Steady => self.steady(),
            Tick => {
                self.gateway.wait_until_due();
                self.tell(Input::Tick)
            }
            Late => {
                self.gateway.wait_until_due();
                Ok(())
            }
            Step => {
                self.gateway.step();
                self.tell(Input::Tick)
            }
            SleepPort => {
                self.gateway.sleep();
                self.frame(1)?;
                self.tell(Input::Tick)
            }
            SleepLink => {
                self.gateway.sleep();
                if self.judge.way.has_state() && self.gateway.conns.is_open(LinkId::STATE) {
                    self.state(1)?;
                } else if self.judge.way.shows() && self.gateway.conns.is_open(link) {
                    self.shown(0)?;
                }
                self.tell(Input::Tick)
            }
            Up(link) => self.tell(Input::LinkUp { link }),
            Down(link) => self.tell(Input::LinkDown { link }),
            Taken => self.tell(Input::LinkSent { link }),
            Acked => self.tell(Input::LinkAcked { link, left: 0 }),
            AckedFirst => {
                let left = self.gateway.conns.of(link).all_but_first();
                self.tell(Input::LinkAcked { link, left })
            }
            Garbage => self.tell(Input::LinkBytes { link: LinkId::STATE, bytes: &[255; 3 * 1468] }),
            State(nth) => self.state(nth),
            Shown(nth) => self.shown(nth),
            Gone => self.tell(Input::PortDown { port }),
            Back => self.tell(Input::PortUp { port }),
        }
    }

    fn fingerprint(&self, unique: u64) -> u64 {
        let look_back =
            LookBack { bits: TIMEOUT, stamps: LONGEST_AGE, unconfirmed: REPEAT_FAST_FOR, confirmed: DOUBT };
        let mut scribe = Scribe::new(self.gateway.now, 0, look_back, unique);
        self.gateway.describe(&mut scribe);
        scribe.describe(&self.judge);
        scribe.finish()
    }
}
