//! Bits of variables by name: in bindings, safe values and initial values.

use proto_core::config::{FieldSpec, OutputBinding, SafeValue};
use proto_core::sysvar::{SysVar, VarBit};
use proto_core::wire::scalar::{Scalar, ScalarType};
use recipe_config::file::{Text, parse_controller, parse_gateway};
use recipe_config::{Function, InitialTarget, ShownState};

/// Two panels on one byte.
const PANELS: &str = r#"
[controller]
address = "192.168.12.138"

[[recipe]]
name = "start"
kind = "stream"
mode = "user"
[recipe.input]
head = [255]
fields = [{ name = "button", type = "byte", to = "BitInputReg[3].4" }]

[[recipe]]
name = "lamp"
kind = "stream"
mode = "user"
[recipe.input]
head = [255]
fields = [{ name = "lamp", type = "byte", to = "__BitInputReg_3.5" }]

[[port]]
name = "one"
bus = "rs485"
recipe = "start"
on_timeout = { "BitInputReg[3].4" = 0 }

[[port]]
name = "two"
bus = "rs485"
recipe = "lamp"
on_timeout = { "BitInputReg[3].5" = true }
"#;

fn refused(from: &str, to: &str) -> String {
    assert!(PANELS.contains(from), "{from}");
    let toml = PANELS.replacen(from, to, 1);
    parse_gateway(Text { name: "panels.toml", toml: &toml }, &[]).unwrap_err().to_string()
}

#[test]
fn two_ports_own_bits_of_one_byte() {
    let config = parse_gateway(Text { name: "panels.toml", toml: PANELS }, &[]).unwrap();
    let var = SysVar::parse("BitInputReg[3]").unwrap();
    let bound: Vec<_> = config.fields.iter().filter_map(|field| field.bit()).collect();
    assert_eq!(bound, [VarBit { var, bit: 4 }, VarBit { var, bit: 5 }]);
    let safe = [SafeValue::bit(bound[0], false), SafeValue::bit(bound[1], true)];
    assert_eq!(config.safe_values[..], safe);
}

#[test]
fn mistakes_with_bits_are_named() {
    for (from, to, said) in [
        ("BitInputReg[3].4\" }", "BitInputReg[3].8\" }", "BitInputReg[3] has no bit 8; allowed: 0..=7"),
        ("BitInputReg[3].4\" }", "WordInputReg[3].4\" }", "WordInputReg[3] is a word without bits"),
        ("BitInputReg[3].4\" }", "DigitalOutputCommand[3].2\" }", "has no bit 2; allowed: 0..=1"),
        ("BitInputReg[3].4\" }", "BitOutputReg[3].4\" }", "cannot be written"),
        ("BitInputReg[3].4\" }", "BitInputReg[3].4\", scale = 2 }", "not allowed for a bit"),
        ("type = \"byte\", to = \"BitInputReg[3].4", "type = \"float\", to = \"BitInputReg[3].4", "float"),
        ("__BitInputReg_3.5", "BitInputReg[3].4", "BitInputReg[3].4 is written by this port and by"),
        ("__BitInputReg_3.5", "BitInputReg[3]", "one as a whole and one BitInputReg[3].4"),
        ("\"BitInputReg[3].4\" = 0", "\"BitInputReg[3].4\" = 2", "2 is out of range; allowed: 0..=1"),
        ("\"BitInputReg[3].4\" = 0", "\"BitInputReg[3].5\" = 0", "does not write BitInputReg[3].5"),
        ("\"BitInputReg[3].4\" = 0", "\"BitInputReg[3].9\" = 0", "has no bit 9"),
        ("\"BitInputReg[3].4\" = 0", "\"BitInputReg[3]\" = 0", "this port does not write BitInputReg[3]"),
    ] {
        let message = refused(from, to);
        assert!(message.contains(said), "{to}: {message}");
    }
}

#[test]
fn a_bit_has_an_initial_value() {
    let toml = "[initial]\n\"BitInputReg[3].4\" = 1\n\"DigitalOutputCommand[1].0\" = true\n";
    let config = parse_controller(Text { name: "robot.toml", toml }, &[]).unwrap();
    let names: Vec<_> = config.initial.iter().map(|initial| initial.target.to_string()).collect();
    assert_eq!(names, ["BitInputReg[3].4", "DigitalOutputCommand[1].0"]);
    assert!(matches!(config.initial[0].target, InitialTarget::VarBit(VarBit { bit: 4, .. })));
    for (wrong, said) in [
        ("\"BitInputReg[3].8\" = 1", "BitInputReg[3] has no bit 8; allowed: 0..=7"),
        ("\"BitInputReg[3].4\" = 2", "2 is out of range; allowed: 0..=1, false or true"),
        ("\"WordInputReg[3].4\" = 1", "WordInputReg[3] is a word without bits"),
    ] {
        let toml = format!("[initial]\n{wrong}\n");
        let error = parse_controller(Text { name: "robot.toml", toml: &toml }, &[]).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn an_override_names_a_bit_as_a_file_does() {
    let set = |key: &str| vec![format!("initial.{key}=1")];
    for key in ["BitInputReg[3].4", "\"BitInputReg[3].4\"", "\"__BitInputReg_3.4\""] {
        let config = parse_controller(Text { name: "robot.toml", toml: "" }, &set(key)).unwrap();
        assert_eq!(config.initial[0].target.to_string(), "BitInputReg[3].4");
    }
    let set = ["port.one.on_timeout.BitInputReg[3].4=1".to_owned()];
    let config = parse_gateway(Text { name: "panels.toml", toml: PANELS }, &set).unwrap();
    assert_eq!(config.safe_values[0].value, Scalar::Byte(0x10));
}

#[test]
fn an_output_field_shows_a_bit() {
    let output = "[recipe.output]\nhead = [253]\nfields = [FIELD]\n\n[[port]]\nname = \"one\"";
    let with = |field: &str| {
        let toml = PANELS.replace("[[port]]\nname = \"one\"", &output.replace("FIELD", field));
        parse_gateway(Text { name: "panels.toml", toml: &toml }, &[])
    };
    let field = "{ name = \"lit\", type = \"byte\", from = \"DigitalOutputCommand[1].0\" }";
    let config = with(field).unwrap();
    let var = SysVar::parse("DigitalOutputCommand[1]").unwrap();
    let shown = FieldSpec::UserOutput { ty: ScalarType::Byte, from: OutputBinding::Bit { var, bit: 0 } };
    assert!(config.fields.contains(&shown));
    for (to, said) in [
        ("DigitalOutputCommand[1].8\"", "DigitalOutputCommand[1] has no bit 8; allowed: 0..=7"),
        ("WordOutputReg[1].0\"", "WordOutputReg[1] is a word without bits"),
        ("DigitalOutputCommand[1].0\", scale = 2", "not allowed for a bit: it is 0 or 1"),
    ] {
        let error = with(&field.replace("DigitalOutputCommand[1].0\"", to)).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn functions_of_inputs_and_states_of_outputs_are_read() {
    let toml = r#"
        [functions]
        start = "a.jspf"
        inputs = { "FDI[1]" = "start", "__BitInputReg_2.7" = "stop", "ToolButton[2]" = "reset" }
        outputs = { "FDO[8]" = "running", "BitOutputReg[1].0" = "error" }
        [robot]
        [[program]]
        name = "a.jspf"
        script = ""
    "#;
    let text = Text { name: "robot.toml", toml };
    let overrides = ["functions.inputs.FDI[2]=enable", "functions.outputs.BitOutputReg[2].1=remote"];
    let config = parse_controller(text, &overrides.map(str::to_owned)).unwrap();
    let inputs: Vec<_> =
        config.functions.inputs.iter().map(|input| (input.item.to_string(), input.function)).collect();
    let item = |name: &str| name.to_owned();
    assert_eq!(
        inputs,
        [
            (item("FDI[1]"), Function::Start),
            (item("BitInputReg[2].7"), Function::Stop),
            (item("ToolButton[2]"), Function::Reset),
            (item("FDI[2]"), Function::Enable),
        ]
    );
    let state = |name: &str| config.functions.state_of(name.parse().unwrap());
    assert_eq!(state("DigitalSignalStatus[8].7"), Some(ShownState::Running));
    assert_eq!(state("BitOutputReg[1].0"), Some(ShownState::Error));
    assert_eq!(state("BitOutputReg[2].1"), Some(ShownState::Remote));
    assert_eq!((state("FDO[1]"), state("BitOutputReg[1]")), (None, None));
    assert_eq!(config.functions.start.as_deref(), Some("a.jspf"));
    let none = parse_controller(Text { name: "robot.toml", toml: "[robot]" }, &[]).unwrap();
    assert_eq!(none.functions, recipe_config::Functions::default(), "empty unless configured");
}
