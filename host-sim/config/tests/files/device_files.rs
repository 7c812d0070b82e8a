//! What the keys of a device's own frames mean in the configuration.

use proto_core::config::{FieldSpec, GatewayConfig, InputBinding, OutputBinding, Parts};
use proto_core::device::{
    Algorithm, Bits, ByteOrder, Checksum, Crc, Digits, Encoding, Kind, Overflow, Width,
};
use proto_core::sysvar::SysVar;
use proto_core::wire::scalar::ScalarType;
use recipe_config::file::{Text, parse_gateway, parse_recipes};
use recipe_config::{AnyRecipe, DeviceRecipe};

const DEVICE: &str = include_str!("good/device.toml");

/// A file with one recipe for a port of an RS-485 line, with these parts.
fn gateway(parts: &str) -> String {
    format!(
        "[controller]\naddress = \"a\"\n[[recipe]]\nname = \"r\"\nkind = \"stream\"\nmode = \"user\"\n{parts}\n\
         [[port]]\nname = \"p\"\nbus = \"rs485\"\nrecipe = \"r\"\n"
    )
}

fn parsed(parts: &str) -> Box<GatewayConfig> {
    parse_gateway(Text { name: "test.toml", toml: &gateway(parts) }, &[])
        .unwrap_or_else(|error| panic!("{error}"))
}

/// The fields of an input part with these keys and this list.
fn input(keys: &str, fields: &str) -> Vec<FieldSpec> {
    parsed(&format!("[recipe.input]\nhead = [1]\n{keys}\nfields = [{fields}]")).fields.to_vec()
}

fn orders(keys: &str, fields: &str) -> Vec<ByteOrder> {
    input(keys, fields).iter().filter_map(|field| Some(field.element()?.encoding()?.order)).collect()
}

fn to(name: &str) -> InputBinding {
    InputBinding::Variable { var: SysVar::parse(name).unwrap(), scale: 1.0, offset: 0.0 }
}

fn little(kind: Kind) -> Encoding {
    Encoding { kind, order: ByteOrder::Little, shared: false }
}

fn bits(first: u8, count: u8) -> Encoding {
    little(Kind::Bits(Bits { bytes: 1, first, count, signed: false }))
}

#[test]
fn every_key_has_its_place_in_the_configuration() {
    let config = parse_gateway(Text { name: "device.toml", toml: DEVICE }, &[]).unwrap();
    let Parts::Stream { input: Some(input), output: Some(output) } = &config.recipes[0].parts else {
        panic!("{:?}", config.recipes[0].parts)
    };
    let byte = Encoding::scalar(ScalarType::Byte);
    let value = |encoding, to| FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to };
    let crc = Checksum {
        order: ByteOrder::Big,
        first: 1,
        ..Checksum::standard(Algorithm::named("crc16-modbus").unwrap())
    };
    let total = Encoding { order: ByteOrder::BigSwapped, ..Encoding::scalar(ScalarType::Dword) };
    let weight = Kind::Decimal(Digits { width: Width::Fixed(8), decimals: 2 });
    let order = Encoding { shared: true, ..bits(4, 4) };
    let commands = input.fields.of(&config.fields)[3];
    assert_eq!(
        input.fields.of(&config.fields),
        [
            FieldSpec::Fixed { encoding: byte, value: 9 },
            value(bits(0, 1), InputBinding::Unused),
            value(order, to("WordInputReg[1]")),
            commands,
            FieldSpec::Padding { len: 2, fill: 255 },
            FieldSpec::DeviceInput { encoding: total, overflow: Overflow::Wrap, to: to("WordInputReg[2]") },
            FieldSpec::Fixed { encoding: byte, value: i64::from(b'k') },
            FieldSpec::Fixed { encoding: byte, value: i64::from(b'g') },
            value(little(weight), to("WordInputReg[3]")),
            value(little(Kind::Hex(Width::Until(b','))), to("WordInputReg[4]")),
            FieldSpec::Checksum(crc),
        ]
    );
    // The second use of the same bits.
    let FieldSpec::DeviceInput { encoding, to: InputBinding::Commands { table, .. }, .. } = commands else {
        panic!("{commands:?}")
    };
    assert_eq!((encoding, table.of(&config.commands)[0].text.as_str()), (order, "stop"));
    let own = Crc { width: 8, poly: 7, init: 0, xorout: 0, refin: false, refout: false };
    assert_eq!(
        output.fields.of(&config.fields),
        [
            // What the controller's recipes can have stays as it is in them.
            FieldSpec::UserOutput { ty: ScalarType::Byte, from: OutputBinding::Constant(125.0) },
            FieldSpec::DeviceOutput {
                encoding: little(Kind::Bcd { bytes: 2 }),
                overflow: Overflow::Usual,
                from: OutputBinding::Counter
            },
            FieldSpec::Checksum(Checksum::standard(Algorithm::Crc(own))),
        ]
    );
    let view = config.view();
    assert_eq!([0, 1, 2].map(|nth| view.is_device(&config.recipes[nth])), [true, true, false]);
}

#[test]
fn a_part_gives_the_order_and_a_field_another() {
    let fields = "{ name = \"a\", type = \"byte\" }, { name = \"b\", type = \"short\" }, { name = \"c\", type = \"uint24\" }, \
                  { name = \"d\", type = \"float\" }, { name = \"e\", type = \"double\" }, \
                  { name = \"f\", type = \"bcd\", width = 4 }, { name = \"g\", type = \"dword\", bits = 3 }, \
                  { name = \"h\", type = \"decimal\", width = 4 }";
    use ByteOrder::{Big, BigSwapped, Little, LittleSwapped};
    let of = |keys| orders(keys, fields);
    assert_eq!(of(""), [Little; 8]);
    assert_eq!(of("endian = \"big\""), [Little, Big, Big, Big, Big, Big, Big, Little]);
    let (low, high) = ("word_order = \"low-first\"", "word_order = \"high-first\"");
    assert_eq!(of(low), [Little; 8]);
    assert_eq!(
        of(high),
        [Little, Little, Little, LittleSwapped, LittleSwapped, LittleSwapped, LittleSwapped, Little]
    );
    let big = "endian = \"big\"\n";
    assert_eq!(
        of(&format!("{big}{low}")),
        [Little, Big, Big, BigSwapped, BigSwapped, BigSwapped, BigSwapped, Little]
    );
    let own = "{ name = \"a\", type = \"dword\", endian = \"little\" }, { name = \"b\", type = \"dword\", word_order = \"low-first\" }";
    assert_eq!(orders(big, own), [Little, BigSwapped]);
}

#[test]
fn bits_share_a_number_until_they_meet() {
    let shared = |fields: &str| -> Vec<bool> {
        let fields = input("", fields);
        fields.iter().filter_map(|field| Some(field.element()?.encoding()?.shared)).collect()
    };
    let bit = |ty: &str, keys: &str| format!("{{ name = \"x\", type = \"{ty}\", {keys} }}");
    let of =
        |keys: &[&str]| shared(&keys.iter().map(|keys| bit("byte", keys)).collect::<Vec<_>>().join(", "));
    assert_eq!(of(&["bits = 0", "bits = 7", "bits = \"1..3\""]), [false, true, true]);
    assert_eq!(of(&["bits = 0", "bits = \"0..1\"", "bits = 2"]), [false, false, true]);
    assert_eq!(of(&["bits = 0", "bits = 1, new = true", "bits = 0"]), [false, false, true]);
    let word = bit("word", "bits = 1");
    let byte = bit("byte", "bits = 0");
    assert_eq!(shared(&format!("{byte}, {word}")), [false, false]);
    let other = bit("word", "bits = 2, endian = \"big\"");
    assert_eq!(shared(&format!("{word}, {other}")), [false, false]);
    let between = format!("{byte}, {{ pad = 1 }}, {}", bit("byte", "bits = 1"));
    assert_eq!(shared(&between), [false, false]);
    let with_command = bit("byte", "bits = 1, to = \"WordInputReg[1]\", commands = { 1 = \"stop\" }");
    assert_eq!(
        shared(&format!("{byte}, {with_command}, {}", bit("byte", "bits = 2"))),
        [false, true, true, true]
    );
    // All 32 bits of a number, as a signed one.
    let all = input("", "{ name = \"x\", type = \"dword\", bits = \"0..31\", signed = true }");
    let kind = Kind::Bits(Bits { bytes: 4, first: 0, count: 32, signed: true });
    assert_eq!(all[0].element().unwrap().encoding().unwrap().kind, kind);
}

#[test]
fn a_checksum_stands_where_it_should() {
    let place = |keys: &str| {
        let fields = "{ name = \"a\", type = \"byte\", bits = 0 }, { name = \"b\", type = \"byte\", bits = 1 }, { pad = 2 }, \
                      { name = \"c\", type = \"word\" }";
        let fields = input(&format!("checksum = {{ kind = \"crc16-xmodem\"{keys} }}"), fields);
        let place = fields.iter().position(|field| matches!(field, FieldSpec::Checksum(_))).unwrap();
        let FieldSpec::Checksum(sum) = fields[place] else { unreachable!() };
        (place, sum.first, sum.last(), sum.order, sum.text)
    };
    use ByteOrder::{Big, Little};
    assert_eq!(place(""), (4, 0, None, Big, false));
    assert_eq!(place(", over = \"1..3\", order = \"little\", as = \"hex\""), (4, 1, Some(3), Little, true));
    assert_eq!(place(", at = 2"), (2, 0, None, Big, false));
    assert_eq!(place(", at = 1, over = \"3..6\""), (0, 3, Some(6), Big, false));
    assert_eq!(place(", at = 6"), (4, 0, None, Big, false));
}

#[test]
fn what_the_controller_can_have_stays_plain() {
    let part = "[recipe.input]\nhead = [1]\nendian = \"little\"\nfields = [{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }]";
    let config = parsed(part);
    assert!(!config.view().is_device(&config.recipes[0]));
    let big = parsed(&part.replace("little", "big"));
    assert!(big.view().is_device(&big.recipes[0]));
    // One byte has no order.
    let byte = parsed(&part.replace("little", "big").replace("word", "byte"));
    assert!(!byte.view().is_device(&byte.recipes[0]));
}

#[test]
fn the_names_of_a_devices_fields_are_kept() {
    let recipes = parse_recipes(Text { name: "device.toml", toml: DEVICE }, &[]).unwrap();
    let [AnyRecipe::Device(gauge), AnyRecipe::Device(panel), AnyRecipe::Plain(plain)] = &recipes[..] else {
        panic!("{recipes:?}")
    };
    let names = |recipe: &DeviceRecipe| {
        recipe
            .input
            .iter()
            .flat_map(|frame| &frame.fields)
            .map(|field| field.name.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(names(gauge), ["", "ready", "order", "order", "", "total", "", "", "weight", "code", ""]);
    let repeats: Vec<_> = gauge.input[0].fields.iter().map(|field| field.repeats).collect();
    assert_eq!(repeats.iter().position(|&repeats| repeats), Some(3));
    assert_eq!(names(panel), ["x", "", "y"]);
    assert_eq!((plain.name.as_str(), recipes[2].plain()), ("plain", Some(plain)));
}
