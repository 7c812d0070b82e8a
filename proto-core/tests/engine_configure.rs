//! An engine that is configured where it stands is one that was made so, whatever it ran before.

mod rig;

use proto_core::config::{CommandWhen, InputBinding, Parts};
use proto_core::engine::{Engine, Input, OUTPUT_BUFFER, Output, PortId};
use proto_core::recipe::model::Mode;
use proto_core::time::Instant;
use proto_core::wire::scalar::ScalarType;
use rig::*;

type Small = Engine<2, 1, 16>;

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
    for cell in [stream_cell(), can_cell(), command_cell(), stream_cell()] {
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
