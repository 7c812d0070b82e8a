//! The documents of a gateway, compared with what serde makes of the same status.

use proto_core::config::{ExchangeBuilder, GatewayConfig, InputField, Port, Recipe};
use proto_core::engine::{Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::time::{Duration, Instant};
use recipe_api::documents::{Document, Pieces};
use recipe_api::metrics::Families;
use serde_json::Value;

/// A gateway with two ports, one of which has a name that has to be escaped. A good frame and a wrong one
/// have arrived, and a state packet.
fn engine() -> Box<Engine> {
    let word = |name, field| Recipe::realtime(name).stream_input(&[1, 2], &[3, 4], field);
    let config: GatewayConfig = GatewayConfig::builder()
        .controller("127.0.0.1")
        .recipe(word("word", &["WordInputReg[1]"]))
        .recipe(word("pose", &["FloatInputReg[1]"]).stream_output(&[1], &[2], &["RobotState[8..13]"]))
        .port(Port::rs485("back\\slash", "word"))
        .port(Port::rs485("pose", "pose"))
        .recipe(word("up", &["FloatInputReg[1]"]))
        .recipe_link("up")
        .build()
        .unwrap();
    let mut engine = Box::new(Engine::new(&config).unwrap());
    let ports = [PortId(0), PortId(1)];
    let mut inputs: Vec<Input<'_>> = ports.iter().map(|&port| Input::PortUp { port }).collect();
    inputs.push(Input::PortBytes { port: PortId(0), bytes: &[1, 2, 7, 0, 3, 4] });
    inputs.push(Input::PortBytes { port: PortId(1), bytes: &[1, 2, 0, 0, 0xC0, 0x7F, 3, 4] });
    inputs.push(Input::LinkUp { link: LinkId::STATE });
    let packet = [0; proto_core::wire::state::LEN];
    inputs.push(Input::LinkBytes { link: LinkId::STATE, bytes: &packet });
    let mut buf = [0; OUTPUT_BUFFER];
    for input in [Input::Tick].into_iter().chain(inputs) {
        engine.handle(at(1_000), input);
        while !matches!(engine.poll_output(at(1_000), &mut buf), Output::Sleep { .. }) {}
    }
    engine
}

fn at(micros: u64) -> Instant {
    Instant::from_micros(micros)
}

fn read(document: Document, engine: &Engine) -> Value {
    let mut text = String::new();
    Pieces::of(document).write_all(engine.status(at(2_000)), &mut text).unwrap();
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

#[test]
fn both_documents_together_are_the_status() {
    let engine = engine();
    let mut status = read(Document::Status, &engine);
    let values = read(Document::Values, &engine);
    assert_eq!(status["time_us"], values["time_us"]);
    assert_eq!(status.as_object_mut().unwrap().remove("health"), Some("no-controller".into()));
    status["values"] = values["values"].clone();
    // Through a text: numbers of 32 bits have another one than as numbers of 64.
    let whole = serde_json::to_string(&engine.status(at(2_000))).unwrap();
    let whole: Value = serde_json::from_str(&whole).unwrap();
    assert_eq!(status, whole);
    assert!(values["values"].as_object().unwrap().len() == 7, "{values}");
    assert_eq!(status["ports"]["pose"]["counters"]["rejected_not_finite"], 1);
}

#[test]
fn a_piece_is_small_and_later_pieces_may_be_of_a_later_instant() {
    let mut engine = engine();
    for document in [Document::Status, Document::Values] {
        let (mut pieces, mut text, mut longest) = (Pieces::of(document), String::new(), 0);
        let mut now = 2_000;
        loop {
            let mut piece = String::new();
            if !pieces.write_next(engine.status(at(now)), &mut piece).unwrap() {
                break;
            }
            longest = longest.max(piece.len());
            text += &piece;
            // Meanwhile the variables become known one after the other, and time goes on.
            now += 100;
            engine.handle(at(now), Input::LinkDown { link: LinkId::STATE });
        }
        serde_json::from_str::<Value>(&text).unwrap_or_else(|error| panic!("{error}: {text}"));
        assert!(longest < 2_048, "a piece of {longest} bytes");
    }
}

/// A line with twenty slaves: each is a piece of its own.
#[test]
fn the_peers_of_a_port_are_pieces_too() {
    let padding = [InputField::padding(2)];
    let asks: Vec<_> = (1..=20)
        .map(|slave| {
            ExchangeBuilder::read_holding_registers(slave, 0, &padding).every(Duration::from_millis(1_000))
        })
        .collect();
    let config: GatewayConfig = GatewayConfig::builder()
        .controller("127.0.0.1")
        .recipe(Recipe::user("line").exchanges(&asks))
        .port(Port::modbus_rtu("line", "line"))
        .build()
        .unwrap();
    let engine = Box::new(<Engine>::new(&config).unwrap());
    let (mut pieces, mut text, mut longest) = (Pieces::of(Document::Status), String::new(), 0);
    loop {
        let mut piece = String::new();
        if !pieces.write_next(engine.status(at(2_000)), &mut piece).unwrap() {
            break;
        }
        longest = longest.max(piece.len());
        text += &piece;
    }
    let written: Value = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"));
    let whole = serde_json::to_value(engine.status(at(2_000))).unwrap();
    assert_eq!(written["ports"], whole["ports"]);
    assert_eq!(written["ports"]["line"]["peers"].as_object().unwrap().len(), 20);
    assert!(longest < 2_048, "a piece of {longest} bytes");
}

#[test]
fn too_little_room_is_an_error() {
    let engine = engine();
    let mut small = heapless::String::<100>::new();
    assert!(Pieces::of(Document::Status).write_all(engine.status(at(2_000)), &mut small).is_err());
    assert!(Families::new().write_all(engine.status(at(2_000)), &mut small).is_err());
}

/// Each family once and in one piece, each sample of its family, counts of buckets that only rise.
#[test]
fn metrics_are_open_metrics() {
    let engine = engine();
    let mut text = String::new();
    Families::new().write_all(engine.status(at(2_000)), &mut text).unwrap();
    assert!(text.ends_with("\n# EOF\n"));
    let (mut families, mut samples, mut rising) = (Vec::new(), Vec::new(), 0.0);
    for line in text.lines() {
        if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').unwrap();
            assert!(!families.iter().any(|(other, _)| *other == name), "{name} comes twice");
            families.push((name, kind));
            rising = 0.0;
        } else if !line.starts_with('#') {
            let (series, value) = line.rsplit_once(' ').unwrap();
            let (family, kind) = families.last().unwrap();
            let name = series.split('{').next().unwrap();
            let end = name.strip_prefix(family).unwrap_or_else(|| panic!("{line} is not of {family}"));
            let ends: &[&str] = match *kind {
                "counter" => &["_total"],
                "histogram" => &["_bucket", "_count", "_sum"],
                _ => &[""],
            };
            assert!(ends.contains(&end), "{line} in a {kind}");
            let value: f64 = value.parse().unwrap();
            if end == "_bucket" {
                assert!(value >= rising, "{line}");
                rising = value;
            }
            assert!(!samples.contains(&series), "{series} comes twice");
            samples.push(series);
        }
    }
    for sample in [
        "rgw_port_frames_in_total{port=\"back\\\\slash\"} 1",
        "rgw_port_rejected_total{port=\"pose\",reason=\"not_finite\"} 1",
        "rgw_port_age_seconds{port=\"back\\\\slash\"} 0.001000",
        "rgw_link_up{link=\"state\"} 1",
        "rgw_link_received_total{link=\"state\"} 1",
        "rgw_health{rgw_health=\"no-controller\"} 1",
        "rgw_handed_over_seconds_bucket{le=\"0.000000\"} 0",
        "rgw_handed_over_seconds_bucket{le=\"+Inf\"} 0",
    ] {
        assert!(text.lines().any(|line| line == sample), "{sample} is not in\n{text}");
    }
    assert!(!text.contains("port_age_seconds{port=\"pose\"}"), "what is unknown is absent");
}
