//! What becomes of the values of input fields in files: `as`, limits, maps, `no_value`, `valid_to`, `point`.

use proto_core::config::{FieldSpec, InputRule, Limits, MapEntry, NoText, Outside};
use proto_core::engine::{Engine, Input, PortId};
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use recipe_config::file::{Text, parse_gateway};

fn specs(input: &str) -> Result<Vec<FieldSpec>, String> {
    let toml = format!(
        "[controller]\naddress = \"192.168.1.10\"\n\n[[recipe]]\nname = \"drive\"\nkind = \"can\"\nmode = \"user\"\n\n\
         [[recipe.input.frame]]\nid = 0x52\nfields = [{input}]\n"
    );
    let config = parse_gateway(Text { name: "cell.toml", toml: &toml }, &[]);
    config.map(|config| config.fields.to_vec()).map_err(|error| error.to_string())
}

fn behind(ty: &str, keys: &str) -> Vec<FieldSpec> {
    let all = specs(&format!("{{ name = \"a\", type = {ty}, to = \"WordInputReg[1]\", {keys} }}")).unwrap();
    assert!(matches!(all[0], FieldSpec::UserInput { .. } | FieldSpec::DeviceInput { .. }), "{all:?}");
    all[1..].to_vec()
}

#[test]
fn each_key_has_its_place_behind_the_field() {
    let rule = FieldSpec::InputRule;
    let limits = |low, high, outside| FieldSpec::Limits(Limits { low, high, outside });
    let entry = |first, last, sent| FieldSpec::Mapped(MapEntry { first, last, sent });
    let var = |name| SysVar::parse(name).unwrap();
    let short = "\"short\"";
    assert_eq!(behind(short, "as = \"int16\""), [rule(InputRule::Int16)]);
    assert_eq!(behind(short, "min = 5"), [limits(5.0, 32_767.0, Outside::Refuse)]);
    assert_eq!(
        behind(short, "max = 5, outside = \"clamp\", scale = 2"),
        [limits(-32_768.0, 5.0, Outside::Clamp)]
    );
    assert_eq!(
        behind(short, "map = { 0 = 1, \"-3..-1\" = 2, else = 9 }"),
        [entry(0, 0, 1.0), entry(-3, -1, 2.0), rule(InputRule::Else(9.0))]
    );
    assert_eq!(
        behind(
            "\"decimal\", width = 6",
            "no_value = [-1, \"----\", 99.5], point = \",\", valid_to = \"BitInputReg[3].4\""
        ),
        [
            rule(InputRule::Comma),
            rule(InputRule::NoNumber(-1.0)),
            rule(InputRule::NoText(NoText::new("----").unwrap())),
            rule(InputRule::NoNumber(99.5)),
            rule(InputRule::ValidTo { var: var("BitInputReg[3]"), bit: Some(4) }),
        ]
    );
    assert_eq!(
        behind(short, "valid_to = \"WordInputReg[2]\""),
        [rule(InputRule::ValidTo { var: var("WordInputReg[2]"), bit: None })]
    );
    assert_eq!(behind("\"decimal\", width = 6", "point = \".\""), []);
    // A field that is used twice has them at its variable.
    let twice = specs(
        "{ name = \"a\", type = \"short\", to = \"WordInputReg[1]\", as = \"int16\", commands = { 1 = \"stop\" } }",
    );
    assert!(matches!(
        twice.unwrap()[..],
        [FieldSpec::UserInput { .. }, FieldSpec::InputRule(InputRule::Int16), FieldSpec::DeviceInput { .. }]
    ));
}

#[test]
fn what_may_be_taken_is_refused_at_its_place() {
    let field = |keys: &str| specs(&format!("{{ name = \"a\", {keys} }}")).unwrap_err();
    let short = |keys: &str| field(&format!("type = \"short\", to = \"WordInputReg[1]\", {keys}"));
    let digits =
        |keys: &str| field(&format!("type = \"decimal\", width = 6, to = \"WordInputReg[1]\", {keys}"));
    insta::assert_snapshot!(
        [
            short("as = \"int32\""),
            field("type = \"short\", to = \"FloatInputReg[1]\", as = \"int16\""),
            field("type = \"short\", as = \"int16\""),
            field("type = \"byte\", to = \"BitInputReg[1].0\", min = 1"),
            short("as = \"int16\", overflow = \"wrap\""),
            short("max = 40000"),
            short("min = 0.5"),
            short("min = 9, max = 8"),
            short("outside = \"clamp\""),
            short("map = {}"),
            short("map = { else = 1 }"),
            short("map = { a = 1 }"),
            short("map = { 1 = 70000 }"),
            short("map = { 1 = 40000 }, as = \"int16\""),
            short("map = { \"5..1\" = 3 }"),
            short("map = { \"1..5\" = 3, 4 = 2 }"),
            short("map = { 1 = 2 }, max = 3"),
            short("map = { 1 = 2 }, scale = 2"),
            short("no_value = 5"),
            short("no_value = [40000]"),
            short("no_value = [\"--\"]"),
            digits("no_value = [\"too long a text\"]"),
            digits("no_value = [true]"),
            short("valid_to = \"FloatInputReg[1]\""),
            short("valid_to = \"BitOutputReg[1].2\""),
            short("valid_to = \"WordInputReg[1]\""),
            short("point = \",\""),
            digits("point = \";\""),
            field("type = \"decimal\", until = \",\", to = \"WordInputReg[1]\", point = \",\""),
        ]
        .join("\n")
    );
}

struct Run {
    engine: Box<Engine>,
    now: Instant,
    /// Number of requests so far.
    asked: u32,
}

const MS: fn(u64) -> Duration = Duration::from_millis;

impl Run {
    fn new(toml: &str) -> Self {
        let config = parse_gateway(Text { name: "cell.toml", toml }, &[]).unwrap();
        let engine = Box::new(Engine::new(&*config).unwrap());
        let mut run = Self { engine, now: Instant::from_millis(1_000), asked: 0 };
        run.engine.handle(run.now, Input::PortUp { port: PortId(0) });
        run.wait(1);
        run
    }

    /// Lets time pass, with a tick each millisecond.
    fn wait(&mut self, millis: u64) {
        let mut buf = [0; proto_core::engine::OUTPUT_BUFFER];
        for _ in 0..millis {
            self.now += MS(1);
            self.engine.handle(self.now, Input::Tick);
            loop {
                match self.engine.poll_output(self.now, &mut buf) {
                    proto_core::engine::Output::Sleep { .. } => break,
                    proto_core::engine::Output::PortSend { port, .. } => {
                        self.asked += 1;
                        self.engine.handle(self.now, Input::PortSent { port });
                    }
                    _ => {}
                }
            }
        }
    }

    /// Answers the next two requests; the first reply after the start may belong to an older request.
    fn answer_twice(&mut self, reply: &[u8]) {
        for _ in 0..2 {
            let before = self.asked;
            while self.asked == before {
                self.wait(1);
            }
            self.wait(5);
            self.bytes(reply);
        }
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.engine.handle(self.now, Input::PortBytes { port: PortId(0), bytes });
    }

    fn word(&self, nth: u8) -> f64 {
        self.engine.image().value(SysVar::parse(&format!("WordInputReg[{nth}]")).unwrap()).as_f64()
    }
}

const AMPLIFIERS: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "il"
kind = "stream"
mode = "user"
[[recipe.exchange]]
every_ms = 50
[recipe.exchange.request]
tail = [13, 10]
fields = [{ text = "MS" }]
[recipe.exchange.reply]
tail = [13, 10]
fields = [
    { text = "MS," },
    { name = "judge0", type = "hex", until = ",", to = "WordInputReg[10]" },
    { name = "dist0", type = "decimal", until = ",", to = "WordInputReg[11]", scale = 1000, offset = 30000 },
    { name = "judge1", type = "hex", until = ",", to = "WordInputReg[12]" },
    { name = "dist1", type = "decimal", width = 7, to = "WordInputReg[13]", scale = 100, offset = 32768 },
]

[[port]]
name = "il"
bus = "rs485"
recipe = "il"
baud = 38400
timeout_ms = 300
on_timeout = { "WordInputReg[11]" = 65535 }
"#;

#[test]
fn one_amplifier_out_of_range_leaves_the_others_value_good() {
    let mut run = Run::new(AMPLIFIERS);
    // Until then replies to what was asked before may come.
    run.wait(1_010);
    run.bytes(b"MS,00,+12.345,04,-00.100\r\n");
    assert_eq!([10, 11, 12, 13].map(|nth| run.word(nth)), [0.0, 42_345.0, 4.0, 32_758.0]);
    for nth in 1_u8..=7 {
        run.wait(50);
        run.bytes(format!("MS,01,+99.999,05,+00.{nth}00\r\n").as_bytes());
        assert_eq!([10, 12, 13].map(|nth| run.word(nth)), [1.0, 5.0, 32_768.0 + 10.0 * f64::from(nth)]);
    }
    assert_eq!(run.word(11), 65_535.0, "its safe value, although replies come");
    let status = run.engine.status(run.now);
    let port = status.ports().next().unwrap();
    assert_eq!((port.counters.rejected_fields, port.counters.timeouts, port.overdue), (7, 0, 0));
    let field = port.rejected_field.unwrap();
    assert_eq!((field.var, field.value), (SysVar::parse("WordInputReg[11]").ok(), Some(99.999)));
    assert_eq!(field.allowed, Some((-30.0, 35.535)));
    run.bytes(b"MS,00,+01.000,04,-00.100\r\n");
    run.wait(50);
    run.bytes(b"MS,00,+01.000,04,-00.100\r\n");
    assert_eq!(run.word(11), 31_000.0);
}

#[test]
fn a_negative_register_is_named_or_taken_as_twos_complement() {
    let toml = |keys: &str| {
        format!(
            "[controller]\naddress = \"127.0.0.1\"\n[[recipe]]\nname = \"line\"\nkind = \"modbus-rtu\"\n\
             [[recipe.exchange]]\nslave = 1\nfunction = \"read-holding-registers\"\naddress = 0\nevery_ms = 100\n\
             read = [{{ name = \"v\", type = \"short\", to = \"WordInputReg[1]\"{keys} }}]\n\
             [[port]]\nname = \"line\"\nbus = \"modbus-rtu\"\nrecipe = \"line\"\ntimeout_ms = 12000\n"
        )
    };
    let reply = || {
        let crc = proto_core::device::Algorithm::named("crc16-modbus").unwrap();
        let bytes = [1, 3, 2, 0xFF, 0xCE];
        [&bytes[..], &(crc.of([&bytes[..]]) as u16).to_le_bytes()].concat()
    };
    let mut run = Run::new(&toml(""));
    run.answer_twice(&reply());
    let status = run.engine.status(run.now);
    let port = status.ports().next().unwrap();
    let field = port.rejected_field.unwrap();
    assert_eq!((field.var, field.value), (SysVar::parse("WordInputReg[1]").ok(), Some(-50.0)));
    assert_eq!(field.allowed, Some((0.0, 32_767.0)));
    let mut run = Run::new(&toml(", as = \"int16\""));
    run.answer_twice(&reply());
    assert_eq!(run.word(1), 65_486.0);
}
