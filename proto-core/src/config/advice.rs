//! Warnings about configurations that are valid but contain a typical beginner's mistake: an address as numbered in
//! manuals, a stop that acts only on an edge, commands that are forgotten after silence, a timeout that no device can
//! keep.
//!
//! In: a configuration. Out: [`Warning`]s. Refuses nothing.

use super::{
    Bus, CommandEntry, CommandWhen, ConfigView, Echo, Exchange, FieldSpec, InputBinding, Port, Recipe, Span,
    Transaction, Warning,
};
use crate::command::Request;
use crate::device::Kind;
use crate::modbus::rtu::{BROADCAST, Operation, Table};
use crate::sysvar::Direction;
use crate::time::Duration;

/// Devices that send periodically rarely do so more than 10 times a second, and have a shorter timeout than this. A
/// device that sends on events is silent for longer.
const SHORT_TIMEOUT: Duration = Duration::from_millis(250);

impl Table {
    /// The address on the line for a number as in manuals, such as 4 for holding register 40005. `None` if this table
    /// has no such number.
    pub const fn address_of_number(self, number: u32) -> Option<u16> {
        let (of_five, of_six) = match self {
            // Numbers of coils have no leading digit.
            Self::Coils => return None,
            Self::DiscreteInputs => (10_001, 100_001),
            Self::InputRegisters => (30_001, 300_001),
            Self::HoldingRegisters => (40_001, 400_001),
        };
        match (number.checked_sub(of_six), number.checked_sub(of_five)) {
            (Some(address), _) if address <= 0xFFFF => Some(address as u16),
            (_, Some(address)) if address < 9_999 => Some(address as u16),
            _ => None,
        }
    }
}

impl<'c> ConfigView<'c> {
    pub(super) fn advice(self) -> impl Iterator<Item = Warning> + 'c {
        let commands = self.stops_on_edges().chain(self.forgotten_bases());
        let times = self.short_timeouts().chain(self.slow_replies()).chain(self.lost_peers());
        let events = self.repeated_events().chain(self.without_stop()).chain(self.unknown_echoes());
        self.manual_addresses().chain(commands).chain(times).chain(events)
    }

    /// Events that a device may execute twice.
    fn repeated_events(self) -> impl Iterator<Item = Warning> + 'c {
        (0..).zip(self.recipes).flat_map(move |(recipe, of)| {
            let all = (0..).zip(self.exchanges_of(of));
            let is_repeated = |one: &Exchange| {
                one.is_answered() && one.event_retries > 0 && (one.is_event() || one.is_start_event())
            };
            let repeated = all.filter(move |(_, one)| is_repeated(one));
            repeated.map(move |(exchange, _)| Warning::RepeatedEvent { recipe, exchange })
        })
    }

    /// Devices that a bit triggers but nothing stops.
    fn without_stop(self) -> impl Iterator<Item = Warning> + 'c {
        (0..).zip(self.recipes).flat_map(move |(recipe, of)| {
            let all = self.exchanges_of(of);
            let writes = |one: &Exchange| {
                one.when.rising.is_some()
                    && match one.transaction {
                        Transaction::Rtu { operation, .. } => operation.written_len() > 0,
                        _ => true,
                    }
            };
            let has_stop = move |peer: u8| all.iter().any(|other| other.peer == peer && other.stop);
            let is_first = move |nth: usize, one: &Exchange| {
                !all.iter().take(nth).any(|other| other.peer == one.peer && writes(other))
            };
            let found = all
                .iter()
                .enumerate()
                .filter(move |&(nth, one)| writes(one) && is_first(nth, one) && !has_stop(one.peer));
            found.map(move |(nth, one)| Warning::NoStop { recipe, exchange: nth as u8, peer: one.peer })
        })
    }

    /// Lines whose echo cannot be learned.
    fn unknown_echoes(self) -> impl Iterator<Item = Warning> + 'c {
        let ports = (0..)
            .zip(self.ports)
            .filter(|(_, port)| matches!(&port.bus, Bus::Rs485(line) if line.echo == Echo::Auto));
        ports.filter_map(move |(port, config)| {
            let of = self.recipes.get(usize::from(config.recipe))?;
            let mut answered = self.exchanges_of(of).iter().filter(|one| one.is_answered()).peekable();
            answered.peek()?;
            answered.all(|one| self.may_be_echo(one)).then_some(Warning::EchoUnknown { port })
        })
    }

    /// Whether the reply of an exchange may have the same bytes as its request.
    fn may_be_echo(self, exchange: &Exchange) -> bool {
        match exchange.transaction {
            Transaction::Rtu { operation, .. } => operation.is_repeated_by_reply(),
            Transaction::Frames { request: Some(request), reply: Some(reply), .. } => {
                let frame = |nth: u8| self.frames.get(usize::from(nth));
                frame(request).zip(frame(reply)).is_none_or(|(request, reply)| reply.may_echo(request, self))
            }
            _ => false,
        }
    }

    /// Replies that take longer on the line than their timeout allows.
    fn slow_replies(self) -> impl Iterator<Item = Warning> + 'c {
        (0..).zip(self.ports).flat_map(move |(port, config)| {
            let of = self.recipes.get(usize::from(config.recipe));
            let all = of.map_or(&[][..], |of| self.exchanges_of(of));
            (0..).zip(all).filter_map(move |(exchange, one)| {
                let (time, timeout) = (self.reply_time(config, one), one.timeout);
                (one.is_answered() && time > timeout).then_some(Warning::SlowReply {
                    port,
                    exchange,
                    time,
                    timeout,
                })
            })
        })
    }

    /// Devices that receive something only once and have no periodic exchange that would notice a power failure.
    fn lost_peers(self) -> impl Iterator<Item = Warning> + 'c {
        (0..).zip(self.recipes).flat_map(move |(recipe, of)| {
            let all = self.exchanges_of(of);
            let told = (0..).zip(all).filter(|(_, one)| {
                let is_to_all = matches!(one.transaction, Transaction::Rtu { .. }) && one.peer == BROADCAST;
                (one.when.start || one.when.change) && !is_to_all
            });
            told.filter_map(move |(exchange, one)| {
                let mut peers = (0..).zip(all).filter(|(_, other)| other.peer == one.peer);
                let is_asked = peers.clone().any(|(_, other)| other.when.every.is_some());
                let is_sent = |other: &Exchange| other.when.start || other.when.change;
                let first = peers.find(|(_, other)| is_sent(other)).map(|(nth, _)| nth);
                let is_first = first == Some(exchange);
                (is_first && !is_asked).then_some(Warning::NeverLookedFor {
                    recipe,
                    exchange,
                    peer: one.peer,
                })
            })
        })
    }

    /// Ports whose frames take longer on the line than the timeout allows.
    fn short_timeouts(self) -> impl Iterator<Item = Warning> + 'c {
        let ports = (0..).zip(self.ports).filter(|(_, port)| port.bus.is_field());
        ports.filter_map(move |(port, config)| {
            let (time, timeout) = (self.budget(config, Direction::Input)?.time, config.timeout);
            (timeout < time + time).then_some(Warning::ShortTimeout { port, timeout, time })
        })
    }

    /// Modbus addresses that look like numbers as in manuals.
    fn manual_addresses(self) -> impl Iterator<Item = Warning> + 'c {
        (0..).zip(self.recipes).flat_map(move |(recipe, of)| {
            (0..).zip(self.exchanges_of(of)).flat_map(move |(exchange, asked)| {
                addresses(asked).into_iter().flatten().filter_map(move |(table, number)| {
                    let address = table.address_of_number(u32::from(number))?;
                    Some(Warning::ManualAddress { recipe, exchange, number, address })
                })
            })
        })
    }

    /// Bits that stop the robot only on an edge.
    fn stops_on_edges(self) -> impl Iterator<Item = Warning> + 'c {
        (0..).zip(self.recipes).flat_map(move |(recipe, of)| {
            self.command_fields(of).flat_map(move |(field, table, when)| {
                let entries = (table.start..).zip(table.of(self.commands));
                let is_edge = is_bit(field) && when != CommandWhen::Frame;
                let stops = entries.filter(move |(_, command)| is_edge && command.has(1) && stops(command));
                stops.map(move |(entry, _)| Warning::StopOnEdge { recipe, entry })
            })
        })
    }

    /// Ports that forget their commands after a timeout that is short for a device that sends on events.
    fn forgotten_bases(self) -> impl Iterator<Item = Warning> + 'c {
        let of = move |port: &'c Port| self.recipes.get(usize::from(port.recipe));
        let ports = (0..).zip(self.ports).filter(|(_, port)| port.bus.is_field());
        ports.filter_map(move |(port, config)| {
            let timeout = config.timeout;
            let forgets = self.unasked(of(config)?).any(|span| {
                span.of(self.fields).iter().filter_map(commands).any(|(_, when)| when == CommandWhen::Change)
            });
            (forgets && timeout < SHORT_TIMEOUT).then_some(Warning::ForgetsBase { port, timeout })
        })
    }

    /// The fields of a recipe that pick commands.
    fn command_fields(
        self,
        recipe: &'c Recipe,
    ) -> impl Iterator<Item = (&'c FieldSpec, Span, CommandWhen)> + 'c {
        self.fields_of(recipe, Direction::Input).filter_map(|(_, _, field)| {
            let (table, when) = commands(field)?;
            Some((field, table, when))
        })
    }

    /// The fields of the frames that arrive without a periodic request.
    fn unasked(self, recipe: &'c Recipe) -> impl Iterator<Item = Span> + 'c {
        let exchanges = self.exchanges_of(recipe).iter().filter(|exchange| exchange.when.every.is_none());
        let unasked = exchanges.filter_map(move |exchange| exchange.fields(self.frames, Direction::Input));
        recipe.part_frames(Direction::Input).chain(unasked)
    }
}

/// The addresses of an exchange, each with its table.
const fn addresses(exchange: &Exchange) -> [Option<(Table, u16)>; 2] {
    let operation = match exchange.transaction {
        Transaction::Rtu { operation, .. } | Transaction::Served { operation, .. } => operation,
        Transaction::Frames { .. } => return [None, None],
    };
    let (table, address, _) = operation.place();
    let written = match operation {
        Operation::ReadWriteRegisters { write_address, .. } => Some((table, write_address)),
        _ => None,
    };
    [Some((table, address)), written]
}

const fn commands(field: &FieldSpec) -> Option<(Span, CommandWhen)> {
    match *field {
        FieldSpec::UserInput { to: InputBinding::Commands { table, when }, .. }
        | FieldSpec::DeviceInput { to: InputBinding::Commands { table, when }, .. } => Some((table, when)),
        _ => None,
    }
}

const fn is_bit(field: &FieldSpec) -> bool {
    match field {
        FieldSpec::DeviceInput { encoding, .. } => match encoding.kind {
            Kind::Bits(bits) => bits.count == 1,
            _ => false,
        },
        _ => false,
    }
}

fn stops(command: &CommandEntry) -> bool {
    Request::parse(command.text.as_bytes()).is_ok_and(|request| request.keyword().is_urgent())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_manuals_have_an_address() {
        use Table::*;
        for (table, number, address) in [
            (HoldingRegisters, 40_001, Some(0)),
            (HoldingRegisters, 40_005, Some(4)),
            (HoldingRegisters, 49_999, Some(9_998)),
            (HoldingRegisters, 50_000, None),
            (HoldingRegisters, 40_000, None),
            (HoldingRegisters, 400_005, Some(4)),
            (HoldingRegisters, 465_536, Some(65_535)),
            (HoldingRegisters, 465_537, None),
            (HoldingRegisters, 30_001, None),
            (InputRegisters, 30_001, Some(0)),
            (InputRegisters, 300_001, Some(0)),
            (DiscreteInputs, 10_010, Some(9)),
            (Coils, 10_010, None),
            (InputRegisters, 0, None),
        ] {
            assert_eq!(table.address_of_number(number), address, "{table:?} {number}");
        }
    }
}
