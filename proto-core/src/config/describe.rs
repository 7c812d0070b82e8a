//! Error texts for configurations.
//!
//! In: an error, and the configuration if available. Out: one sentence that says what is wrong and what is allowed.
//! Recipes and ports are named, or counted from 1.

use core::fmt;

use super::error::{
    ConfigError, ConfigErrorKind, ControllerKey, ExchangeError, ExchangeKey, NetworkKey, Place, PortKey,
    RecipeKey,
};
use super::rules::LONGEST_TRIGGER;
use super::{ConfigView, LinkSource, MAX_NAME, Name};
use crate::decimal::Decimal;
use crate::device::Algorithm;
use crate::modbus::rtu::{MAX_ADDRESS, MAX_SLAVES};
use crate::recipe::model::{MAX_CAN_IDS, Mode};
use crate::sysvar::Direction;
use crate::wire::dialect::Dialect;

impl core::error::Error for ConfigError {}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Described { config: None, error: *self }.fmt(f)
    }
}

impl fmt::Display for ConfigErrorKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        DescribedKind { config: None, kind: *self }.fmt(f)
    }
}

impl<'c> ConfigView<'c> {
    /// Displays `error` with the names of its recipes and ports.
    pub fn describe(self, error: ConfigError) -> impl fmt::Display + 'c {
        Described { config: Some(self), error }
    }

    /// Displays what is wrong, with the names of recipes and ports, but without the place.
    pub fn describe_kind(self, kind: ConfigErrorKind) -> impl fmt::Display + 'c {
        DescribedKind { config: Some(self), kind }
    }
}

struct Described<'a> {
    config: Option<ConfigView<'a>>,
    error: ConfigError,
}

impl fmt::Display for Described<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { config, error } = self;
        match error.place {
            Place::Whole => f.write_str("configuration")?,
            Place::Controller(key) => write!(f, "controller, {}", key.name())?,
            Place::Network(key) => write!(f, "network, {}", key.name())?,
            Place::Recipe { recipe, key } => {
                RecipeName(*config, recipe).fmt(f)?;
                f.write_str(match key {
                    RecipeKey::Whole => "",
                    RecipeKey::Name => ", name",
                    RecipeKey::Send => ", send",
                })?;
            }
            Place::Part { recipe, part } => {
                write!(f, "{}, {}", RecipeName(*config, recipe), part_name(part))?
            }
            Place::Frame { recipe, part, frame } => {
                write!(
                    f,
                    "{}, {}, frame {}",
                    RecipeName(*config, recipe),
                    part_name(part),
                    one_based(frame)
                )?;
            }
            Place::Field { recipe, part, frame, field } => {
                write!(f, "{}, {}, ", RecipeName(*config, recipe), part_name(part))?;
                if frame != 0 {
                    write!(f, "frame {}, ", one_based(frame))?;
                }
                write!(f, "field {}", one_based(field))?;
            }
            Place::Exchange { recipe, exchange, key } => {
                write!(f, "{}, exchange {}", RecipeName(*config, recipe), one_based(exchange))?;
                f.write_str(key.name())?;
            }
            Place::Command { entry } => write!(f, "command {}", u32::from(entry).saturating_add(1))?,
            Place::Port { port, key } => write!(f, "{}, {}", PortName(*config, port), key.name())?,
            Place::SafeValue { entry } => write!(f, "safe value {}", u32::from(entry).saturating_add(1))?,
        }
        write!(f, ": {}", DescribedKind { config: *config, kind: error.kind })
    }
}

impl ControllerKey {
    fn name(self) -> &'static str {
        match self {
            Self::Address => "address",
            Self::Dialect => "dialect",
            Self::Ports => "ports",
            Self::RecipeLink => "recipe link",
        }
    }
}

impl NetworkKey {
    fn name(self) -> &'static str {
        match self {
            Self::Address => "address",
            Self::Router => "router",
            Self::Dns => "dns",
        }
    }
}

impl ExchangeKey {
    fn name(self) -> &'static str {
        match self {
            Self::Whole => "",
            Self::Peer => ", peer",
            Self::Registers => ", registers or coils",
            Self::Every => ", period",
            Self::Rising => ", rising bit",
            Self::Timeout => ", timeout",
            Self::Pause => ", pause",
            Self::Trigger => ", trigger",
            Self::Late => ", late",
            Self::Stop => ", stop",
            Self::Follow => ", follow",
            Self::Overdue => ", overdue",
            Self::Outcome => ", outcome",
            Self::Request => ", request",
            Self::Reply => ", reply",
            Self::Pending => ", pending",
            Self::Refusal => ", refusal",
            Self::Restarted => ", restarted",
        }
    }
}

impl PortKey {
    fn name(self) -> &'static str {
        match self {
            Self::Name => "name",
            Self::Recipe => "recipe",
            Self::Cycle => "cycle",
            Self::Timeout => "timeout",
            Self::OnTimeout => "safe values",
            Self::StaleAfter => "stale after",
            Self::Baud => "baud",
            Self::StopBits => "stop bits",
            Self::IdleGap => "idle gap",
            Self::Turnaround => "turnaround",
            Self::Echo => "echo",
            Self::Bitrate => "bitrate",
            Self::Listen => "listen",
            Self::To => "to",
            Self::Health => "health",
            Self::Absent => "absent",
            Self::SafeAtStart => "safe at start",
            Self::Refresh => "refresh",
        }
    }
}

fn part_name(part: Direction) -> &'static str {
    match part {
        Direction::Input => "input part",
        Direction::Output => "output part",
    }
}

pub(super) fn one_based(index: u8) -> u16 {
    u16::from(index).saturating_add(1)
}

pub(super) struct RecipeName<'a>(pub(super) Option<ConfigView<'a>>, pub(super) u8);

impl fmt::Display for RecipeName<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let recipe = self.0.and_then(|config| config.recipes.get(usize::from(self.1)));
        named(f, "recipe", recipe.map(|recipe| &recipe.name), self.1)
    }
}

pub(super) struct PortName<'a>(pub(super) Option<ConfigView<'a>>, pub(super) u8);

impl fmt::Display for PortName<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let port = self.0.and_then(|config| config.ports.get(usize::from(self.1)));
        named(f, "port", port.map(|port| &port.name), self.1)
    }
}

fn named(f: &mut fmt::Formatter<'_>, what: &str, name: Option<&Name>, index: u8) -> fmt::Result {
    match name {
        Some(name) if !name.is_empty() => write!(f, "{what} {name:?}"),
        _ => write!(f, "{what} {}", one_based(index)),
    }
}

struct DescribedKind<'a> {
    config: Option<ConfigView<'a>>,
    kind: ConfigErrorKind,
}

impl fmt::Display for DescribedKind<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        use ConfigErrorKind as Kind;
        let recipe_name = |recipe| RecipeName(self.config, recipe);
        let port_name = |port| PortName(self.config, port);
        match self.kind {
            Kind::UnknownDialect => {
                f.write_str("there is no such dialect; there are")?;
                for (nth, name) in Dialect::NAMES.iter().enumerate() {
                    write!(f, "{} {name:?}", if nth == 0 { "" } else { "," })?;
                }
                Ok(())
            }
            Kind::Variable(error) => error.fmt(f),
            Kind::WrongField { mode: Mode::Realtime, .. } => {
                f.write_str("the fields of a realtime recipe are system variables")
            }
            Kind::WrongField { mode: Mode::User, part } => {
                write!(f, "the {} of a user recipe takes user fields with its own bindings", part_name(part))
            }
            Kind::Constant(error) => error.fmt(f),
            Kind::Layout(error) => error.fmt(f),
            Kind::Exchange(error) => error.fmt(f),
            Kind::UnknownChecksum => {
                f.write_str("no checksum has this name; allowed:")?;
                let mut names = Algorithm::names();
                names.try_for_each(|name| write!(f, " {name}"))
            }
            Kind::Command(error) => error.fmt(f),
            Kind::Part(error) => error.fmt(f),
            Kind::Framing { recipe, error } => write!(f, "{} does not fit: {error}", recipe_name(recipe)),
            Kind::NeedsStreamRecipe { recipe } => {
                write!(f, "{} is a CAN recipe; only CAN ports take CAN recipes", recipe_name(recipe))
            }
            Kind::NeedsModbusMaster { recipe } => write!(
                f,
                "{} has no exchanges of a Modbus master; a port of Modbus TCP takes only such recipes",
                recipe_name(recipe)
            ),
            Kind::NeedsCanRecipe { recipe } => {
                write!(f, "{} is a stream recipe; a CAN port takes only CAN recipes", recipe_name(recipe))
            }
            Kind::NeedsRealtimeRecipe { recipe } => write!(
                f,
                "{} is user-defined; the controller's TCP and UDP ports take only realtime recipes",
                recipe_name(recipe)
            ),
            Kind::ListenTwice { other } => write!(f, "{} already listens here", port_name(other)),
            Kind::OwnedTwice { var, other } => write!(
                f,
                "{var} is written by this port and by {}; a variable has one owner",
                port_name(other)
            ),
            Kind::BitOwnedTwice { bit, other } => {
                write!(f, "{bit} is written by this port and by {}; a bit has one owner", port_name(other))
            }
            Kind::OwnedAndShared { bit, other } => write!(
                f,
                "this port and {} both write {}, one as a whole and one {bit}; allowed: one owner of the \
                 whole, or owners of bits",
                port_name(other),
                bit.var
            ),
            Kind::NoRoute { var, port } => write!(
                f,
                "{} writes {var}, which only the controller's own recipe ports can carry; add it to the input of \
                 the recipe of controller.recipe_link or of a tcp-listen or udp-listen port",
                port_name(port)
            ),
            Kind::NoSource { var, port } => write!(
                f,
                "{} sends {var}, which only the controller's own recipe ports show; add it to the output of the \
                 recipe of controller.recipe_link or of a tcp-listen or udp-listen port",
                port_name(port)
            ),
            Kind::StateValue(error) => error.fmt(f),
            Kind::NoFieldPort { port } => {
                write!(f, "{} is no field port; only field ports have a health", port_name(port))
            }
            Kind::NoLink { link: LinkSource::Listening(port) } => {
                write!(f, "{} is no port to which the controller connects", port_name(port))
            }
            Kind::NoLink { link } => {
                let name = link.name().unwrap_or_default();
                write!(f, "there is no link {name}; controller.recipe_link makes it")
            }
            kind => kind.fmt_variable(f),
        }
    }
}

impl ConfigErrorKind {
    fn fmt_variable(self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        use ConfigErrorKind as Kind;
        match self {
            Kind::NotInVariable { var, value } => write!(f, "{var} cannot be {}", Decimal::Double(value)),
            Kind::NotAWord { var } => write!(f, "{var} is no word register; allowed: WordInputReg"),
            Kind::NotWords { var, count } => {
                write!(f, "{count} word variables are needed, such as WordInputReg[1]; found: {var}")
            }
            Kind::NotAnInput { var } => write!(
                f,
                "{var} is an output of the robot and cannot be written; inputs are DigitalOutputCommand, BitInputReg, \
                 WordInputReg, FloatInputReg, ForceEnd, ForceBase"
            ),
            Kind::WrittenTwice { var } => {
                write!(f, "another field of this recipe already writes {var}")
            }
            Kind::BitWrittenTwice { bit } => {
                write!(f, "another field of this recipe already writes {bit}")
            }
            Kind::WholeAndBit { bit } => write!(
                f,
                "this recipe writes both {} as a whole and its bit {}; allowed: the whole or bits",
                bit.var, bit.bit
            ),
            Kind::HasNoBits { var } => {
                write!(f, "{var} is a {} without bits", var.ty())?;
                match var.direction() {
                    Direction::Input => f.write_str("; allowed: bits of DigitalOutputCommand, BitInputReg"),
                    Direction::Output => Ok(()),
                }
            }
            Kind::NotBits { var } => {
                write!(f, "{var} is a {}; a trigger needs a variable made of bits", var.ty())
            }
            Kind::NoSuchBit { var, bit } => {
                let bits = var.valid_bits().count_ones();
                write!(f, "{var} has no bit {bit}; allowed: 0..={}", bits.saturating_sub(1))
            }
            Kind::Unowned { var } => write!(
                f,
                "{var} goes to the controller with this recipe, but no port writes it and it cannot be read back, so \
                 its value would be invented; let a port write it, or remove it here and on the controller"
            ),
            Kind::NotOwned { var } => write!(f, "this port does not write {var}"),
            Kind::BitsNotOwned { var, mask } => {
                write!(f, "this port does not write {var}.{} by itself", mask.trailing_zeros())
            }
            Kind::SafeType { var, ty } => write!(f, "{var} is a {}, but its safe value is a {ty}", var.ty()),
            Kind::SafeValue { var } => {
                write!(f, "not a value for {var}: not finite, or reserved bits are set")
            }
            Kind::SafeTwice { var } => write!(f, "{var} already has a safe value"),
            Kind::NotForHealth { var } => {
                write!(f, "{var} cannot tell a port's health; allowed: WordInputReg, FloatInputReg")
            }
            Kind::HealthTwice { var } => write!(f, "this port already writes {var}"),
            _ => self.fmt_value(f),
        }
    }

    fn fmt_value(self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        use ConfigErrorKind as Kind;
        match self {
            Kind::Prefix { prefix } => {
                write!(f, "a prefix of {prefix} bits is out of range; allowed: 1..=30")
            }
            Kind::NoHostAddress { address, network } => {
                write!(f, "{address} is not a host address in the board's network {network}")
            }
            Kind::NeedsRouter { address, network } => {
                write!(f, "{address} is not in the board's network {network}; a router is needed")
            }
            Kind::NoSuchRecipe { recipe, recipes } => {
                write!(f, "there is no recipe {}; there are {recipes}", one_based(recipe))
            }
            Kind::OutsidePool { end, len } => {
                write!(f, "a range ends at {end}, but there are only {len} entries")
            }
            Kind::TooMany { what, needed, room } => {
                write!(f, "{needed} {what}; there is room for {room}")
            }
            Kind::TooLong { len, longest } => write!(f, "{len} bytes long; at most {longest} are allowed"),
            Kind::NameLength { len } => write!(f, "{len} bytes long; allowed: 1..={MAX_NAME}"),
            Kind::NameCharacter { character } => {
                write!(
                    f,
                    "a name cannot contain {character:?}; spaces, quotes, '=' and control characters are not allowed"
                )
            }
            Kind::DuplicateName { other } => {
                write!(f, "entry {} already has this name; names must differ", one_based(other))
            }
            Kind::BadScale { scale, offset } => {
                let [scale, offset] = [scale, offset].map(Decimal::Single);
                write!(
                    f,
                    "scale {scale} and offset {offset} must be finite numbers, and scale not 0: the value would be lost"
                )
            }
            Kind::NeedsInteger { ty } => {
                write!(f, "needs an integer field (byte, char, word, short, dword, int); this one is a {ty}")
            }
            Kind::Counter { high, .. } if high < 1.0 => {
                f.write_str("a counter needs a field that has unsigned integers only")
            }
            Kind::Counter { max, high } => {
                write!(f, "a counter up to {max} does not fit; allowed: 1..={}", Decimal::Double(high))
            }
            Kind::NotInField { value, low, high } => {
                let [value, low, high] = [value, low, high].map(Decimal::Double);
                write!(f, "the field cannot be {value}; allowed: {low}..={high}")
            }
            Kind::BackwardLimits { low, high } => {
                let [low, high] = [low, high].map(Decimal::Double);
                write!(f, "min {low} is above max {high}")
            }
            Kind::FractionOfInteger { value } => {
                write!(f, "{} has a fraction; this field has integers only", Decimal::Double(value))
            }
            Kind::TooManyDecimals { value, decimals } => {
                let value = Decimal::Double(value);
                write!(f, "{value} has more than the field's {decimals} digits behind the point")
            }
            Kind::MappedTwice { value } => write!(f, "an earlier entry already has the value {value}"),
            Kind::CommandValue { value, ty } => {
                let (low, high) = ty.range();
                let [low, high] = [low, high].map(Decimal::Double);
                write!(f, "a {ty} cannot be {value}; allowed: {low}..={high}")
            }
            Kind::DuplicateCommand { value } => write!(f, "an earlier command already has the value {value}"),
            Kind::BaudOutOfRange { baud } => {
                write!(f, "{baud} baud is out of range; allowed: 1200..=4000000")
            }
            Kind::StopBits { stop_bits } => write!(f, "{stop_bits} stop bits; allowed: 1, 2"),
            Kind::BitrateOutOfRange { bitrate } => {
                write!(f, "{bitrate} bit/s is out of range; allowed: 10000..=1000000")
            }
            Kind::CycleTooShort { cycle } => write!(f, "a cycle of {cycle} is too short; at least 4 ms"),
            Kind::TimeTooLong { time, longest } => write!(f, "{time} is too long; at most {longest}"),
            Kind::CommandFor { value, error } => write!(f, "with the value {value}: {error}"),
            Kind::BackwardRange { first, last } => {
                write!(f, "{first}..{last} contains no value; allowed: {last}..{first}")
            }
            _ => f.write_str(self.sentence()),
        }
    }

    /// Errors whose text needs neither names nor numbers.
    fn sentence(self) -> &'static str {
        use ConfigErrorKind as Kind;
        match self {
            Kind::ZeroPort => "port 0 is out of range; allowed: 1..=65535",
            Kind::OwnAddress => "this is the board's own address",
            Kind::NeedsDns => "controller.address is a host name, so dns is needed; or write an IP address",
            Kind::NoSuchName => "no earlier recipe has this name",
            Kind::MixedParts => "one part is a stream, the other is CAN",
            Kind::Address => "neither an IP address nor a host name; port numbers go in controller.ports",
            Kind::NoParts => "a recipe needs an input part, an output part or an exchange",
            Kind::RealtimeSendsByPeriod => {
                "a realtime recipe allows only send = \"period\"; other triggers need mode = \"user\""
            }
            Kind::NothingToSend => "the recipe has no output part to send",
            Kind::NoInputToAnswer => "sent for each input frame, but the recipe has no input part",
            Kind::EchoNeedsExchanges => {
                "allowed only with a recipe of exchanges: other frames are not told from their echo"
            }
            Kind::NeedsIntegers => "needs a field that has integers only",
            Kind::NothingToLimit => "only an output field with a source has limits or a map",
            Kind::NothingToRule => {
                "only an input field that writes a variable, and not a bit of it, has as, min, max, map, no_value or \
                 valid_to"
            }
            Kind::RuleTwice => "it is said twice, or too late, what becomes of the field's value",
            Kind::ElseWithoutMap => "else is for a map with other entries",
            Kind::NoTextNeedsDigits => "a text stands for no value in fields of digits only: decimal, hex",
            Kind::NoComma => "a decimal comma is for decimal fields that no comma ends",
            Kind::LimitsAndWrap => "overflow = \"wrap\" takes any number; as, min, max and map do not",
            Kind::LimitsAndMap => {
                "a map has nothing but its own numbers; min, max and outside are not for it"
            }
            Kind::LimitedCount => "a count wraps, so min, max and map are not allowed",
            Kind::ScaledMap => "a map takes values as they are, so scale and offset are not allowed",
            Kind::OnlyIntegersWrap => "only integers wrap; this one may have a fraction",
            Kind::TextOrder => "the order of a text's characters is little or big",
            Kind::FramingNeedsUser => "framing and escape need mode = \"user\"",
            Kind::TwoFramings => "escape bytes tell frames apart already; framing is not needed beside them",
            Kind::NoTail => "framing = \"tail\" needs a tail",
            Kind::EmptyTable => "a command table needs at least one command",
            Kind::ZeroTime => "must be longer than 0",
            Kind::ListenAddress => {
                "not an address to listen on; write an IP address and a port, such as \"0.0.0.0:50000\""
            }
            Kind::ScaledCount => "a count wraps, so scale and offset are not allowed",
            Kind::OnlyFieldPorts => "allowed only on field ports: rs485, modbus-tcp, can",
            Kind::NoSafeValues => "the port has no safe values; write them in on_timeout",
            Kind::OnlyChangesRefresh => "allowed only with a recipe whose output part has send = \"change\"",
            _ => "",
        }
    }
}

impl fmt::Display for ExchangeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Slave { address } => {
                write!(
                    f,
                    "slave {address} is out of range; allowed: 1..={MAX_ADDRESS}, or 0 to write to all of them"
                )
            }
            Self::OwnAddress { address } => {
                write!(f, "address {address} is out of range; allowed: 1..={MAX_ADDRESS}")
            }
            Self::BeyondLast { address, count } => {
                let last = u32::from(*address).saturating_add(u32::from(*count)).saturating_sub(1);
                write!(f, "{address} to {last} are out of range; the last register or coil is 65535")
            }
            Self::TooManyPeers => {
                write!(f, "one slave or other peer too many; allowed: up to {MAX_SLAVES} on a port")
            }
            Self::Count(error) => error.fmt(f),
            Self::Fields { needed, found } => {
                write!(f, "the fields have {found} bytes, the registers or coils {needed}; pad fills them up")
            }
            Self::Indistinguishable { id } => write!(
                f,
                "another frame that can come at the same time has id {id}, too, and nothing tells the two apart; give \
                 both a constant at the same place, with another value"
            ),
            Self::RestartedField { field } => {
                write!(f, "field {} of the reply is no number", u16::from(*field).saturating_add(1))
            }
            Self::Trigger { time } => {
                write!(f, "{time} is out of range; allowed: above 0, at most {LONGEST_TRIGGER}")
            }
            Self::NotForOutcome { var } => {
                write!(f, "{var} cannot tell what became of an event; allowed: WordInputReg, FloatInputReg")
            }
            Self::TooManyIds => {
                write!(f, "more than {MAX_CAN_IDS} ids of received frames; a CAN port has no room for more")
            }
            _ => f.write_str(self.sentence()),
        }
    }
}

impl ExchangeError {
    /// Errors whose text needs no numbers.
    fn sentence(&self) -> &'static str {
        match self {
            Self::NeedsUser => "exchanges need mode = \"user\"",
            Self::Mixed => "a recipe has exchanges of one kind: Modbus master, Modbus slave, or frames",
            Self::CutParts => {
                "beside exchanges a part has framing = \"fields\" and no escape; replies could not be found"
            }
            Self::PartsBesideModbus => "a recipe of Modbus has exchanges only, no input and output part",
            Self::WrongBus => "frames of a CAN recipe have an id, those of a stream recipe have none",
            Self::OtherAddress => "the blocks of a slave have one address",
            Self::BroadcastRead => "slave 0 is all of them, which cannot be read; allowed: writes",
            Self::BroadcastOverTcp => {
                "slave 0 is all of them, which Modbus TCP does not have; allowed: 1..=255"
            }
            Self::NotCoils => "the fields of coils are one bit each; their type is Coil",
            Self::Mask => {
                "the fields are some bits of the register, not all; those are written with write-register"
            }
            Self::Varying => "fields in registers have a fixed length; give the text a width",
            Self::NotServed => "a block has holding registers, input registers, coils or discrete inputs",
            Self::Overlap => "an earlier block has some of these registers or coils",
            Self::Nothing => "an exchange needs a request, a reply or both",
            Self::LoneRefusal => "a pending answer or a refusal answers a request that has a reply",
            Self::Never => "it would never be asked; set every_ms, on or follow",
            Self::Unasked => "there is no request to send; remove every_ms and on",
            Self::RemoteFields => "a remote request has no fields",
            Self::RemoteReply => "only a request can be remote",
            Self::RefusalValues => {
                "the fields of a pending answer and of a refusal have no commands and no counter"
            }
            Self::Hidden => {
                "every such frame is another answer as well, which is looked for first (reply, pending, refusal) or is \
                 shorter; give that one a constant that this one does not have"
            }
            Self::PendingEcho => {
                "it may have the bytes of its request, as an echo has; give it another constant"
            }
            Self::RestartedNothing => {
                "allowed in the reply of an exchange, if one of its device has \"start\" in on, which is asked again"
            }
            Self::NoEvent => {
                "allowed only for an event: an exchange with a rising bit in on, or with follow, and without stop"
            }
            Self::StopNeedsReply => "a write that stops is repeated until it is confirmed; it needs a reply",
            Self::FollowsNothing { .. } => "an exchange follows another one of its recipe, not itself",
            Self::FollowsUnanswered => {
                "the exchange that it follows has no reply, so nothing tells that it was done"
            }
            Self::FollowsAndRises => {
                "an exchange that follows another has no rising bit of its own in on, and no stop"
            }
            Self::FollowsCircle => {
                "the exchanges follow each other in a circle, so nothing begins it; remove one follow"
            }
            _ => "",
        }
    }
}
