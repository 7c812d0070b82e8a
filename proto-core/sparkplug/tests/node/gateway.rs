//! What a gateway tells: the catalog of a configuration, and samples of a real engine.

use proto_core::config::{GatewayConfig, Port, Recipe};
use proto_core::engine::{
    Engine, Input as EngineInput, LinkId, OUTPUT_BUFFER, Output as EngineOutput, PortId,
};
use proto_core::sysvar::VarRange;
use proto_core::time::{Duration, Instant};
use recipe_sparkplug::catalog::{Catalog, Owner, Report};
use recipe_sparkplug::gateway::{GatewayCatalog, NoRoom, PublishRule, Rates};
use recipe_sparkplug::node::{EdgeNode, NodeCounters};
use recipe_sparkplug::value::{DataType, Value};

use crate::kit::settings;

fn config() -> GatewayConfig {
    let word = |name, field| Recipe::realtime(name).stream_input(&[1, 2], &[3, 4], field);
    GatewayConfig::builder()
        .controller("127.0.0.1")
        .recipe(word("word", &["WordInputReg[1]"]))
        .recipe(word("pose", &["FloatInputReg[31..32]"]).stream_output(&[1], &[2], &["RobotState[8..9]"]))
        .port(Port::rs485("a/b", "word"))
        .port(Port::rs485("pose", "pose"))
        .recipe(word("up", &["FloatInputReg[31..32]"]))
        .recipe_link("up")
        .build()
        .unwrap()
}

/// Word 7 has arrived at the first port, a state packet of zeros from the controller.
fn engine(config: &GatewayConfig) -> Box<Engine> {
    let mut engine = Box::new(Engine::new(config).unwrap());
    let packet = [0; proto_core::wire::state::LEN];
    let inputs = [
        EngineInput::Tick,
        EngineInput::PortUp { port: PortId(0) },
        EngineInput::PortUp { port: PortId(1) },
        EngineInput::PortBytes { port: PortId(0), bytes: &[1, 2, 7, 0, 3, 4] },
        EngineInput::LinkUp { link: LinkId::STATE },
        EngineInput::LinkBytes { link: LinkId::STATE, bytes: &packet },
    ];
    let mut buf = [0; OUTPUT_BUFFER];
    let now = Instant::from_micros(1_000);
    for input in inputs {
        engine.handle(now, input);
        while !matches!(engine.poll_output(now, &mut buf), EngineOutput::Sleep { .. }) {}
    }
    engine
}

const RATES: Rates<'_> = Rates {
    min_interval: Duration::from_millis(200),
    counter_interval: Duration::from_secs(10),
    rules: &[],
    values: &[],
};

type Small<'c> = GatewayCatalog<'c, 64>;

fn names<const N: usize>(catalog: &GatewayCatalog<'_, N>) -> Vec<String> {
    (0..catalog.len()).map(|place| catalog.metric(place).unwrap().name.to_string()).collect()
}

#[test]
fn ports_are_devices_with_what_they_write() {
    let config = config();
    let engine = engine(&config);
    let catalog = Small::new(config.view(), engine.status(Instant::ZERO), RATES, "0.0.0").unwrap();
    assert_eq!((catalog.devices(), catalog.device(0), catalog.device(1)), (2, "a_b", "pose"));
    let names = names(&catalog);
    let (node, left) = names.split_at(catalog.metrics(Owner::Node));
    let (left, right) = left.split_at(catalog.metrics(Owner::Device(0)));
    let expected = [
        "Node Info/Version",
        "Node Info/Uptime",
        "gateway/health",
        "gateway/sleeps",
        "gateway/values_lost",
        "gateway/commands_refused",
        "port/a_b/alive",
        "port/pose/alive",
    ];
    assert_eq!(node[..8], expected);
    assert!(node.contains(&"link/state/up".into()) && node.contains(&"controller/safety".into()));
    assert_eq!(node[node.len() - 2..], ["controller/RobotState/8", "controller/RobotState/9"]);
    let counters = ["state", "frames/in", "frames/out", "frames/rejected", "frames/timeouts"];
    assert_eq!(
        (&left[..5], &left[5..]),
        (&counters.map(String::from)[..], &["WordInputReg/1".to_owned()][..])
    );
    assert_eq!(right[5..], ["FloatInputReg/31", "FloatInputReg/32"]);
    // It is what a node takes.
    assert!(EdgeNode::<64, 8>::new(settings(), &catalog, None, 1).is_ok());
}

#[test]
fn samples_have_the_type_of_their_metric_and_nothing_invented() {
    let config = config();
    let engine = engine(&config);
    let now = Instant::from_micros(2_000);
    let catalog = Small::new(config.view(), engine.status(now), RATES, "0.0.0").unwrap();
    let sample = |now| {
        let mut values = vec![Some(Value::Boolean(true)); catalog.len()];
        let alive =
            catalog.sample(engine.status(now), Duration::from_secs(9), &NodeCounters::default(), &mut values);
        let known: std::collections::BTreeMap<_, _> = names(&catalog)
            .into_iter()
            .zip(values)
            .enumerate()
            .filter_map(|(place, (name, value))| {
                let value = value?;
                assert_eq!(value.data_type(), catalog.metric(place).unwrap().data_type, "{name}");
                Some((name, value))
            })
            .collect();
        (alive, known)
    };
    let (alive, known) = sample(now);
    assert_eq!(alive, 0b01, "the second port has heard nothing");
    assert_eq!(known["WordInputReg/1"], Value::UInt16(7));
    assert_eq!(known["controller/RobotState/8"], Value::Float(0.0));
    assert_eq!(known["Node Info/Uptime"], Value::UInt64(9));
    assert_eq!(known["port/a_b/alive"], Value::Boolean(true));
    assert_eq!(known["link/state/up"], Value::Boolean(true));
    assert!(!known.contains_key("FloatInputReg/31"), "{known:?}");
    // What the controller said 5 s ago is not what it is.
    let (_, known) = sample(Instant::from_millis(5_002));
    assert!(!known.contains_key("controller/RobotState/8") && !known.contains_key("controller/mode"));
}

#[test]
fn parts_of_a_sample_are_the_whole() {
    let config = config();
    let engine = engine(&config);
    let now = Instant::from_micros(2_000);
    let catalog = Small::new(config.view(), engine.status(now), RATES, "0.0.0").unwrap();
    let (uptime, counters) = (Duration::from_secs(9), NodeCounters::default());
    let mut whole = vec![None; catalog.len()];
    let alive = catalog.sample(engine.status(now), uptime, &counters, &mut whole);
    assert_eq!(catalog.alive(engine.status(now)), alive);
    for len in [1, 7, catalog.len()] {
        let mut values = vec![Some(Value::Boolean(true)); catalog.len()];
        for start in (0..catalog.len()).step_by(len) {
            let part = &mut values[start..];
            catalog.sample_part(engine.status(now), uptime, &counters, start..start + len, part);
            assert!(part.iter().skip(len).all(|value| *value == Some(Value::Boolean(true))), "{len}");
        }
        assert_eq!(values, whole, "{len}");
    }
}

#[test]
fn rules_count_for_their_variables_and_the_last_one_wins() {
    let config = config();
    let engine = engine(&config);
    let vars = VarRange::parse("FloatInputReg[31..32]").unwrap();
    let second = VarRange::parse("FloatInputReg[32]").unwrap();
    let rules = [
        PublishRule { vars, dead_band: 0.5, min_interval: Some(Duration::from_secs(2)) },
        PublishRule { vars: second, dead_band: 0.1, min_interval: None },
    ];
    let values = ["RobotState[1..2]", "RobotState[11]"].map(|range| VarRange::parse(range).unwrap());
    let rates = Rates { rules: &rules, values: &values, ..RATES };
    let catalog = Small::new(config.view(), engine.status(Instant::ZERO), rates, "0.0.0").unwrap();
    let names = names(&catalog);
    let report = |name: &str| catalog.report(names.iter().position(|other| other == name).unwrap());
    assert_eq!(report("FloatInputReg/31"), Report { dead_band: 0.5, min_interval: Duration::from_secs(2) });
    assert_eq!(report("FloatInputReg/32"), Report { dead_band: 0.1, min_interval: RATES.min_interval });
    assert_eq!(report("WordInputReg/1"), Report { dead_band: 0.0, min_interval: RATES.min_interval });
    assert_eq!(report("frames/in").min_interval, RATES.counter_interval);
    let asked = names.iter().position(|name| name == "controller/RobotState/1").unwrap();
    let metric = catalog.metric(asked).unwrap();
    assert_eq!((metric.data_type, metric.unit), (DataType::Float, "rad"));
    let unit =
        |name: &str| catalog.metric(names.iter().position(|other| other == name).unwrap()).unwrap().unit;
    // Place and direction of the tool.
    assert_eq!((unit("controller/RobotState/9"), unit("controller/RobotState/11")), ("m", "rad"));
    assert_eq!(metric.description, "joint position; the 7th is reserved");
}

#[test]
fn too_many_metrics_are_refused() {
    let config = config();
    let engine = engine(&config);
    let catalog = GatewayCatalog::<16>::new(config.view(), engine.status(Instant::ZERO), RATES, "0.0.0");
    assert_eq!(catalog.map(|_| ()), Err(NoRoom));
}
