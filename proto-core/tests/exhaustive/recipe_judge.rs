//! What the gateway promises of a float and a bit by a recipe link, and of what it shows the device.

use proto_core::engine::{Input, LinkId, PortState};
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::Scalar;

use crate::driver::{AFTER_SLEEP, Broken, Conns, Is, Judge, PORT, Small};
use crate::recipe_cell::Way;
use crate::rig::var;
use crate::values::{Bits, Float, Instead};

pub const BIT: &str = "BitInputReg[3]";
/// What the controller's recipe frames bring.
pub const SHOWN: &str = "RobotState[26]";
pub const SAFE_BIT: u8 = 4;
/// By TCP, where nothing could be read back.
pub const SAFE_FLOAT: f32 = 0.5;
/// Places in the state packet.
pub const BITS_AT: usize = 1120;
pub const FLOATS_AT: usize = 832;
pub const OUTPUTS_AT: usize = 960;
const PACKET: usize = 1468;

/// How often the device is shown something by TCP; else each of its frames is answered.
pub const CYCLE: Duration = Duration::from_millis(200);
pub const STALE_AFTER: Duration = Duration::from_millis(300);
/// A value that was read back may be so old, and a controller whose frames are missing for longer is
/// away.
pub const LONGEST_AGE: Duration = Duration::from_millis(500);
const GREET_EVERY: Duration = Duration::from_millis(500);
const SPEAK_EVERY: Duration = Duration::from_secs(20);
const SILENCE: Duration = Duration::from_secs(2);
/// However short the timeout is, a frame has so long to be acknowledged.
const PATIENCE: Duration = Duration::from_millis(250);
const MOST_UNACKNOWLEDGED: usize = 64;
const REPEAT: Duration = Duration::from_millis(4);
const REPEAT_SLOWLY: Duration = Duration::from_millis(100);
pub const REPEAT_FAST_FOR: Duration = Duration::from_secs(1);

/// What is so.
#[derive(Debug, Clone)]
pub struct Facts {
    pub way: Way,
    pub is_up: bool,
    /// The device's newest frame.
    pub repeats: Option<u8>,
    slept_until: Option<Instant>,
    bits: Bits,
    float: Float,
    /// What the controller showed before there was a value of the bit's owner.
    bits_back: Option<u8>,
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
    /// Frames accepted, not finite, discarded after a sleep, and not passed on at once for what is not
    /// known; not part of the state.
    counted: [u32; 4],
}

impl Facts {
    pub fn new(way: Way) -> Self {
        Self {
            way,
            is_up: false,
            repeats: None,
            slept_until: None,
            bits: Bits::new(SAFE_BIT),
            float: Float::new(match way {
                Way::Udp | Way::UdpBoth => Instead::Shown,
                Way::Tcp => Instead::Safe(SAFE_FLOAT),
                Way::Held => Instead::Last,
            }),
            bits_back: None,
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
            counted: [0; 4],
        }
    }

    /// A frame of the device came whole, with both values or one of them.
    fn frame(&mut self, now: Instant, (float, bits): (Option<f32>, Option<u8>), conns: &Conns) {
        if self.slept_until.is_some() {
            self.counted[2] += 1;
            return;
        }
        if float.is_some_and(|value| !value.is_finite()) {
            self.counted[1] += 1;
            return;
        }
        self.counted[0] += 1;
        let is_reachable = conns.is_open(self.way.link());
        if let Some(bits) = bits {
            self.bits.received(bits, is_reachable, now);
            self.bits_back = None;
        }
        if let Some(value) = float {
            self.float.received(value, is_reachable, now);
        }
        self.counted[3] += u32::from(is_reachable && !self.is_ready(now));
        self.frame_at = Some(now);
        self.is_due |= self.way.answers();
    }

    fn packet(&mut self, now: Instant, bytes: &[u8]) {
        self.packet_by = Some(now + SILENCE);
        let float = |at| Some(float_at(bytes, at)).filter(|value| value.is_finite());
        let bits = (0..8).fold(0, |sum, bit| sum | bytes[BITS_AT + bit] << bit);
        self.bits.shown(bits, now);
        self.bits_back = Some(bits).filter(|_| self.bits.newest.is_none());
        if !self.float.is_live && self.way.has_neighbour() {
            self.float.read_back(float(FLOATS_AT));
        }
        self.neighbour = float(FLOATS_AT + 4).filter(|_| self.way.has_neighbour());
        self.packet_at = Some(now);
        if self.way == Way::Udp {
            self.source = float(OUTPUTS_AT);
            self.source_at = Some(now);
        }
    }

    fn recipe_frame(&mut self, now: Instant, bytes: &[u8]) {
        self.frame_by = (self.way == Way::Tcp).then_some(now + SILENCE);
        let was_away = self.source_at.is_some_and(|at| now.saturating_since(at) > LONGEST_AGE);
        if was_away {
            self.was_away(now);
        }
        self.source = Some(float_at(bytes, 2)).filter(|value| value.is_finite());
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
        let is_young = self.packet_at.is_some_and(|at| now.saturating_since(at) <= LONGEST_AGE);
        let is_bit_known = self.bits.newest.is_some() || self.bits_back.is_some() && is_young;
        let is_neighbour_known = !self.way.has_neighbour() || self.neighbour.is_some() && is_young;
        self.float.newest.is_some() && is_bit_known && is_neighbour_known
    }

    /// Its frames or packets tell that the controller is there; without both it can be another.
    fn look_for_controller(&mut self, now: Instant) {
        let is_missing = |at: Option<Instant>| at.is_none_or(|at| now.saturating_since(at) > LONGEST_AGE);
        if is_missing(self.packet_at) && is_missing(self.source_at) {
            self.float.controller_is_new();
        }
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
        self.look_for_controller(now);
        match *input {
            Input::Tick => self.slept_until = self.slept_until.filter(|&until| now < until),
            Input::PortBytes { bytes, .. } => {
                self.frame(now, (Some(float_at(bytes, 2)), Some(bytes[6])), conns);
            }
            Input::PortCan { frame, .. } => match *frame.data() {
                [bits] => self.frame(now, (None, Some(bits)), conns),
                _ => self.frame(now, (Some(float_at(frame.data(), 0)), None), conns),
            },
            Input::PortUp { .. } => self.is_up = true,
            Input::PortDown { .. } => (self.is_up, self.is_due) = (false, false),
            Input::LinkUp { link } => {
                self.was_away(now);
                if link == LinkId::STATE {
                    self.packet_by = Some(now + SILENCE);
                } else {
                    self.float.controller_is_new();
                    self.frame_by = (self.way == Way::Tcp).then_some(now + SILENCE);
                    self.greet_at = self.way.greets().then_some(now);
                    self.speak_at = self.greet_at;
                }
            }
            Input::LinkBytes { link, bytes } if conns.is_open(link) => match link {
                LinkId::STATE if bytes.len() > PACKET => {
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
        self.bits.deadlines(now);
        self.float.deadlines(now);
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
        if self.frame_by.is_some_and(|by| now >= by) {
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
        self.slept_until = Some(now + AFTER_SLEEP);
    }

    fn sent(&mut self, now: Instant, _: LinkId, bytes: &[u8], conns: &mut Conns) -> Result<Instant, Broken> {
        if self.way.greets() && bytes == [0] {
            let is_time = self.is_to_greet(now);
            self.greet_at = Some(now + GREET_EVERY);
            self.speak_at = Some(now + SPEAK_EVERY);
            return is_time.then_some(Instant::NEVER).ok_or("greets too soon".to_owned());
        }
        let (frame, neighbour) = match *bytes {
            [255, 255, a, b, c, d, bits, 238, 238] if !self.way.has_neighbour() => {
                (([a, b, c, d], bits), None)
            }
            [255, 255, a, b, c, d, bits, e, f, g, h, 238, 238] if self.way.has_neighbour() => {
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
        if self.way.has_neighbour() && neighbour != self.neighbour {
            return Err(format!("sends {neighbour:?} as the neighbour instead of {:?}", self.neighbour));
        }
        if self.bits.is_waiting() {
            self.bits.take(bits, now)?;
        } else if Some(bits) != self.bits.newest.or(self.bits_back) {
            return Err(format!("sends {bits} instead of {:?}", self.bits.newest.or(self.bits_back)));
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

    fn rested(
        &mut self,
        now: Instant,
        _: Instant,
        engine: &Small,
        conns: &Conns,
        is_late: bool,
    ) -> Result<(), Broken> {
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
        if self.way.shows() && known(SHOWN) != self.source.map(Scalar::Float) {
            return Err(format!("has {:?} instead of {:?}", known(SHOWN), self.source));
        }
        let state = match () {
            () if !self.is_up => PortState::Gone,
            () if self.bits.is_silent() || self.float.is_silent() => PortState::Silent,
            () => PortState::Working,
        };
        if engine.port_state(PORT) != Some(state) {
            return Err(format!("says that its port is {:?} instead of {state:?}", engine.port_state(PORT)));
        }
        let counters = engine.port_counters(PORT).ok_or("the port is missing")?;
        let rejected = counters.rejected_not_finite;
        let counted = [counters.frames_in, rejected, counters.asleep, counters.withheld];
        if counted != self.counted {
            return Err(format!("counts {counted:?} instead of {:?}", self.counted));
        }
        Ok(())
    }
}

fn float_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}
