//! How long frames take on a line, and warnings about configurations that are valid but may not work as intended.
//!
//! In: a configuration. Out: times, and [`Warning`]s. Refuses nothing.

use core::fmt;

use super::describe::{PortName, RecipeName, one_based};
use super::{Bus, ConfigView, Echo, Exchange, FieldSpec, Parity, Parts, Port, Rs485, Span, Transaction};
use crate::modbus::rtu::{self, Slave, Timing};
use crate::sysvar::{Direction, SysVar};
use crate::time::Duration;
use crate::wire::can::CanId;

impl Rs485 {
    /// Bits of one character: start bit, data bits, parity and stop bits.
    pub fn bits_per_character(&self) -> u64 {
        let parity = u64::from(self.parity != Parity::None);
        9_u64.saturating_add(parity).saturating_add(u64::from(self.stop_bits))
    }

    /// The time that `len` bytes take on the line, rounded up to the microsecond.
    pub fn time_on_line(&self, len: usize) -> Duration {
        bits_time((len as u64).saturating_mul(self.bits_per_character()), self.baud)
    }

    /// A Modbus slave on this line; `None` if the address is invalid.
    pub(crate) fn slave(&self, address: u8) -> Option<Slave> {
        let timing = Timing::new(self.baud, self.bits_per_character() as u8).with_silence(self.idle_gap);
        let echo = if self.echo == Echo::Yes { rtu::Echo::Heard } else { rtu::Echo::Absent };
        Slave::new(timing, echo, address)
    }

    /// The time that `n` + 0.5 characters take on the line.
    pub(crate) fn characters_and_a_half(&self, n: u64) -> Duration {
        let half_bits = n.saturating_mul(2).saturating_add(1).saturating_mul(self.bits_per_character());
        bits_time(half_bits, self.baud.saturating_mul(2))
    }
}

/// The time of a data frame with `len` bytes on a CAN bus, for worst-case bit stuffing and including the interframe
/// space.
pub fn can_frame_time(id: CanId, len: usize, bitrate: u32) -> Duration {
    let data = (len as u64).saturating_mul(8);
    // Bits that are subject to stuffing, and bits that are not (delimiters, end, space).
    let (stuffed, fixed) = match id {
        CanId::Standard(_) => (data.saturating_add(34), 13_u64),
        CanId::Extended(_) => (data.saturating_add(54), 13_u64),
    };
    let stuff = stuffed.saturating_sub(1) / 4;
    bits_time(stuffed.saturating_add(fixed).saturating_add(stuff), bitrate)
}

fn bits_time(bits: u64, per_second: u32) -> Duration {
    Duration::from_micros(bits.saturating_mul(1_000_000).div_ceil(u64::from(per_second.max(1))))
}

/// Line usage of one part of a port's recipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PartBudget {
    /// Frames: 1 in a stream part.
    pub frames: usize,
    /// Maximum number of bytes of all frames, including heads, tails and escape bytes; on CAN, of their data.
    pub bytes: usize,
    /// Time of all frames on the line; zero if there is no line.
    pub time: Duration,
}

impl<'c> ConfigView<'c> {
    /// Line usage of one part of the port's recipe; `None` if the recipe has no such part.
    pub fn budget(self, port: &Port, part: Direction) -> Option<PartBudget> {
        let recipe = self.recipes.get(usize::from(port.recipe))?;
        let bytes_of =
            |span: Span| span.of(self.fields).iter().map(FieldSpec::longest).fold(0, usize::saturating_add);
        match &recipe.parts {
            Parts::Stream { input, output } => {
                let part = if part == Direction::Input { input } else { output }.as_ref()?;
                let bytes =
                    bytes_of(part.fields).saturating_add(part.head.len()).saturating_add(part.tail.len());
                let bytes = part.escape.map_or(bytes, |escape| escape.longest(bytes));
                let time = match &port.bus {
                    Bus::Rs485(line) => line.time_on_line(bytes),
                    _ => Duration::ZERO,
                };
                Some(PartBudget { frames: 1, bytes, time })
            }
            Parts::Can { input, output } => {
                let frames = if part == Direction::Input { input } else { output };
                let mut budget = PartBudget { frames: frames.len(), ..PartBudget::default() };
                for frame in frames {
                    let bytes = bytes_of(frame.fields);
                    budget.bytes = budget.bytes.saturating_add(bytes);
                    if let Bus::Can { bitrate } = port.bus {
                        budget.time = budget.time + can_frame_time(frame.id, bytes, bitrate);
                    }
                }
                (budget.frames > 0).then_some(budget)
            }
        }
    }

    /// The shortest cycle in which the port's output fits its line (D20), including the turnaround on RS-485.
    pub(crate) fn shortest_cycle(self, port: &Port) -> Duration {
        let time = self.budget(port, Direction::Output).map_or(Duration::ZERO, |budget| budget.time);
        match &port.bus {
            Bus::Rs485(line) if time > Duration::ZERO => time + line.turnaround,
            _ => time,
        }
    }

    /// Warnings about settings that are valid but may not work as intended.
    pub fn warnings(self) -> impl Iterator<Item = Warning> + 'c {
        let lines = self.slow_ports().chain(self.exchanges());
        lines.chain(self.advice()).chain(self.read_back()).chain(self.unused_recipes())
    }

    fn slow_ports(self) -> impl Iterator<Item = Warning> + 'c {
        (0..).zip(self.ports).filter_map(move |(port, config)| {
            let shortest = self.shortest_cycle(config);
            (shortest > config.cycle).then_some(Warning::DoesNotFit { port, cycle: config.cycle, shortest })
        })
    }

    /// Warnings about exchanges of a port that are too frequent or too rare.
    fn exchanges(self) -> impl Iterator<Item = Warning> + 'c {
        (0..).zip(self.ports).flat_map(move |(port, config)| {
            let percent = self.line_share(config).filter(|percent| *percent > 100);
            let every = self.slowest_reply(config).filter(|every| *every >= config.timeout);
            let full = percent.map(|percent| Warning::LineFull { port, percent });
            let rare = every.map(|every| Warning::AskedRarely { port, timeout: config.timeout, every });
            full.into_iter().chain(rare)
        })
    }

    fn read_back(self) -> impl Iterator<Item = Warning> + 'c {
        self.upstream_recipes().flat_map(move |(index, recipe)| {
            self.written_by(recipe)
                .filter(move |&var| !self.is_owned(var))
                .map(move |var| Warning::ReadBack { recipe: index, var })
        })
    }

    fn unused_recipes(self) -> impl Iterator<Item = Warning> + 'c {
        let is_used = move |index: u8| {
            self.ports.iter().any(|port| port.recipe == index)
                || self.controller.recipe_link.is_some_and(|link| link.recipe == index)
        };
        (0..)
            .zip(self.recipes)
            .filter_map(move |(recipe, _)| (!is_used(recipe)).then_some(Warning::Unused { recipe }))
    }

    /// Whether the gateway serves the recipe's exchanges as a slave.
    fn is_slave(self, recipe: u8) -> bool {
        let recipe = self.recipes.get(usize::from(recipe));
        recipe.is_some_and(|recipe| self.exchanges_of(recipe).iter().any(Exchange::is_served))
    }

    /// `warning` with the names of its recipes and ports.
    pub fn describe_warning(self, warning: Warning) -> impl fmt::Display + 'c {
        DescribedWarning { config: self, warning }
    }
}

/// A setting that is valid but may not work as intended. Numbers are indices from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Warning {
    /// A port's output takes longer than its cycle on its line (D20): it is sent back to back, and cycles are skipped.
    DoesNotFit {
        /// The port.
        port: u8,
        /// Its cycle.
        cycle: Duration,
        /// The shortest cycle in which the output fits.
        shortest: Duration,
    },
    /// The periodic exchanges of a port take more than all of its line's time: they are sent less often.
    LineFull {
        /// The port.
        port: u8,
        /// Their time in percent.
        percent: u32,
    },
    /// A port's timeout is not longer than the period of one of its exchanges: the values of its reply become overdue
    /// before the next one.
    AskedRarely {
        /// The port.
        port: u8,
        /// Its timeout.
        timeout: Duration,
        /// The longest period.
        every: Duration,
    },
    /// A Modbus address of an exchange or block looks like a number as in manuals, such as 40005, which counts from
    /// 40001.
    ManualAddress {
        /// The recipe.
        recipe: u8,
        /// Index of the exchange in the recipe.
        exchange: u8,
        /// The configured address.
        number: u16,
        /// The address on the line for such a number.
        address: u16,
    },
    /// A bit stops the robot only when it changes to 1.
    StopOnEdge {
        /// The recipe.
        recipe: u8,
        /// Index of the command.
        entry: u16,
    },
    /// The commands of a device that sends on its own are forgotten after a short silence: the next value then selects
    /// none.
    ForgetsBase {
        /// The port.
        port: u8,
        /// Its timeout.
        timeout: Duration,
    },
    /// A device receives something only at the start or on change, and has no periodic exchange: a power failure is not
    /// noticed, so nothing is sent again.
    NeverLookedFor {
        /// The recipe.
        recipe: u8,
        /// Index of the first such exchange with the device.
        exchange: u8,
        /// The slave's address, or the number of the device.
        peer: u8,
    },
    /// A port's timeout is shorter than two of its input frames take on the line.
    ShortTimeout {
        /// The port.
        port: u8,
        /// Its timeout.
        timeout: Duration,
        /// Time of the frames.
        time: Duration,
    },
    /// An event, or a request sent only at the start, is repeated if the reply is missing: the device may execute it
    /// twice.
    RepeatedEvent {
        /// The recipe.
        recipe: u8,
        /// Index of the exchange in the recipe.
        exchange: u8,
    },
    /// A bit triggers a write to a device, but nothing stops the device.
    NoStop {
        /// The recipe.
        recipe: u8,
        /// Index of the first such exchange with the device.
        exchange: u8,
        /// The slave's address, or the number of the device.
        peer: u8,
    },
    /// Whether the line echoes is to be learned, but no exchange has a reply that differs from its request: no write is
    /// ever confirmed.
    EchoUnknown {
        /// The port.
        port: u8,
    },
    /// A reply takes longer on the line than its timeout allows.
    SlowReply {
        /// The port.
        port: u8,
        /// Index of the exchange in the recipe.
        exchange: u8,
        /// Time of the reply on the line, including the silence before it.
        time: Duration,
        /// Its timeout.
        timeout: Duration,
    },
    /// A route carries a variable that no port writes: it is read from the state stream and sent back, so a change by
    /// somebody else can be undone for 100 ms.
    ReadBack {
        /// The recipe of the route.
        recipe: u8,
        /// The variable.
        var: SysVar,
    },
    /// A recipe that is not used.
    Unused {
        /// The recipe.
        recipe: u8,
    },
}

struct DescribedWarning<'a> {
    config: ConfigView<'a>,
    warning: Warning,
}

impl fmt::Display for DescribedWarning<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let config = self.config;
        let exchange = match self.warning {
            Warning::LineFull { port, .. }
            | Warning::AskedRarely { port, .. }
            | Warning::DoesNotFit { port, .. }
            | Warning::ForgetsBase { port, .. }
            | Warning::ShortTimeout { port, .. }
            | Warning::EchoUnknown { port } => {
                PortName(Some(config), port).fmt(f)?;
                None
            }
            Warning::SlowReply { port, exchange, .. } => {
                PortName(Some(config), port).fmt(f)?;
                Some(("exchange", exchange))
            }
            Warning::StopOnEdge { recipe, .. }
            | Warning::NeverLookedFor { recipe, .. }
            | Warning::ReadBack { recipe, .. }
            | Warning::Unused { recipe } => {
                RecipeName(Some(config), recipe).fmt(f)?;
                None
            }
            Warning::ManualAddress { recipe, exchange, .. }
            | Warning::RepeatedEvent { recipe, exchange }
            | Warning::NoStop { recipe, exchange, .. } => {
                RecipeName(Some(config), recipe).fmt(f)?;
                Some((if config.is_slave(recipe) { "block" } else { "exchange" }, exchange))
            }
        };
        if let Some((what, nth)) = exchange {
            write!(f, ", {what} {}", one_based(nth))?;
        }
        let is_clause = matches!(self.warning, Warning::ReadBack { .. } | Warning::Unused { .. });
        f.write_str(if is_clause { " " } else { ": " })?;
        self.fmt_text(f)
    }
}

impl DescribedWarning<'_> {
    /// The text of the warning, after its place.
    fn fmt_text(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.warning {
            Warning::LineFull { percent, .. } => write!(
                f,
                "the exchanges with a period take {percent} % of the line's time, so they are asked less \
                 often"
            ),
            Warning::AskedRarely { timeout, every, .. } => write!(
                f,
                "an exchange is asked every {every}, but the timeout is {timeout}, so its values are \
                 overdue until the next reply"
            ),
            Warning::DoesNotFit { cycle, shortest, .. } => write!(
                f,
                "the output does not fit a cycle of {cycle}; the shortest possible is {shortest}, so it \
                 is sent back to back and cycles are skipped"
            ),
            Warning::ManualAddress { number, address, .. } => {
                write!(
                    f,
                    "{number} looks like the number of a manual that counts from {}; if it is, write \
                     {address}, the address on the line",
                    u32::from(number).saturating_sub(u32::from(address))
                )
            }
            Warning::StopOnEdge { entry, .. } => {
                let command = self.config.commands.get(usize::from(entry));
                let text = command.map_or("", |command| command.text.as_str());
                write!(
                    f,
                    "{text:?} is given only when its bit changes, so a button that is held at the start or \
                     after a silence stops nothing; commands = {{ level = {text:?} }} stops as long as the \
                     bit is 1"
                )
            }
            Warning::ForgetsBase { timeout, .. } => write!(
                f,
                "after {timeout} without a frame, the next value picks no command; for a device that sends \
                 less often set a longer timeout_ms, for one that sends only changes base = \"keep\" as \
                 well"
            ),
            Warning::NeverLookedFor { recipe, exchange, peer } => {
                let of = self.config.recipes.get(usize::from(recipe));
                let asked = of.and_then(|of| self.config.exchanges_of(of).get(usize::from(exchange)));
                let device = match asked.map(|asked| asked.transaction) {
                    Some(Transaction::Rtu { .. }) => "slave",
                    _ => "device",
                };
                write!(
                    f,
                    "no exchange with {device} {peer} has a period, so nobody notices that it was without \
                     power, and what it was told is not told again; write every_ms in one of them, such as \
                     500"
                )
            }
            Warning::ShortTimeout { timeout, time, .. } => write!(
                f,
                "a frame takes {time} on the line, but the timeout is {timeout}, so one lost frame or a \
                 short pause makes the port silent; write two periods of the device or more in timeout_ms"
            ),
            Warning::RepeatedEvent { .. } => f.write_str(
                "an event is repeated if its reply is lost, so the device may carry it out twice; retries = \
                 0 does not repeat it",
            ),
            Warning::NoStop { peer, .. } => write!(
                f,
                "a bit triggers a write to device {peer}, and no exchange with stop = true stops it; if it \
                 moves something, add one"
            ),
            Warning::EchoUnknown { .. } => f.write_str(
                "each reply equals its request, so nothing tells it from an echo, and no write is \
                 confirmed; write echo = false, or true if the adapter hears itself",
            ),
            Warning::SlowReply { time, timeout, .. } => write!(
                f,
                "the reply takes {time} on the line, and timeout_ms is {timeout}, so it is always too late"
            ),
            Warning::ReadBack { var, .. } => write!(
                f,
                "carries {var}, which no port writes: it is read back from the controller and sent on, so a \
                 change made by somebody else can be undone for 100 ms"
            ),
            Warning::Unused { .. } => f.write_str("is not used"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(baud: u32, parity: Parity, stop_bits: u8) -> Rs485 {
        let (idle_gap, turnaround) = (Duration::from_millis(50), Duration::ZERO);
        Rs485 { baud, parity, stop_bits, idle_gap, turnaround, echo: Echo::No }
    }

    #[test]
    fn line_times_are_those_of_the_wire() {
        assert_eq!(line(115_200, Parity::None, 1).time_on_line(28), Duration::from_micros(2_431));
        assert_eq!(line(460_800, Parity::None, 1).time_on_line(28), Duration::from_micros(608));
        assert_eq!(line(9_600, Parity::Even, 2).time_on_line(1), Duration::from_micros(1_250));
        assert_eq!(line(9_600, Parity::None, 1).time_on_line(0), Duration::ZERO);
        let gap = line(9_600, Parity::None, 1).characters_and_a_half(3);
        assert_eq!(gap, Duration::from_micros(3_646));
    }

    #[test]
    fn can_times_are_the_worst_case_of_stuffing() {
        // 135 and 160 bits: the known maxima for eight data bytes, including the interframe space.
        assert_eq!(can_frame_time(CanId::Standard(1), 8, 1_000_000), Duration::from_micros(135));
        assert_eq!(can_frame_time(CanId::Extended(1), 8, 1_000_000), Duration::from_micros(160));
        assert_eq!(can_frame_time(CanId::Standard(1), 0, 500_000), Duration::from_micros(110));
    }
}
