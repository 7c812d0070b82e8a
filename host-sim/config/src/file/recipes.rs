//! `[[recipe]]` of both kinds of files: read once, and checked by the layouts themselves.
//!
//! In: tables. Out: [`FileRecipe`], which keeps the places for later checks.

use proto_core::config::{FieldSpec, InputBinding, OnStale, OutputBinding};
use proto_core::device::{Boundary, Checksum, Encoding, Escape, Kind, Overflow};
use proto_core::recipe::CanLayout;
use proto_core::recipe::PartError;
use proto_core::recipe::StreamLayout;
use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::sysvar::{Direction, SysVar, VarRange};
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;

use super::bindings::{self, FileInput, FileOutput};
use super::checksums;
use super::device::{self, FieldReader};
use super::encoding::refuse;
use super::exchanges::{self, FileExchange};
use super::framings;
use super::modbus;
use super::names::{did_you_mean, meant_variable};
use super::order::{self, FrameOrder, ORDER_KEYS};
use super::reader::{Result, Spot, TableReader, TableValue};
use crate::device::AnyRecipe;
use crate::keys;
use crate::sim::{SimCanFrame, SimField, SimParts, SimRecipe, SimStreamPart};

/// The kind of file: only a gateway's recipes have bindings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Flavour {
    Gateway,
    Controller,
}

pub(super) struct FileRecipe {
    pub(super) spot: Spot,
    pub(super) name: String,
    pub(super) name_spot: Spot,
    pub(super) mode: Mode,
    pub(super) kind: RecipeKind,
    pub(super) input: Option<FilePart>,
    pub(super) output: Option<FilePart>,
    /// What is asked of devices beside the parts, or all that a recipe of Modbus has.
    pub(super) exchanges: Vec<FileExchange>,
    /// What requests do while a value of them is stale, if there is no output part to say it.
    pub(super) on_stale: Option<OnStale>,
}

/// What carries a recipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RecipeKind {
    Stream,
    Can,
    ModbusMaster,
    ModbusSlave,
}

/// The words of `kind`.
pub(crate) const KINDS: [(&str, RecipeKind); 4] = [
    ("stream", RecipeKind::Stream),
    ("can", RecipeKind::Can),
    ("modbus-rtu", RecipeKind::ModbusMaster),
    ("modbus-rtu-slave", RecipeKind::ModbusSlave),
];

impl RecipeKind {
    /// As files have it.
    pub(super) fn name(self) -> &'static str {
        KINDS.iter().find(|(_, kind)| *kind == self).map_or("", |(name, _)| name)
    }

    pub(super) fn is_modbus(self) -> bool {
        matches!(self, Self::ModbusMaster | Self::ModbusSlave)
    }
}

pub(super) struct FilePart {
    pub(super) spot: Spot,
    pub(super) head: Vec<u8>,
    pub(super) tail: Vec<u8>,
    pub(super) head_spot: Option<Spot>,
    pub(super) tail_spot: Option<Spot>,
    /// One in a stream part, one for each id in a CAN part.
    pub(super) frames: Vec<FileFrame>,
    /// The gateway's keys of an output part.
    pub(super) sending: bindings::Sending,
    /// What tells the frames of a stream apart.
    pub(super) framing: (Boundary, Option<Escape>),
}

pub(super) struct FileFrame {
    pub(super) spot: Spot,
    /// 0 in a stream part.
    pub(super) id: CanId,
    pub(super) id_spot: Spot,
    pub(super) fields: Vec<FileField>,
    /// Of an output frame on CAN.
    pub(super) order: FrameOrder,
}

pub(super) struct FileField {
    pub(super) spot: Spot,
    pub(super) kind: FileFieldKind,
}

pub(super) enum FileFieldKind {
    System(SysVar),
    /// `again` marks a second use of the bytes of the field before.
    UserInput {
        name: String,
        written: WrittenField,
        to: FileInput,
        again: bool,
        /// The number that tells that the device has restarted.
        restarted: Option<(Spot, f64)>,
    },
    UserOutput {
        name: String,
        written: WrittenField,
        from: FileOutput,
    },
    Fixed {
        name: Option<String>,
        encoding: Encoding,
        value: i64,
    },
    Padding {
        len: u8,
        fill: u8,
    },
    Checksum(Checksum),
    /// What has no binding of a number: a text, or a length.
    Device {
        name: Option<String>,
        spec: FieldSpec,
    },
}

/// How a field with a value is written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct WrittenField {
    pub(super) encoding: Encoding,
    pub(super) overflow: Overflow,
}

impl WrittenField {
    pub(super) fn plain(ty: ScalarType) -> Self {
        Self { encoding: Encoding::scalar(ty), overflow: Overflow::Usual }
    }

    /// The type, if the controller's recipes have such a field.
    fn as_plain(self) -> Option<ScalarType> {
        match self.encoding.kind {
            Kind::Scalar(ty) if self == Self::plain(ty) => Some(ty),
            _ => None,
        }
    }
}

impl FileField {
    /// The field as the controller's recipes have it; `None` if only frames of devices have it.
    fn field(&self) -> Option<Field> {
        match self.kind {
            FileFieldKind::System(var) => Some(Field::System(var)),
            FileFieldKind::UserInput { written, .. } | FileFieldKind::UserOutput { written, .. } => {
                written.as_plain().map(Field::User)
            }
            _ => None,
        }
    }

    /// The field as the configuration has it; `bind` makes the binding of an input field.
    pub(super) fn bound_spec(&self, bind: impl FnOnce(&FileInput) -> InputBinding) -> FieldSpec {
        match &self.kind {
            FileFieldKind::System(var) => FieldSpec::System(*var),
            FileFieldKind::UserInput { written, to, .. } => {
                let to = bind(to);
                let WrittenField { encoding, overflow } = *written;
                match written.as_plain() {
                    Some(ty) => FieldSpec::UserInput { ty, to },
                    None => FieldSpec::DeviceInput { encoding, overflow, to },
                }
            }
            FileFieldKind::UserOutput { written, from, .. } => {
                let from = match from {
                    // Which port it is, is put in when all ports are known.
                    FileOutput::Bound(binding) | FileOutput::PortNamed { binding, .. } => *binding,
                    FileOutput::Program => OutputBinding::Constant(0.0),
                };
                let WrittenField { encoding, overflow } = *written;
                match written.as_plain() {
                    Some(ty) => FieldSpec::UserOutput { ty, from },
                    None => FieldSpec::DeviceOutput { encoding, overflow, from },
                }
            }
            &FileFieldKind::Fixed { encoding, value, .. } => FieldSpec::Fixed { encoding, value },
            &FileFieldKind::Padding { len, fill } => FieldSpec::Padding { len, fill },
            FileFieldKind::Checksum(sum) => FieldSpec::Checksum(*sum),
            FileFieldKind::Device { spec, .. } => *spec,
        }
    }

    /// The source of an output field that shows the health of a port with this name.
    pub(super) fn port_named(&self) -> Option<(OutputBinding, &str, &Spot)> {
        match &self.kind {
            FileFieldKind::UserOutput { from: FileOutput::PortNamed { name, spot, binding }, .. } => {
                Some((*binding, name, spot))
            }
            _ => None,
        }
    }

    /// Its name; empty for what needs none.
    pub(super) fn name(&self) -> String {
        match &self.kind {
            FileFieldKind::System(var) => var.to_string(),
            FileFieldKind::UserInput { name, .. } | FileFieldKind::UserOutput { name, .. } => name.clone(),
            FileFieldKind::Fixed { name, .. } | FileFieldKind::Device { name, .. } => {
                name.clone().unwrap_or_default()
            }
            FileFieldKind::Padding { .. } | FileFieldKind::Checksum(_) => String::new(),
        }
    }
}

/// Every recipe of a file, within the limits of any port.
pub(super) fn read_all(root: &TableReader<'_>, flavour: Flavour) -> Result<Vec<FileRecipe>> {
    let mut recipes: Vec<FileRecipe> = Vec::new();
    let tables = root.any_tables("recipe")?;
    tables.iter().try_for_each(|table| check_keys(table, flavour))?;
    for table in tables {
        let recipe = read(&table, flavour)?;
        if recipes.iter().any(|before| before.name == recipe.name) {
            let message = format!("there is already a recipe {:?}; names must differ", recipe.name);
            return Err(recipe.name_spot.error(root.document, message));
        }
        recipes.push(recipe);
    }
    Ok(recipes)
}

/// The index of the recipe with the name in `item`.
pub(super) fn find(recipes: &[FileRecipe], item: &TableValue<'_>) -> Result<usize> {
    let name = item.string()?;
    recipes.iter().position(|recipe| recipe.name == name).ok_or_else(|| {
        let names: Vec<_> = recipes.iter().map(|recipe| format!("{:?}", recipe.name)).collect();
        let known =
            if names.is_empty() { "there is none".into() } else { format!("there are {}", names.join(", ")) };
        let meant = did_you_mean(name, recipes.iter().map(|recipe| recipe.name.as_str()));
        item.error(format!("there is no recipe {name:?}; {known}{meant}"))
    })
}

/// A name that `--bind NAME=DEVICE` and `--set` can carry, of at most 32 bytes.
pub(super) fn read_name(table: &TableReader<'_>) -> Result<(String, Spot)> {
    let item = table.required("name", "the name that ports and tools refer to it by")?;
    let name = item.string()?;
    proto_core::config::check_name(name).map_err(|kind| item.error(kind))?;
    Ok((name.to_owned(), item.spot))
}

/// The keys of a recipe depend on its kind.
fn check_keys(table: &TableReader<'_>, flavour: Flavour) -> Result<()> {
    let given = table.optional("kind").and_then(|item| item.as_string());
    let kind = KINDS.iter().find(|(name, _)| Some(*name) == given).map(|(_, kind)| *kind);
    if flavour == Flavour::Controller {
        let why = "only gateway files have exchanges; the controller's recipes have input and output";
        refuse(table, &["exchange"], why)?;
    }
    match kind {
        // Refused with its kind.
        Some(kind) if kind.is_modbus() && flavour == Flavour::Controller => Ok(()),
        Some(kind) if kind.is_modbus() => {
            refuse(
                table,
                &["input", "output"],
                "a recipe of Modbus has no parts; its fields are in exchanges or blocks",
            )?;
            table.check(&keys::recipe::OF_GATEWAY)
        }
        _ if flavour == Flavour::Controller => table.check(&keys::recipe::OF_CONTROLLER),
        _ => table.check(&keys::recipe::OF_GATEWAY),
    }
}

fn read_kind(table: &TableReader<'_>, flavour: Flavour) -> Result<RecipeKind> {
    if flavour == Flavour::Gateway {
        let item = table.required("kind", "\"stream\", \"can\", \"modbus-rtu\" or \"modbus-rtu-slave\"")?;
        return item.choice(&KINDS);
    }
    let item = table.required("kind", "\"stream\" or \"can\"")?;
    if KINDS.iter().any(|(name, kind)| kind.is_modbus() && item.as_string() == Some(name)) {
        return Err(item.error("the controller's ports have no Modbus RTU; only gateway files do"));
    }
    item.choice(&KINDS[..2])
}

/// The words of `mode`.
pub(crate) const MODES: [(&str, Mode); 2] = [("realtime", Mode::Realtime), ("user", Mode::User)];

fn read_mode(table: &TableReader<'_>, kind: RecipeKind) -> Result<Mode> {
    if !kind.is_modbus() {
        let item =
            table.required("mode", "\"realtime\" (system variables) or \"user\" (fields of your own)")?;
        return item.choice(&MODES);
    }
    match table.optional("mode") {
        Some(item) => item.choice(&MODES[1..]),
        None => Ok(Mode::User),
    }
}

/// What all exchanges do while a value that they send is stale.
fn read_on_stale(table: &TableReader<'_>, has_output: bool, is_without: bool) -> Result<Option<OnStale>> {
    let Some(item) = table.optional("on_stale") else { return Ok(None) };
    if has_output {
        return Err(item.error("a recipe with an output part has on_stale there, also for its exchanges"));
    }
    if is_without {
        return Err(item.error("allowed only in a recipe with exchanges, or in its output part"));
    }
    bindings::read_on_stale(&item).map(Some)
}

fn read(table: &TableReader<'_>, flavour: Flavour) -> Result<FileRecipe> {
    let (name, name_spot) = read_name(table)?;
    let kind = read_kind(table, flavour)?;
    let mode = read_mode(table, kind)?;
    let is_can = kind == RecipeKind::Can;
    let read_part = |key, direction| match table.optional(key) {
        Some(item) => read_part(&item, Rules { mode, direction }, is_can, flavour).map(Some),
        None => Ok(None),
    };
    let input = read_part("input", Direction::Input)?;
    let output = read_part("output", Direction::Output)?;
    let exchanges = match kind {
        RecipeKind::Stream | RecipeKind::Can => exchanges::read_all(table, mode, is_can)?,
        RecipeKind::ModbusMaster => modbus::read_master(table)?,
        RecipeKind::ModbusSlave => modbus::read_slave(table)?,
    };
    if input.is_none() && output.is_none() && exchanges.is_empty() {
        return Err(table.error(match flavour {
            Flavour::Gateway => "a recipe needs an input part, an output part or an exchange",
            Flavour::Controller => "a recipe needs an input part, an output part or both",
        }));
    }
    let on_stale = read_on_stale(table, output.is_some(), exchanges.is_empty())?;
    let spot = table.spot.clone();
    let mut recipe = FileRecipe { on_stale, spot, name, name_spot, mode, kind, input, output, exchanges };
    let is_device = flavour == Flavour::Gateway && recipe.is_device();
    for direction in [Direction::Input, Direction::Output] {
        let Some(part) = recipe.part(direction) else { continue };
        if is_device {
            part.check_device(table, recipe.carrier(direction), direction)?;
            continue;
        }
        // UDP needs the least of a stream recipe; it does not take user-defined recipes (D16).
        let framing = if mode == Mode::User { Framing::Bytes } else { Framing::Datagram };
        part.check(Rules { mode, direction }, is_can, framing)
            .map_err(|error| part.spot_of(error).error(table.document, error))?;
    }
    if let Some(part) = &mut recipe.output {
        order::sort(&mut part.frames).map_err(|(spot, message)| spot.error(table.document, message))?;
    }
    Ok(recipe)
}

fn read_part(item: &TableValue<'_>, rules: Rules, is_can: bool, flavour: Flavour) -> Result<FilePart> {
    let is_gateway_output = flavour == Flavour::Gateway && rules.direction == Direction::Output;
    let table = item.any_table()?;
    let own = if is_can { keys::recipe::CAN_PART.common } else { keys::recipe::REALTIME.common };
    let sending_keys = if is_gateway_output { keys::recipe::SENDING } else { &[] };
    let when = if is_can { " in a CAN recipe" } else { " in a stream recipe" };
    let frame_keys = if is_can {
        device::refuse_in_can_part(&table, rules.mode, flavour)?;
        &[][..]
    } else {
        device::stream_keys(&table, rules.mode, flavour)?
    };
    table.check_keys(&[own, frame_keys, sending_keys], when)?;

    let (sending, framing) = (bindings::read_sending(&table)?, framings::read_part(&table)?);
    let mut part = FilePart { sending, framing, ..FilePart::new(&table) };
    if is_can {
        for frame in table.any_tables("frame")? {
            let frame_keys = device::frame_keys(&frame, rules.mode, flavour)?;
            let has_order = is_gateway_output && rules.mode == Mode::User;
            let order_keys = if has_order { ORDER_KEYS } else { &[] };
            frame.check_keys(&[keys::recipe::CAN_REALTIME.common, order_keys, frame_keys], "")?;
            let order = if has_order { FrameOrder::read(&frame)? } else { FrameOrder::default() };
            let item = frame.required("id", "the frame's CAN id")?;
            let id = read_id(&frame, &item)?;
            let fields = read_fields(&frame, 0, rules, flavour)?;
            part.frames.push(FileFrame { spot: frame.spot.clone(), id, id_spot: item.spot, fields, order });
        }
    } else {
        (part.head, part.head_spot) = read_bytes(&table, "head")?;
        (part.tail, part.tail_spot) = read_bytes(&table, "tail")?;
        let fields = read_fields(&table, part.head.len(), rules, flavour)?;
        let spot = table.spot.clone();
        let (id, order) = (CanId::Standard(0), FrameOrder::default());
        part.frames.push(FileFrame { spot: spot.clone(), id, id_spot: spot, fields, order });
    }
    exchanges::refuse_restarted(&table, Some(&part))?;
    Ok(part)
}

/// 11 bits, or 29 with `extended = true`.
pub(super) fn read_id(frame: &TableReader<'_>, item: &TableValue<'_>) -> Result<CanId> {
    let is_extended = frame.flag(&keys::recipe::EXTENDED)?;
    let limit = if is_extended { "0x1FFFFFFF" } else { "0x7FF" };
    if !item.is_integer() {
        return Err(item.no_integer(&format!("0..={limit}")));
    }
    let number: i64 = item.integer(i64::MIN..=i64::MAX)?;
    let standard = || u16::try_from(number).ok().map(CanId::Standard);
    let extended = || u32::try_from(number).ok().map(CanId::Extended);
    let id = if is_extended { extended() } else { standard() };
    id.filter(|id| id.is_valid()).ok_or_else(|| {
        let hint = if extended().is_some_and(CanId::is_valid) {
            ", or 0..=0x1FFFFFFF with extended = true"
        } else {
            ""
        };
        let shown = if number < 0 { number.to_string() } else { format!("{number:#X}") };
        item.error(format!("{shown} is out of range; allowed: 0..={limit}{hint}"))
    })
}

pub(super) fn read_bytes(table: &TableReader<'_>, key: &str) -> Result<(Vec<u8>, Option<Spot>)> {
    let Some(item) = table.optional(key) else { return Ok((Vec::new(), None)) };
    let bytes = item
        .array("of bytes, such as [255, 255]")?
        .iter()
        .map(|item| item.integer(0..=255))
        .collect::<Result<_>>()?;
    Ok((bytes, Some(item.spot)))
}

/// The fields of a stream part, or of one CAN frame, behind a head of so many bytes.
pub(super) fn read_fields(
    table: &TableReader<'_>,
    head: usize,
    rules: Rules,
    flavour: Flavour,
) -> Result<Vec<FileField>> {
    let mut reader = FieldReader::new(table, rules, flavour)?;
    let list = table.required("fields", "the list of the frame's fields")?;
    let mut fields = Vec::new();
    for item in list.array("of fields, such as [\"RobotState[8..13]\"]")? {
        match (rules.mode, item.as_string()) {
            (Mode::Realtime, Some(name)) => {
                let range = VarRange::parse(name)
                    .map_err(|error| item.error(format!("{name:?}: {error}{}", meant_variable(name))))?;
                fields.extend(
                    range
                        .iter()
                        .map(|var| FileField { spot: item.spot.clone(), kind: FileFieldKind::System(var) }),
                );
            }
            (Mode::Realtime, None) => {
                return Err(item.error(
                    "the fields of a realtime recipe are names of system variables, such as \"RobotState[8]\"; \
                     for fields of your own set mode = \"user\"",
                ));
            }
            (Mode::User, Some(_)) => {
                return Err(item.error(
                    "the fields of a user recipe are tables, such as { name = \"grip\", type = \"byte\" }; \
                     for system variables set mode = \"realtime\"",
                ));
            }
            (Mode::User, None) => reader.read(&item, &mut fields)?,
        }
    }
    checksums::read_checksum(table, head, &mut fields)?;
    Ok(fields)
}

impl FilePart {
    /// Checks that the part fits this framing.
    fn check(&self, rules: Rules, is_can: bool, framing: Framing) -> std::result::Result<(), PartError> {
        let fields = |frame: &FileFrame| frame.fields.iter().filter_map(FileField::field).collect::<Vec<_>>();
        if is_can {
            CanLayout::new(rules, self.frames.iter().map(|frame| (frame.id, fields(frame)))).map(|_| ())
        } else {
            let all = self.frames.iter().flat_map(fields);
            StreamLayout::new(rules, &self.head, &self.tail, all, framing).map(|_| ())
        }
    }

    /// The place of `error`.
    pub(super) fn spot_of(&self, error: PartError) -> &Spot {
        let delimiter = match error {
            PartError::HeadTooLong { .. } => self.head_spot.as_ref(),
            PartError::TailTooLong { .. } => self.tail_spot.as_ref(),
            _ => None,
        };
        let frame = error.frame().and_then(|frame| self.frames.get(usize::from(frame)));
        let field = error.field().and_then(|at| {
            self.frames.get(usize::from(at.frame.unwrap_or(0)))?.fields.get(usize::from(at.field))
        });
        match error {
            PartError::InvalidId { .. }
            | PartError::DuplicateId { .. }
            | PartError::Indistinguishable { .. } => frame.map(|frame| &frame.id_spot),
            _ => delimiter.or(field.map(|field| &field.spot)).or(frame.map(|frame| &frame.spot)),
        }
        .unwrap_or(&self.spot)
    }
}

impl FileRecipe {
    pub(super) fn part(&self, direction: Direction) -> Option<&FilePart> {
        match direction {
            Direction::Input => self.input.as_ref(),
            Direction::Output => self.output.as_ref(),
        }
    }

    pub(super) fn is_can(&self) -> bool {
        self.kind == RecipeKind::Can
    }

    /// Checks that a port with this framing can carry the recipe.
    pub(super) fn check_framing(&self, framing: Framing) -> std::result::Result<(), String> {
        if self.is_device() {
            // Its frames are laid out when the recipe is read, the same for every line.
            return Ok(());
        }
        for direction in [Direction::Input, Direction::Output] {
            if let Some(part) = self.part(direction) {
                part.check(Rules { mode: self.mode, direction }, self.is_can(), framing)
                    .map_err(|error| format!("recipe {:?} does not fit this port: {error}", self.name))?;
            }
        }
        Ok(())
    }

    /// The recipe with the names of its fields.
    pub(super) fn named(&self) -> AnyRecipe {
        if self.is_device() { AnyRecipe::Device(self.to_device()) } else { AnyRecipe::Plain(self.to_sim()) }
    }

    /// The recipe with the names of its fields, without bindings; frames of devices are not in it.
    pub(super) fn to_sim(&self) -> SimRecipe {
        let fields = |frame: &FileFrame| {
            let named = |field: &FileField| Some(SimField { name: field.name(), field: field.field()? });
            frame.fields.iter().filter_map(named).collect()
        };
        let stream = |part: &Option<FilePart>| {
            part.as_ref().map(|part| SimStreamPart {
                head: part.head.clone(),
                tail: part.tail.clone(),
                fields: part.frames.iter().flat_map(|frame| -> Vec<_> { fields(frame) }).collect(),
            })
        };
        let can = |part: &Option<FilePart>| {
            let frames = part.iter().flat_map(|part| &part.frames);
            frames.map(|frame| SimCanFrame { id: frame.id, fields: fields(frame) }).collect()
        };
        let parts = if self.is_can() {
            SimParts::Can { input: can(&self.input), output: can(&self.output) }
        } else {
            SimParts::Stream { input: stream(&self.input), output: stream(&self.output) }
        };
        SimRecipe { name: self.name.clone(), mode: self.mode, parts }
    }
}
