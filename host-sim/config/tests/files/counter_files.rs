//! Alive counters and data ids in files.

use proto_core::config::{FieldSpec, InputBinding, OutputBinding};
use recipe_config::file::{Text, parse_gateway};

fn file(input: &str, output: &str) -> String {
    format!(
        "[controller]\naddress = \"192.168.1.10\"\n\n[[recipe]]\nname = \"drive\"\nkind = \"can\"\nmode = \"user\"\n\n\
         [[recipe.input.frame]]\nid = 0x51\nfields = [{input}, {{ pad = 1 }}]\n\n\
         [[recipe.output.frame]]\nid = 0x52\nfields = [{output}]\n"
    )
}

fn specs(input: &str, output: &str) -> Result<Vec<FieldSpec>, String> {
    let toml = file(input, output);
    let config = parse_gateway(Text { name: "cell.toml", toml: &toml }, &[]);
    config.map(|config| config.fields.to_vec()).map_err(|error| error.to_string())
}

const OUTPUT: &str = r#"{ name = "count", type = "byte", from = "counter" }"#;

fn counters(input: &str) -> Vec<InputBinding> {
    let to = |field: FieldSpec| match field {
        FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => Some(to),
        _ => None,
    };
    specs(input, OUTPUT).unwrap().into_iter().filter_map(to).collect()
}

#[test]
fn a_counter_has_the_range_of_its_field_or_less() {
    let counter = |max| InputBinding::Counter { max };
    assert_eq!(counters(r#"{ name = "alive", type = "byte", counter = true }"#), [counter(255)]);
    assert_eq!(counters(r#"{ name = "alive", type = "byte", counter = { max = 14 } }"#), [counter(14)]);
    assert_eq!(
        counters(r#"{ name = "alive", type = "byte", bits = "0..3", counter = true }"#),
        [counter(15)]
    );
    assert_eq!(counters(r#"{ name = "alive", type = "byte", counter = false }"#), [InputBinding::Unused]);
    let both = counters(r#"{ name = "alive", type = "byte", counter = true, to = "WordInputReg[1]" }"#);
    assert!(
        matches!(both[..], [InputBinding::Variable { .. }, InputBinding::Counter { max: 255 }]),
        "{both:?}"
    );
}

#[test]
fn a_sent_counter_may_end_sooner() {
    let output = r#"{ name = "count", type = "byte", from = "counter", counter = { max = 14 } }"#;
    let specs = specs(r#"{ name = "a", type = "byte" }"#, output).unwrap();
    assert_eq!(specs.last().unwrap().source(), Some(OutputBinding::CounterTo { max: 14 }));
}

#[test]
fn what_is_no_counter_is_refused_at_its_place() {
    let input = |field: &str| specs(field, OUTPUT).unwrap_err();
    let output = |field: &str| specs(r#"{ name = "a", type = "byte" }"#, field).unwrap_err();
    insta::assert_snapshot!(
        [
            input(r#"{ name = "alive", type = "char", counter = true }"#),
            input(r#"{ name = "alive", type = "float", counter = true }"#),
            input(r#"{ name = "alive", type = "byte", counter = { max = 256 } }"#),
            input(r#"{ name = "alive", type = "byte", counter = { max = 0 } }"#),
            input(r#"{ name = "alive", type = "byte", counter = {} }"#),
            input(r#"{ name = "alive", type = "byte", counter = 14 }"#),
            input(r#"{ type = "byte", equals = 3, counter = true }"#),
            output(r#"{ name = "count", type = "byte", value = 3, counter = { max = 14 } }"#),
            output(r#"{ name = "count", type = "float", from = "counter", counter = { max = 14 } }"#),
        ]
        .join("\n")
    );
}

/// The data id of a frame's checksum: its bytes, and whether they are behind the frame's.
fn data_id(keys: &str) -> Result<(Vec<u8>, bool), String> {
    let toml = file(r#"{ name = "a", type = "byte" }"#, OUTPUT).replace(
        "{ pad = 1 }]",
        &format!("{{ pad = 1 }}]\nchecksum = {{ kind = \"crc8-gsm-a\", at = 0, over = \"1..2\", {keys} }}"),
    );
    let config =
        parse_gateway(Text { name: "cell.toml", toml: &toml }, &[]).map_err(|error| error.to_string())?;
    let sum = config.fields.iter().find_map(|field| match field {
        FieldSpec::Checksum(sum) => Some(sum.data_id),
        _ => None,
    });
    let id = sum.unwrap();
    Ok((id.bytes().to_vec(), id.is_behind()))
}

#[test]
fn a_checksum_may_have_a_data_id() {
    assert_eq!(data_id(r#"data_id = 0x1234"#), Ok((vec![0x34, 0x12], false)));
    assert_eq!(data_id(r#"data_id = [0x23, 0], data_id_at = "start""#), Ok((vec![0x23, 0], false)));
    assert_eq!(data_id(r#"data_id = [7], data_id_at = "end""#), Ok((vec![7], true)));
    insta::assert_snapshot!(
        [
            data_id(r#"data_id = 0x12345"#).unwrap_err(),
            data_id(r#"data_id = []"#).unwrap_err(),
            data_id(r#"data_id = [1, 2, 3, 4, 5]"#).unwrap_err(),
            data_id(r#"data_id = "12""#).unwrap_err(),
            data_id(r#"data_id = 1, data_id_at = "middle""#).unwrap_err(),
            data_id(r#"data_id_at = "end""#).unwrap_err(),
        ]
        .join("\n")
    );
}
