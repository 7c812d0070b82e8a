//! The fields of coils: one bit each, without a type, packed into bytes from the lowest bit up.
//!
//! In: the list of fields of a Modbus exchange or block. Out: [`FileField`]s that share bytes, and the number of coils.

use proto_core::config::FieldSpec;
use proto_core::device::{Bits, ByteOrder, Encoding, Kind, Overflow};
use proto_core::sysvar::Direction;

use super::device::{bind, binding_keys, read_constant};
use super::encoding::refuse;
use super::model::FileField;
use super::reader::{Result, Spot, TableReader, TableValue};
use crate::keys::field::{self, PAD_COILS};

/// Coils read so far.
struct Packer {
    fields: Vec<FileField>,
    /// Coils so far.
    count: usize,
    /// Number of bytes that have fields or padding.
    bytes: usize,
    /// The newest padding, for bytes that have nothing else.
    padded: Option<Spot>,
}

/// Reads the fields of a list; returns them with the number of coils.
pub(super) fn read(list: &TableValue<'_>, direction: Direction) -> Result<(Vec<FileField>, usize)> {
    let mut packer = Packer { fields: Vec::new(), count: 0, bytes: 0, padded: None };
    for item in list.array("of coils, such as [{ name = \"ready\", to = \"WordInputReg[1]\" }]")? {
        packer.read(&item.any_table()?, direction)?;
    }
    let bytes = packer.count.div_ceil(8);
    packer.pad_up_to(bytes);
    Ok((packer.fields, packer.count))
}

impl Packer {
    fn read(&mut self, table: &TableReader<'_>, direction: Direction) -> Result<()> {
        if let Some(pad) = table.optional("pad") {
            table.check_keys(&[field::COIL_PADDING], " in padding of coils, which are sent as 0")?;
            self.count += pad.integer::<usize>(PAD_COILS.integers())?;
            self.padded = Some(table.spot.clone());
            return Ok(());
        }
        refuse(table, &["type", "bits"], "a coil is one bit; it has no type and no bits")?;
        let keys = binding_keys(table, direction)?;
        table.check_keys(&[field::COIL, keys], field::COIL_IN.place)?;
        let (byte, first) = (self.count / 8, (self.count % 8) as u8);
        self.pad_up_to(byte);
        let kind = Kind::Bits(Bits { bytes: 1, first, count: 1, signed: false });
        let shared = self.bytes > byte;
        let encoding = Encoding { kind, order: ByteOrder::Little, shared };
        (self.bytes, self.count) = (byte + 1, self.count + 1);
        match table.optional("equals") {
            Some(equals) => self.fields.push(read_constant(table, &table.spot, &equals, encoding)?),
            None => bind(table, direction, (encoding, Overflow::Usual), &table.spot, &mut self.fields)?,
        }
        Ok(())
    }

    /// Adds padding for bytes in which all coils are skipped.
    fn pad_up_to(&mut self, bytes: usize) {
        while self.bytes < bytes {
            let len = (bytes - self.bytes).min(usize::from(u8::MAX));
            if let Some(spot) = self.padded.clone() {
                let spec = FieldSpec::Padding { len: len as u8, fill: 0 };
                self.fields.push(FileField::new(spot, String::new(), spec));
            }
            self.bytes += len;
        }
    }
}
