//! `check --json`, shared buses, and `export schema`.

use std::process::Output;

use recipe_test_kit::{example, examples};
use serde_json::Value;

use super::BINARY;

fn host_sim(args: &[&str]) -> Output {
    BINARY.command().args(args).output().unwrap()
}

fn path(name: &str) -> String {
    example(name).to_str().unwrap().to_owned()
}

/// The exit code, and the JSON on stdout.
#[track_caller]
fn json(args: &[&str]) -> (Option<i32>, Value) {
    let output = host_sim(args);
    assert!(output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
    (output.status.code(), serde_json::from_slice(&output.stdout).unwrap())
}

/// Without what is before the file's name in its path.
fn named(mut report: Value) -> String {
    if let Some(file) = report.get("file").and_then(Value::as_str) {
        report["file"] = file.rsplit('/').next().unwrap().into();
    }
    for list in ["warnings", "errors"] {
        for message in report.get_mut(list).and_then(Value::as_array_mut).into_iter().flatten() {
            if let Some(file) = message.get("file").and_then(Value::as_str) {
                message["file"] = file.rsplit('/').next().unwrap().into();
            }
        }
    }
    format!("{report:#}")
}

#[test]
fn the_json_has_all_that_the_text_has() {
    for (snapshot, file) in [
        ("json_force_sensor", "force-sensor.toml"),
        ("json_request_response", "request-response.toml"),
        ("json_can_panel", "can-panel.toml"),
        ("json_gripper", "gripper.toml"),
        ("json_can_system_controller", "can-system-controller.toml"),
    ] {
        let (code, report) = json(&["check", &path(file), "--json"]);
        assert_eq!(code, Some(0), "{file}");
        insta::assert_snapshot!(snapshot, named(report));
    }
}

/// Words of a text, without signs.
fn words(text: &str) -> Vec<String> {
    let parts = text.split(|c: char| !c.is_alphanumeric() && !matches!(c, '_' | '[' | ']' | '.'));
    parts.filter(|word| !word.is_empty()).map(|word| word.trim_matches('.').to_owned()).collect()
}

/// Names of variables, frames, ports and commands in the text are in the JSON too.
#[test]
fn no_name_of_the_text_is_missing_in_the_json() {
    for file in examples() {
        let file = file.to_str().unwrap();
        let text = String::from_utf8(host_sim(&["check", file]).stdout).unwrap();
        let (_, report) = json(&["check", file, "--json"]);
        let known = words(&report.to_string());
        for word in
            words(&text).iter().filter(|word| word.contains(['[', '_', '-']) || word.starts_with("0x"))
        {
            assert!(known.contains(word), "{file}: {word:?} is in the text only");
        }
        let warnings = report["warnings"].as_array().unwrap();
        assert_eq!(text.contains("\nwarnings\n"), !warnings.is_empty(), "{file}");
        for warning in warnings {
            assert!(text.contains(warning["message"].as_str().unwrap()), "{file}: {warning}");
            assert!(warning["line"].as_u64().is_some_and(|line| line > 0), "{file}: {warning}");
        }
    }
}

#[test]
fn a_mistake_is_json_too() {
    let file = path("rs485-system.toml");
    let folder = tempfile::tempdir().unwrap();
    let wrong = folder.path().join("wrong.toml");
    let text = std::fs::read_to_string(&file).unwrap().replacen("cycle_ms", "cylce_ms", 1);
    assert!(text.contains("cylce_ms"));
    std::fs::write(&wrong, text).unwrap();
    let (code, refused) = json(&["check", wrong.to_str().unwrap(), "--json"]);
    assert_eq!(code, Some(2));
    insta::assert_snapshot!("json_wrong_key", named(refused));

    let (code, refused) = json(&["check", &file, "--json", "--set", "port.rs485-1.baud=1"]);
    assert_eq!(code, Some(2));
    insta::assert_snapshot!("json_wrong_override", named(refused));

    let (code, refused) = json(&["check", "no-such-file.toml", "--json"]);
    assert_eq!(code, Some(2));
    insta::assert_snapshot!("json_no_file", named(refused));
}

/// Two panels on one CAN bus.
fn two_panels() -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("panels.toml");
    let mut text = std::fs::read_to_string(example("can-panel.toml")).unwrap();
    text = text.replace("\"WordInputReg[4]\"", "\"WordInputReg[4]\", overflow = \"wrap\"");
    text += "\n[[recipe]]\nname = \"other\"\nkind = \"can\"\nmode = \"user\"\n[[recipe.input.frame]]\nid = 0x182\n\
             fields = [{ name = \"x\", type = \"dword\" }]\n[[recipe.output.frame]]\nid = 0x201\n\
             fields = [{ name = \"y\", type = \"word\", value = 1 }]\n\
             [[port]]\nname = \"can-2\"\nbus = \"can\"\nbitrate = 250000\nrecipe = \"other\"\n";
    std::fs::write(&file, text).unwrap();
    let file = file.to_str().unwrap().to_owned();
    (folder, file)
}

#[test]
fn ports_on_one_bus_are_added_up() {
    let (_folder, file) = two_panels();
    let (_, alone) = json(&["check", &file, "--json"]);
    let buses = alone["buses"].as_array().unwrap();
    assert_eq!(buses.len(), 2, "{alone:#}");
    // Both send 0x201, which matters if the ports are on one bus.
    let warnings = alone["warnings"].as_array().unwrap();
    assert_eq!(warnings.len(), 1, "{alone:#}");
    let said = warnings[0]["message"].as_str().unwrap();
    assert!(said.contains("both send id 0x201; if both are on one bus, two frames"), "{said}");
    assert_eq!(warnings[0]["key"], "port.can-2.bus");
    let load = |bus: &Value, key: &str| bus[key].as_f64().unwrap();
    let sum: f64 = buses.iter().map(|bus| load(bus, "worst_percent")).sum();

    let (code, together) = json(&["check", &file, "--json", "--same-bus", "can-1,can-2"]);
    assert_eq!(code, Some(0));
    let bus = &together["buses"][0];
    assert_eq!(together["buses"].as_array().unwrap().len(), 1);
    assert!((load(bus, "worst_percent") - sum).abs() < 0.2, "{bus} {sum}");
    assert!(load(bus, "average_percent") < load(bus, "worst_percent"));
    // Both send 0x201.
    let warnings = together["warnings"].as_array().unwrap();
    assert_eq!(warnings.len(), 1, "{together:#}");
    assert!(warnings[0]["message"].as_str().unwrap().contains("both send id 0x201"), "{warnings:?}");
    assert_eq!(warnings[0]["key"], "port.can-2.bus");

    let (_, full) =
        json(&["check", &file, "--json", "--same-bus", "can-1,can-2", "--set", "port.can-2.bitrate=20000"]);
    let said = full["warnings"].to_string();
    assert!(said.contains("20000 bit/s, but is on one bus with"), "{said}");
    let (_, full) = json(&["check", &file, "--json", "--set", "port.can-2.bitrate=20000"]);
    assert!(full["warnings"].to_string().contains("in the worst case of stuffed bits"), "{full:#}");

    for (names, said) in [
        ("can-1", "write two ports or more"),
        ("can-1,can-3", "there is no CAN port \"can-3\"; there are: can-1, can-2"),
        ("can-1,can-1", "is there twice"),
    ] {
        let output = host_sim(&["check", &file, "--same-bus", names]);
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(said), "{message}");
    }
}

#[test]
fn ids_that_collide_are_told() {
    let frame = |part: &str, id: u16| {
        let field = match part {
            "input" => "type = \"byte\"".to_owned(),
            _ => "type = \"byte\", value = 1".to_owned(),
        };
        format!("[[recipe.{part}.frame]]\nid = {id}\nfields = [{{ name = \"x\", {field} }}]\n")
    };
    let port = |name: &str, frames: &str| {
        format!(
            "[[recipe]]\nname = \"{name}\"\nkind = \"can\"\nmode = \"user\"\n{frames}\
             [[port]]\nname = \"{name}\"\nbus = \"can\"\nrecipe = \"{name}\"\n"
        )
    };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cell.toml");
    let file = path.to_str().unwrap();
    let told = |ports: &[String], more: &[&str]| {
        std::fs::write(&path, format!("[controller]\naddress = \"10.0.0.2\"\n{}", ports.concat())).unwrap();
        let (_, report) = json(&[&["check", file, "--json"], more].concat());
        let said =
            report["warnings"].as_array().unwrap().iter().map(|w| w["message"].as_str().unwrap().to_owned());
        said.filter(|said| said.contains("destroy")).collect::<Vec<_>>()
    };
    let end = "if both are on one bus, two frames with one id at the same time destroy each other";
    let a = port("a", &(frame("input", 0x101) + frame("output", 0x201).as_str()));
    assert_eq!(told(&[a.clone(), port("b", &frame("output", 0x202))], &[]), [""; 0]);
    assert_eq!(
        told(&[a.clone(), port("b", &frame("output", 0x201))], &[]),
        [format!("port \"a\" and port \"b\" both send id 0x201; {end}")]
    );
    assert_eq!(
        told(&[a.clone(), port("b", &frame("output", 0x101))], &[]),
        [format!("port \"b\" sends id 0x101, which port \"a\" receives from a device; {end}")]
    );
    // Both may listen to one device.
    assert_eq!(told(&[a.clone(), port("b", &frame("input", 0x101))], &[]), [""; 0]);
    let one_bus = ["--same-bus", "a,b"];
    assert_eq!(told(&[a.clone(), port("b", &frame("output", 0x201))], &one_bus).len(), 1);
    let own = told(&[port("a", &(frame("input", 0x101) + frame("output", 0x101).as_str()))], &[]);
    assert!(own.len() == 1 && own[0].starts_with("port \"a\" sends id 0x101 and receives it: "), "{own:?}");
}

#[test]
fn frames_that_vary_are_shown_with_the_longest() {
    let shown = |input: &str| {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("line.toml");
        let toml = format!(
            "controller = {{ address = \"127.0.0.1\" }}
            [[recipe]]
            name = \"r\"
            kind = \"stream\"
            mode = \"user\"
            [recipe.input]
            {input}
            [[port]]
            name = \"line\"
            bus = \"rs485\"
            baud = 9600
            recipe = \"r\""
        );
        std::fs::write(&path, toml).unwrap();
        let path = path.to_str().unwrap();
        let text = String::from_utf8(host_sim(&["check", path]).stdout).unwrap();
        let (_, json) = json(&["check", "--json", path]);
        let part = &json["ports"][0]["parts"][0];
        let sizes = ["least_bytes", "bytes", "time_us"].map(|key| part[key].as_u64());
        (text.lines().find(|line| line.starts_with("  input")).unwrap_or(&text).to_owned(), sizes)
    };
    let code = "{ name = \"code\", type = \"text\", to = \"WordInputReg[1..8]\" }";
    let word = "{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }";
    assert_eq!(
        shown(&format!("framing = \"tail\"\ntail = [13, 10]\nfields = [{code}]")),
        (
            "  input   2 to 130 bytes, the longest 135.417 ms on the line, at most 7 of these a second"
                .into(),
            [Some(2), Some(130), Some(135_417)]
        )
    );
    assert_eq!(
        shown(&format!("head = [2]\nfields = [{{ length = true, type = \"byte\" }}, {code}]")),
        (
            "  input   2 to 130 bytes, the longest 135.417 ms on the line, at most 7 of these a second"
                .into(),
            [Some(2), Some(130), Some(135_417)]
        )
    );
    // DLE STX, two bytes that may have to be doubled, DLE ETX.
    assert_eq!(
        shown(&format!("escape = \"dle\"\nfields = [{word}]")),
        (
            "  input   6 to 8 bytes, the longest 8.334 ms on the line, at most 119 of these a second".into(),
            [Some(6), Some(8), Some(8_334)]
        )
    );
    assert_eq!(
        shown(&format!("head = [2, 3]\nfields = [{word}]")),
        (
            "  input   4 bytes, 4.167 ms on the line, at most 239 a second".into(),
            [None, Some(4), Some(4_167)]
        )
    );
}

#[test]
fn the_schema_is_printed() {
    for (kind, key) in [("gateway", "network"), ("controller", "program")] {
        let (code, schema) = json(&["export", "schema", kind]);
        assert_eq!(code, Some(0));
        assert_eq!(schema["$schema"], "http://json-schema.org/draft-07/schema#");
        assert!(schema["properties"][key].is_object(), "{kind}");
    }
    assert_eq!(json(&["export", "schema"]), json(&["export", "schema", "gateway"]));
}

/// The keys of a value, at any depth.
fn keys(value: &Value, all: &mut std::collections::BTreeSet<String>) {
    match value {
        Value::Object(object) => {
            for (key, value) in object {
                all.insert(key.clone());
                keys(value, all);
            }
        }
        Value::Array(items) => items.iter().for_each(|item| keys(item, all)),
        _ => {}
    }
}

#[test]
fn bits_of_a_register_that_are_written_as_0_are_told() {
    let shown = |function: &str, keys: &str| {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("line.toml");
        let toml = format!(
            "controller = {{ address = \"127.0.0.1\" }}
            [[recipe]]
            name = \"r\"
            kind = \"modbus-rtu\"
            [[recipe.exchange]]
            slave = 6
            function = \"{function}\"
            address = 256
            on = [\"change\"]
            write = [{{ name = \"light\", type = \"word\", {keys} from = \"WordOutputReg[2]\" }}]
            [[port]]
            name = \"line\"
            bus = \"modbus-rtu\"
            recipe = \"r\""
        );
        std::fs::write(&path, toml).unwrap();
        let path = path.to_str().unwrap();
        let text = String::from_utf8(host_sim(&["check", path]).stdout).unwrap();
        let exchange = json(&["check", "--json", path]).1["ports"][0]["exchanges"][0].clone();
        let is_told =
            text.contains("bits 0xFFFB are written as 0; mask-write-register leaves them as they are");
        assert_eq!(is_told, exchange["zeroed_bits"] == "0xFFFB", "{text}");
        (is_told, exchange["what"].as_str().unwrap().to_owned())
    };
    let (function, bits) = ("write-register", "bits = 2,");
    assert_eq!(shown(function, bits), (true, "slave 6, write-register (6), 1 at 0x0100".into()));
    assert!(shown("write-registers", bits).0 && !shown(function, "").0);
    let what = "slave 6, mask-write-register (22), bits 0x0004 at 0x0100";
    assert_eq!(shown("mask-write-register", bits), (false, what.into()));
}

#[test]
fn every_key_of_the_json_is_documented() {
    let page = std::fs::read_to_string(recipe_test_kit::repository().join("docs/checking.md")).unwrap();
    let mut all = std::collections::BTreeSet::new();
    for file in examples() {
        keys(&json(&["check", file.to_str().unwrap(), "--json"]).1, &mut all);
    }
    let file = path("rs485-system.toml");
    keys(&json(&["check", &file, "--json", "--set", "port.rs485-1.baud=1"]).1, &mut all);
    keys(&json(&["check", &file, "--json", "--set", "network.address=192.168.12.20/24"]).1, &mut all);
    let missing: Vec<_> = all.iter().filter(|key| !page.contains(&format!("`{key}`"))).collect();
    assert!(all.len() > 60 && missing.is_empty(), "{} keys; not in docs/checking.md: {missing:?}", all.len());
}

#[test]
fn a_board_is_given_no_more_than_it_has() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("cell.toml");
    let toml = std::fs::read_to_string(path("force-sensor.toml")).unwrap();
    let port = "\n[[port]]\nname = \"more-N\"\nbus = \"can\"\nrecipe = \"more-N\"\n[[recipe]]\nname = \"more-N\"\n\
                kind = \"can\"\nmode = \"realtime\"\n[[recipe.input.frame]]\nid = 1\nfields = [\"WordInputReg[N]\"]\n";
    std::fs::write(&file, format!("{toml}{}{}", port.replace('N', "1"), port.replace('N', "2"))).unwrap();
    let (file, image) = (file.to_str().unwrap(), folder.path().join("cell.img"));
    assert!(host_sim(&["check", file]).status.success());
    for args in [
        vec!["check", file, "--board", "nucleo-h743zi"],
        vec!["image", file, "-o", image.to_str().unwrap(), "--board", "mps2-an500"],
    ] {
        let output = host_sim(&args);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains("port.more-2.bus: the board ") && said.contains("has 1 CAN ports"), "{said}");
    }
    assert!(!image.exists());
    assert!(host_sim(&["check", &path("force-sensor.toml"), "--board", "nucleo-h743zi"]).status.success());
    let output = host_sim(&["check", file, "--board", "pico"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("there are nucleo-h743zi, mps2-an500"), "{said}");
}

#[test]
fn what_changed_since_a_version_is_told_with_its_place() {
    let dir = tempfile::tempdir().unwrap();
    let cell = dir.path().join("cell.toml");
    let file = cell.to_str().unwrap();
    let exchange = "[[recipe.exchange]]\nslave = 1\nfunction = \"write-coil\"\naddress = 3\nlate_ms = 0\n\
                    on = [\"rising:BitOutputReg[3].0\"]\nwrite = [{ name = \"go\", value = 1 }]\n";
    let text = format!(
        "[controller]\naddress = \"10.0.0.2\"\n[[recipe]]\nname = \"r\"\nkind = \"modbus-rtu\"\n{exchange}\
         [[port]]\nname = \"p\"\nbus = \"modbus-rtu\"\nrecipe = \"r\"\n"
    );
    std::fs::write(&cell, text).unwrap();
    let said = |args: &[&str]| {
        let output = host_sim(&[&["check", file], args].concat());
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let (_, without) = said(&[]);
    assert!(!without.contains("changed since"), "{without}");
    let (code, with) = said(&["--since", "0.2"]);
    assert_eq!(code, Some(0));
    let changes: Vec<_> = with.split_once("\nchanged since 0.2\n").unwrap().1.lines().collect();
    assert_eq!(changes.len(), 3, "{with}");
    assert!(changes[0].starts_with("  port \"p\", echo: learned from"), "{with}");
    assert!(changes[1].starts_with("  port \"p\", exchange 1, on: a rise is sent once"), "{with}");
    assert!(changes[2].starts_with("  port \"p\", exchange 1, retries: it is not"), "{with}");
    // What has been decided since is not told, wherever it was decided.
    let decided = [
        "--since",
        "0.2.0",
        "--set",
        "port.p.echo=false",
        "--set",
        "recipe.r.exchange.1.retries=0",
        "--set",
        "recipe.r.exchange.1.trigger_ms=50",
    ];
    let (_, nothing) = said(&decided);
    assert!(nothing.ends_with("\nchanged since 0.2\n  nothing in this file\n"), "{nothing}");

    let (code, report) = json(&["check", file, "--json", "--since", "0.2"]);
    assert_eq!(code, Some(0));
    assert_eq!(report["changes"][1]["key"], "recipe.r.exchange.1.on");
    assert_eq!((&report["changes"][1]["line"], &report["changes"][1]["file"]), (&11.into(), &file.into()));
    let (_, report) = json(&["check", file, "--json"]);
    assert!(report.get("changes").is_none(), "{report:#}");

    for (args, said) in [
        (["check", file, "--since", "0.1"], "[possible values: 0.2]"),
        (["check", file, "--since", "1"], "[possible values: 0.2]"),
        (["check", &path("rs485-system-controller.toml"), "--since", "0.2"], "--since is for gateway files"),
    ] {
        let output = host_sim(&args);
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(said), "{message}");
    }
}
