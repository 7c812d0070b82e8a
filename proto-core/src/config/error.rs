//! What can be wrong with a configuration, and where.

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

/// The first mistake that [`ConfigView::validate`](super::ConfigView::validate) found.
///
/// Its `Display` counts recipes and ports from 1; [`ConfigView::describe`](super::ConfigView::describe) names them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConfigError {
    /// Where it is.
    pub place: Place,
    /// What is wrong.
    pub kind: ConfigErrorKind,
}

/// A place in a configuration. Numbers are indices, from 0.
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
        /// Index of the CAN frame in the part; 0 in a stream recipe. The frames of exchanges are counted
        /// on behind those of the part.
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
        /// What about it.
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
    /// User-defined fields that pick commands.
    CommandFields,
    /// Bytes of all command texts.
    CommandBytes,
    /// Frames of one port with a device's own frames.
    DeviceFrames,
    /// Bytes of whose bits an input frame writes some, over all input frames.
    BitShares,
    /// Texts of one port.
    Texts,
    /// Alive counters of all input frames.
    Counters,
    /// Groups of variables that arrive together.
    Groups,
    /// Blocks of neighbouring variables that are polled by Modbus.
    PollBlocks,
    /// Values of the state packet and of the health of ports that all ports send.
    Sources,
    /// Exchanges of all recipes.
    Exchanges,
    /// Frames of all exchanges.
    ExchangeFrames,
    /// Pieces of 32 bytes that the blocks need which masters write.
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
    /// There is no dialect of this name.
    UnknownDialect,
    /// A port number of the controller is 0.
    ZeroPort,
    /// A prefix that leaves no room for hosts, or is not a prefix.
    Prefix {
        /// The prefix.
        prefix: u8,
    },
    /// The address cannot be that of a host in the board's network.
    NoHostAddress {
        /// The address.
        address: Ipv4Addr,
        /// The board's network.
        network: Network,
    },
    /// The board's own address, where that of another host is required.
    OwnAddress,
    /// The address is in another network, and no router is configured.
    NeedsRouter {
        /// The address.
        address: Ipv4Addr,
        /// The board's network.
        network: Network,
    },
    /// The controller is configured by name, and no name server is configured.
    NeedsDns,
    /// There is no recipe with this index.
    NoSuchRecipe {
        /// The index.
        recipe: u8,
        /// How many recipes there are.
        recipes: u8,
    },
    /// A range of fields, commands or safe values ends beyond its list.
    OutsidePool {
        /// The end of the range.
        end: u32,
        /// The length of the list.
        len: u32,
    },
    /// More entries than there is room for in this type of configuration, or in any.
    TooMany {
        /// The list.
        what: Counted,
        /// Number of entries needed.
        needed: usize,
        /// Number of entries there is room for.
        room: usize,
    },
    /// A text or a delimiter is too long.
    TooLong {
        /// Its length in bytes.
        len: usize,
        /// The longest that is allowed, in bytes.
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
    /// The name is not that of a system variable.
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
    /// Sent for each input frame, but there is no input part.
    NoInputToAnswer,
    /// A scale is 0 or not finite, or an offset is not finite.
    BadScale {
        /// Scale.
        scale: f32,
        /// Offset.
        offset: f32,
    },
    /// A constant does not fit in its field, or a safe value in its variable.
    Constant(ScalarError),
    /// This use needs a field of an integer type.
    NeedsInteger {
        /// The field's type.
        ty: ScalarType,
    },
    /// The frame of a device cannot be laid out.
    Layout(LayoutError),
    /// The exchange cannot be.
    Exchange(ExchangeError),
    /// The range of an alive counter.
    Counter {
        /// Its highest number.
        max: u32,
        /// The highest number of the field; below 0 if it is none of unsigned integers.
        high: f64,
    },
    /// An echo is told from replies in exchanges only.
    EchoNeedsExchanges,
    /// A number that its field cannot have.
    NotInField {
        /// The number.
        value: f64,
        /// The smallest number that the field can have.
        low: f64,
        /// The largest.
        high: f64,
    },
    /// This use needs a field that has integers only.
    NeedsIntegers,
    /// Only integers wrap around.
    OnlyIntegersWrap,
    /// Limits or an entry of a table stand behind no output field with a source.
    NothingToLimit,
    /// Limits, a table or a rule stand behind no input field that writes a variable as a whole.
    NothingToRule,
    /// A field has the same rule twice, or one after the table that it changes.
    RuleTwice,
    /// What becomes of all other values, without a table.
    ElseWithoutMap,
    /// A number that its variable cannot have.
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
    /// A text can only stand for no value where digits stand.
    NoTextNeedsDigits,
    /// A comma is for decimal digits that it does not end.
    NoComma,
    /// A field that wraps has limits or a table.
    LimitsAndWrap,
    /// A field has limits twice, or limits and a table.
    LimitsAndMap,
    /// A count wraps, and has neither limits nor a table.
    LimitedCount,
    /// A table takes the values of the source as they are.
    ScaledMap,
    /// The limits of a field run backwards.
    BackwardLimits {
        /// The lowest number.
        low: f64,
        /// The highest number.
        high: f64,
    },
    /// A number with a fraction, where its field has integers only.
    FractionOfInteger {
        /// The number.
        value: f64,
    },
    /// A number with more digits behind the point than its field has.
    TooManyDecimals {
        /// The number.
        value: f64,
        /// Digits of the field.
        decimals: u8,
    },
    /// An earlier entry of the table has the value.
    MappedTwice {
        /// The value.
        value: i64,
    },
    /// No checksum has this name.
    UnknownChecksum,
    /// A text, its length or its count needs so many word variables that follow each other.
    NotWords {
        /// The first variable.
        var: SysVar,
        /// Number of variables.
        count: u8,
    },
    /// A word has two characters, so their order is little or big.
    TextOrder,
    /// Frames that are told apart by something else than their fields, in a realtime recipe.
    FramingNeedsUser,
    /// Escape bytes and something else tell frames apart.
    TwoFramings,
    /// Frames are told apart by a tail that the part does not have.
    NoTail,
    /// A command table has no entries.
    EmptyTable,
    /// The field can never have a command's value.
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
    /// A recipe writes a variable as a whole and one of its bits.
    WholeAndBit {
        /// The bit.
        bit: VarBit,
    },
    /// Only variables made of bits have bits.
    HasNoBits {
        /// The variable.
        var: SysVar,
    },
    /// Input fields write input variables only.
    NotAnInput {
        /// The variable.
        var: SysVar,
    },
    /// Two fields of one recipe write the same variable.
    WrittenTwice {
        /// The variable.
        var: SysVar,
    },
    /// A trigger needs a variable made of bits.
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
    /// A time is longer than makes sense.
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
    /// Another recipe than that of a Modbus master on a port of Modbus TCP.
    NeedsModbusMaster {
        /// Index of the recipe.
        recipe: u8,
    },
    /// A stream recipe on a CAN bus (D16).
    NeedsCanRecipe {
        /// Index of the recipe.
        recipe: u8,
    },
    /// A user-defined recipe where the controller knows realtime ones only (D16).
    NeedsRealtimeRecipe {
        /// Index of the recipe.
        recipe: u8,
    },
    /// Not an address and port to listen on.
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
    /// One port writes the whole variable, and the other one of its bits.
    OwnedAndShared {
        /// The bit.
        bit: VarBit,
        /// Index of the other port.
        other: u8,
    },
    /// A port writes a variable that no configured way up can carry (D15).
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
    /// A way up carries a variable that no port owns and that cannot be read back, so its value is
    /// not known.
    Unowned {
        /// The variable.
        var: SysVar,
    },
    /// A safe value for a variable that the port does not write.
    NotOwned {
        /// The variable.
        var: SysVar,
    },
    /// A safe value for bits that the port does not write one by one.
    BitsNotOwned {
        /// The variable.
        var: SysVar,
        /// Its bits.
        mask: u8,
    },
    /// A safe value's type is not its variable's.
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
    /// The text of a command is not a request of port 2000 with one of its values.
    CommandFor {
        /// The value.
        value: i64,
        /// What is wrong with the text.
        error: ParseError,
    },
    /// The values of a command run backwards.
    BackwardRange {
        /// The first value.
        first: i64,
        /// The last value.
        last: i64,
    },
    /// The controller's state packet has no such value.
    StateValue(StateValueError),
    /// There is no field port with this index.
    NoFieldPort {
        /// The index.
        port: u8,
    },
    /// There is no such link: no UDP server of recipes is configured, or the port does not listen.
    NoLink {
        /// The link.
        link: LinkSource,
    },
    /// Counts have no scale and offset: they wrap.
    ScaledCount,
    /// The variable cannot tell the health of a port.
    NotForHealth {
        /// The variable.
        var: SysVar,
    },
    /// The port itself writes the variable, from its frames or as another value of its health.
    HealthTwice {
        /// The variable.
        var: SysVar,
    },
    /// Only field ports have this key.
    OnlyFieldPorts,
    /// Safe values at the start, but the port has no safe values.
    NoSafeValues,
    /// Only a recipe that is sent on change is refreshed.
    OnlyChangesRefresh,
}

/// Why an exchange is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ExchangeError {
    /// The recipe is realtime.
    NeedsUser,
    /// Modbus master, Modbus slave and frames of a device's own are mixed in one recipe.
    Mixed,
    /// What tells the frames of a part apart is not their fields: replies could not be found.
    CutParts,
    /// A recipe of Modbus has parts.
    PartsBesideModbus,
    /// A frame for a line in a CAN recipe, or one with an id in a stream recipe.
    WrongBus,
    /// The slave's address.
    Slave {
        /// The address.
        address: u8,
    },
    /// The address of the gateway as a slave.
    OwnAddress {
        /// The address.
        address: u8,
    },
    /// Blocks of one slave with different addresses.
    OtherAddress,
    /// Registers or coils behind the last one.
    BeyondLast {
        /// The first of them.
        address: u16,
        /// How many there are.
        count: u16,
    },
    /// A broadcast that reads: nobody would answer.
    BroadcastRead,
    /// A write to all slaves over Modbus TCP, which has no broadcast.
    BroadcastOverTcp,
    /// A field of coils that is not one bit.
    NotCoils,
    /// More slaves or other peers than one port can have.
    TooManyPeers,
    /// The count of registers or coils.
    Count(CountError),
    /// The fields do not fill their registers or coils.
    Fields {
        /// The bytes of the registers or coils.
        needed: usize,
        /// The bytes of the fields.
        found: usize,
    },
    /// The fields have no fixed length.
    Varying,
    /// The fields are not the bits that the mask names, or are none, or all of the register.
    Mask,
    /// An operation that a slave does not serve.
    NotServed,
    /// Registers or coils that another block has.
    Overlap,
    /// Neither request nor reply.
    Nothing,
    /// A pending answer or a refusal without a request and its reply.
    LoneRefusal,
    /// A request that is never sent.
    Never,
    /// A reply that comes unasked has a time at which it is asked.
    Unasked,
    /// A remote request with fields.
    RemoteFields,
    /// A remote frame that the gateway would receive.
    RemoteReply,
    /// A pending answer or a refusal with commands or an alive counter.
    RefusalValues,
    /// A pending answer or a refusal whose frames are all taken for an answer that is looked for first.
    Hidden,
    /// A pending answer that may have the bytes of its request, as an echo has.
    PendingEcho,
    /// Nothing is asked at the start of the peer, so its restart means nothing; or there is no reply.
    RestartedNothing,
    /// The field that tells of a restart is none with a number in the reply.
    RestartedField {
        /// The field, counted from 0.
        field: u8,
    },
    /// A frame with the id of another one that can come at the same time, and no constant that tells
    /// them apart.
    Indistinguishable {
        /// Their id.
        id: CanId,
    },
    /// More CAN ids of received frames than one port can have.
    TooManyIds,
    /// The time in which an event may be sent.
    Trigger {
        /// The time.
        time: Duration,
    },
    /// A time or outcome of events of an exchange that no event asks.
    NoEvent,
    /// A write that stops its peer and that nothing confirms.
    StopNeedsReply,
    /// An exchange that follows itself, or one that the recipe does not have.
    FollowsNothing {
        /// The exchange that it names, counted from 0.
        follow: u8,
    },
    /// An exchange that follows one without a reply.
    FollowsUnanswered,
    /// An exchange that follows another and has a rising bit of its own, or stops its peer.
    FollowsAndRises,
    /// Exchanges that follow each other in a circle.
    FollowsCircle,
    /// A variable that cannot tell what became of an event.
    NotForOutcome {
        /// The variable.
        var: SysVar,
    },
}
