//! An RS-485 port with a float and a bit, which go to the controller over a recipe link; the device is
//! shown a float of the controller's and its own bit.

use proto_core::config::{Bus, GatewayConfig, InputBinding, OnStale, OutputBinding, Parts, SendOn};
use proto_core::engine::{Input, LinkId, PortId, PortState};
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::{Scalar, ScalarType};

use crate::driver::{Broken, Conns, Gateway, Is, Judge, PORT, Small};
use crate::rig::{Cell, user_in, user_out, var};
use crate::scribe::{LookBack, Scribe};
use crate::search::World;
use crate::values::{Bits, DOUBT, Float, TIMEOUT};

/// Which recipe link it is, and what is beside it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// UDP 2011 with a third variable, which is read back from the state stream, as is the bit.
    Udp,
    /// The same, and frames come back.
    UdpBoth,
    /// The controller's TCP client: nothing shows what it has, and frames come back.
    Tcp,
}

const FLOAT: &str = "FloatInputReg[1]";
const BIT: &str = "BitInputReg[3]";
/// A neighbour in the link's frame, which nobody here sends.
const NEIGHBOUR: &str = "FloatInputReg[2]";
const SAFE_BIT: u8 = 4;
const SAFE_FLOAT: f32 = 0.5;
/// The device's frames.
const FRAMES: [(f32, u8); 3] = [(1.0, 0), (2.0, 1), (f32::NAN, 1)];
/// The controller's state packets: bit, float, neighbour and what the device is shown.
const PACKETS: [(u8, [f32; 3]); 3] =
    [(0, [7.0, 5.0, 8.0]), (SAFE_BIT, [7.5, 5.5, 8.5]), (SAFE_BIT, [f32::NAN; 3])];
/// What the controller's own recipe frames show.
const SHOWN: [f32; 2] = [9.0, f32::INFINITY];
/// Places in the state packet.
const BITS_AT: usize = 1120;
const FLOATS_AT: usize = 832;
const OUTPUTS_AT: usize = 960;

const CYCLE: Duration = Duration::from_millis(200);
const STALE_AFTER: Duration = Duration::from_millis(300);
const READ_BACK_MAX_AGE: Duration = Duration::from_millis(500);
const AWAY_AFTER: Duration = Duration::from_millis(500);
const GREET_EVERY: Duration = Duration::from_millis(500);
const SPEAK_EVERY: Duration = Duration::from_secs(20);
const SILENCE: Duration = Duration::from_secs(2);
/// The device repeats a frame so often that it is never overdue.
const STEADY: Duration = Duration::from_millis(90);
const DEAF: Duration = Duration::from_millis(50);
/// However short the timeout is, a frame has so long to be acknowledged.
const PATIENCE: Duration = Duration::from_millis(250);
const MOST_UNACKNOWLEDGED: usize = 64;
const REPEAT: Duration = Duration::from_millis(4);
const REPEAT_SLOWLY: Duration = Duration::from_millis(100);
const REPEAT_FAST_FOR: Duration = Duration::from_secs(1);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// The device sends one of [`FRAMES`].
    Frame(u8),
    /// The device repeats its newest frame for a while, often enough, and the driver keeps its time.
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
    /// A recipe frame with one of [`SHOWN`] comes.
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

/// What is so.
#[derive(Debug, Clone)]
struct Facts {
    way: Way,
    is_up: bool,
    /// The device's newest frame.
    repeats: Option<u8>,
    deaf_until: Option<Instant>,
    bits: Bits,
    float: Float,
    /// As the controller showed it last, when that could be read.
    neighbour: Option<f32>,
    /// When it showed anything.
    packet_at: Option<Instant>,
    /// What the device is to be shown, and when it came.
    source: Option<f32>,
    source_at: Option<Instant>,
    /// When the device sent anything.
    frame_at: Option<Instant>,
    /// The device is to be sent something: an answer to its frame, or by TCP what is due each cycle.
    is_due: bool,
    cycle_at: Instant,
    /// When a safe value is sent again.
    repeat_at: Option<Instant>,
    /// When the controller is asked for its frames, and when it would forget who asked.
    greet_at: Option<Instant>,
    speak_at: Option<Instant>,
    /// Until when links that should talk may be silent.
    packet_by: Option<Instant>,
    frame_by: Option<Instant>,
    /// Frames accepted, not finite, and discarded after a sleep; not part of the state.
    counted: [u32; 3],
}

fn config(way: Way) -> GatewayConfig {
    let mut cell = Cell::new();
    let shown = if way == Way::Udp { "FloatOutputReg[1]" } else { "RobotState[26]" };
    let link = match way {
        Way::Udp => cell.stream(&[FLOAT, BIT, NEIGHBOUR], &[]),
        Way::UdpBoth => cell.stream(&[FLOAT, BIT, NEIGHBOUR], &[shown]),
        Way::Tcp => cell.stream(&[FLOAT, BIT], &[shown]),
    };
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
    cell.rs485(recipe);
    cell.last_port().timeout = TIMEOUT;
    cell.last_port().stale_after = STALE_AFTER;
    cell.last_port().cycle = CYCLE;
    cell.safe(BIT, f64::from(SAFE_BIT));
    match way {
        Way::Udp | Way::UdpBoth => cell.recipe_link(link),
        Way::Tcp => {
            cell.safe(FLOAT, f64::from(SAFE_FLOAT));
            let listen = heapless::String::try_from("0.0.0.0:50000").expect("short");
            cell.port(Bus::TcpListen { listen }, link);
        }
    }
    cell.0
}

impl Way {
    pub fn link(self) -> LinkId {
        if self == Way::Tcp { LinkId::of_port(PortId(1)) } else { LinkId::RECIPE_UDP }
    }

    fn has_state(self) -> bool {
        self != Way::Tcp
    }

    fn shows(self) -> bool {
        self != Way::Udp
    }

    fn greets(self) -> bool {
        self == Way::UdpBoth
    }
}

impl RecipeCell {
    pub fn new(way: Way, now: Instant) -> Self {
        let engine = Small::new(&config(way)).unwrap_or_else(|error| panic!("{error}: {error:?}"));
        let conns = match way {
            Way::Tcp => Conns::new(&[(way.link(), true)]),
            _ => Conns::new(&[(LinkId::STATE, false), (way.link(), false)]),
        };
        let judge = Facts {
            way,
            is_up: false,
            repeats: None,
            deaf_until: None,
            bits: Bits::new(SAFE_BIT),
            float: Float::new((way == Way::Tcp).then_some(SAFE_FLOAT)),
            neighbour: None,
            packet_at: None,
            source: None,
            source_at: None,
            frame_at: None,
            is_due: false,
            cycle_at: Instant::ZERO,
            repeat_at: None,
            greet_at: None,
            speak_at: None,
            packet_by: None,
            frame_by: None,
            counted: [0; 3],
        };
        Self { gateway: Gateway::new(engine, conns, now), judge }
    }

    /// The same after these events.
    #[track_caller]
    pub fn after(mut self, events: &[Event]) -> Self {
        for (nth, &event) in events.iter().enumerate() {
            assert!(self.events().contains(&event), "{event:?}, number {nth}, cannot happen");
            self.happen(event).unwrap_or_else(|broken| panic!("{event:?}, number {nth}: {broken}"));
        }
        self
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
        let (float, bits) = FRAMES[usize::from(nth)];
        if float.is_finite() {
            self.judge.repeats = Some(nth);
        }
        let [a, b, c, d] = float.to_le_bytes();
        self.tell(Input::PortBytes { port: PORT, bytes: &[255, 255, a, b, c, d, bits, 238, 238] })
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
        let [a, b, c, d] = SHOWN[usize::from(nth)].to_le_bytes();
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
        for nth in 0..FRAMES.len() {
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
        add(SleepLink, !judge.is_up || is_stated || is_shown);
        for conn in &gateway.conns.0 {
            add(Up(conn.link), conn.is == Is::Opening);
            add(Down(conn.link), matches!(conn.is, Is::Opening | Is::Open));
        }
        add(Taken, link.unsent);
        add(Acked, !link.unsent && !link.under_way.is_empty());
        add(AckedFirst, !link.unsent && link.under_way.len() > 1);
        for nth in 0..PACKETS.len() {
            add(State(nth as u8), is_stated);
        }
        add(Garbage, is_stated);
        for nth in 0..SHOWN.len() {
            add(Shown(nth as u8), is_shown);
        }
        add(Gone, judge.is_up);
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
        let look_back = LookBack {
            bits: TIMEOUT,
            stamps: READ_BACK_MAX_AGE,
            unconfirmed: REPEAT_FAST_FOR,
            confirmed: DOUBT,
        };
        let mut scribe = Scribe::new(self.gateway.now, 0, look_back, unique);
        self.gateway.describe(&mut scribe);
        scribe.describe(&self.judge);
        scribe.finish()
    }
}

impl Facts {
    /// A frame of the device came whole.
    fn frame(&mut self, now: Instant, bytes: &[u8], conns: &Conns) {
        if self.deaf_until.is_some() {
            self.counted[2] += 1;
            return;
        }
        let value = f32::from_le_bytes(bytes[2..6].try_into().expect("four bytes"));
        if !value.is_finite() {
            self.counted[1] += 1;
            return;
        }
        self.counted[0] += 1;
        let is_reachable = conns.is_open(self.way.link());
        self.bits.received(bytes[6], is_reachable, now);
        self.float.received(value, is_reachable);
        self.frame_at = Some(now);
        self.is_due |= self.way != Way::Tcp;
    }

    fn packet(&mut self, now: Instant, bytes: &[u8]) {
        self.packet_by = Some(now + SILENCE);
        let float = |at: usize| {
            let value = f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
            Some(value).filter(|value| value.is_finite())
        };
        let bits = (0..8).fold(0, |sum, bit| sum | bytes[BITS_AT + bit] << bit);
        self.bits.shown(bits, now);
        if !self.float.is_live {
            self.float.read_back(float(FLOATS_AT));
        }
        self.neighbour = float(FLOATS_AT + 4);
        self.packet_at = Some(now);
        if self.way == Way::Udp {
            self.source = float(OUTPUTS_AT);
            self.source_at = Some(now);
        }
    }

    fn recipe_frame(&mut self, now: Instant, bytes: &[u8]) {
        self.frame_by = Some(now + SILENCE);
        let was_away = self.source_at.is_some_and(|at| now.saturating_since(at) > AWAY_AFTER);
        if was_away {
            self.was_away(now);
        }
        let value = f32::from_le_bytes(bytes[2..6].try_into().expect("four bytes"));
        self.source = Some(value).filter(|value| value.is_finite());
        self.source_at = Some(now);
        if self.way.greets() {
            self.greet_at = Some(now + GREET_EVERY);
        }
    }

    /// The controller may have started anew.
    fn was_away(&mut self, now: Instant) {
        self.bits.controller_was_away(now);
        self.float.again(self.bits.is_safe());
    }

    /// Whether every variable of a frame to the controller is known.
    fn is_ready(&self, now: Instant) -> bool {
        let is_young = self.packet_at.is_some_and(|at| now.saturating_since(at) <= READ_BACK_MAX_AGE);
        let is_float_known = self.float.is_live || self.float.newest.is_some() && is_young;
        is_float_known && (self.way == Way::Tcp || self.neighbour.is_some() && is_young)
    }

    fn is_to_greet(&self, now: Instant) -> bool {
        self.greet_at.into_iter().chain(self.speak_at).any(|at| now >= at)
    }

    fn is_waiting(&self) -> bool {
        self.bits.is_waiting() || self.float.is_waiting()
    }

    /// What the device may be shown: the controller's value and its own, when both are young.
    fn showable(&self, now: Instant) -> Option<(f32, u8)> {
        let is_young = |at: Option<Instant>| at.is_some_and(|at| now.saturating_since(at) <= STALE_AFTER);
        let shown = self.source.zip(self.bits.newest);
        shown.filter(|_| is_young(self.source_at) && is_young(self.frame_at))
    }
}

impl Judge for Facts {
    fn told(&mut self, now: Instant, input: &Input<'_>, conns: &mut Conns) {
        match *input {
            Input::Tick => self.deaf_until = self.deaf_until.filter(|&until| now < until),
            Input::PortBytes { bytes, .. } => self.frame(now, bytes, conns),
            Input::PortUp { .. } => self.is_up = true,
            Input::PortDown { .. } => (self.is_up, self.is_due) = (false, false),
            Input::LinkUp { link } => {
                self.was_away(now);
                if link == LinkId::STATE {
                    self.packet_by = Some(now + SILENCE);
                } else {
                    self.frame_by = Some(now + SILENCE);
                    self.greet_at = self.way.greets().then_some(now);
                    self.speak_at = self.greet_at;
                }
            }
            Input::LinkBytes { link, bytes } if conns.is_open(link) => match link {
                LinkId::STATE if bytes.len() > 1468 => {
                    conns.must_close(now, link);
                    self.lost(now, link);
                }
                LinkId::STATE => self.packet(now, bytes),
                _ => self.recipe_frame(now, bytes),
            },
            _ => {}
        }
    }

    fn down(&mut self, _: Instant, _: LinkId, _: Is, _: &mut Conns) {}

    fn deadlines(&mut self, now: Instant, conns: &mut Conns) -> Result<(), Broken> {
        if self.bits.deadlines(now) {
            self.float.overdue();
        }
        if self.way == Way::Tcp && now >= self.cycle_at {
            let cycle = CYCLE.as_micros();
            self.cycle_at = Instant::from_micros((now.as_micros() / cycle + 1) * cycle);
            self.is_due |= self.is_up;
        }
        for link in conns.overdue(now).into_iter().chain(conns.not_opened(now)) {
            conns.must_close(now, link);
            self.lost(now, link);
        }
        let link = self.way.link();
        if self.repeat_at.take_if(|at| now >= *at).is_some()
            && let Some(since) = self.bits.unconfirmed_since
        {
            self.bits.again();
            self.float.again(true);
            // The state stream would show it.
            let is_fast = self.way.has_state() || now.saturating_since(since) < REPEAT_FAST_FOR;
            self.repeat_at = Some(now + if is_fast { REPEAT } else { REPEAT_SLOWLY });
        }
        if self.packet_by.is_some_and(|by| now >= by) {
            conns.must_close(now, LinkId::STATE);
            self.lost(now, LinkId::STATE);
        }
        if self.way == Way::Tcp && self.frame_by.is_some_and(|by| now >= by) {
            conns.must_close(now, link);
            self.lost(now, link);
        }
        Ok(())
    }

    fn lost(&mut self, _: Instant, link: LinkId) {
        if link == LinkId::STATE {
            self.packet_by = None;
            return;
        }
        self.bits.lost();
        self.float.lost(self.bits.is_safe());
        (self.repeat_at, self.greet_at, self.speak_at, self.frame_by) = (None, None, None, None);
    }

    fn slept(&mut self, now: Instant) {
        self.is_due = false;
        self.deaf_until = Some(now + DEAF);
    }

    fn sent(&mut self, now: Instant, _: LinkId, bytes: &[u8], conns: &mut Conns) -> Result<Instant, Broken> {
        if self.way.greets() && bytes == [0] {
            let is_time = self.is_to_greet(now);
            self.greet_at = Some(now + GREET_EVERY);
            self.speak_at = Some(now + SPEAK_EVERY);
            return is_time.then_some(Instant::NEVER).ok_or("greets too soon".to_owned());
        }
        let (frame, neighbour) = match *bytes {
            [255, 255, a, b, c, d, bits, 238, 238] if self.way == Way::Tcp => (([a, b, c, d], bits), None),
            [255, 255, a, b, c, d, bits, e, f, g, h, 238, 238] if self.way != Way::Tcp => {
                (([a, b, c, d], bits), Some(f32::from_le_bytes([e, f, g, h])))
            }
            _ => return Err(format!("sends {bytes:?}")),
        };
        let (float, bits) = (f32::from_le_bytes(frame.0), frame.1);
        if !self.is_waiting() {
            return Err(format!("sends {float} and {bits}, and nothing is new"));
        }
        if !self.is_ready(now) {
            return Err(format!("sends {float}, {bits} and {neighbour:?}, and not all of it is known"));
        }
        if conns.of(self.way.link()).under_way.len() >= MOST_UNACKNOWLEDGED {
            return Err("sends more than may be unacknowledged".to_owned());
        }
        if Some(float) != self.float.newest {
            return Err(format!("sends {float} instead of {:?}", self.float.newest));
        }
        if self.way != Way::Tcp && neighbour != self.neighbour {
            return Err(format!("sends {neighbour:?} as the neighbour instead of {:?}", self.neighbour));
        }
        if self.bits.is_waiting() {
            self.bits.take(bits, now)?;
        } else if Some(bits) != self.bits.newest {
            return Err(format!("sends {bits} instead of {:?}", self.bits.newest));
        }
        self.float.taken();
        if let Some(since) = self.bits.unconfirmed_since
            && (self.repeat_at.is_none() || now.saturating_since(since) < REPEAT_FAST_FOR)
        {
            let next = now + REPEAT;
            self.repeat_at = Some(self.repeat_at.map_or(next, |at| at.min(next)));
        }
        if let Some(greet_at) = &mut self.greet_at {
            *greet_at = (*greet_at).max(now + GREET_EVERY);
            self.speak_at = Some(now + SPEAK_EVERY);
        }
        Ok(now + PATIENCE)
    }

    fn shown(&mut self, now: Instant, bytes: &[u8]) -> Result<(), Broken> {
        let [255, 255, a, b, c, d, bits, 254, 254] = *bytes else {
            return Err(format!("sends {bytes:?} to the field"));
        };
        let shown = (f32::from_le_bytes([a, b, c, d]), bits);
        if !std::mem::take(&mut self.is_due) {
            return Err("sends to the field what is not due".to_owned());
        }
        if Some(shown) != self.showable(now) {
            return Err(format!("shows the device {shown:?} instead of {:?}", self.showable(now)));
        }
        Ok(())
    }

    fn rested(&mut self, now: Instant, engine: &Small, conns: &Conns, is_late: bool) -> Result<(), Broken> {
        let link = conns.of(self.way.link());
        if !is_late {
            let is_free = link.is_free() && link.under_way.len() < MOST_UNACKNOWLEDGED;
            if self.is_waiting() && is_free && self.is_ready(now) {
                return Err("lets a value wait though the link is free".to_owned());
            }
            if self.is_to_greet(now) && is_free {
                return Err("does not greet".to_owned());
            }
            if std::mem::take(&mut self.is_due) && self.showable(now).is_some() {
                return Err("shows the device nothing".to_owned());
            }
        }
        let image = engine.image();
        let known = |name| image.is_known(var(name)).then(|| image.value(var(name)));
        if known(BIT) != self.bits.newest.map(Scalar::Byte) {
            return Err(format!("has {:?} instead of {:?}", known(BIT), self.bits.newest));
        }
        let state = match () {
            () if !self.is_up => PortState::Gone,
            () if self.bits.is_silent() => PortState::Silent,
            () => PortState::Working,
        };
        if engine.port_state(PORT) != Some(state) {
            return Err(format!("says that its port is {:?} instead of {state:?}", engine.port_state(PORT)));
        }
        let counters = engine.port_counters(PORT).ok_or("the port is missing")?;
        let counted = [counters.frames_in, counters.rejected_not_finite, counters.asleep];
        if counted != self.counted {
            return Err(format!("counts {counted:?} instead of {:?}", self.counted));
        }
        Ok(())
    }
}
