//! Commands for ranges of values, with the value in them.

use super::*;
use proto_core::command::ParseError;
use proto_core::wire::scalar::ScalarType as T;

fn cell_with(entries: &[(i64, i64, &str)], ty: T) -> (Cell, PortId) {
    let mut cell = Cell::new();
    let table = ranges(&mut cell, entries);
    let port = panel(&mut cell, &[user_in(ty, InputBinding::Commands { table, when: CommandWhen::Change })]);
    (cell, port)
}

#[test]
fn the_value_is_in_the_command() {
    let (cell, port) = cell_with(&[(1, 100, "speed({value})"), (101, 120, "run(p{value}.jspf)")], T::Byte);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[0xA5, 0]);
    for (value, text, answer) in [
        (1, "speed(1)", &b"set success"[..]),
        (100, "speed(100)", b"set success"),
        (101, "run(p101.jspf)", b"run start"),
        (120, "run(p120.jspf)", b"run start"),
    ] {
        rig.bytes(port, &[0xA5, value]);
        assert_eq!(sent(&mut rig, LinkId::COMMAND), [text]);
        assert_eq!(newest(&rig).as_deref(), Some(text));
        rig.link_bytes(LinkId::COMMAND, answer);
        assert_eq!(reply(&rig, port), ReplyCode::Success);
    }
    rig.bytes(port, &[0xA5, 121]);
    assert_eq!(not_given(&rig), Some((DropReason::Unknown, 0, 121)));
}

#[test]
fn a_waiting_command_has_the_value_that_picked_it() {
    let (cell, port) = cell_with(&[(1, 100, "speed({value})")], T::Byte);
    let mut rig = cell.rig();
    rig.run(MS(10));
    for value in [0, 10, 20, 0] {
        rig.bytes(port, &[0xA5, value]);
    }
    assert_eq!(sent(&mut rig, LinkId::COMMAND), ["speed(10)"]);
    rig.link_bytes(LinkId::COMMAND, b"set success");
    assert_eq!(sent(&mut rig, LinkId::COMMAND), ["speed(20)"]);
}

#[test]
fn a_stop_for_several_values_is_asked_for_by_each_of_them() {
    let (cell, port) = cell_with(&[(3, 5, "stop")], T::Byte);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.reachable.clear();
    for link in [LinkId::COMMAND, LinkId::URGENT] {
        rig.input(proto_core::engine::Input::LinkDown { link });
    }
    rig.bytes(port, &[0xA5, 0]);
    for value in [3, 4, 4] {
        for _ in 0..30 {
            rig.bytes(port, &[0xA5, value]);
            rig.run(MS(50));
        }
    }
    assert_eq!(reply(&rig, port), ReplyCode::Pending, "it does not grow old");
    rig.reachable = (0..16).collect();
    for _ in 0..120 {
        rig.bytes(port, &[0xA5, 4]);
        rig.run(MS(50));
    }
    let all = [sent(&mut rig, LinkId::COMMAND), sent(&mut rig, LinkId::URGENT)].concat();
    assert_eq!(all.first().map(String::as_str), Some("stop"));
}

#[test]
fn what_a_range_cannot_be_is_refused_with_its_place() {
    let wrong = |value, error| ConfigErrorKind::CommandFor { value, error };
    let speed = |value| wrong(value, ParseError::InvalidSpeed);
    for (entries, kind) in [
        (vec![(1, 101, "speed({value})")], speed(101)),
        (vec![(0, 100, "speed({value})")], speed(0)),
        (vec![(1, 100, "speed({value}0)")], speed(100)),
        (vec![(1, 2, "{value}()")], wrong(1, ParseError::UnknownWord)),
        (vec![(9, 3, "stop")], ConfigErrorKind::BackwardRange { first: 9, last: 3 }),
        (vec![(1, 256, "stop")], ConfigErrorKind::CommandValue { value: 256, ty: T::Byte }),
        (vec![(-1, 4, "stop")], ConfigErrorKind::CommandValue { value: -1, ty: T::Byte }),
    ] {
        let (cell, _) = cell_with(&entries, T::Byte);
        let place = Place::Command { entry: 0 };
        assert_eq!(cell.0.validate(), Err(ConfigError { place, kind }), "{entries:?}");
    }
    // As long as a command may be, with seven digits.
    let long = format!("run({}{{value}})", "x".repeat(84));
    let (cell, _) = cell_with(&[(1, 9_999_999, &long)], T::Dword);
    assert_eq!(cell.0.validate(), Ok(()));
    let (cell, _) = cell_with(&[(1, 10_000_000, &long)], T::Dword);
    let kind = ConfigErrorKind::TooLong { len: 97, longest: MAX_COMMAND_TEXT };
    assert_eq!(cell.0.validate(), Err(ConfigError { place: Place::Command { entry: 0 }, kind }));
    for (second, value) in [((10, 20), 10), ((5, 5), 5), ((-3, 1), 1), ((0, 40), 1)] {
        let entries = [(1, 10, "state"), (second.0, second.1, "resume")];
        let (cell, _) = cell_with(&entries, T::Char);
        let kind = ConfigErrorKind::DuplicateCommand { value };
        assert_eq!(cell.0.validate(), Err(ConfigError { place: Place::Command { entry: 1 }, kind }));
    }
    let (cell, _) = cell_with(&[(3, 3, "")], T::Byte);
    assert_eq!(cell.0.validate().unwrap_err().kind, ConfigErrorKind::EmptyTable);
}

#[test]
fn a_program_writes_ranges_and_idle_values() {
    let mut config: GatewayConfig<1, 1, 1, 3, 0> = GatewayConfig::empty();
    config.set_controller("192.168.12.138").unwrap();
    let table = [(1, 100, "speed({value})"), (200, 200, "stop")];
    let field = [InputField::command_ranges(T::Byte, &table).idle(255).when(CommandWhen::Kept)];
    config.add_recipe(&Recipe::user("panel").stream_input(&[0xA5], &[], &field)).unwrap();
    config.add_port(&Port::rs485("line", "panel")).unwrap();
    assert_eq!(config.validate(), Ok(()));
    let said: Vec<_> = config.commands.iter().map(|c| (c.first, c.last, c.text.as_str())).collect();
    assert_eq!(said, [(1, 100, "speed({value})"), (200, 200, "stop"), (255, 255, "")]);
    let empty = [InputField::commands(T::Byte, &[(1, "")])];
    let mut config: GatewayConfig<1, 1, 1, 1, 0> = GatewayConfig::empty();
    let refused = config.add_recipe(&Recipe::user("panel").stream_input(&[0xA5], &[], &empty));
    assert_eq!(refused.unwrap_err().kind, ConfigErrorKind::Command(ParseError::Empty));
}
