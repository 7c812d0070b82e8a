//! What the keys of texts, lengths, framings and escapes mean in the configuration.

use proto_core::config::{FieldSpec, GatewayConfig, Parts, StreamPart, Words};
use proto_core::device::{Boundary, ByteOrder, Counts, Encoding, Escape, Ignored, Length, Text, TextWidth};
use proto_core::sysvar::SysVar;
use proto_core::wire::scalar::ScalarType;
use recipe_config::file;

fn parse(parts: &str) -> Result<Box<GatewayConfig>, String> {
    let text = format!(
        "[controller]\naddress = \"a\"\n[[recipe]]\nname = \"r\"\nkind = \"stream\"\nmode = \"user\"\n{parts}\n\
         [[port]]\nname = \"p\"\nbus = \"rs485\"\nrecipe = \"r\"\n"
    );
    file::parse_gateway(file::Text { name: "test.toml", toml: &text }, &[]).map_err(|error| error.to_string())
}

fn input(keys: &str, fields: &str) -> Result<Box<GatewayConfig>, String> {
    parse(&format!("[recipe.input]\n{keys}\nfields = [{fields}]"))
}

fn part(config: &GatewayConfig) -> &StreamPart {
    match &config.recipes[0].parts {
        Parts::Stream { input: Some(part), .. } | Parts::Stream { output: Some(part), .. } => part,
        parts => panic!("{parts:?}"),
    }
}

fn var(name: &str) -> SysVar {
    SysVar::parse(name).unwrap()
}

const CODE: &str = "{ name = \"code\", type = \"text\", to = \"WordInputReg[1..8]\" }";

#[test]
fn a_scanner_in_four_lines() {
    let code = "{ name = \"code\", type = \"text\", to = \"WordInputReg[1..8]\", \
                length_to = \"WordInputReg[9]\", count_to = \"WordInputReg[10]\" }";
    let config = input("framing = \"tail\"\ntail = [13, 10]", code).unwrap();
    assert_eq!((part(&config).framing, part(&config).escape), (Boundary::Tail, None));
    let expected = FieldSpec::TextInput {
        text: Text { width: TextWidth::Rest, fill: None },
        to: Some(Words { first: var("WordInputReg[1]"), count: 8, order: ByteOrder::Big }),
        length_to: Some(var("WordInputReg[9]")),
        count_to: Some(var("WordInputReg[10]")),
        ignored: Ignored::NONE,
    };
    assert_eq!(config.fields, [expected]);
}

#[test]
fn texts_have_widths_ends_and_orders() {
    let fields = "{ type = \"text\", width = 8, fill = \" \" }, \
                  { type = \"text\", until = \";\", order = \"low-first\", to = \"WordInputReg[3]\" }";
    let config = input("head = [2]", fields).unwrap();
    let text = |width, fill, to| FieldSpec::TextInput {
        text: Text { width, fill },
        to,
        length_to: None,
        count_to: None,
        ignored: Ignored::NONE,
    };
    let words = Words { first: var("WordInputReg[3]"), count: 1, order: ByteOrder::Little };
    assert_eq!(
        config.fields,
        [text(TextWidth::Fixed(8), Some(b' '), None), text(TextWidth::Until(b';'), None, Some(words))]
    );
    let config = parse(
        "[recipe.output]\ntail = [10]\nfields = [{ type = \"text\", from = \"WordOutputReg[1..3]\", \
         length_from = \"WordOutputReg[4]\" }]",
    )
    .unwrap();
    let expected = FieldSpec::TextOutput {
        text: Text { width: TextWidth::Rest, fill: None },
        from: Words { first: var("WordOutputReg[1]"), count: 3, order: ByteOrder::Big },
        length_from: Some(var("WordOutputReg[4]")),
    };
    assert_eq!(config.fields, [expected]);
}

#[test]
fn a_length_is_a_field() {
    let config = input(
        "head = [2]\nendian = \"big\"",
        "{ length = true, type = \"word\", counts = \"frame\", plus = -2 }, { type = \"text\" }",
    )
    .unwrap();
    let encoding = Encoding { order: ByteOrder::Big, ..Encoding::scalar(ScalarType::Word) };
    let expected = FieldSpec::Length(Length { encoding, counts: Counts::Frame, plus: -2 });
    assert_eq!(config.fields[0], expected);
}

#[test]
fn escapes_and_silence_belong_to_a_part() {
    for (name, escape) in [("dle", Escape::Dle), ("slip", Escape::Slip), ("cobs", Escape::Cobs)] {
        let config = input(&format!("escape = {name:?}"), "{ name = \"x\", type = \"word\" }").unwrap();
        assert_eq!((part(&config).framing, part(&config).escape), (Boundary::Fields, Some(escape)));
    }
    let config = input("framing = \"silence\"", CODE).unwrap();
    assert_eq!(part(&config).framing, Boundary::Silence);
}

#[test]
fn mistakes_are_told_where_they_are() {
    let tail = "framing = \"tail\"\ntail = [13, 10]";
    for (keys, field, message) in [
        ("tail = [13, 10]", CODE, "a text at the beginning of a frame could be the end of a longer one"),
        ("framing = \"tail\"", CODE, "framing = \"tail\" needs a tail, such as tail = [13, 10]"),
        ("framing = \"silence\"\nescape = \"slip\"", CODE, "escape bytes tell frames apart already"),
        ("framing = \"line\"", CODE, "\"tail\""),
        ("head = [2]", "{ type = \"text\" }", "nothing tells where the text ends"),
        (tail, "{ type = \"text\", width = 4, until = \";\" }", "a text takes width or until, not both"),
        (tail, "{ type = \"text\", fill = \" \" }", "allowed only together with width"),
        (tail, "{ type = \"text\", width = 129 }", "128"),
        (tail, "{ type = \"text\", to = \"FloatInputReg[1]\" }", "1 word variables are needed"),
        (tail, "{ name = \"x\", type = \"byte\", count_to = \"WordInputReg[1]\" }", "type = \"text\""),
        (tail, "{ name = \"x\", type = \"byte\", plus = 1 }", "allowed only together with length = true"),
        (tail, "{ length = true, type = \"float\" }", "a length is an integer in a fixed number of bytes"),
    ] {
        let error = input(keys, field).unwrap_err();
        assert!(error.contains(message), "{keys}, {field}: {error}");
    }
}

#[test]
fn ignored_texts_are_those_that_the_field_can_have() {
    let field =
        |keys: &str| input("tail = [13]\nframing = \"tail\"", &format!("{{ type = \"text\", {keys} }}"));
    let config = field("ignore = [\"NOREAD\", \"?\"]").unwrap();
    let [FieldSpec::TextInput { ignored, .. }] = config.fields[..] else { panic!("{:?}", config.fields) };
    assert_eq!(ignored, Ignored::new(&[b"NOREAD", b"?"]).unwrap());
    let config = field("ignore = [\"NOREAD\", \"\"]").unwrap();
    let [FieldSpec::TextInput { ignored, .. }] = config.fields[..] else { panic!("{:?}", config.fields) };
    assert!(ignored.has(b"NOREAD") && ignored.has(b""), "a line without a text");
    for (keys, said) in [
        ("ignore = \"NOREAD\"", "expected an array of texts, such as [\"NOREAD\"], found a string"),
        ("ignore = [\"é\"]", "is not ASCII"),
        ("width = 5, ignore = [\"NOREAD\"]", "6 characters, but the field has 5"),
        ("ignore = [\"NO READ AT ALL\"]", "too long; allowed: 13 characters in one text"),
    ] {
        let error = field(keys).unwrap_err().to_string();
        assert!(error.contains("ignore") && error.contains(said), "{keys}: {error}");
    }
}
