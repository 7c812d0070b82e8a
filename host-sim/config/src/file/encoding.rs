//! The encoding of one field of a device's frame: its type, byte order and bits.
//!
//! In: a field's table, and the byte order of its part. Out: an [`Encoding`].

use proto_core::device::{Bits, ByteOrder, Digits, Encoding, Kind, MAX_DIGITS, Width};
use proto_core::wire::scalar::ScalarType;

use super::names::meant_type;
use super::reader::{Result, TableReader, TableValue};
use crate::keys::device::{ENDIAN, ORDERS, WORD_ORDER, WORD_ORDERS};
use crate::keys::field::{DECIMALS, OWN_TYPES, SIGNED, Type};

/// The byte order given by a part or a field.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct FieldOrder {
    is_big: Option<bool>,
    low_word_first: Option<bool>,
}

impl FieldOrder {
    /// The keys `endian` and `word_order` of a part or a field.
    pub(super) fn read(table: &TableReader<'_>) -> Result<Self> {
        Ok(Self {
            is_big: table.word(&ENDIAN, &ORDERS)?,
            low_word_first: table.word(&WORD_ORDER, &WORD_ORDERS)?,
        })
    }

    /// The order of fields in Modbus registers, whose bytes are big-endian.
    pub(super) fn of_registers(exchange: &TableReader<'_>) -> Result<Self> {
        Ok(Self { is_big: Some(true), ..Self::read(exchange)? })
    }

    /// The order of a number of `len` bytes; `self` is the field's order, `part` that of its part.
    fn of(self, part: Self, len: usize) -> ByteOrder {
        let is_big = self.is_big.or(part.is_big).unwrap_or(false);
        let low_word_first = self.low_word_first.or(part.low_word_first).unwrap_or(!is_big);
        match (is_big, low_word_first) {
            _ if len == 1 => ByteOrder::Little,
            (true, true) if matches!(len, 4 | 8) => ByteOrder::BigSwapped,
            (false, false) if matches!(len, 4 | 8) => ByteOrder::LittleSwapped,
            (true, _) => ByteOrder::Big,
            (false, _) => ByteOrder::Little,
        }
    }
}

/// The number that the previous bit fields belong to.
#[derive(Debug, Clone, Copy)]
pub(super) struct OpenNumber {
    bytes: u8,
    order: ByteOrder,
    /// The used bits of the number's bytes; the first byte is the lowest.
    taken: u64,
}

/// The type of a field that any recipe can have.
pub(super) fn read_plain_type(field: &TableReader<'_>) -> Result<ScalarType> {
    let item = read_type_item(field)?;
    if let Some((name, _)) = OWN_TYPES.iter().find(|(name, _)| item.as_string() == Some(name)) {
        return Err(
            item.error(format!("{name} is a type of a device's own frames; only gateway files have them"))
        );
    }
    let types: Vec<_> = ScalarType::ALL.into_iter().map(|ty| (ty.name(), ty)).collect();
    choose(&item, &types)
}

fn read_type(field: &TableReader<'_>) -> Result<Type> {
    let scalars = ScalarType::ALL.into_iter().map(|ty| (ty.name(), Type::Scalar(ty)));
    choose(&read_type_item(field)?, &scalars.chain(OWN_TYPES).collect::<Vec<_>>())
}

fn choose<T: Clone>(item: &TableValue<'_>, types: &[(&str, T)]) -> Result<T> {
    item.choice_or(types, |text| {
        let names: Vec<_> = types.iter().map(|(name, _)| *name).collect();
        meant_type(text, &names)
    })
}

fn read_type_item<'a>(field: &TableReader<'a>) -> Result<TableValue<'a>> {
    field.required("type", "byte, char, word, short, dword, int, float or double")
}

/// The encoding of a field. `open` is the number of bits that the previous field belongs to, and is set to that of this
/// field.
pub(super) fn read(
    field: &TableReader<'_>,
    part: FieldOrder,
    open: &mut Option<OpenNumber>,
) -> Result<Encoding> {
    let ty = read_type(field)?;
    let before = open.take();
    if let Some(item) = field.optional("bits") {
        refuse(field, &["width", "until", "decimals"], "a field of bits has no such key")?;
        let bits = read_bits(field, &item, ty)?;
        let order = read_order(field, part, Some(usize::from(bits.bytes)))?;
        let is_new = field.optional("new").map(|item| item.bool()).transpose()?;
        let ones = places(&bits, order);
        let shared = before.filter(|open| {
            // Bits in another byte order share the same bytes only if the file says so.
            let may_share = is_new.map_or(open.order == order, |is_new| !is_new);
            may_share && open.bytes == bits.bytes && open.taken & ones == 0
        });
        let taken = ones | shared.map_or(0, |open| open.taken);
        *open = Some(OpenNumber { bytes: bits.bytes, order, taken });
        return Ok(Encoding { kind: Kind::Bits(bits), order, shared: shared.is_some() });
    }
    refuse(field, &["signed", "new"], "allowed only together with bits")?;
    let kind = read_kind(field, ty)?;
    let encoding = Encoding { kind, order: ByteOrder::Little, shared: false };
    let len = encoding.size().filter(|_| !matches!(ty, Type::Decimal | Type::Hex));
    Ok(Encoding { order: read_order(field, part, len)?, ..encoding })
}

/// The bits in the bytes of their number; the first byte is the lowest.
fn places(bits: &Bits, order: ByteOrder) -> u64 {
    let ones = (u64::MAX >> (64 - u32::from(bits.count))) << bits.first;
    let mut bytes = [0; 8];
    order.write(ones, &mut bytes[..usize::from(bits.bytes)]);
    u64::from_le_bytes(bytes)
}

fn read_kind(field: &TableReader<'_>, ty: Type) -> Result<Kind> {
    if let Type::Wide(_) = ty {
        return Err(field.error("a number of more than 4 bytes has no value as a whole; give the field bits"));
    }
    match ty {
        Type::Scalar(_) | Type::Uint24 | Type::Int24 => {
            refuse(field, &["width"], "only bcd, decimal and hex have a width")?;
        }
        Type::Bcd | Type::Decimal | Type::Hex | Type::Wide(_) => {}
    }
    if !matches!(ty, Type::Decimal | Type::Hex) {
        refuse(field, &["until"], "only decimal and hex end with a character")?;
    }
    if ty != Type::Decimal {
        refuse(field, &["decimals"], "only decimal has decimals")?;
    }
    Ok(match ty {
        Type::Scalar(ty) => Kind::Scalar(ty),
        Type::Uint24 | Type::Wide(_) => Kind::Uint24,
        Type::Int24 => Kind::Int24,
        Type::Bcd => {
            Kind::Bcd { bytes: field.required("width", "the number of bytes, 1..=4")?.integer(1..=4)? }
        }
        Type::Hex => Kind::Hex(read_width(field, 8, |end| !end.is_ascii_hexdigit(), "a hexadecimal digit")?),
        Type::Decimal => {
            let ends = |end: char| !matches!(end, '0'..='9' | '+' | '-' | '.' | ' ');
            let width = read_width(field, MAX_DIGITS as i64, ends, "a digit, a sign, a point or a blank")?;
            let decimals = match (field.optional("decimals"), width) {
                (None, _) => 0,
                (Some(item), Width::Until(_)) => item.integer(DECIMALS.integers())?,
                (Some(item), Width::Fixed(width)) => {
                    let decimals: u8 = item.integer(DECIMALS.integers())?;
                    // A sign, a digit and a point come before the decimals.
                    if decimals > 0 && width < decimals + 3 {
                        let least = decimals + 3;
                        return Err(item.error(format!(
                            "{decimals} decimals need a sign, a digit and a point before them; a width of \
                             {least} or more is needed, this one is {width}"
                        )));
                    }
                    decimals
                }
            };
            Kind::Decimal(Digits { width, decimals })
        }
    })
}

/// `width` or `until`, of a field of digits.
fn read_width(
    field: &TableReader<'_>,
    most: i64,
    ends: impl Fn(char) -> bool,
    digits: &str,
) -> Result<Width> {
    match (field.optional("width"), field.optional("until")) {
        (Some(width), None) => Ok(Width::Fixed(width.integer(1..=most)?)),
        (None, Some(until)) => {
            let text = until.string()?;
            let mut characters = text.chars();
            match (characters.next(), characters.next()) {
                (Some(end), None) if end.is_ascii() && ends(end) => Ok(Width::Until(end as u8)),
                (Some(end), None) if end.is_ascii() => {
                    Err(until.error(format!("{text:?} cannot end the field; allowed: what is not {digits}")))
                }
                _ => {
                    Err(until
                        .error(format!("{text:?} is not one character of ASCII, such as \",\" or \"\\r\"")))
                }
            }
        }
        (Some(_), Some(until)) => Err(until.error("a field takes width or until, not both")),
        (None, None) => Err(field.error(format!(
            "width or until is missing; width is the number of characters, 1..={most}, until the character \
             behind the field, such as \",\""
        ))),
    }
}

/// `bits = 3` or `bits = "4..7"`, of an unsigned number.
fn read_bits(field: &TableReader<'_>, item: &TableValue<'_>, ty: Type) -> Result<Bits> {
    let bytes = match ty {
        Type::Scalar(ty @ (ScalarType::Byte | ScalarType::Word | ScalarType::Dword)) => ty.size() as u8,
        Type::Uint24 => 3,
        Type::Wide(bytes) => bytes,
        _ => {
            return Err(item.error(
                "only byte, word, dword and uint24 to uint64 have bits; with signed = true they may be negative",
            ));
        }
    };
    let last_bit = bytes * 8 - 1;
    let (first, last) = match item.as_string() {
        None => {
            let bit = item.integer(0..=i64::from(last_bit))?;
            (bit, bit)
        }
        Some(text) => {
            let range = text.split_once("..").unwrap_or((text, text));
            let (Ok(first), Ok(last)) = (range.0.parse::<u8>(), range.1.parse::<u8>()) else {
                return Err(item.error(format!("{text:?} is not a range of bits; write 3 or \"4..7\"")));
            };
            if first > last || last > last_bit {
                return Err(item.error(format!(
                    "{text:?} is out of range; allowed: bits in 0..{last_bit}, the lowest first"
                )));
            }
            if last - first >= 32 {
                return Err(item.error(format!("{text:?} are too many; allowed: up to 32 bits")));
            }
            (first, last)
        }
    };
    let signed = field.flag(&SIGNED)?;
    Ok(Bits { bytes, first, count: last - first + 1, signed })
}

/// The byte order of a field of `len` bytes; `None` for digits.
fn read_order(field: &TableReader<'_>, part: FieldOrder, len: Option<usize>) -> Result<ByteOrder> {
    let own = FieldOrder::read(field)?;
    if len.is_none_or(|len| len == 1) {
        refuse(
            field,
            &["endian"],
            "one byte, or digits, have no byte order; allowed: fields of 2 bytes or more",
        )?;
    }
    if !matches!(len, Some(4 | 8)) {
        refuse(field, &["word_order"], "only fields of 4 or 8 bytes have an order of words")?;
    }
    Ok(own.of(part, len.unwrap_or(1)))
}

/// Refuses the first of `keys` that the table has.
pub(super) fn refuse(table: &TableReader<'_>, keys: &[&str], why: &str) -> Result<()> {
    match keys.iter().find_map(|key| table.optional(key)) {
        Some(item) => Err(item.error(why)),
        None => Ok(()),
    }
}
