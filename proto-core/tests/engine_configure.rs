//! An engine that is configured in place equals a new one, whatever it ran before.

mod rig;

use proto_core::config::{
    CanFields, CommandWhen, ConfigBuilder, GatewayConfig, InputBinding, InputField, Parts, Port, Recipe,
};
use proto_core::engine::{BuildError, Engine, Input, OUTPUT_BUFFER, Output, PortId};
use proto_core::recipe::model::Mode;
use proto_core::time::Instant;
use proto_core::wire::scalar::ScalarType;
use rig::*;

type Small = Engine<2, 1, 16, 0, 0>;

fn can_cell() -> Cell {
    let mut cell = Cell::new();
    let recipe = cell.can(&[(1, &["DigitalOutputCommand[1]"])], &[(2, &["RobotState[8..9]"])]);
    cell.can_port(recipe);
    cell
}

fn stream_cell() -> Cell {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["BitInputReg[1]", "WordInputReg[1]"], &["DigitalSignalStatus[1]"]);
    cell.rs485(recipe);
    cell.safe("BitInputReg[1]", 3.0);
    cell
}

/// A panel that stops and starts the robot.
fn command_cell() -> Cell {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf,50)"), (2, "stop")]);
    let when = CommandWhen::Frame;
    let fields = [0; 3].map(|_| user_in(ScalarType::Byte, InputBinding::Commands { table, when }));
    let fields = cell.fields(fields);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    cell.rs485(recipe);
    cell
}

/// All of an engine's state, as text.
fn state(engine: &Small) -> String {
    format!("{engine:?}")
}

/// Lets it open its links, take a frame, time out, and sleep.
fn use_it(engine: &mut Small) {
    let mut buf = [0; OUTPUT_BUFFER];
    let links: Vec<_> = engine.links().map(|link| link.id).collect();
    let mut inputs = vec![Input::Tick, Input::PortUp { port: PortId(0) }];
    inputs.extend(links.iter().map(|&link| Input::LinkUp { link }));
    inputs.push(Input::PortBytes { port: PortId(0), bytes: &[255, 255, 1, 2, 0, 238, 238] });
    inputs.push(Input::Tick);
    for (nth, input) in (0..).zip(inputs) {
        let now = Instant::from_millis(200 * nth);
        engine.handle(now, input);
        while !matches!(engine.poll_output(now, &mut buf), Output::Sleep { .. }) {}
    }
    engine.handle(Instant::from_millis(60_000), Input::Tick);
    assert_eq!(engine.sleeps(), 1);
}

#[test]
fn a_used_engine_takes_another_configuration_whole() {
    let mut engine = Small::idle();
    // One at a time: four of them are too much for a test's stack.
    let cells: [fn() -> Cell; 4] = [stream_cell, can_cell, command_cell, stream_cell];
    for cell in cells.map(|cell| move || Box::new(cell())) {
        let cell = cell();
        assert_eq!(engine.configure(&cell.0), Ok(()));
        assert_eq!(state(&engine), state(&Small::new(&cell.0).unwrap()));
        let fresh = state(&engine);
        use_it(&mut engine);
        assert_ne!(state(&engine), fresh, "it did nothing");
    }
}

#[test]
fn after_a_refused_configuration_it_is_idle() {
    let mut engine = Small::new(&stream_cell().0).unwrap();
    use_it(&mut engine);
    let mut wrong = stream_cell();
    wrong.0.controller.dialect.clear();
    assert_eq!(engine.configure(&wrong.0), Small::new(&wrong.0).map(|_| ()));
    assert!(engine.configure(&wrong.0).is_err());
    assert_eq!(state(&engine), state(&Small::idle()));
    let mut buf = [0; OUTPUT_BUFFER];
    let asleep = Output::Sleep { until: Instant::NEVER };
    assert_eq!(engine.poll_output(Instant::from_millis(1), &mut buf), asleep);
}

#[test]
fn configurations_of_every_size_are_the_same_to_it() {
    fn builder<
        const P: usize,
        const R: usize,
        const F: usize,
        const C: usize,
        const S: usize,
        const E: usize,
    >() -> ConfigBuilder<P, R, F, C, S, E> {
        GatewayConfig::builder()
            .controller("10.0.0.2")
            .recipe(
                Recipe::realtime("panel")
                    .stream_input(&[255], &[], &["BitInputReg[1]", "WordInputReg[1..30]"])
                    .stream_output(&[255], &[], &["DigitalSignalStatus[1]"]),
            )
            .port(Port::rs485("panel", "panel").safe(&[("BitInputReg[1]", 3.0)]))
    }
    let small: GatewayConfig<1, 1, 32, 0, 1, 0> = builder().build().unwrap();
    let full: GatewayConfig = builder().build().unwrap();
    assert!(size_of_val(&small) < 4 * 1024, "{} bytes", size_of_val(&small));
    assert_eq!(state(&Small::new(&small).unwrap()), state(&Small::new(&full).unwrap()));
    assert_eq!(Small::new(small.view()).map(|_| ()), Ok(()));
}

#[test]
fn what_it_has_no_room_for_is_counted() {
    let refused = |builder: ConfigBuilder| {
        let config = builder.build().unwrap();
        match Small::new(&config).map(|_| ()) {
            Err(error @ BuildError::TooMany { .. }) => error.to_string(),
            other => panic!("{other:?}"),
        }
    };
    let output = || Recipe::realtime("out").stream_output(&[255], &[], &["RobotState[8]"]);
    let base = || GatewayConfig::builder().controller("10.0.0.2").recipe(output());
    let ports = ["a", "b", "c"].into_iter().fold(base(), |base, name| base.port(Port::rs485(name, "out")));
    assert_eq!(refused(ports), "too many field ports: 3 are needed; this gateway has room for 2");
    let links = ["a", "b", "c"].into_iter().enumerate().fold(base(), |base, (nth, name)| {
        base.port(Port::udp_listen(name, "out", ["1.1.1.1:1", "1.1.1.1:2", "1.1.1.1:3"][nth]))
    });
    assert_eq!(
        refused(links.recipe_link("out")),
        "too many recipe links and Modbus TCP ports: 4 are needed; this gateway has room for 1"
    );
    let fields = [InputField::unused(ScalarType::Byte); 17];
    let user = base().recipe(Recipe::user("user").stream_input(&[255], &[], &fields));
    assert_eq!(
        refused(user.port(Port::rs485("a", "user"))),
        "too many user-defined fields in one direction: 17 are needed; this gateway has room for 16"
    );
    let frames =
        |first: u16| (first..first + 25).map(|id| CanFields::standard(id, &fields[..1])).collect::<Vec<_>>();
    let (one, two) = (frames(0), frames(100));
    let can = base()
        .recipe(Recipe::user("one").can_input(&one))
        .recipe(Recipe::user("two").can_input(&two))
        .port(Port::can("a", "one"))
        .port(Port::can("b", "two"));
    assert_eq!(refused(can), "too many input frames: 50 are needed; this gateway has room for 48");
}
