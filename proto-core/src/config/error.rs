//! Errors in a configuration, and their places.

use core::net::Ipv4Addr;

pub use super::keys::{ControllerKey, ExchangeKey, NetworkKey, PortKey, RecipeKey};
use super::{LinkSource, Network, StateValueError};
use crate::command::ParseError;
use crate::device::LayoutError;
use crate::modbus::rtu::CountError;
use crate::recipe::PartError;
use crate::recipe::model::Mode;
use crate::sysvar::{Direction, ParseError as VarError, SysVar, VarBit};
use crate::time::Duration;
use crate::wire::can::CanId;
use crate::wire::scalar::{ScalarError, ScalarType};

/// The first error that [`ConfigView::validate`](super::ConfigView::validate) found.
///
/// Its `Display` counts recipes and ports from 1; [`ConfigView::describe`](super::ConfigView::describe) names them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConfigError {
    /// Where it is.
    pub place: Place,
    /// What is wrong.
    pub kind: ConfigErrorKind,
}

/// A place in a configuration. Numbers are indices from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Place {
    /// The configuration as a whole.
    Whole,
    /// The controller's section.
    Controller(ControllerKey),
    /// The board's own address.
    Network(NetworkKey),
    /// A recipe, or one of its keys.
    Recipe {
        /// Index of the recipe.
        recipe: u8,
        /// The key.
        key: RecipeKey,
    },
    /// A recipe's part.
    Part {
        /// Index of the recipe.
        recipe: u8,
        /// Input or output part.
        part: Direction,
    },
    /// One frame id of a CAN recipe's part.
    Frame {
        /// Index of the recipe.
        recipe: u8,
        /// Input or output part.
        part: Direction,
        /// Index of the frame in the part.
        frame: u8,
    },
    /// One field.
    Field {
        /// Index of the recipe.
        recipe: u8,
        /// Input or output part.
        part: Direction,
        /// Index of the CAN frame in the part; 0 in a stream recipe. The frames of exchanges are counted after those of
        /// the part.
        frame: u8,
        /// Index of the field in the part or frame.
        field: u8,
    },
    /// One exchange.
    Exchange {
        /// Index of the recipe.
        recipe: u8,
        /// Index of the exchange in the recipe.
        exchange: u8,
        /// The key.
        key: ExchangeKey,
    },
    /// One entry of a command table.
    Command {
        /// Index into [`GatewayConfig::commands`](super::GatewayConfig::commands).
        entry: u16,
    },
    /// A port.
    Port {
        /// Index of the port.
        port: u8,
        /// The key.
        key: PortKey,
    },
    /// One safe value of a port.
    SafeValue {
        /// Index into [`GatewayConfig::safe_values`](super::GatewayConfig::safe_values).
        entry: u16,
    },
}

/// A list with a limited number of entries: of a configuration, or of the engine that runs it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Counted {
    /// Ports.
    Ports,
    /// Recipes.
    Recipes,
    /// Fields of all recipes.
    Fields,
    /// Frames of one CAN part.
    CanFrames,
    /// Entries of all command tables.
    Commands,
    /// Limits of output fields, and entries of their tables.
    Sendable,
    /// Safe values of all ports.
    SafeValues,
    /// Field ports of an engine.
    FieldPorts,
    /// Input frames of all field ports.
    InputFrames,
    /// Recipe links and Modbus TCP ports of an engine.
    RecipeLinks,
    /// User-defined fields of all field ports in one direction.
    UserFields,
    /// User-defined fields that select commands.
    CommandFields,
    /// Bytes of all command texts.
    CommandBytes,
    /// Frames of one port that are a device's own.
    DeviceFrames,
    /// Bytes of which input frames write single bits, over all input frames.
    BitShares,
    /// Texts of one port.
    Texts,
    /// Alive counters of all input frames.
    Counters,
    /// Groups of variables that arrive together.
    Groups,
    /// Blocks of neighbouring variables that are polled by Modbus.
    PollBlocks,
    /// Values of the state packet and of the health of ports, over all ports that send them.
    Sources,
    /// Exchanges of all recipes.
    Exchanges,
    /// Frames of all exchanges.
    ExchangeFrames,
    /// Pieces of 32 bytes for the blocks that masters write.
    WrittenPieces,
}

impl core::fmt::Display for Counted {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Ports => "ports",
            Self::Recipes => "recipes",
            Self::Fields => "fields in all recipes together",
            Self::CanFrames => "frames in one part",
            Self::Commands => "commands in all recipes together",
            Self::Sendable => "limits and map entries of output fields on all ports together",
            Self::SafeValues => "safe values on all ports together",
            Self::FieldPorts => "field ports",
            Self::Texts => "texts of one port",
            Self::Counters => "alive counters in input frames",
            Self::DeviceFrames => "frames of a device on one port",
            Self::InputFrames => "input frames",
            Self::RecipeLinks => "recipe links and Modbus TCP ports",
            Self::UserFields => "user-defined fields in one direction",
            Self::CommandFields => "command fields",
            Self::CommandBytes => "bytes of command texts",
            Self::BitShares => "bytes in input frames that write single bits",
            Self::Groups => "groups",
            Self::PollBlocks => "Modbus poll blocks",
            Self::Exchanges => "exchanges in all recipes together",
            Self::ExchangeFrames => "frames of exchanges in all recipes together",
            Self::WrittenPieces => "pieces of 32 bytes in all blocks that masters write",
            Self::Sources => "values of the controller's state and of the health of ports",
        })
    }
}

/// What is wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum ConfigErrorKind {
    /// There is no dialect with this name.
    UnknownDialect,
    /// A port number of the controller is 0.
    ZeroPort,
    /// A network prefix that is invalid or has no host addresses.
    Prefix {
        /// The prefix.
        prefix: u8,
    },
    /// The address cannot be a host's in the board's network.
    NoHostAddress {
        /// The address.
        address: Ipv4Addr,
        /// The board's network.
        network: Network,
    },
    /// The address is the board's own, but must be another host's.
    OwnAddress,
    /// The address is in another network, but no router is configured.
    NeedsRouter {
        /// The address.
        address: Ipv4Addr,
        /// The board's network.
        network: Network,
    },
    /// The controller is configured by name, but no name server is configured.
    NeedsDns,
    /// There is no recipe with this index.
    NoSuchRecipe {
        /// The index.
        recipe: u8,
        /// Number of recipes.
        recipes: u8,
    },
    /// A range of fields, commands or safe values ends beyond its list.
    OutsidePool {
        /// The end of the range.
        end: u32,
        /// The length of the list.
        len: u32,
    },
    /// More entries than this type of configuration, or any, can hold.
    TooMany {
        /// The list.
        what: Counted,
        /// Number of entries needed.
        needed: usize,
        /// Number of entries that fit.
        room: usize,
    },
    /// A text or a delimiter is too long.
    TooLong {
        /// Its length in bytes.
        len: usize,
        /// Maximum length in bytes.
        longest: usize,
    },
    /// A name is empty or too long.
    NameLength {
        /// Its length in bytes.
        len: usize,
    },
    /// A name contains a space, a quote, `=` or a control character.
    NameCharacter {
        /// The first such character.
        character: char,
    },
    /// No earlier recipe has this name.
    NoSuchName,
    /// No system variable has this name.
    Variable(VarError),
    /// One part of a recipe is a stream and the other CAN.
    MixedParts,
    /// The controller's address is neither an IP address nor a host name.
    Address,
    /// An earlier recipe or port has the same name.
    DuplicateName {
        /// Index of the earlier one.
        other: u8,
    },
    /// A recipe has neither an input nor an output part.
    NoParts,
    /// A user field in a realtime recipe, an output field in an input part, or the like.
    WrongField {
        /// The recipe's mode.
        mode: Mode,
        /// The part.
        part: Direction,
    },
    /// A realtime recipe can only be sent every period.
    RealtimeSendsByPeriod,
    /// A trigger, but no output part to send.
    NothingToSend,
    /// The output part is sent for each input frame, but there is no input part.
    NoInputToAnswer,
    /// A scale is 0 or not finite, or an offset is not finite.
    BadScale {
        /// Scale.
        scale: f32,
        /// Offset.
        offset: f32,
    },
    /// A constant does not fit its field, or a safe value its variable.
    Constant(ScalarError),
    /// This use needs a field of an integer type.
    NeedsInteger {
        /// The field's type.
        ty: ScalarType,
    },
    /// The frame of a device has an invalid layout.
    Layout(LayoutError),
    /// The exchange is invalid.
    Exchange(ExchangeError),
    /// The range of an alive counter.
    Counter {
        /// Its highest number.
        max: u32,
        /// The highest number of the field; negative if its type is not an unsigned integer.
        high: f64,
    },
    /// An echo can be told from replies only with exchanges.
    EchoNeedsExchanges,
    /// The field cannot have this number.
    NotInField {
        /// The number.
        value: f64,
        /// The smallest number that the field can have.
        low: f64,
        /// The largest.
        high: f64,
    },
    /// This use needs a field that can only have integers.
    NeedsIntegers,
    /// Only integers wrap around.
    OnlyIntegersWrap,
    /// Limits or a table entry do not follow an output field that has a source.
    NothingToLimit,
    /// Limits, a table or a rule do not follow an input field that writes a variable as a whole.
    NothingToRule,
    /// A field has the same rule twice, or a rule after the table that it changes.
    RuleTwice,
    /// `Else` without a table.
    ElseWithoutMap,
    /// The variable cannot have this number.
    NotInVariable {
        /// The variable.
        var: SysVar,
        /// The number.
        value: f64,
    },
    /// This is for word registers only.
    NotAWord {
        /// The variable.
        var: SysVar,
    },
    /// A text for "no value" in a field that is not digits.
    NoTextNeedsDigits,
    /// A comma as decimal point in a field that is not decimal digits or ends with a comma.
    NoComma,
    /// A field that wraps also has limits or a table.
    LimitsAndWrap,
    /// A field has limits twice, or limits and a table.
    LimitsAndMap,
    /// A count has limits or a table, although it wraps.
    LimitedCount,
    /// A field with a table has a scale or offset; tables use the values of the source unchanged.
    ScaledMap,
    /// The lower limit of a field exceeds the upper one.
    BackwardLimits {
        /// The lowest number.
        low: f64,
        /// The highest number.
        high: f64,
    },
    /// A number with a fraction for a field that can only have integers.
    FractionOfInteger {
        /// The number.
        value: f64,
    },
    /// A number with more digits after the point than its field has.
    TooManyDecimals {
        /// The number.
        value: f64,
        /// Digits of the field.
        decimals: u8,
    },
    /// An earlier entry of the table has this value.
    MappedTwice {
        /// The value.
        value: i64,
    },
    /// No checksum has this name.
    UnknownChecksum,
    /// A text, its length or its count needs this many consecutive word variables.
    NotWords {
        /// The first variable.
        var: SysVar,
        /// Number of variables.
        count: u8,
    },
    /// The byte order of a text is neither little nor big; a word has two characters.
    TextOrder,
    /// A realtime recipe whose frames are separated by something else than their fields.
    FramingNeedsUser,
    /// Frames are separated both by escape bytes and in another way.
    TwoFramings,
    /// Frames are separated by a tail, which the part does not have.
    NoTail,
    /// A command table has no entries.
    EmptyTable,
    /// The field can never have the value of a command.
    CommandValue {
        /// The value.
        value: i64,
        /// The field's type.
        ty: ScalarType,
    },
    /// Two commands of a table have the same value.
    DuplicateCommand {
        /// The value.
        value: i64,
    },
    /// The text is not a request of port 2000.
    Command(ParseError),
    /// The recipe's part breaks a limit or a rule (D16, D18).
    Part(PartError),
    /// The port's line cannot carry the recipe's part.
    Framing {
        /// Index of the recipe.
        recipe: u8,
        /// The reason.
        error: PartError,
    },
    /// Two fields of one recipe write the same bit.
    BitWrittenTwice {
        /// The bit.
        bit: VarBit,
    },
    /// A recipe writes a variable as a whole and also one of its bits.
    WholeAndBit {
        /// The bit.
        bit: VarBit,
    },
    /// The variable does not consist of bits.
    HasNoBits {
        /// The variable.
        var: SysVar,
    },
    /// An input field writes a variable that is not an input.
    NotAnInput {
        /// The variable.
        var: SysVar,
    },
    /// Two fields of one recipe write the same variable.
    WrittenTwice {
        /// The variable.
        var: SysVar,
    },
    /// A trigger needs a variable that consists of bits.
    NotBits {
        /// The variable.
        var: SysVar,
    },
    /// The variable has no such bit.
    NoSuchBit {
        /// The variable.
        var: SysVar,
        /// The bit.
        bit: u8,
    },
    /// The serial line's speed is out of range (D21).
    BaudOutOfRange {
        /// Bit/s.
        baud: u32,
    },
    /// The number of stop bits is neither 1 nor 2.
    StopBits {
        /// The number of stop bits.
        stop_bits: u8,
    },
    /// The CAN bus's speed is out of range (D21).
    BitrateOutOfRange {
        /// Bit/s.
        bitrate: u32,
    },
    /// A cycle shorter than the controller's fastest.
    CycleTooShort {
        /// The cycle.
        cycle: Duration,
    },
    /// A time that must be positive is 0.
    ZeroTime,
    /// A time is longer than allowed.
    TimeTooLong {
        /// The time.
        time: Duration,
        /// The longest allowed.
        longest: Duration,
    },
    /// A CAN recipe on a port or link that carries byte streams (D16).
    NeedsStreamRecipe {
        /// Index of the recipe.
        recipe: u8,
    },
    /// A recipe other than a Modbus master's on a Modbus TCP port.
    NeedsModbusMaster {
        /// Index of the recipe.
        recipe: u8,
    },
    /// A stream recipe on a CAN bus (D16).
    NeedsCanRecipe {
        /// Index of the recipe.
        recipe: u8,
    },
    /// A user-defined recipe where the controller supports only realtime ones (D16).
    NeedsRealtimeRecipe {
        /// Index of the recipe.
        recipe: u8,
    },
    /// The text is not an address and port to listen on.
    ListenAddress,
    /// An earlier port listens on the same address and port.
    ListenTwice {
        /// Index of the earlier port.
        other: u8,
    },
    /// An earlier port writes the same variable; a variable has one owner.
    OwnedTwice {
        /// The variable.
        var: SysVar,
        /// Index of the earlier port.
        other: u8,
    },
    /// An earlier port writes the same bit; a bit has one owner.
    BitOwnedTwice {
        /// The bit.
        bit: VarBit,
        /// Index of the earlier port.
        other: u8,
    },
    /// One port writes the whole variable, and another one a bit of it.
    OwnedAndShared {
        /// The bit.
        bit: VarBit,
        /// Index of the other port.
        other: u8,
    },
    /// A port writes a variable that no configured route can carry (D15).
    NoRoute {
        /// The variable.
        var: SysVar,
        /// Index of the port.
        port: u8,
    },
    /// A port shows a variable that has no configured source (D15).
    NoSource {
        /// The variable.
        var: SysVar,
        /// Index of the port.
        port: u8,
    },
    /// A route carries a variable that no port owns and that cannot be read back, so its value is unknown.
    Unowned {
        /// The variable.
        var: SysVar,
    },
    /// A safe value for a variable that the port does not write.
    NotOwned {
        /// The variable.
        var: SysVar,
    },
    /// A safe value for bits that the port does not write individually.
    BitsNotOwned {
        /// The variable.
        var: SysVar,
        /// Its bits.
        mask: u8,
    },
    /// The type of a safe value differs from its variable's.
    SafeType {
        /// The variable.
        var: SysVar,
        /// The value's type.
        ty: ScalarType,
    },
    /// A safe value is not finite or sets reserved bits.
    SafeValue {
        /// The variable.
        var: SysVar,
    },
    /// A variable has two safe values.
    SafeTwice {
        /// The variable.
        var: SysVar,
    },
    /// The text of a command is not a request of port 2000 with this value inserted.
    CommandFor {
        /// The value.
        value: i64,
        /// What is wrong with the text.
        error: ParseError,
    },
    /// The first value of a command exceeds the last one.
    BackwardRange {
        /// The first value.
        first: i64,
        /// The last value.
        last: i64,
    },
    /// The state packet has no such value.
    StateValue(StateValueError),
    /// There is no field port with this index.
    NoFieldPort {
        /// The index.
        port: u8,
    },
    /// The link does not exist: no recipe link is configured, or the port does not listen.
    NoLink {
        /// The link.
        link: LinkSource,
    },
    /// Counts wrap, so they cannot have scale and offset.
    ScaledCount,
    /// The variable cannot report the health of a port.
    NotForHealth {
        /// The variable.
        var: SysVar,
    },
    /// The port already writes the variable, from its frames or for another value of its health.
    HealthTwice {
        /// The variable.
        var: SysVar,
    },
    /// Only field ports have this key.
    OnlyFieldPorts,
    /// The port has no safe values to apply at the start.
    NoSafeValues,
    /// A refresh for a recipe that is not sent on change.
    OnlyChangesRefresh,
}

/// Why an exchange is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ExchangeError {
    /// The recipe is realtime.
    NeedsUser,
    /// One recipe mixes Modbus master, Modbus slave and a device's own frames.
    Mixed,
    /// The frames of a part are separated by something else than their fields, so replies cannot be found.
    CutParts,
    /// A Modbus recipe has parts.
    PartsBesideModbus,
    /// A frame without an id in a CAN recipe, or with an id in a stream recipe.
    WrongBus,
    /// An invalid slave address.
    Slave {
        /// The address.
        address: u8,
    },
    /// An invalid address for the gateway as a slave.
    OwnAddress {
        /// The address.
        address: u8,
    },
    /// Blocks of one slave have different addresses.
    OtherAddress,
    /// Registers or coils after the last one.
    BeyondLast {
        /// The first address.
        address: u16,
        /// Their number.
        count: u16,
    },
    /// A broadcast read, which nobody would answer.
    BroadcastRead,
    /// A broadcast over Modbus TCP, which has none.
    BroadcastOverTcp,
    /// A field of coils that is not one bit.
    NotCoils,
    /// More slaves or other peers than allowed on one port.
    TooManyPeers,
    /// An invalid count of registers or coils.
    Count(CountError),
    /// The fields do not fill their registers or coils.
    Fields {
        /// Number of bytes of the registers or coils.
        needed: usize,
        /// Number of bytes of the fields.
        found: usize,
    },
    /// A field of varying length.
    Varying,
    /// The fields are not the bits of the mask, or are no bits or all bits of the register.
    Mask,
    /// An operation that the gateway does not serve as a slave.
    NotServed,
    /// The registers or coils overlap those of another block.
    Overlap,
    /// Neither a request nor a reply.
    Nothing,
    /// A pending answer or a refusal needs a request and its reply.
    LoneRefusal,
    /// The request has no trigger.
    Never,
    /// An unsolicited reply has triggers.
    Unasked,
    /// A remote request has fields.
    RemoteFields,
    /// A received frame is a remote frame.
    RemoteReply,
    /// A pending answer or a refusal has commands or an alive counter.
    RefusalValues,
    /// A pending answer or a refusal whose frames always match another answer that is checked first.
    Hidden,
    /// A pending answer may equal its request, like an echo.
    PendingEcho,
    /// A sign of a restart without requests at the start, or without a reply.
    RestartedNothing,
    /// The field that shows a restart is not one with a number in the reply.
    RestartedField {
        /// The field, counted from 0.
        field: u8,
    },
    /// A frame has the same id as another one that may arrive at the same time, and no constant tells them apart.
    Indistinguishable {
        /// Their id.
        id: CanId,
    },
    /// More CAN ids of received frames than allowed on one port.
    TooManyIds,
    /// An invalid time in which an event may be sent.
    Trigger {
        /// The time.
        time: Duration,
    },
    /// A time or outcome of events, but the exchange has no events.
    NoEvent,
    /// A write that stops its peer, but has no confirmation.
    StopNeedsReply,
    /// An exchange that follows itself, or a missing exchange.
    FollowsNothing {
        /// The exchange to follow, counted from 0.
        follow: u8,
    },
    /// An exchange that follows another one without a reply.
    FollowsUnanswered,
    /// An exchange that follows another one and also has a rising bit or stops its peer.
    FollowsAndRises,
    /// Exchanges follow each other in a circle.
    FollowsCircle,
    /// The variable cannot report the outcome of an event.
    NotForOutcome {
        /// The variable.
        var: SysVar,
    },
}
