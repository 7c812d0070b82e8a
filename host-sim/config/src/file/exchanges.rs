//! `[[recipe.exchange]]`: requests to devices, their replies, and when they are sent.
//!
//! In: the tables of a gateway file's recipe. Out: [`FileExchange`]s with their frames laid out. The frames here are a
//! device's own; those of Modbus are in `modbus`.

use proto_core::config::{
    Exchange, ExchangeError, ExchangeKey, InputBinding, OutcomeTo, Port, Restarted, Triggers,
};
use proto_core::device::{Boundary, Carrier, Element};
use proto_core::recipe::model::{Mode, Rules};
use proto_core::sysvar::{Direction, SysVar, VarBit};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;

use super::bindings;
use super::encoding::refuse;
use super::frames::{read_bytes, read_fields, read_id};
use super::model::{FileExchange, FileField, FileFrame, FilePart, Flavour, FrameOrder, Sending};
use super::reader::{Result, Spot, TableReader, TableValue};
use crate::device::ExchangeKind;
use crate::keys::frame::OF_FRAME;
use crate::keys::{self, exchange};

/// Reads the exchanges of a stream or CAN recipe.
pub(super) fn read_all(recipe: &TableReader<'_>, mode: Mode, is_can: bool) -> Result<Vec<FileExchange>> {
    let tables = recipe.any_tables("exchange")?;
    if let Some(item) = recipe.optional("exchange").filter(|_| mode != Mode::User) {
        let first = tables.first().map(|table| table.error(ExchangeError::NeedsUser));
        return Err(first.unwrap_or_else(|| item.error(ExchangeError::NeedsUser)));
    }
    let names = names(&tables)?;
    tables.iter().map(|table| read(table, is_can, &names)).collect()
}

/// Reads the names of exchanges; `None` for those without one.
pub(super) fn names(tables: &[TableReader<'_>]) -> Result<Vec<Option<String>>> {
    let mut names: Vec<Option<String>> = Vec::new();
    for table in tables {
        let Some(item) = table.optional(exchange::NAME.name) else {
            names.push(None);
            continue;
        };
        let name = item.string()?;
        if names.iter().flatten().any(|before| before == name) {
            return Err(item.error(format!("another exchange of the recipe is called {name:?}")));
        }
        if !(1..=32).contains(&name.len()) {
            return Err(item.error(format!("{name:?} has {} bytes; allowed: 1..=32", name.len())));
        }
        names.push(Some(name.to_owned()));
    }
    Ok(names)
}

fn read(table: &TableReader<'_>, is_can: bool, names: &[Option<String>]) -> Result<FileExchange> {
    table.check(if is_can { &exchange::OF_CAN } else { &exchange::OF_STREAM })?;
    let peer = table.integer_or(&exchange::PEER)?;
    let frame = |key, direction| {
        table.optional(key).map(|item| read_frame(&item, key, direction, is_can)).transpose()
    };
    let request = frame("request", Direction::Output)?;
    let reply = frame("reply", Direction::Input)?;
    let pending = frame("pending", Direction::Input)?;
    let refusal = frame("refusal", Direction::Input)?;
    match (&request, &reply, pending.as_ref().or(refusal.as_ref())) {
        (None, None, _) => return Err(table.error(ExchangeError::Nothing)),
        (None, _, Some((part, _))) | (_, None, Some((part, _))) => {
            return Err(part.spot.error(table.document, ExchangeError::LoneRefusal));
        }
        (None, ..) => refuse(
            table,
            &keys::names(exchange::TIMING.iter()),
            "there is no request to send; allowed: reply, peer",
        )?,
        (Some(_), None, _) => {
            refuse(table, &["timeout_ms", "retries", "late_ms", "stop"], "there is no reply to wait for")?;
        }
        _ => {}
    }
    let (mut settings, retries) = read_settings(table, peer, names)?;
    if let Some(reply) = table.optional("reply") {
        settings.overdue = read_overdue(&reply.any_table()?, "timeout_ms")?;
    }
    if request.is_some() {
        check_asked(table, &settings)?;
    }
    for (part, _) in [&pending, &refusal].into_iter().flatten() {
        check_refusal(table, part)?;
    }
    let mut spots = spots(
        table,
        &[
            ("peer", ExchangeKey::Peer),
            ("request", ExchangeKey::Request),
            ("reply", ExchangeKey::Reply),
            ("pending", ExchangeKey::Pending),
            ("refusal", ExchangeKey::Refusal),
        ],
    );
    settings.restarted = restarted(table, reply.as_ref().map(|(part, _)| part), &mut spots)?;
    let remote = request.as_ref().is_some_and(|(_, remote)| *remote);
    let [output, input, pending, refusal] = [request, reply, pending, refusal].map(|frame| Some(frame?.0));
    Ok(FileExchange {
        spot: table.spot.clone(),
        spots,
        settings,
        retries,
        kind: ExchangeKind::Frames,
        output,
        input,
        pending,
        refusal,
        is_can,
        remote,
    })
}

/// Reads the time after which the values of a reply are overdue.
pub(super) fn read_overdue(table: &TableReader<'_>, key: &str) -> Result<Option<Duration>> {
    let own = table.optional(key);
    let Some(item) = table.optional(exchange::EXPECT.name) else {
        return own.map(|own| own.time(&exchange::OVERDUE)).transpose();
    };
    item.choice(&exchange::EXPECTATIONS)?;
    match own {
        Some(own) => {
            Err(own.error("a reply that is expected as an event is never overdue; remove one of the two"))
        }
        None => Ok(Some(Port::NEVER)),
    }
}

/// The places of all keys of an exchange; for a key that is absent, the place of the exchange.
pub(super) fn spots(table: &TableReader<'_>, own: &[(&str, ExchangeKey)]) -> Vec<(ExchangeKey, Spot)> {
    let timing = [
        ("every_ms", ExchangeKey::Every),
        ("on", ExchangeKey::Rising),
        ("timeout_ms", ExchangeKey::Timeout),
        ("pause_ms", ExchangeKey::Pause),
        ("trigger_ms", ExchangeKey::Trigger),
        ("late_ms", ExchangeKey::Late),
        ("stop", ExchangeKey::Stop),
        ("follow", ExchangeKey::Follow),
        ("outcome", ExchangeKey::Outcome),
        ("overdue_ms", ExchangeKey::Overdue),
    ];
    let spot = |key| table.optional(key).map_or(table.spot.clone(), |item| item.spot);
    let keys = own.iter().copied().chain(timing).map(|(name, key)| (key, spot(name)));
    keys.chain([(ExchangeKey::Whole, table.spot.clone())]).collect()
}

/// Finds the field of a reply that reports a restart; adds its place to `spots`.
pub(super) fn restarted(
    table: &TableReader<'_>,
    reply: Option<&FilePart>,
    spots: &mut Vec<(ExchangeKey, Spot)>,
) -> Result<Option<Restarted>> {
    let Some(reply) = reply else { return Ok(None) };
    let has_number = |field: &&FileField| {
        matches!(field.spec().element(), Some(Element::Value { .. } | Element::Fixed { .. }))
    };
    let numbers = reply.fields().iter().filter(has_number).enumerate();
    let mut found = numbers.filter_map(|(nth, field)| Some((nth, field.restarted.as_ref()?)));
    let Some((nth, (spot, value))) = found.next() else { return Ok(None) };
    if let Some((_, (other, _))) = found.next() {
        return Err(other.error(table.document, "another field of the reply has restarted; one tells it"));
    }
    spots.push((ExchangeKey::Restarted, spot.clone()));
    Ok(Some(Restarted { field: u8::try_from(nth).unwrap_or(u8::MAX), value: *value }))
}

/// Refuses a restart number where it has no effect.
pub(super) fn refuse_restarted(table: &TableReader<'_>, part: Option<&FilePart>) -> Result<()> {
    let fields = part.into_iter().flat_map(|part| part.frames.iter().flat_map(|frame| &frame.fields));
    match fields.filter_map(|field| field.restarted.as_ref()).next() {
        Some((spot, _)) => Err(spot.error(table.document, ExchangeError::RestartedNothing)),
        None => Ok(()),
    }
}

/// Reads a request, a reply, a pending reply or a refusal, and whether it is a remote frame.
fn read_frame(
    item: &TableValue<'_>,
    key: &str,
    direction: Direction,
    is_can: bool,
) -> Result<(FilePart, bool)> {
    let table = item.any_table()?;
    let is_request = direction == Direction::Output;
    let recipe = if is_can { "a CAN recipe" } else { "a stream recipe" };
    let keys = match (is_can, is_request) {
        (true, true) => &exchange::CAN_REQUEST,
        (true, false) if key != "reply" => &exchange::CAN_REFUSAL,
        (true, false) => &exchange::CAN_REPLY,
        (false, true) => &exchange::STREAM_REQUEST,
        (false, false) if key != "reply" => &exchange::STREAM_REFUSAL,
        (false, false) => &exchange::STREAM_REPLY,
    };
    let what = if key == "pending" { "pending answer" } else { key };
    table.check_keys(&[keys.common, OF_FRAME], &format!(" of a {what} in {recipe}"))?;
    let mut part = FilePart::new(&table);
    let mut frame = FileFrame::new(table.spot.clone());
    if is_can {
        let id = table.required("id", "the frame's CAN id")?;
        (frame.id, frame.id_spot) = (read_id(&table, &id)?, id.spot);
    } else {
        (part.head, part.head_spot) = read_bytes(&table, "head")?;
        (part.tail, part.tail_spot) = read_bytes(&table, "tail")?;
    }
    if table.flag(&exchange::REMOTE)? {
        refuse(&table, &["fields", "checksum", "endian", "word_order"], "a remote request has no data")?;
        part.frames.push(frame);
        return Ok((part, true));
    }
    let rules = Rules { mode: Mode::User, direction };
    frame.fields = read_fields(&table, part.head.len(), rules, Flavour::Gateway)?;
    part.frames.push(frame);
    part.check_device(&table, if is_can { Carrier::Can } else { Carrier::Stream }, direction)?;
    Ok((part, false))
}

/// Checks that a pending reply or a refusal has only values.
fn check_refusal(table: &TableReader<'_>, part: &FilePart) -> Result<()> {
    refuse_restarted(table, Some(part))?;
    let is_other = |field: &&FileField| {
        let is_counter = |to: InputBinding| matches!(to, InputBinding::Counter { .. });
        field.named.commands.is_some() || field.spec().target().is_some_and(is_counter)
    };
    match part.fields().iter().find(is_other) {
        Some(field) => Err(field.spot.error(table.document, ExchangeError::RefusalValues)),
        None => Ok(()),
    }
}

impl FilePart {
    /// A part, or the frame of an exchange, with nothing but its place.
    pub(super) fn new(table: &TableReader<'_>) -> Self {
        Self {
            spot: table.spot.clone(),
            head: Vec::new(),
            tail: Vec::new(),
            head_spot: None,
            tail_spot: None,
            frames: Vec::new(),
            sending: Sending::default(),
            framing: (Boundary::Fields, None),
        }
    }

    /// The fields, if it is the frame of an exchange.
    pub(super) fn fields(&self) -> &[FileField] {
        self.frames.first().map_or(&[], |frame| &frame.fields)
    }
}

impl FileFrame {
    fn new(spot: Spot) -> Self {
        let (id, order) = (CanId::Standard(0), FrameOrder::default());
        Self { id_spot: spot.clone(), spot, id, fields: Vec::new(), order }
    }

    /// The registers or coils of an exchange, without a frame around them.
    pub(super) fn of_fields(spot: Spot, fields: Vec<FileField>) -> Self {
        Self { fields, ..Self::new(spot) }
    }
}

/// Reads when an exchange is requested, its timeouts and its repetitions; `names` has the names of all exchanges of the
/// recipe.
pub(super) fn read_settings(
    table: &TableReader<'_>,
    peer: u8,
    names: &[Option<String>],
) -> Result<(Exchange, Option<u8>)> {
    let mut settings = FileExchange::never(peer);
    settings.when.every = table.time(&exchange::EVERY)?;
    if let Some(on) = table.optional("on") {
        let list = on.array("such as [\"start\", \"change\"]")?;
        if list.is_empty() {
            return Err(
                on.error("an empty list; allowed: \"start\", \"change\", \"rising:BitOutputReg[3].0\"")
            );
        }
        list.iter().try_for_each(|item| read_on(item, &mut settings.when))?;
    }
    settings.timeout = table.time_or(&exchange::TIMEOUT)?;
    let retries = table.integer(&exchange::RETRIES)?;
    settings.pause = table.time_or(&exchange::PAUSE)?;
    settings.trigger = table.time(&exchange::TRIGGER)?;
    settings.late = table.time(&exchange::LATE)?;
    settings.stop = table.flag(&exchange::STOP)?;
    settings.follow = table.optional("follow").map(|item| read_follow(&item, names)).transpose()?;
    settings.outcome = table.optional("outcome").map_or(Ok(OutcomeTo::NONE), |item| read_outcome(&item))?;
    Ok((settings, retries))
}

/// Refuses a request that is never sent.
pub(super) fn check_asked(table: &TableReader<'_>, settings: &Exchange) -> Result<()> {
    if settings.is_never() { Err(table.error(ExchangeError::Never)) } else { Ok(()) }
}

/// Reads the name of an exchange and returns its number.
fn read_follow(item: &TableValue<'_>, names: &[Option<String>]) -> Result<u8> {
    let name = item.string()?;
    let nth = names.iter().position(|other| other.as_deref() == Some(name));
    nth.and_then(|nth| u8::try_from(nth).ok()).ok_or_else(|| {
        let known: Vec<_> = names.iter().flatten().map(|name| format!("{name:?}")).collect();
        let allowed = match known.is_empty() {
            true => "no exchange of the recipe has a name".to_owned(),
            false => format!("allowed: {}", known.join(", ")),
        };
        item.error(format!("there is no exchange {name:?}; {allowed}"))
    })
}

/// Reads the variables that report the outcome of events.
fn read_outcome(item: &TableValue<'_>) -> Result<OutcomeTo> {
    let table = item.table(&exchange::OUTCOME_TABLE)?;
    let variable = |key| -> Result<Option<SysVar>> {
        let Some(item) = table.optional(key) else { return Ok(None) };
        if VarBit::parse(item.string()?).is_some() {
            return Err(item.error("a number does not fit in one bit; allowed: WordInputReg, FloatInputReg"));
        }
        bindings::read_var(&item).map(Some)
    };
    let outcome =
        OutcomeTo { to: variable("to")?, code_to: variable("code_to")?, count_to: variable("count_to")? };
    if outcome == OutcomeTo::NONE {
        return Err(item.error("no variable; allowed: to, code_to, count_to"));
    }
    Ok(outcome)
}

/// Reads one entry of `on`.
fn read_on(item: &TableValue<'_>, when: &mut Triggers) -> Result<()> {
    let text = item.string()?;
    let flag =
        match text {
            "start" => &mut when.start,
            "change" => &mut when.change,
            _ => {
                let (var, bit) = bindings::read_rising(item, text, "\"start\", \"change\"")?;
                return match when.rising.replace((var, bit)) {
                    None => Ok(()),
                    Some((before, nth)) => Err(item
                        .error(format!("one bit can trigger an exchange, and {before}.{nth} does already"))),
                };
            }
        };
    match std::mem::replace(flag, true) {
        false => Ok(()),
        true => Err(item.error(format!("{text:?} is there twice"))),
    }
}
