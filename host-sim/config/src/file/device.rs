//! Frames of devices in a gateway file: fields beyond the plain types.
//!
//! In: the tables of a part and of its fields. Out: [`FileField`]s, and frames with their layouts. The controller's own
//! recipes have none of these keys; they are refused with the reason.

use proto_core::config::{Constants, DeviceFrame, FieldSpec, InputBinding, OutputBinding};
use proto_core::device::{Boundary, Carrier, Encoding, LayoutError, Overflow};
use proto_core::recipe::PartError;
use proto_core::recipe::model::{MAX_CAN_IDS, MAX_DELIMITER, Mode, Rules};
use proto_core::sysvar::Direction;
use proto_core::wire::scalar::ScalarType;

use super::bindings;
use super::encoding::{self, FieldOrder, OpenNumber, refuse};
use super::framings;
use super::model::{FileExchange, FileField, FileFrame, FilePart, FileRecipe, Flavour};
use super::reader::{Result, Spot, TableReader, TableValue};
use super::{input_rules, rtu_frames, sendable};
use crate::device::{DeviceField, DeviceRecipe, ExchangeKind, FrameEnds, NamedExchange, NamedFrame};
use crate::keys::field::{self, EQUALS, FILL, OVERFLOW, OVERFLOWS, PAD};
use crate::keys::frame::{OF_FRAME, OF_STREAM};
use crate::keys::{Key, names};

/// Why recipes of this kind cannot have device frames; `None` if they can.
fn why_plain(mode: Mode, flavour: Flavour) -> Option<&'static str> {
    match (flavour, mode) {
        (Flavour::Gateway, Mode::User) => None,
        (Flavour::Gateway, Mode::Realtime) => Some(
            "a realtime recipe is the controller's own: little-endian and without a checksum; for a device's own \
             frames set mode = \"user\"",
        ),
        (Flavour::Controller, _) => Some(
            "the controller's recipes are little-endian and have no checksum; only gateway files describe a \
             device's own frames",
        ),
    }
}

/// The keys of a stream part or a CAN frame beyond those of any recipe; refuses them where they are not allowed.
pub(super) fn frame_keys(table: &TableReader<'_>, mode: Mode, flavour: Flavour) -> Result<&'static [Key]> {
    own_keys(OF_FRAME, table, mode, flavour)
}

/// As [`frame_keys`], for a stream part.
pub(super) fn stream_keys(table: &TableReader<'_>, mode: Mode, flavour: Flavour) -> Result<&'static [Key]> {
    own_keys(OF_STREAM, table, mode, flavour)
}

fn own_keys(
    keys: &'static [Key],
    table: &TableReader<'_>,
    mode: Mode,
    flavour: Flavour,
) -> Result<&'static [Key]> {
    match why_plain(mode, flavour) {
        None => Ok(keys),
        Some(why) => refuse(table, &names(keys.iter()), why).map(|()| -> &[Key] { &[] }),
    }
}

/// Refuses the keys of a frame in a CAN part, which has several frames.
pub(super) fn refuse_in_can_part(part: &TableReader<'_>, mode: Mode, flavour: Flavour) -> Result<()> {
    stream_keys(part, mode, flavour)?;
    refuse(part, &framings::PART_KEYS, "a CAN bus tells frames apart itself")?;
    refuse(
        part,
        &names(OF_FRAME.iter()),
        "in a CAN recipe each frame has its own; write it below the frame's id",
    )
}

/// What the fields of a frame have in common, while they are read.
pub(super) struct FieldReader {
    direction: Direction,
    flavour: Flavour,
    order: FieldOrder,
    open: Option<OpenNumber>,
}

impl FieldReader {
    pub(super) fn new(frame: &TableReader<'_>, rules: Rules, flavour: Flavour) -> Result<Self> {
        Ok(Self { direction: rules.direction, flavour, order: FieldOrder::read(frame)?, open: None })
    }

    /// Fields in Modbus registers.
    pub(super) fn of_registers(exchange: &TableReader<'_>, direction: Direction) -> Result<Self> {
        let order = FieldOrder::of_registers(exchange)?;
        Ok(Self { direction, flavour: Flavour::Gateway, order, open: None })
    }

    /// Reads one field of a user recipe, which may become several items of the frame.
    pub(super) fn read(&mut self, item: &TableValue<'_>, fields: &mut Vec<FileField>) -> Result<()> {
        let table = item.any_table()?;
        let mut push = |name, spec| fields.push(FileField::new(item.spot.clone(), name, spec));
        let when = match self.direction {
            Direction::Input => " in an input field",
            Direction::Output => " in an output field",
        };
        if let Some(why) = why_plain(Mode::User, self.flavour) {
            refuse(&table, &names(field::OWN.iter().copied().flatten()), why)?;
            table.check_keys(&[field::PLAIN.common], when)?;
            push(read_name(&table)?, self.read_plain(&table)?);
            return Ok(());
        }
        if let Some(pad) = table.optional("pad") {
            table.check_keys(&[field::PADDING], " in padding")?;
            let fill = table.integer_or(&FILL)?;
            self.open = None;
            push(String::new(), FieldSpec::Padding { len: pad.integer(PAD.integers())?, fill });
            return Ok(());
        }
        if table.optional("type").and_then(|item| item.as_string()) == Some("text") {
            self.open = None;
            push(read_name_if_any(&table)?, framings::read_text(&table, self.direction)?);
            return Ok(());
        }
        refuse(&table, &framings::TEXT_KEYS, "allowed only together with type = \"text\"")?;
        if table.optional("length").is_some() {
            table.check_keys(&[field::LENGTHS, field::WRITTEN], " in a length")?;
            let encoding = encoding::read(&table, self.order, &mut self.open)?;
            push(read_name_if_any(&table)?, framings::read_length(&table, encoding)?);
            return Ok(());
        }
        refuse(&table, &framings::LENGTH_KEYS, "allowed only together with length = true")?;
        refuse(&table, &["fill"], "allowed only together with pad, or with type = \"text\" and width")?;
        if let Some(text) = table.optional("text") {
            table.check_keys(&[field::CONSTANT_TEXT], " in a text")?;
            self.open = None;
            for byte in read_text(&text)? {
                let encoding = Encoding::scalar(ScalarType::Byte);
                push(String::new(), FieldSpec::Fixed { encoding, value: i64::from(byte) });
            }
            return Ok(());
        }
        let bound = binding_keys(&table, self.direction)?;
        table.check_keys(&[field::NAMED, bound, &[OVERFLOW], field::WRITTEN], when)?;
        match table.optional("equals") {
            Some(equals) => {
                refuse_bindings(&table)?;
                let encoding = encoding::read(&table, self.order, &mut self.open)?;
                fields.push(read_constant(&table, &item.spot, &equals, encoding)?);
            }
            None => self.read_value(&table, &item.spot, fields)?,
        }
        Ok(())
    }

    /// A field of a controller's recipe, whose programs use its value.
    fn read_plain(&self, table: &TableReader<'_>) -> Result<FieldSpec> {
        let ty = encoding::read_plain_type(table)?;
        Ok(match self.direction {
            Direction::Input => FieldSpec::UserInput { ty, to: InputBinding::Unused },
            Direction::Output => FieldSpec::UserOutput { ty, from: OutputBinding::Constant(0.0) },
        })
    }

    /// A field with a name and a value.
    fn read_value(
        &mut self,
        table: &TableReader<'_>,
        spot: &Spot,
        fields: &mut Vec<FileField>,
    ) -> Result<()> {
        let encoding = encoding::read(table, self.order, &mut self.open)?;
        let key = match self.direction {
            Direction::Input => "to",
            Direction::Output => "from",
        };
        if table.optional(key).is_none() {
            refuse(table, &["overflow"], &format!("allowed only together with {key}"))?;
        }
        let overflow = table.word(&OVERFLOW, &OVERFLOWS)?.unwrap_or(Overflow::Usual);
        bind(table, self.direction, (encoding, overflow), spot, fields)
    }
}

/// The keys that say what a value is for; refuses those of the other direction.
pub(super) fn binding_keys(table: &TableReader<'_>, direction: Direction) -> Result<&'static [Key]> {
    match direction {
        Direction::Input => {
            refuse(table, &["value"], "an input field has equals = 9 for a constant")?;
            Ok(field::BOUND_IN)
        }
        Direction::Output => {
            refuse(table, &["equals"], "an output field has value = 9 for a constant")?;
            Ok(field::BOUND_OUT)
        }
    }
}

fn refuse_bindings(table: &TableReader<'_>) -> Result<()> {
    let bindings = names(field::BOUND_IN.iter().chain([&OVERFLOW]).filter(|key| key.name != EQUALS.name));
    refuse(table, &bindings, "a field with equals is a constant and has nothing else")
}

/// Reads an integer that must match.
pub(super) fn read_constant(
    table: &TableReader<'_>,
    spot: &Spot,
    equals: &TableValue<'_>,
    encoding: Encoding,
) -> Result<FileField> {
    refuse_bindings(table)?;
    let name = read_name_if_any(table)?;
    if !encoding.is_integer() {
        return Err(equals.error("only integers can be constants; this field may have a fraction"));
    }
    let (low, high) = encoding.range();
    let value = equals.integer(low as i64..=high as i64)?;
    Ok(FileField::new(spot.clone(), name, FieldSpec::Fixed { encoding, value }))
}

/// A field with its binding, or two fields if its bytes are used twice.
pub(super) fn bind(
    table: &TableReader<'_>,
    direction: Direction,
    written: (Encoding, Overflow),
    spot: &Spot,
    fields: &mut Vec<FileField>,
) -> Result<()> {
    match direction {
        Direction::Output => bind_output(table, written, spot, fields),
        Direction::Input => bind_input(table, written, spot, fields),
    }
}

fn bind_output(
    table: &TableReader<'_>,
    (encoding, overflow): (Encoding, Overflow),
    spot: &Spot,
    fields: &mut Vec<FileField>,
) -> Result<()> {
    let (mut from, port) = bindings::read_output(table)?;
    match bindings::read_counter(table, &encoding)? {
        Some(max) if matches!(from, OutputBinding::Counter) => from = OutputBinding::CounterTo { max },
        Some(_) => refuse(table, &["counter"], "allowed only together with from = \"counter\"")?,
        None => {}
    }
    if let Some(item) = table.optional("value").filter(|_| encoding.is_integer())
        && item.number()?.fract() != 0.0
    {
        let value = item.number()?;
        return Err(item.error(format!("{value} has a fraction; this field has integers only")));
    }
    let sendable = sendable::read(table, encoding, overflow, from)?;
    if let Some(item) = table.optional("value").filter(|_| table.optional("name").is_none()) {
        if !encoding.is_integer() {
            return Err(item.error("a constant that may have a fraction needs a name"));
        }
        let value = item.number()? as i64;
        fields.push(FileField::new(spot.clone(), String::new(), FieldSpec::Fixed { encoding, value }));
        return Ok(());
    }
    let spec = FieldSpec::output(encoding, overflow, from);
    let mut field = FileField::new(spot.clone(), read_name(table)?, spec);
    (field.named.of_port, field.port) = port.unzip();
    fields.push(field);
    fields.extend(sendable);
    Ok(())
}

fn bind_input(
    table: &TableReader<'_>,
    (encoding, overflow): (Encoding, Overflow),
    spot: &Spot,
    fields: &mut Vec<FileField>,
) -> Result<()> {
    let name = read_name(table)?;
    let (to, mut commands) = bindings::read_input(table)?;
    let counter = bindings::read_counter(table, &encoding)?.map(|max| InputBinding::Counter { max });
    let mut rules = input_rules::read(table, encoding, overflow, to)?;
    let mut restarted = input_rules::read_restarted(table, &encoding)?;
    let picks = commands.is_some().then_some(InputBinding::Unused);
    // Without a variable, commands come first.
    let uses = if to.is_some() { [to, counter, picks] } else { [picks, counter, None] };
    let uses: Vec<_> = uses.into_iter().flatten().collect();
    let uses = if uses.is_empty() { vec![InputBinding::Unused] } else { uses };
    for (nth, to) in uses.into_iter().enumerate() {
        let spec = match nth {
            0 => FieldSpec::input(encoding, overflow, to),
            _ => FieldSpec::input(Encoding { shared: true, ..encoding }, Overflow::Usual, to),
        };
        let mut field = FileField::new(spot.clone(), name.clone(), spec);
        (field.named.repeats, field.restarted) = (nth > 0, restarted.take());
        field.named.has_offset =
            matches!(to, InputBinding::Variable { .. }) && table.optional("offset").is_some();
        if let Some((commands, spots)) = commands.take_if(|_| to == InputBinding::Unused) {
            (field.named.commands, field.commands) = (Some(commands), spots);
        }
        fields.push(field);
        // The rules of the variable, which is the first use.
        fields.append(&mut rules);
    }
    Ok(())
}

pub(super) fn read_name(table: &TableReader<'_>) -> Result<String> {
    Ok(table.required("name", "give the field a name")?.string()?.to_owned())
}

fn read_name_if_any(table: &TableReader<'_>) -> Result<String> {
    table.optional("name").map_or(Ok(String::new()), |item| item.string().map(str::to_owned))
}

fn read_text<'a>(item: &TableValue<'a>) -> Result<impl Iterator<Item = u8> + use<'a>> {
    let text = item.string()?;
    if text.is_empty() {
        return Err(item.error("a text of no bytes; write at least one character"));
    }
    match text.chars().find(|c| !c.is_ascii()) {
        Some(c) => Err(item.error(format!("{c:?} is not ASCII; allowed: characters of one byte, 0..=127"))),
        None => Ok(text.bytes()),
    }
}

impl FilePart {
    /// Whether something other than the fields marks the end of a frame.
    fn ends(&self) -> FrameEnds {
        let (boundary, escape) = self.framing;
        FrameEnds { boundary, escape }
    }

    fn is_cut(&self) -> bool {
        self.framing != (Boundary::Fields, None)
    }

    /// Checks the part of a recipe with a device's own frames.
    pub(super) fn check_device(
        &self,
        document: &TableReader<'_>,
        carrier: Carrier,
        part: Direction,
    ) -> Result<()> {
        let refused = |error: PartError| Err(self.spot_of(error).error(document.document, error));
        if self.frames.is_empty() {
            return refused(PartError::NoFrames);
        }
        if self.frames.len() > MAX_CAN_IDS {
            return refused(PartError::TooManyFrames);
        }
        for (nth, frame) in (0..).zip(&self.frames) {
            if let Err(error) = self.lay_out(frame, carrier, part) {
                return Err(self.spot_of_layout(frame, error).error(document.document, error));
            }
            let same_id = |(_, earlier): &(u8, &FileFrame)| earlier.id == frame.id;
            let is_same = |(_, earlier): &(u8, &FileFrame)| !earlier.differs(frame, part);
            let earlier = (0..nth).zip(&self.frames).filter(same_id).find(is_same);
            if let Some((first, _)) = earlier {
                return refused(PartError::Indistinguishable { frame: nth, first, id: frame.id });
            }
        }
        Ok(())
    }

    fn lay_out(
        &self,
        frame: &FileFrame,
        carrier: Carrier,
        part: Direction,
    ) -> std::result::Result<DeviceFrame, LayoutError> {
        let specs: Vec<_> = frame.fields.iter().map(FileField::spec).collect();
        DeviceFrame::new(carrier, part, (&self.head, &self.tail), &specs)
    }

    /// The place of `error`.
    fn spot_of_layout<'f>(&'f self, frame: &'f FileFrame, error: LayoutError) -> &'f super::reader::Spot {
        let delimiter = match error {
            LayoutError::DelimiterTooLong { .. } if self.head.len() > MAX_DELIMITER => {
                self.head_spot.as_ref()
            }
            LayoutError::DelimiterTooLong { .. } => self.tail_spot.as_ref(),
            _ => None,
        };
        let is_element = |field: &&FileField| field.spec().element().is_some();
        let is_checksum = |field: &&FileField| matches!(field.spec(), FieldSpec::Checksum(_));
        let field = match error.element() {
            Some(element) => frame.fields.iter().filter(is_element).nth(usize::from(element)),
            None if error.is_of_checksum() => frame.fields.iter().find(is_checksum),
            None => None,
        };
        delimiter.or(field.map(|field| &field.spot)).unwrap_or(&frame.spot)
    }
}

impl FileFrame {
    /// Whether a constant distinguishes the frame from `other`, which has the same id.
    fn differs(&self, other: &Self, part: Direction) -> bool {
        let constants = |frame: &Self| {
            let specs: Vec<_> = frame.fields.iter().map(FileField::spec).collect();
            Constants::of(&specs, part)
        };
        constants(self).differ(&constants(other))
    }
}

impl FileRecipe {
    /// Whether several frames of a part have the same id.
    fn repeats_ids(&self) -> bool {
        let repeats = |part: &FilePart| {
            let ids = || part.frames.iter().map(|frame| frame.id);
            ids().enumerate().any(|(nth, id)| ids().take(nth).any(|before| before == id))
        };
        self.is_can()
            && self.mode == Mode::User
            && [&self.input, &self.output].into_iter().flatten().any(repeats)
    }

    /// Whether a frame without data is sent.
    fn sends_empty(&self) -> bool {
        let frames = self.output.iter().flat_map(|part| &part.frames);
        self.is_can() && self.mode == Mode::User && frames.into_iter().any(|frame| frame.fields.is_empty())
    }

    /// Whether the recipe has frames that no recipe of the controller can have.
    pub(super) fn is_device(&self) -> bool {
        let parts = [&self.input, &self.output].into_iter().flatten();
        let mut fields = parts.flat_map(|part| &part.frames).flat_map(|frame| &frame.fields);
        let is_cut = [&self.input, &self.output].into_iter().flatten().any(FilePart::is_cut);
        !self.exchanges.is_empty()
            || is_cut
            || self.repeats_ids()
            || self.sends_empty()
            || fields.any(|field| field.spec().is_device())
    }

    /// What carries the frames of a part.
    pub(super) fn carrier(&self, part: Direction) -> Carrier {
        match self.part(part) {
            _ if self.is_can() => Carrier::Can,
            Some(part) if part.is_cut() => Carrier::Whole,
            _ => Carrier::Stream,
        }
    }

    /// The recipe with the names of its fields.
    pub(super) fn to_device(&self) -> DeviceRecipe {
        let frames = |part: &Option<FilePart>| {
            part.iter()
                .flat_map(|part| part.frames.iter().map(|frame| self.named_frame(part, frame)))
                .collect()
        };
        DeviceRecipe {
            name: self.name.clone(),
            carrier: [Direction::Input, Direction::Output]
                .map(|part| self.carrier(part))
                .into_iter()
                .find(|&carrier| carrier == Carrier::Whole)
                .unwrap_or(self.carrier(Direction::Input)),
            input: frames(&self.input),
            output: frames(&self.output),
            input_ends: self.input.as_ref().map_or(FrameEnds::default(), FilePart::ends),
            output_ends: self.output.as_ref().map_or(FrameEnds::default(), FilePart::ends),
            exchanges: self.exchanges.iter().map(|exchange| self.named_exchange(exchange)).collect(),
        }
    }

    fn named_frame(&self, part: &FilePart, frame: &FileFrame) -> NamedFrame {
        let mut fields: Vec<DeviceField> = Vec::new();
        for named in frame.fields.iter().map(|field| field.named.clone()) {
            match fields.last_mut().filter(|_| named.spec.is_of_field_before()) {
                Some(field) => field.sendable.push(named.spec),
                None => fields.push(named),
            }
        }
        NamedFrame {
            id: self.is_can().then_some(frame.id),
            head: part.head.clone(),
            tail: part.tail.clone(),
            fields,
            name: frame.order.name().map(str::to_owned),
            after: frame.order.after().map(str::to_owned),
        }
    }

    fn named_exchange(&self, exchange: &FileExchange) -> NamedExchange {
        let FileExchange { settings, kind, output, input, pending, refusal, remote, .. } = exchange;
        let peer = settings.peer;
        let frame = |part: &Option<FilePart>| {
            part.as_ref().and_then(|part| Some(self.named_frame(part, part.frames.first()?)))
        };
        let fields = |part: &Option<FilePart>| frame(part).map_or(Vec::new(), |frame| frame.fields);
        let [request, reply, refusal] = match kind {
            ExchangeKind::Frames => [frame(output), frame(input), frame(refusal)],
            ExchangeKind::Master(operation) => {
                rtu_frames::frames(peer, operation, &fields(output), &fields(input))
            }
            ExchangeKind::Slave(operation) => {
                rtu_frames::frames(peer, operation, &fields(input), &fields(output))
            }
        };
        let pending = frame(pending);
        NamedExchange { peer, kind: *kind, request, reply, pending, refusal, remote: *remote }
    }
}
