//! A panel whose start and stop are bits of one byte.

use super::*;

const START: u8 = 1;
const STOP: u8 = 2;

/// Start and stop with their rising edges, in both orders of the fields.
fn panels() -> [(Rig, PortId); 2] {
    [false, true].map(|stop_first| {
        let mut cell = Cell::new();
        let when = CommandWhen::Change;
        let start = InputBinding::Commands { table: cell.commands(&[(1, "run(pick.jspf)")]), when };
        let stop = InputBinding::Commands { table: cell.commands(&[(1, "stop")]), when };
        let fields = match stop_first {
            false => [bit(0, false, start), bit(1, true, stop)],
            true => [bit(1, false, stop), bit(0, true, start)],
        };
        let port = panel(&mut cell, &fields);
        let mut rig = cell.rig();
        rig.run(MS(10));
        rig.bytes(port, &[0xA5, 0]);
        (rig, port)
    })
}

#[test]
fn a_stop_is_sent_while_start_is_held() {
    for (mut rig, port) in panels() {
        rig.bytes(port, &[0xA5, START]);
        assert_eq!(sent(&mut rig, LinkId::COMMAND), ["run(pick.jspf)"]);
        rig.link_bytes(LinkId::COMMAND, b"run start");
        rig.bytes(port, &[0xA5, START | STOP]);
        assert_eq!(sent(&mut rig, LinkId::URGENT), ["stop"]);
        assert_eq!((reply(&rig, port), newest(&rig).as_deref()), (ReplyCode::Pending, Some("stop")));
        rig.link_bytes(LinkId::URGENT, b"stop success");
        // Releasing one after the other picks nothing.
        rig.bytes(port, &[0xA5, START]);
        rig.bytes(port, &[0xA5, 0]);
        assert_eq!(reply(&rig, port), ReplyCode::Success);
        assert_eq!(sent(&mut rig, LinkId::COMMAND), [""; 0]);
        let counters = rig.counters(port);
        assert_eq!((counters.commands, counters.commands_dropped, counters.commands_unknown), (2, 0, 0));
    }
}

#[test]
fn of_start_and_stop_in_one_frame_only_stop_is_sent_and_its_result_is_told() {
    for (nth, (mut rig, port)) in panels().into_iter().enumerate() {
        rig.bytes(port, &[0xA5, START | STOP]);
        assert_eq!(sent(&mut rig, LinkId::URGENT), ["stop"]);
        assert_eq!((reply(&rig, port), newest(&rig).as_deref()), (ReplyCode::Pending, Some("stop")));
        rig.link_bytes(LinkId::URGENT, b"stop success");
        rig.run(MS(50));
        assert_eq!(reply(&rig, port), ReplyCode::Success, "the start is not the newest");
        assert_eq!(sent(&mut rig, LinkId::COMMAND), [""; 0]);
        let counters = rig.counters(port);
        assert_eq!((counters.commands, counters.commands_dropped), (2, 1));
        assert_eq!(not_given(&rig), Some((DropReason::Overtaken, nth as u8, 1)));
    }
}

#[test]
fn a_start_that_cannot_be_sent_hides_no_stop() {
    for (mut rig, port) in panels() {
        rig.reachable.remove(&LinkId::COMMAND.0);
        rig.input(proto_core::engine::Input::LinkDown { link: LinkId::COMMAND });
        rig.bytes(port, &[0xA5, START | STOP]);
        assert_eq!(sent(&mut rig, LinkId::URGENT), ["stop"]);
        assert_eq!(reply(&rig, port), ReplyCode::Pending);
        rig.link_bytes(LinkId::URGENT, b"stop success");
        assert_eq!(reply(&rig, port), ReplyCode::Success);
        assert_eq!(rig.counters(port).commands_dropped, 1);
    }
}

#[test]
fn a_level_holds_the_robot_stopped() {
    let mut cell = Cell::new();
    let start = cell.commands(&[(1, "run(pick.jspf)")]);
    let start = InputBinding::Commands { table: start, when: CommandWhen::Change };
    let stop = InputBinding::Commands { table: cell.commands(&[(1, "stop")]), when: CommandWhen::Frame };
    let port = panel(&mut cell, &[bit(0, false, start), bit(1, true, stop)]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[0xA5, STOP]);
    rig.link_bytes(LinkId::URGENT, b"stop success");
    rig.bytes(port, &[0xA5, START | STOP]);
    rig.link_bytes(LinkId::URGENT, b"stop success");
    rig.run(MS(50));
    assert_eq!(sent(&mut rig, LinkId::URGENT), ["stop", "stop"]);
    assert_eq!(sent(&mut rig, LinkId::COMMAND), [""; 0], "not while stop is held");
    rig.bytes(port, &[0xA5, 0]);
    rig.bytes(port, &[0xA5, START]);
    assert_eq!(sent(&mut rig, LinkId::COMMAND), ["run(pick.jspf)"]);
}

#[test]
fn a_falling_edge_picks_a_command_too() {
    let mut cell = Cell::new();
    // A wire that is closed at rest, as a stop button's is.
    let table = ranges(&mut cell, &[(0, 0, "stop"), (1, 1, "")]);
    let port =
        panel(&mut cell, &[bit(7, false, InputBinding::Commands { table, when: CommandWhen::Change })]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[0xA5, 0x80]);
    rig.bytes(port, &[0xA5, 0x00]);
    assert_eq!(sent(&mut rig, LinkId::URGENT), ["stop"]);
    rig.link_bytes(LinkId::URGENT, b"stop success");
    rig.bytes(port, &[0xA5, 0x80]);
    let counters = rig.counters(port);
    assert_eq!((counters.commands, counters.commands_unknown, counters.commands_based), (1, 0, 0));
}

#[test]
fn several_others_are_sent_in_the_order_of_their_fields() {
    let mut cell = Cell::new();
    let when = CommandWhen::Change;
    let texts = ["enable", "speed(20)", "resume"];
    let to = texts.map(|text| InputBinding::Commands { table: cell.commands(&[(1, text)]), when });
    let port = panel(&mut cell, &[bit(5, false, to[0]), bit(0, true, to[1]), bit(3, true, to[2])]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[0xA5, 0]);
    rig.bytes(port, &[0xA5, 0xFF]);
    for (text, answer) in texts.into_iter().zip(["enable success", "set success", "resume success"]) {
        assert_eq!(sent(&mut rig, LinkId::COMMAND), [text]);
        rig.link_bytes(LinkId::COMMAND, answer.as_bytes());
    }
    assert_eq!((rig.counters(port).commands, reply(&rig, port)), (3, ReplyCode::Success));
}

#[test]
fn a_value_in_no_table_is_counted_once_and_told() {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf)"), (2, "stop")]);
    let order = InputBinding::Commands { table, when: CommandWhen::Change };
    let ty = proto_core::wire::scalar::ScalarType::Byte;
    let port = panel(&mut cell, &[user_in(ty, InputBinding::Unused), user_in(ty, order)]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    for value in [0, 1, 3, 3, 0] {
        rig.bytes(port, &[0xA5, 9, value]);
    }
    assert_eq!(rig.counters(port).commands_unknown, 1);
    assert_eq!(not_given(&rig), Some((DropReason::Unknown, 1, 3)));
    assert_eq!(rig.counters(port).commands, 1);
}

#[test]
fn the_idle_value_may_be_another_than_0() {
    let mut cell = Cell::new();
    let table = ranges(&mut cell, &[(1, 1, "resume"), (255, 255, "")]);
    let order = InputBinding::Commands { table, when: CommandWhen::Frame };
    let port = panel(&mut cell, &[user_in(proto_core::wire::scalar::ScalarType::Byte, order)]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    for value in [255, 255, 1, 255, 0, 0] {
        rig.bytes(port, &[0xA5, value]);
    }
    let counters = rig.counters(port);
    assert_eq!((counters.commands, counters.commands_unknown), (1, 2), "each frame counts");
    assert_eq!(not_given(&rig), Some((DropReason::Unknown, 0, 0)));
}
