//! Limits and maps of output fields in files.

use proto_core::config::{FieldSpec, Limits, MapEntry, Outside};
use recipe_config::file::{Text, parse_gateway};

fn specs(output: &str) -> Result<Vec<FieldSpec>, String> {
    let toml = format!(
        "[controller]\naddress = \"192.168.1.10\"\n\n[[recipe]]\nname = \"drive\"\nkind = \"can\"\nmode = \"user\"\n\n\
         [[recipe.output.frame]]\nid = 0x52\nchecksum = {{ kind = \"xor8\", at = 1 }}\nfields = [{output}, {{ pad = 1 }}]\n"
    );
    let config = parse_gateway(Text { name: "cell.toml", toml: &toml }, &[]);
    config.map(|config| config.fields.to_vec()).map_err(|error| error.to_string())
}

fn behind(keys: &str) -> Vec<FieldSpec> {
    let all =
        specs(&format!("{{ name = \"a\", type = \"byte\", from = \"WordOutputReg[1]\", {keys} }}")).unwrap();
    assert!(matches!(all[0], FieldSpec::UserOutput { .. }));
    let rest = &all[1..];
    // The checksum stands behind what belongs to the field, and before the padding.
    assert!(
        matches!(rest[rest.len() - 2..], [FieldSpec::Checksum(_), FieldSpec::Padding { .. }]),
        "{rest:?}"
    );
    rest[..rest.len() - 2].to_vec()
}

#[test]
fn limits_that_are_not_written_are_those_of_the_field() {
    let limits = |low, high, outside| vec![FieldSpec::Limits(Limits { low, high, outside })];
    assert_eq!(behind("min = 5, max = 110"), limits(5.0, 110.0, Outside::Refuse));
    assert_eq!(behind("min = 5"), limits(5.0, 255.0, Outside::Refuse));
    assert_eq!(behind("max = 5, outside = \"clamp\""), limits(0.0, 5.0, Outside::Clamp));
    assert_eq!(behind("max = 5, outside = \"refuse\", scale = 0.5"), limits(0.0, 5.0, Outside::Refuse));
}

#[test]
fn a_map_has_an_entry_for_each_key() {
    let entry = |first, last, sent| FieldSpec::Mapped(MapEntry { first, last, sent });
    assert_eq!(
        behind("map = { 0 = 1, \"-3..-1\" = 2, 0x10 = 0 }"),
        [entry(0, 0, 1.0), entry(-3, -1, 2.0), entry(16, 16, 0.0)]
    );
}

#[test]
fn what_may_be_sent_is_refused_at_its_place() {
    let field = |keys: &str| specs(&format!("{{ name = \"a\", type = \"byte\", {keys} }}")).unwrap_err();
    let from = |keys: &str| field(&format!("from = \"WordOutputReg[1]\", {keys}"));
    insta::assert_snapshot!(
        [
            from("max = 256"),
            from("min = 0.5"),
            from("min = \"0\""),
            from("min = 9, max = 8"),
            from("outside = \"clamp\""),
            from("max = 8, outside = \"wrap\""),
            from("max = 8, overflow = \"wrap\""),
            from("map = {}"),
            from("map = { a = 1 }"),
            from("map = { 1 = 300 }"),
            from("map = { \"5..1\" = 3 }"),
            from("map = { \"1..5\" = 3, 4 = 2 }"),
            from("map = { 1 = 2 }, max = 3"),
            from("map = { 1 = 2 }, scale = 2"),
            field("value = 5, max = 8"),
            field("from = \"counter\", max = 8"),
            field("from = \"port.frames\", map = { 1 = 2 }"),
        ]
        .join("\n")
    );
}
