//! A CAN database (DBC) of the frames of a file's CAN ports.
//!
//! In: the frames of a file. Out: the text. Signals have the raw values on the bus, as `host-sim decode` shows them;
//! comments say what they are used for. Frames that share an id are multiplexed by the constants in which they differ.

mod multiplex;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use proto_core::device::{Bits, ByteOrder, Element, Encoding, Kind};
use proto_core::sysvar::Direction;
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;

use crate::model::{BusModel, Format, FrameField, Model, Owner, PortModel};
use crate::names::{Collision, Names};
use crate::uses::{describe_use, unit_of};
use multiplex::Multiplex;

/// A database.
#[derive(Debug, Clone)]
pub struct Dbc {
    /// The file's text, ASCII.
    pub text: String,
    /// What a DBC cannot express.
    pub notes: Vec<String>,
}

/// Why no database was made.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum DbcError {
    /// There is no port with this name.
    NoPort {
        /// The requested name.
        name: String,
        /// The names of the CAN ports.
        known: Vec<String>,
    },
    /// The file has no CAN port.
    NoCan,
    /// Two ports have different frames with one id.
    SharedId {
        /// The id.
        id: u32,
        /// The ports.
        ports: [String; 2],
    },
    /// Two names have the same identifier.
    Names(Collision),
}

impl fmt::Display for DbcError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoPort { name, known } => {
                write!(f, "there is no CAN port {name:?}; there are {}", known.join(", "))
            }
            Self::NoCan => f.write_str("there is no CAN port in this file"),
            Self::SharedId { id, ports: [one, other] } => write!(
                f,
                "ports {one} and {other} have different frames with id {id:#X}; choose one port with --port NAME"
            ),
            Self::Names(collision) => collision.fmt(f),
        }
    }
}

impl std::error::Error for DbcError {}

impl From<Collision> for DbcError {
    fn from(collision: Collision) -> Self {
        Self::Names(collision)
    }
}

/// The database of all CAN ports, or of the port called `port`.
pub fn dbc(model: &Model, port: Option<&str>) -> Result<Dbc, DbcError> {
    let can = || model.ports.iter().filter(|port| matches!(port.bus, BusModel::Can { .. }));
    let known = || can().map(|port| port.name.clone()).collect::<Vec<_>>();
    let ports: Vec<&PortModel> = match port {
        Some(name) => can().filter(|port| port.name == name).collect(),
        None => can().collect(),
    };
    match (&ports[..], port) {
        ([], Some(name)) if !known().is_empty() => {
            return Err(DbcError::NoPort { name: name.to_owned(), known: known() });
        }
        ([], _) => return Err(DbcError::NoCan),
        _ => {}
    }
    let mut writer = DbcWriter::new(model.owner);
    for message in messages(model, &ports)?.values() {
        writer.message(message)?;
    }
    Ok(writer.finish(&ports))
}

struct DbcMessage<'m> {
    id: CanId,
    recipe: &'m str,
    port: &'m PortModel,
    formats: Vec<&'m Format>,
}

fn messages<'m>(
    model: &'m Model,
    ports: &[&'m PortModel],
) -> Result<BTreeMap<u32, DbcMessage<'m>>, DbcError> {
    let mut messages: BTreeMap<u32, DbcMessage<'m>> = BTreeMap::new();
    for port in ports {
        let Some(recipe) = model.recipe_of(port) else { continue };
        for format in recipe.formats.iter().filter(|format| !format.is_remote) {
            let Some(id) = format.id else { continue };
            let new = || DbcMessage { id, recipe: &recipe.name, port, formats: Vec::new() };
            let message = messages.entry(number(id)).or_insert_with(new);
            if message.port.name == port.name {
                message.formats.push(format);
            } else if message.recipe != recipe.name {
                let ports = [message.port.name.clone(), port.name.clone()];
                return Err(DbcError::SharedId { id: number(id) & 0x1FFF_FFFF, ports });
            }
        }
    }
    Ok(messages)
}

/// An id in a DBC: bit 31 marks a 29-bit id.
fn number(id: CanId) -> u32 {
    match id {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id | 1 << 31,
    }
}

#[derive(Default)]
struct DbcWriter {
    owner: &'static str,
    nodes: Names,
    message_names: Names,
    messages: String,
    /// Comments, attributes, names of values and the rest, which have separate places in the file.
    comments: String,
    attributes: String,
    value_names: String,
    value_types: String,
    multiplexed: String,
    notes: Vec<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct SignalShape {
    start: usize,
    bits: usize,
    order: ByteOrder,
    signed: bool,
    /// As in `SIG_VALTYPE_`: 0 integer, 1 float, 2 double.
    value_type: u8,
}

impl DbcWriter {
    fn new(owner: Owner) -> Self {
        Self {
            owner: match owner {
                Owner::Gateway => "Gateway",
                Owner::Controller => "Controller",
            },
            ..Self::default()
        }
    }

    fn device(&mut self, port: &PortModel) -> Result<String, Collision> {
        self.nodes.add(&format!("{}-device", port.name))
    }

    fn message(&mut self, message: &DbcMessage<'_>) -> Result<(), DbcError> {
        let DbcMessage { id, recipe, port, formats } = message;
        let device = self.device(port)?;
        let (id, shown) = (number(*id), number(*id) & 0x1FFF_FFFF);
        let name = self.message_names.add(&format!("{recipe}-{shown:03X}"))?;
        let len = formats.iter().map(|format| format.frame.layout.lengths().1).max().unwrap_or(0);
        let is_sent = formats.iter().any(|format| format.direction == Direction::Output);
        let (sender, receiver) =
            if is_sent { (self.owner.to_owned(), device) } else { (device, self.owner.to_owned()) };
        self.messages += &format!("\nBO_ {id} {name}: {len} {sender}\n");
        let roles: Vec<_> = formats.iter().map(|format| format.role.name()).collect();
        let comment = format!("recipe {recipe}, {}, port {}", roles.join(", "), port.name);
        self.comments += &format!("CM_ BO_ {id} \"{}\";\n", quoted(&comment));
        if let Some(every) = formats.iter().find_map(|format| period(format, port)) {
            self.attributes += &format!("BA_ \"GenMsgCycleTime\" BO_ {id} {};\n", every.as_millis());
        }
        let multiplex = Multiplex::of(formats);
        if formats.len() > 1 && multiplex.is_none() {
            let message =
                format!("the frames with id {shown:#X} do not differ in constants; only the first is in");
            self.notes.push(message);
        }
        let mut scope = Scope {
            id,
            receiver,
            names: Names::default(),
            in_several: in_several(formats),
            done: BTreeSet::new(),
        };
        match multiplex {
            None => {
                scope.in_several.clear();
                for format in formats.iter().take(1) {
                    self.signals(&mut scope, format, "", None, &[])?;
                }
            }
            Some(multiplex) => self.multiplexed(&mut scope, formats, &multiplex)?,
        }
        Ok(())
    }

    /// The signals of frames with one id: the multiplexing constants, then the signals of each frame.
    fn multiplexed(
        &mut self,
        scope: &mut Scope,
        formats: &[&Format],
        multiplex: &Multiplex,
    ) -> Result<(), DbcError> {
        let first = &multiplex.first;
        let top = scope.names.add_new(&first.name)?;
        self.signal(scope, &top, " M", first.shape);
        for value in multiplex.values() {
            let those = || formats.iter().filter(|format| multiplex.first_of(format) == Some(value));
            let second = multiplex.second.as_ref().filter(|_| those().count() > 1);
            let Some(second) = second else {
                for format in those() {
                    let skipped = [first.shape];
                    self.signals(scope, format, &format!(" m{value}"), Some((&top, value)), &skipped)?;
                }
                continue;
            };
            let inner = scope.names.add_new(&format!("{}-{value}", second.name))?;
            self.signal(scope, &inner, &format!(" m{value}M"), second.shape);
            self.multiplexed += &format!("SG_MUL_VAL_ {} {inner} {top} {value}-{value};\n", scope.id);
            for format in those() {
                let Some(number) = multiplex.second_of(format) else { continue };
                let skipped = [first.shape, second.shape];
                self.signals(scope, format, &format!(" m{number}"), Some((&inner, number)), &skipped)?;
            }
        }
        Ok(())
    }

    fn signals(
        &mut self,
        scope: &mut Scope,
        format: &Format,
        tag: &str,
        below: Option<(&str, u64)>,
        skipped: &[SignalShape],
    ) -> Result<(), DbcError> {
        for (field, element) in format.named_values() {
            let Some(shape) = shape(field, element) else {
                self.notes.push(format!("{} has no place that a signal can have", field.name()));
                continue;
            };
            if skipped.contains(&SignalShape { signed: false, ..shape }) {
                continue;
            }
            let (mut name, mut tag, mut below) = (field.name().to_owned(), tag, below);
            match scope.in_several.get(field.name()) {
                None => {}
                // The field is the same in every frame, so its signal is not multiplexed.
                Some(Several::Same) => {
                    if !scope.done.insert(name.clone()) {
                        continue;
                    }
                    (tag, below) = ("", None);
                }
                Some(Several::Different) => {
                    // Several frames may have the same role; their multiplexing numbers differ.
                    let number = below.map_or(0, |(_, number)| number);
                    let above = skipped.get(1).and(below).map_or("", |(above, _)| above);
                    name = format!("{name}-{}-{above}{number}", format.role.name());
                }
            }
            for (half, shape) in halves(shape) {
                let identifier = scope.names.add_new(&format!("{name}{half}"))?;
                let unit = field.system.map_or("", unit_of);
                self.signal_with(scope, &identifier, tag, shape, unit);
                if let Some((above, value)) = below {
                    let id = scope.id;
                    self.multiplexed += &format!("SG_MUL_VAL_ {id} {identifier} {above} {value}-{value};\n");
                }
                self.describe(scope.id, &identifier, field, element, half);
            }
        }
        Ok(())
    }

    fn signal(&mut self, scope: &Scope, name: &str, tag: &str, shape: SignalShape) {
        self.signal_with(scope, name, tag, shape, "");
    }

    fn signal_with(&mut self, scope: &Scope, name: &str, tag: &str, shape: SignalShape, unit: &str) {
        let SignalShape { start, bits, order, signed, value_type } = shape;
        let order = if order == ByteOrder::Big { 0 } else { 1 };
        let sign = if signed { '-' } else { '+' };
        let receiver = &scope.receiver;
        self.messages +=
            &format!(" SG_ {name}{tag} : {start}|{bits}@{order}{sign} (1,0) [0|0] \"{unit}\" {receiver}\n");
        if value_type > 0 {
            self.value_types += &format!("SIG_VALTYPE_ {} {name} : {value_type};\n", scope.id);
        }
    }

    /// Writes the comment and the names of values.
    fn describe(&mut self, id: u32, name: &str, field: &FrameField, element: &Element, half: &str) {
        let mut words = Vec::new();
        if name != field.name() {
            words.push(format!("field {}", field.name()));
        }
        words.extend(encoding_words(element).map(str::to_owned));
        words.extend((!half.is_empty()).then(|| "16 bits of 32, whose words are swapped".to_owned()));
        let uses = describe_use(field);
        words.extend((!uses.is_empty()).then_some(uses));
        if !words.is_empty() {
            self.comments += &format!("CM_ SG_ {id} {name} \"{}\";\n", quoted(&words.join("; ")));
        }
        let commands = field.field.commands.iter().flat_map(|commands| &commands.entries);
        let named = commands.filter(|(first, last, text)| first == last && !text.is_empty());
        let named: String = named.map(|(value, _, text)| format!(" {value} \"{}\"", quoted(text))).collect();
        if !named.is_empty() {
            self.value_names += &format!("VAL_ {id} {name}{named} ;\n");
        }
    }

    fn finish(mut self, ports: &[&PortModel]) -> Dbc {
        let devices: Vec<_> = ports.iter().filter_map(|port| self.device(port).ok()).collect();
        let text = format!(
            "VERSION \"\"\n\nNS_ :\n\tCM_\n\tBA_DEF_\n\tBA_\n\tVAL_\n\tBA_DEF_DEF_\n\tSIG_VALTYPE_\n\tSG_MUL_VAL_\n\nBS_:\n\n\
             BU_: {} {}\n{}\n{}\
             BA_DEF_ BO_ \"GenMsgCycleTime\" INT 0 65535;\nBA_DEF_DEF_ \"GenMsgCycleTime\" 0;\n{}{}{}{}",
            self.owner,
            devices.join(" "),
            self.messages,
            self.comments,
            self.attributes,
            self.value_names,
            self.value_types,
            self.multiplexed,
        );
        Dbc { text, notes: self.notes }
    }
}

struct Scope {
    id: u32,
    receiver: String,
    names: Names,
    /// Names of fields that occur in several frames.
    in_several: BTreeMap<String, Several>,
    /// The names in `in_several` that are already written.
    done: BTreeSet<String>,
}

/// A field name that occurs in several frames of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Several {
    /// In all frames, at the same place.
    Same,
    /// In some frames, or at different places.
    Different,
}

fn in_several(formats: &[&Format]) -> BTreeMap<String, Several> {
    let mut shapes: BTreeMap<String, Vec<Option<SignalShape>>> = BTreeMap::new();
    for (field, element) in formats.iter().flat_map(|format| format.named_values()) {
        shapes.entry(field.name().to_owned()).or_default().push(shape(field, element));
    }
    let kind = |shapes: &[Option<SignalShape>]| {
        let is_same = shapes.len() == formats.len() && shapes.iter().all(|shape| *shape == shapes[0]);
        if is_same { Several::Same } else { Several::Different }
    };
    let several = shapes.into_iter().filter(|(_, shapes)| shapes.len() > 1);
    several.map(|(name, shapes)| (name, kind(&shapes))).collect()
}

/// The period of a frame.
fn period(format: &Format, port: &PortModel) -> Option<Duration> {
    use crate::model::Role;
    match format.role {
        Role::Output => port.period,
        Role::Request(_) => format.every,
        _ => None,
    }
}

/// The place of a field's bits; `None` if it is not the same in all frames.
fn shape(field: &FrameField, element: &Element) -> Option<SignalShape> {
    let (at, len) = (field.place.at?, field.place.len?);
    let whole = SignalShape { start: 0, bits: 8 * len, order: ByteOrder::Big, signed: false, value_type: 0 };
    let Some(encoding) = element.encoding() else {
        // Characters: the first one is the highest byte.
        return Some(SignalShape { start: 8 * at + 7, ..whole }).filter(|shape| shape.bits <= 64);
    };
    let order = if len == 1 { ByteOrder::Little } else { encoding.order };
    let (first, bits, signed, value_type) = match encoding.kind {
        Kind::Bits(Bits { first, count, signed, .. }) => (usize::from(first), usize::from(count), signed, 0),
        Kind::Scalar(ScalarType::Float) => (0, 32, true, 1),
        Kind::Scalar(ScalarType::Double) => (0, 64, true, 2),
        Kind::Scalar(ScalarType::Char | ScalarType::Short | ScalarType::Int) | Kind::Int24 => {
            (0, 8 * len, true, 0)
        }
        Kind::Scalar(_) | Kind::Uint24 | Kind::Bcd { .. } => (0, 8 * len, false, 0),
        // Digits are read from left to right.
        _ => return Some(SignalShape { start: 8 * at + 7, ..whole }).filter(|shape| shape.bits <= 64),
    };
    let start = match order {
        ByteOrder::Big => {
            // The position of the highest bit if the last byte is the lowest.
            let highest = first + bits - 1;
            8 * (at + len - 1).checked_sub(highest / 8)? + highest % 8
        }
        _ => 8 * at + first,
    };
    Some(SignalShape { start, bits, order, signed, value_type })
}

/// A number with swapped words becomes two signals, because a DBC cannot express it as one; others stay as they are.
fn halves(shape: SignalShape) -> Vec<(&'static str, SignalShape)> {
    if !shape.order.swaps_words() {
        return vec![("", shape)];
    }
    let at = shape.start / 8;
    let half = |word: usize, order| {
        let start = 8 * (at + 2 * word) + if order == ByteOrder::Big { 7 } else { 0 };
        SignalShape { start, bits: 16, order, signed: false, value_type: 0 }
    };
    let words = (shape.bits + shape.start % 8).div_ceil(16);
    let order = if shape.order == ByteOrder::BigSwapped { ByteOrder::Big } else { ByteOrder::Little };
    let names = ["-word1", "-word2", "-word3", "-word4"];
    names.into_iter().zip(0..words).map(|(name, word)| (name, half(word, order))).collect()
}

/// Describes what a signal cannot express of a field's encoding.
fn encoding_words(element: &Element) -> Option<&'static str> {
    match element {
        Element::Text(_) => Some("characters, the first is the highest byte"),
        _ => match element.encoding()? {
            Encoding { kind: Kind::Bcd { .. }, .. } => Some("decimal digits, four bits each"),
            Encoding { kind: Kind::Decimal(_) | Kind::Hex(_), .. } => {
                Some("digits in ASCII, the first is the highest byte")
            }
            _ => None,
        },
    }
}

/// The content of a quoted text. Replaces quotes, backslashes, and characters other than ASCII, which have no encoding
/// that every tool reads.
fn quoted(text: &str) -> String {
    let plain = |c: char| match c {
        '"' => "'".to_owned(),
        '\\' => "/".to_owned(),
        ' '..='~' => c.to_string(),
        _ => c.escape_unicode().to_string().replace('\\', ""),
    };
    text.chars().map(plain).collect()
}
