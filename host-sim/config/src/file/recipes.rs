//! `[[recipe]]` of both kinds of files: read in one place, and checked by laying out the frames.
//!
//! In: tables. Out: [`FileRecipe`]s, which have places for later checks.

use proto_core::config::OnStale;
use proto_core::recipe::CanLayout;
use proto_core::recipe::PartError;
use proto_core::recipe::StreamLayout;
use proto_core::recipe::model::{Framing, Mode, Rules};
use proto_core::sysvar::Direction;
use proto_core::wire::can::CanId;

use super::bindings;
use super::device;
use super::encoding::refuse;
use super::exchanges;
use super::frames::{read_bytes, read_fields, read_id};
use super::framings;
use super::modbus;
use super::model::{FileField, FileFrame, FilePart, FileRecipe, Flavour, FrameOrder};
use super::names::did_you_mean;
use super::order::{self, ORDER_KEYS};
use super::reader::{Result, Spot, TableReader, TableValue};
use crate::device::AnyRecipe;
use crate::keys;
use crate::keys::recipe::{KINDS, MODES, RecipeKind};
use crate::sim::{SimCanFrame, SimField, SimParts, SimRecipe, SimStreamPart};

/// Reads every recipe of a file, within the limits of any port.
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

/// Finds the recipe with the name in `item`; returns its index.
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

/// Reads a name of at most 32 bytes that can be written in `--bind NAME=DEVICE` and `--set`.
pub(super) fn read_name(table: &TableReader<'_>) -> Result<(String, Spot)> {
    let item = table.required("name", "the name that ports and tools refer to it by")?;
    let name = item.string()?;
    proto_core::config::check_name(name).map_err(|kind| item.error(kind))?;
    Ok((name.to_owned(), item.spot))
}

/// Checks the keys of a recipe, which depend on its kind.
fn check_keys(table: &TableReader<'_>, flavour: Flavour) -> Result<()> {
    let given = table.optional("kind").and_then(|item| item.as_string());
    let kind = KINDS.iter().find(|(name, _)| Some(*name) == given).map(|(_, kind)| *kind);
    if flavour == Flavour::Controller {
        let why = "only gateway files have exchanges; the controller's recipes have input and output";
        refuse(table, &["exchange"], why)?;
    }
    match kind {
        // Refused later, with its kind.
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

/// Reads what all exchanges do while a value that they send is stale.
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
        // UDP has the fewest requirements of a stream recipe; it does not allow user-defined recipes (D16).
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

impl FilePart {
    fn check(&self, rules: Rules, is_can: bool, framing: Framing) -> std::result::Result<(), PartError> {
        let fields = |frame: &FileFrame| {
            frame.fields.iter().filter_map(|field| field.spec().field()).collect::<Vec<_>>()
        };
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
            // The frames are laid out when the recipe is read, the same for every line.
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

    /// The recipe with the names of its fields, without bindings and device frames.
    pub(super) fn to_sim(&self) -> SimRecipe {
        let fields = |frame: &FileFrame| {
            let named = |field: &FileField| {
                Some(SimField { name: field.named.name.clone(), field: field.spec().field()? })
            };
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
