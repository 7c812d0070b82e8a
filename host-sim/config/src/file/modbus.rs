//! Modbus RTU in a gateway file: the exchanges of a master, and the blocks of a slave.
//!
//! In: `[[recipe.exchange]]` of `kind = "modbus-rtu"` and `[[recipe.block]]` of `kind = "modbus-rtu-slave"`. Out:
//! [`FileExchange`]s. The numbers of registers and coils follow from the fields.

use proto_core::config::{DeviceFrame, ExchangeError, ExchangeKey, register_bits};
use proto_core::device::Carrier;
use proto_core::modbus::rtu::{BROADCAST, Operation, Table};
use proto_core::sysvar::Direction;

use super::coils;
use super::device::FieldReader;
use super::encoding::refuse;
use super::exchanges;
use super::model::{FileExchange, FileField, FileFrame, FilePart};
use super::reader::{Result, TableReader, TableValue};
use crate::device::ExchangeKind;
use crate::keys::exchange::{FUNCTIONS, TABLES};
use crate::keys::{self, exchange};

/// The name of a function of Modbus, such as `read-coils` for 1.
pub fn function_name(operation: &Operation) -> &'static str {
    let code = operation.function();
    FUNCTIONS.iter().find(|(_, known)| *known == code).map_or("", |(name, _)| name)
}

/// Reads the exchanges of a master.
pub(super) fn read_master(recipe: &TableReader<'_>) -> Result<Vec<FileExchange>> {
    let exchanges = recipe.any_tables("exchange")?;
    if exchanges.is_empty() {
        return Err(recipe.error("a recipe of a Modbus master needs an exchange, [[recipe.exchange]]"));
    }
    let names = exchanges::names(&exchanges)?;
    exchanges.iter().map(|table| read_exchange(table, &names)).collect()
}

/// Reads the blocks of a slave.
pub(super) fn read_slave(recipe: &TableReader<'_>) -> Result<Vec<FileExchange>> {
    let address =
        recipe.integer_needed(&keys::recipe::ADDRESS, "the gateway's own address on the line, 1..=247")?;
    let blocks = recipe.any_tables("block")?;
    if blocks.is_empty() {
        return Err(recipe.error("a recipe of a Modbus slave needs a block, [[recipe.block]]"));
    }
    blocks.iter().map(|block| read_block(block, address)).collect()
}

fn read_exchange(table: &TableReader<'_>, names: &[Option<String>]) -> Result<FileExchange> {
    let all = keys::names(exchange::OF_MODBUS.keys());
    table.check_names(&all, exchange::OF_MODBUS.place, |_| false)?;
    let slave = table.required("slave", "the slave's address, 1..=247, or 0 to write to all of them")?;
    let function = read_function(table)?;
    let (holds, ..) = function.place();
    let (reads, writes) = (function.reads(), function.written_len() > 0);
    if !reads {
        refuse(table, &["read"], "this function writes only; its fields are in write")?;
    }
    if !writes {
        refuse(table, &["write"], "this function reads only; its fields are in read")?;
    }
    let is_both = reads && writes;
    if !is_both {
        refuse(table, &["write_address"], "allowed only for read-write-registers, which has two addresses")?;
    }
    let address = |key, what| read_first(&table.required(key, what)?, holds);
    let first = address("address", "the first register or coil, counted from 0 as on the line")?;
    let write_first = match is_both {
        true => address("write_address", "the first register that is written")?,
        false => first,
    };
    let list = |key, direction, is_used: bool| match is_used {
        true => List::read(table, key, direction, is_of_coils(holds)).map(Some),
        false => Ok(None),
    };
    let read = list("read", Direction::Input, reads)?;
    let write = list("write", Direction::Output, writes)?;
    let peer = slave.integer(exchange::SLAVE.integers())?;
    if peer == BROADCAST && reads {
        return Err(slave.error(ExchangeError::BroadcastRead));
    }
    if peer == BROADCAST {
        refuse(
            table,
            &["timeout_ms", "retries", "late_ms", "stop"],
            "nobody answers what is written to all slaves",
        )?;
    }
    let count = |list: &Option<List<'_>>| list.as_ref().map_or(0, |list| list.count);
    if matches!(function, Operation::WriteCoil { .. } | Operation::WriteRegister { .. }) && count(&write) != 1
    {
        let (one, several) = match holds {
            Table::Coils => ("one coil", "write-coils"),
            _ => ("one register", "write-registers"),
        };
        return Err(table.required("write", "")?.error(format!(
            "this function writes {one}, not {}; for several there is function = {several:?}",
            count(&write)
        )));
    }
    let mask = write.as_ref().map_or(0, List::bits);
    if matches!(function, Operation::MaskWriteRegister { .. }) {
        let list = table.required("write", "")?;
        if count(&write) != 1 {
            return Err(list.error(format!(
                "this function writes bits of one register, not of {}; fields of the same type with bits share it",
                count(&write)
            )));
        }
        if matches!(mask, 0 | u16::MAX) {
            return Err(list.error(ExchangeError::Mask));
        }
    }
    let (read_place, write_place) = ((first, count(&read)), (write_first, count(&write)));
    let operation =
        Operation::of_function(function.function(), read_place, write_place, mask).unwrap_or(function);
    check(table, &operation, &read, &write)?;
    let (mut settings, retries) = exchanges::read_settings(table, peer, names)?;
    if !reads {
        refuse(table, &["expect", "overdue_ms"], "this function writes only; its reply has no values")?;
    }
    settings.overdue = exchanges::read_overdue(table, "overdue_ms")?;
    exchanges::check_asked(table, &settings)?;
    let mut spots =
        exchanges::spots(table, &[("slave", ExchangeKey::Peer), ("address", ExchangeKey::Registers)]);
    settings.restarted = exchanges::restarted(table, read.as_ref().map(|list| &list.part), &mut spots)?;
    Ok(FileExchange {
        spot: table.spot.clone(),
        spots,
        settings,
        retries,
        kind: ExchangeKind::Master(operation),
        output: write.map(|list| list.part),
        input: read.map(|list| list.part),
        pending: None,
        refusal: None,
        is_can: false,
        remote: false,
    })
}

fn read_block(table: &TableReader<'_>, peer: u8) -> Result<FileExchange> {
    table.check_names(&keys::names(exchange::BLOCK.keys()), exchange::BLOCK.place, |_| false)?;
    let holds = table.required("table", "coils, discrete-inputs, holding-registers or input-registers")?;
    let holds = holds.choice(&TABLES)?;
    let first = table.required("address", "the first register or coil, counted from 0 as on the line")?;
    let first = read_first(&first, holds)?;
    let direction = direction_of(table, holds)?;
    let list = List::read(table, "fields", direction, is_of_coils(holds))?;
    let operation = Operation::of_block(holds, direction, first, list.count);
    let list = Some(list);
    match direction {
        Direction::Input => check(table, &operation, &None, &list)?,
        Direction::Output => check(table, &operation, &list, &None)?,
    }
    let part = list.map(|list| list.part);
    exchanges::refuse_restarted(table, part.as_ref())?;
    let (input, output) = if direction == Direction::Input { (part, None) } else { (None, part) };
    Ok(FileExchange {
        spot: table.spot.clone(),
        spots: exchanges::spots(table, &[("address", ExchangeKey::Registers)]),
        settings: FileExchange::never(peer),
        retries: None,
        kind: ExchangeKind::Slave(operation),
        output,
        input,
        pending: None,
        refusal: None,
        is_can: false,
        remote: false,
    })
}

/// Reads the address of the first register or coil. The six-digit numbers of manuals are not addresses.
fn read_first(item: &TableValue<'_>, table: Table) -> Result<u16> {
    item.integer(exchange::ADDRESS.integers()).map_err(|mut error| {
        let number = item.as_integer().and_then(|number| u32::try_from(number).ok());
        if let Some(address) = number.and_then(|number| table.address_of_number(number)) {
            error.message += &format!("; on the line, what a manual calls so has the address {address}");
        }
        error
    })
}

/// Who writes the block: a master, with values for the robot, or the gateway.
fn direction_of(block: &TableReader<'_>, holds: Table) -> Result<Direction> {
    let list = block.required("fields", "the list of the block's fields")?;
    let mut found: Option<Direction> = None;
    for item in list.array("of fields")?.iter().filter(|item| item.is_table()) {
        let field = item.any_table()?;
        let has = |keys: &[&str]| keys.iter().find_map(|key| field.optional(key));
        let ways = [
            (Direction::Input, has(&["to", "commands", "equals", "length_to", "count_to"])),
            (Direction::Output, has(&["from", "value", "length_from"])),
        ];
        for (direction, key) in ways.into_iter().filter_map(|(direction, key)| Some((direction, key?))) {
            let is_read_only = matches!(holds, Table::DiscreteInputs | Table::InputRegisters);
            if is_read_only && direction == Direction::Input {
                return Err(key.error(
                    "a master cannot write discrete inputs and input registers; allowed: from, value, pad",
                ));
            }
            match found.replace(direction) {
                Some(before) if before != direction => {
                    return Err(key.error(
                        "a master reads some fields of this block and writes others; these are two blocks",
                    ));
                }
                _ => {}
            }
        }
    }
    Ok(found.unwrap_or(match holds {
        Table::Coils | Table::HoldingRegisters => Direction::Input,
        Table::DiscreteInputs | Table::InputRegisters => Direction::Output,
    }))
}

/// Reads a function given by name or by number. The counts of the operation are 1, to be set later.
fn read_function(table: &TableReader<'_>) -> Result<Operation> {
    let item = table.required("function", "such as \"read-input-registers\", or its number, 4")?;
    let number = match item.as_integer() {
        None => i64::from(item.choice(&FUNCTIONS)?),
        Some(number) => number,
    };
    let known = u8::try_from(number).ok().and_then(|code| Operation::of_function(code, (0, 1), (0, 1), 0));
    known.ok_or_else(|| {
        let codes: Vec<_> = FUNCTIONS.iter().map(|(name, code)| format!("{code} ({name})")).collect();
        item.error(format!("function {number} is unknown; allowed: {}", codes.join(", ")))
    })
}

fn is_of_coils(table: Table) -> bool {
    matches!(table, Table::Coils | Table::DiscreteInputs)
}

/// A list of fields, and their number of registers or coils.
struct List<'a> {
    item: TableValue<'a>,
    part: FilePart,
    count: u16,
}

impl<'a> List<'a> {
    fn read(table: &TableReader<'a>, key: &str, direction: Direction, is_coils: bool) -> Result<Self> {
        let what = if is_coils { "the list of the coils" } else { "the list of the fields in the registers" };
        let item = table.required(key, what)?;
        let (fields, count) = match is_coils {
            true => coils::read(&item, direction)?,
            false => read_registers(table, &item, direction)?,
        };
        let mut part = FilePart::new(table);
        part.spot = item.spot.clone();
        let count = u16::try_from(count).unwrap_or(u16::MAX);
        part.frames.push(FileFrame::of_fields(item.spot.clone(), fields));
        part.check_device(table, Carrier::Whole, direction)?;
        let list = Self { item, part, count };
        if !is_coils { list.with_registers(direction) } else { Ok(list) }
    }

    /// The bits of a register that have fields.
    fn bits(&self) -> u16 {
        register_bits(&self.part.fields().iter().map(FileField::spec).collect::<Vec<_>>())
    }

    /// Counts the registers.
    fn with_registers(mut self, direction: Direction) -> Result<Self> {
        let specs: Vec<_> = self.part.fields().iter().map(FileField::spec).collect();
        let frame = DeviceFrame::new(Carrier::Whole, direction, (&[], &[]), &specs);
        let (shortest, longest) = frame.map_or((0, 0), |frame| frame.layout.lengths());
        if shortest != longest {
            return Err(self.item.error(ExchangeError::Varying));
        }
        if longest % 2 == 1 {
            return Err(self.item.error(format!(
                "the fields have {longest} bytes, but registers have two each; fill them up with {{ pad = 1 }}"
            )));
        }
        self.count = (longest / 2) as u16;
        Ok(self)
    }
}

fn read_registers(
    table: &TableReader<'_>,
    list: &TableValue<'_>,
    direction: Direction,
) -> Result<(Vec<FileField>, usize)> {
    let mut reader = FieldReader::of_registers(table, direction)?;
    let mut fields = Vec::new();
    for item in
        list.array("of fields, such as [{ name = \"speed\", type = \"word\", to = \"WordInputReg[1]\" }]")?
    {
        if item.is_table() {
            refuse(&item.any_table()?, &["length"], "the frames of Modbus have their own length")?;
        }
        reader.read(&item, &mut fields)?;
    }
    Ok((fields, 0))
}

/// Checks the counts and addresses against the limits of the function.
fn check(
    table: &TableReader<'_>,
    operation: &Operation,
    read: &Option<List<'_>>,
    write: &Option<List<'_>>,
) -> Result<()> {
    let lists = [("address", read), ("write_address", write)];
    for (key, list) in lists.into_iter().filter_map(|(key, list)| Some((key, list.as_ref()?))) {
        if let Err(error) = operation.check()
            && error.count == list.count
        {
            return Err(list.item.error(ExchangeError::Count(error)));
        }
        let Some(item) = table.optional(key).or_else(|| table.optional("address")) else { continue };
        let address: u16 = item.integer(exchange::ADDRESS.integers())?;
        if u32::from(address) + u32::from(list.count) > 0x1_0000 {
            return Err(item.error(ExchangeError::BeyondLast { address, count: list.count }));
        }
    }
    Ok(())
}
