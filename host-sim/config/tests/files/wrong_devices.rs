//! Every mistake in a device's own frames gets one message that says where, what, and what is allowed.
//!
//! Each case is one edit of a good file; see `wrong_files`.

use super::wrong_files::{CONTROLLER, Case, messages};

const DEVICE: &str = include_str!("good/device.toml");

const fn device(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (DEVICE, from, to) }
}

const fn controller(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (CONTROLLER, from, to) }
}

#[rustfmt::skip]
const CASES: &[Case] = &[
    // Where there are no frames of devices.
    device("an order in a realtime recipe", "head = [255]", "head = [255]\nendian = \"big\""),
    device("a checksum in a realtime recipe", "head = [255]", "head = [255]\nchecksum = { kind = \"crc16-modbus\" }"),
    device("a checksum of all frames of a CAN part", "[[recipe.input.frame]]\nid = 0x101", "[recipe.input]\nchecksum = { kind = \"sum8\" }\n[[recipe.input.frame]]\nid = 0x101"),
    controller("an order in a controller's file", "[recipe.output]\n", "[recipe.output]\nendian = \"big\"\n"),
    controller("a constant in a controller's file", "{ name = \"input1\", type = \"byte\" }", "{ name = \"input1\", type = \"byte\", equals = 1 }"),
    controller("bits in a controller's file", "{ name = \"input1\", type = \"byte\" }", "{ name = \"input1\", type = \"byte\", bits = 1 }"),
    controller("padding in a controller's file", "{ name = \"input1\", type = \"byte\" }", "{ pad = 1 }"),
    controller("a device's type in a controller's file", "{ name = \"input1\", type = \"byte\" }", "{ name = \"input1\", type = \"uint24\" }"),
    // Names of others.
    device("a type of another language", "{ name = \"fixed\", type = \"byte\"", "{ name = \"fixed\", type = \"int16\""),
    device("a checksum as its catalogue spells it", "kind = \"crc16-", "kind = \"CRC-16/"),
    // Orders.
    device("an unknown order", "endian = \"big\"", "endian = \"middle\""),
    device("an unknown order of words", "word_order = \"low-first\"", "word_order = \"low\""),
    device("an order of words of a word", "type = \"dword\", word_order", "type = \"word\", word_order"),
    device("an order of a byte", "{ name = \"fixed\", type = \"byte\"", "{ name = \"fixed\", type = \"byte\", endian = \"big\""),
    device("an order of digits", "type = \"decimal\", width = 8", "type = \"decimal\", width = 8, endian = \"big\""),
    // Bits.
    device("a bit that a byte does not have", "bits = 0 }", "bits = 8 }"),
    device("a range that a byte does not have", "bits = \"4..7\"", "bits = \"4..8\""),
    device("a range of bits that runs backwards", "bits = \"4..7\"", "bits = \"7..4\""),
    device("bits that are no range", "bits = \"4..7\"", "bits = \"4-7\""),
    device("bits that are no number", "bits = \"4..7\"", "bits = true"),
    device("bits of a signed number", "{ name = \"ready\", type = \"byte\"", "{ name = \"ready\", type = \"char\""),
    device("a sign without bits", "{ name = \"fixed\", type = \"byte\"", "{ name = \"fixed\", type = \"byte\", signed = true"),
    device("a new number without bits", "word_order = \"low-first\"", "new = true"),
    device("bits with a width", "bits = 0 }", "bits = 0, width = 1 }"),
    device("new that is no bool", "bits = 0 }", "bits = 0, new = 1 }"),
    // Digits.
    device("a width of a dword", "type = \"dword\"", "type = \"dword\", width = 4"),
    device("decimals of a hexadecimal number", "type = \"hex\"", "type = \"hex\", decimals = 1"),
    device("an end of a BCD number", "type = \"bcd\", width = 2", "type = \"bcd\", until = \",\""),
    device("no width of a BCD number", "type = \"bcd\", width = 2", "type = \"bcd\""),
    device("a BCD number of 5 bytes", "type = \"bcd\", width = 2", "type = \"bcd\", width = 5"),
    device("digits without a width", "width = 8, ", ""),
    device("a width and an end", "width = 8, ", "width = 8, until = \";\", "),
    device("17 digits", "width = 8", "width = 17"),
    device("9 hexadecimal digits", "until = \",\"", "width = 9"),
    device("an end of two characters", "until = \",\"", "until = \"\\r\\n\""),
    device("an end that is not ASCII", "until = \",\"", "until = \"€\""),
    device("an end that is a digit", "until = \",\"", "until = \"F\""),
    device("a number that ends with a point", "width = 8", "until = \".\""),
    device("6 decimals in 8 characters", "decimals = 2", "decimals = 6"),
    device("10 decimals", "decimals = 2", "decimals = 10"),
    // Constants, padding, texts.
    device("a constant beyond its type", "equals = 9", "equals = 256"),
    device("a constant that is no integer", "equals = 9", "equals = 9.5"),
    device("a constant with a binding", "equals = 9", "equals = 9, to = \"WordInputReg[6]\""),
    device("a constant float", "type = \"byte\", equals = 9", "type = \"float\", equals = 9"),
    device("value in an input field", "equals = 9", "value = 9"),
    device("equals in an output field", "value = 125", "equals = 125"),
    device("a constant beyond its digits", "type = \"bcd\", width = 2, from = \"counter\"", "type = \"bcd\", width = 2, value = 10000"),
    device("a constant with a fraction", "type = \"bcd\", width = 2, from = \"counter\"", "type = \"bcd\", width = 2, value = 1.5"),
    device("no padding", "pad = 2", "pad = 0"),
    device("too much padding", "pad = 2", "pad = 300"),
    device("a fill of 256", "fill = 0xFF", "fill = 256"),
    device("a fill without padding", "value = 125", "value = 125, fill = 1"),
    device("padding with a name", "pad = 2", "pad = 2, name = \"gap\""),
    device("an empty text", "text = \"kg\"", "text = \"\""),
    device("a text that is not ASCII", "text = \"kg\"", "text = \"µg\""),
    device("a text with a name", "text = \"kg\"", "text = \"kg\", name = \"unit\""),
    // What becomes of numbers.
    device("an unknown overflow", "overflow = \"wrap\"", "overflow = \"saturate\""),
    device("an overflow of nothing", "{ name = \"code\", type = \"hex\", until = \",\", to = \"WordInputReg[4]\" }", "{ name = \"code\", type = \"hex\", until = \",\", overflow = \"wrap\" }"),
    device("an overflow of a constant", "value = 125", "value = 125, overflow = \"wrap\""),
    device("a float that wraps", "[controller]\naddress = \"192.168.12.138\"", "[controller]\naddress = \"192.168.12.138\"\nrecipe_link = { recipe = \"plain\" }\n[[recipe]]\nname = \"wraps\"\nkind = \"stream\"\nmode = \"user\"\n[recipe.output]\nhead = [1]\nfields = [{ name = \"x\", type = \"float\", from = \"WordOutputReg[1]\", overflow = \"wrap\" }]"),
    device("a command for a value that bits never have", "commands = { 1 = \"stop\" }", "commands = { 16 = \"stop\" }"),
    device("commands of a number with a fraction", "to = \"WordInputReg[3]\"", "commands = { 1 = \"stop\" }"),
    // Checksums.
    device("a checksum that is a string", "{ kind = \"sum8\" }", "\"sum8\""),
    device("a checksum without a kind", "{ kind = \"sum8\" }", "{ over = \"0..\" }"),
    device("an unknown checksum", "kind = \"crc16-modbus\"", "kind = \"crc16\""),
    device("parameters of a known checksum", "kind = \"crc16-modbus\"", "kind = \"crc16-modbus\", poly = 0x8005"),
    device("an unknown key of a CRC", "poly = 0x07", "polynomial = 0x07"),
    device("a CRC without a width", "\"crc\", width = 8", "\"crc\""),
    device("a CRC without a polynomial", ", poly = 0x07", ""),
    device("a CRC of 33 bits", "\"crc\", width = 8", "\"crc\", width = 33"),
    device("a polynomial of 9 bits", "poly = 0x07", "poly = 0x107"),
    device("bytes that are no range", "over = \"1..\"", "over = \"1\""),
    device("bytes that run backwards", "over = \"1..\"", "over = \"7..1\""),
    device("bytes beyond any frame", "over = \"1..\"", "over = \"512..\""),
    device("bytes behind the checksum", "over = \"1..\"", "over = \"1..60\""),
    device("a place inside a field", "over = \"1..\", order", "at = 6, order"),
    device("a place behind a field of varying length", "over = \"1..\", order", "at = 30, order"),
    device("a checksum in a mixed order", "order = \"big\" }", "order = \"mixed\" }"),
    device("a checksum as text of an unknown kind", "order = \"big\" }", "as = \"ascii\" }"),
    // Frames.
    device("nothing that tells where a frame begins", "checksum = { kind = \"crc\", width = 8, poly = 0x07 }\n", ""),
    device("a frame of 9 bytes on CAN", "fields = [{ name = \"x\", type = \"int24\"", "fields = [{ pad = 5 }, { name = \"x\", type = \"int24\""),
    device("two frames with one id", "id = 0x102", "id = 0x101"),
    device("a CAN part without frames", "id = 0x102\nfields = [{ name = \"y\", type = \"byte\", bits = 7 }]", "id = 0x102\nfields = [{ name = \"y\", type = \"byte\", bits = 7 }]\n[recipe.output]\n"),
    device("a head of nine bytes", "head = [2]", "head = [1, 2, 3, 4, 5, 6, 7, 8, 9]"),
    device("a tail of ten bytes", "tail = [3]", "tail = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]"),
    device("a frame without fields", "fields = [{ name = \"y\", type = \"byte\", bits = 7 }]", "fields = []"),
    device("a frame of 600 bytes", "{ pad = 2, fill = 0xFF }", "{ pad = 255 }, { pad = 255 }, { pad = 90 }"),
    device("an unknown key of a CAN frame", "id = 0x102", "id = 0x102\ncrc = 1"),
    device("two fields to one variable", "to = \"WordInputReg[3]\"", "to = \"WordInputReg[2]\""),
    device("a device's recipe on TCP", "bus = \"rs485\"", "bus = \"tcp-listen\"\nlisten = \"0.0.0.0:50000\""),
];

#[test]
fn every_wrong_frame_says_what_is_wrong_with_it() {
    insta::assert_snapshot!(
        "wrong_devices",
        messages(CASES, |good| if good == DEVICE { "device.toml" } else { "robot.toml" })
    );
}
