//! The controller's state and the health of ports, from the simulated controller to the field and back.

use proto_core::wire::state::OperationMode;
use recipe_cell::{Cell, PeriodicSender};
use recipe_config::file;
use recipe_test_kit::{example, toml};

const GATEWAY: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "sensor"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [{ name = "value", type = "byte", to = "WordInputReg[1]" }]

[[recipe]]
name = "tower"
kind = "stream"
mode = "user"
[recipe.output]
head = [1]
tail = [2]
send = "change"
fields = [
    { name = "mode", type = "byte", from = "controller.mode" },
    { name = "robot", type = "byte", from = "controller.robot_state" },
    { name = "sensor", type = "byte", from = "port.sensor-1.alive" },
]

[[port]]
name = "sensor-1"
bus = "rs485"
recipe = "sensor"
timeout_ms = 100
on_timeout = { "WordInputReg[1]" = 42 }
safe_at_start = true
health = { alive = "WordInputReg[20]", frames = "WordInputReg[21]", age_ms = "WordInputReg[22]" }

[[port]]
name = "tower-1"
bus = "rs485"
recipe = "tower"
refresh_ms = 1000
"#;

fn cell() -> Cell {
    let controller = file::load_controller(&example("rs485-system-controller.toml"), &[]).unwrap();
    Cell::new(&toml::gateway(GATEWAY), &controller, 7).unwrap()
}

/// What the tower shows: the newest frame since the last call.
#[track_caller]
fn shown(cell: &mut Cell) -> [u8; 3] {
    let line = cell.line_of("tower-1");
    let heard: Vec<u8> = cell.line(line).take_heard().into_iter().flat_map(|(_, bytes)| bytes).collect();
    let frames = heard.chunks_exact(5).inspect(|frame| assert_eq!((frame[0], frame[4]), (1, 2)));
    let newest = frames.reduce(|_, newer| newer).expect("a frame");
    [newest[1], newest[2], newest[3]]
}

#[test]
fn a_change_of_mode_reaches_the_field() {
    let mut cell = cell();
    cell.run_ms(1_000);
    let [mode, robot, alive] = shown(&mut cell);
    assert_eq!((mode, robot, alive), (OperationMode::Remote.code(), 6, 0));
    cell.controller_mut().set_mode(OperationMode::Manual);
    cell.run_ms(150);
    assert_eq!(shown(&mut cell)[0], OperationMode::Manual.code());
    // Refreshed each second, and otherwise silent.
    cell.run_ms(3_000);
    let line = cell.line_of("tower-1");
    let frames = cell.line(line).take_heard().into_iter().map(|(_, bytes)| bytes.len()).sum::<usize>() / 5;
    assert!((2..=3).contains(&frames), "{frames}");
}

#[test]
fn a_device_that_is_dead_from_the_start_is_told_and_safe() {
    let mut cell = cell();
    cell.set_value("WordInputReg[1]", 99.0);
    cell.set_value("WordInputReg[20]", 99.0);
    cell.run_ms(1_000);
    let seen = |cell: &Cell| [1, 20, 21, 22].map(|nth| cell.value(&format!("WordInputReg[{nth}]")));
    assert_eq!(seen(&cell), [42.0, 0.0, 0.0, 65_535.0]);
    assert_eq!(shown(&mut cell)[2], 0);

    let line = cell.line_of("sensor-1");
    cell.attach(line, PeriodicSender::new(cell.now(), 50, 50, |_| vec![255, 255, 7, 238, 238]));
    cell.run_ms(900);
    let [value, alive, frames, age] = seen(&cell);
    assert_eq!((value, alive), (7.0, 1.0));
    assert!((40.0..=46.0).contains(&frames) && age <= 40.0, "{frames} {age}");
    assert_eq!(shown(&mut cell)[2], 1);
    cell.run_ms(400);
    assert_eq!(seen(&cell)[..3], [42.0, 0.0, 50.0], "it has fallen silent");
    assert_eq!(shown(&mut cell)[2], 0);
}
