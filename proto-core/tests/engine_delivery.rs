//! Handed over is not delivered: what the controller's TCP has not acknowledged in time ends the
//! connection, so that nothing delivers it later (docs/engine.md section 5).

mod rig;

use heapless::String;
use proto_core::config::*;
use proto_core::engine::{Input, LinkId, PortId, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::wire::scalar::ScalarType;
use rig::*;

/// A button box: 1 runs, 2 resumes, 3 stops; 0 picks nothing.
fn panel() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf,50)"), (2, "resume"), (3, "stop")]);
    let to = InputBinding::Commands { table, when: CommandWhen::Change };
    let fields = cell.fields([user_in(ScalarType::Byte, to)]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    let port = cell.rs485(recipe);
    cell.last_port().timeout = MS(20_000);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.acknowledges = false;
    press(&mut rig, port, 0);
    (rig, port)
}

fn press(rig: &mut Rig, port: PortId, value: u8) {
    rig.bytes(port, &[255, 255, value, 238, 238]);
}

#[track_caller]
fn reply(rig: &Rig, port: PortId) -> ReplyCode {
    rig.engine.reply_code(port).unwrap()
}

fn unacknowledged(rig: &Rig, link: LinkId) -> u32 {
    rig.link(link).counters.unacknowledged
}

#[test]
fn a_command_counts_its_second_from_when_it_was_picked() {
    let (mut rig, port) = panel();
    press(&mut rig, port, 1);
    assert_eq!(rig.sent_on(LinkId::COMMAND), [b"run(pick.jspf,50)"]);
    rig.acked(LinkId::COMMAND, 0);
    rig.run(MS(100));
    let picked = rig.now;
    press(&mut rig, port, 2);
    rig.run(MS(400));
    rig.link_bytes(LinkId::COMMAND, b"run start");
    assert_eq!(rig.sent_on(LinkId::COMMAND), [b"resume"], "handed over 400 ms after it was picked");
    rig.run(MS(599));
    assert_eq!((rig.closed(), reply(&rig, port)), (vec![], ReplyCode::Pending));
    rig.run(MS(1));
    assert_eq!(rig.closed(), [(picked + MS(1_000), LinkId::COMMAND)], "600 ms later");
    assert_eq!(unacknowledged(&rig, LinkId::COMMAND), 1);
    assert_eq!(reply(&rig, port), ReplyCode::NoReply, "whether it was carried out is not known");
    rig.run(MS(5_000));
    assert_eq!(rig.link(LinkId::COMMAND).history.connects, 2);
    assert!(rig.sent_on(LinkId::COMMAND).is_empty(), "a robot must not start later");
}

#[test]
fn a_command_that_is_acknowledged_may_be_answered_later() {
    let (mut rig, port) = panel();
    press(&mut rig, port, 1);
    rig.run(MS(990));
    rig.acked(LinkId::COMMAND, 0);
    rig.run(MS(8_000));
    assert_eq!((rig.closed(), reply(&rig, port)), (vec![], ReplyCode::Pending));
    rig.link_bytes(LinkId::COMMAND, b"run start");
    assert_eq!(reply(&rig, port), ReplyCode::Success);
}

#[test]
fn a_reply_is_an_acknowledgement() {
    let (mut rig, port) = panel();
    press(&mut rig, port, 1);
    rig.run(MS(10));
    rig.link_bytes(LinkId::COMMAND, b"run start");
    press(&mut rig, port, 3);
    rig.run(MS(10));
    rig.link_bytes(LinkId::URGENT, b"stop success");
    assert_eq!(rig.sent_on(LinkId::URGENT), [b"stop"]);
    rig.run(MS(5_000));
    assert_eq!(rig.closed(), [], "an answer implies the acknowledgement");
    // What follows counts from zero.
    press(&mut rig, port, 2);
    let picked = rig.now;
    rig.run(MS(1_000));
    assert_eq!(rig.closed(), [(picked + MS(1_000), LinkId::COMMAND)]);
}

#[test]
fn half_a_command_that_is_acknowledged_is_none() {
    let (mut rig, port) = panel();
    let picked = rig.now;
    press(&mut rig, port, 1);
    let len = rig.sent_on(LinkId::COMMAND)[0].len();
    for left in (1..=len).rev() {
        rig.run(MS(20));
        rig.acked(LinkId::COMMAND, left);
    }
    rig.run(MS(1_000));
    assert_eq!(rig.closed(), [(picked + MS(1_000), LinkId::COMMAND)]);
}

#[test]
fn an_urgent_command_has_a_second_from_when_it_was_handed_over_and_is_sent_again() {
    let (mut rig, port) = panel();
    press(&mut rig, port, 3);
    let first = rig.now;
    assert_eq!(rig.sent_on(LinkId::URGENT), [b"stop"]);
    rig.run(MS(999));
    assert_eq!(rig.closed(), []);
    rig.log.clear();
    rig.run(MS(1));
    assert_eq!(rig.closed(), [(first + MS(1_000), LinkId::URGENT)]);
    assert_eq!(unacknowledged(&rig, LinkId::URGENT), 1);
    assert_eq!(rig.sent_on(LinkId::COMMAND), [b"stop"], "at once, by the other connection");
    assert_eq!(reply(&rig, port), ReplyCode::Pending);
    // That one is no better; by then the second connection is back.
    rig.run(MS(1_000));
    assert_eq!(rig.closed(), [(first + MS(2_000), LinkId::COMMAND)]);
    assert_eq!(unacknowledged(&rig, LinkId::COMMAND), 1);
    assert_eq!(rig.sent_on(LinkId::URGENT), [b"stop"]);
    rig.link_bytes(LinkId::URGENT, b"stop success");
    assert_eq!(reply(&rig, port), ReplyCode::Success);
    rig.run(MS(10_000));
    assert!(rig.sent_on(LinkId::URGENT).is_empty() && rig.sent_on(LinkId::COMMAND).is_empty());
    assert_eq!(rig.link(LinkId::URGENT).state.name(), "up", "the second connection is not to blame");
    assert_eq!(rig.counters(port).commands, 1, "picked once");
}

#[test]
fn an_urgent_command_that_nobody_asks_for_any_more_is_not_sent_again() {
    let (mut rig, port) = panel();
    press(&mut rig, port, 3);
    rig.run(MS(500));
    press(&mut rig, port, 0);
    rig.run(MS(500));
    assert_eq!(unacknowledged(&rig, LinkId::URGENT), 1);
    assert_eq!(reply(&rig, port), ReplyCode::NoReply);
    assert_eq!(rig.sent_on(LinkId::URGENT).len(), 1);
    rig.run(MS(10_000));
    assert!(rig.sent_on(LinkId::URGENT).is_empty() && rig.sent_on(LinkId::COMMAND).is_empty());
}

/// DigitalOutputCommand[1] by Modbus.
fn plc() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.acknowledges = false;
    rig.modbus_answers = false;
    (rig, port)
}

const ON: &[u8] = &[255, 255, 1, 238, 238];
const OFF: &[u8] = &[255, 255, 0, 238, 238];

#[test]
fn a_modbus_request_that_has_not_arrived_when_its_time_is_up_goes_with_its_connection() {
    let (mut rig, port) = plc();
    rig.bytes(port, ON);
    let sent = rig.now;
    rig.run(MS(499));
    assert_eq!(rig.closed(), []);
    rig.run(MS(1));
    assert_eq!(rig.closed(), [(sent + MS(500), LinkId::MODBUS)]);
    let link = rig.link(LinkId::MODBUS);
    assert_eq!((link.counters.unacknowledged, link.counters.timeouts, link.history.losses), (1, 1, 1));
    rig.sent_on(LinkId::MODBUS);
    rig.run(MS(5_000));
    assert!(rig.sent_on(LinkId::MODBUS).is_empty(), "and is not repeated");
}

#[test]
fn a_modbus_request_that_has_arrived_is_only_given_up() {
    let (mut rig, port) = plc();
    for requests in 1..=2 {
        rig.bytes(port, ON);
        rig.run(MS(10));
        rig.acked(LinkId::MODBUS, 0);
        rig.run(MS(490));
        let link = rig.link(LinkId::MODBUS);
        assert_eq!((link.counters.timeouts, link.history.losses), (requests, 0));
    }
    assert_eq!(unacknowledged(&rig, LinkId::MODBUS), 0);
    assert_eq!(rig.closed(), []);
}

#[test]
fn a_modbus_answer_is_an_acknowledgement() {
    let (mut rig, port) = plc();
    rig.modbus_answers = true;
    for _ in 0..50 {
        rig.bytes(port, ON);
        rig.run(MS(50));
    }
    assert_eq!((rig.closed(), rig.take_written().len()), (vec![], 50));
    // A late acknowledgement of what was answered long ago is not one of the next request.
    rig.modbus_answers = false;
    rig.bytes(port, OFF);
    let (sent, len) = (rig.now, rig.sent_on(LinkId::MODBUS).last().unwrap().len());
    rig.run(MS(10));
    rig.acked(LinkId::MODBUS, len);
    rig.run(MS(490));
    assert_eq!(rig.closed(), [(sent + MS(500), LinkId::MODBUS)]);
}

/// Two forces from a sensor, by the connection of the controller's TCP client.
fn tcp(timeouts: &[u64]) -> (Rig, Vec<PortId>, LinkId) {
    let mut cell = Cell::new();
    let names: Vec<std::string::String> =
        (1..=timeouts.len()).map(|nth| format!("FloatInputReg[{nth}]")).collect();
    let names: Vec<&str> = names.iter().map(std::string::String::as_str).collect();
    let up = cell.stream(&names, &[]);
    let mut ports = Vec::new();
    for (name, &timeout) in names.iter().zip(timeouts) {
        let recipe = cell.stream(&[name], &[]);
        ports.push(cell.rs485(recipe));
        cell.last_port().timeout = MS(timeout);
    }
    let listen = String::try_from("0.0.0.0:50000").unwrap();
    let link = LinkId::of_port(cell.port(Bus::TcpListen { listen }, up));
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.acknowledges = false;
    if names.len() > 1 {
        // What the other port has not sent yet is read back.
        rig.link_bytes(LinkId::STATE, &[0; 1468]);
    }
    (rig, ports, link)
}

fn float(value: u16) -> Vec<u8> {
    [&[255, 255][..], &f32::from(value).to_le_bytes(), &[238, 238]].concat()
}

#[test]
fn a_recipe_frame_has_as_long_as_its_owners_may_be_silent_and_at_least_250_ms() {
    for (timeouts, patience) in
        [(&[100][..], 250), (&[250], 250), (&[400], 400), (&[700, 300], 300), (&[600, 20], 250)]
    {
        let (mut rig, ports, link) = tcp(timeouts);
        let sent = rig.now;
        rig.bytes(ports[0], &float(1));
        assert_eq!(rig.sent_on(link).len(), 1, "{timeouts:?}");
        rig.run(MS(1));
        rig.bytes(ports[0], &float(2));
        assert_eq!(rig.sent_on(link).len(), 1, "{timeouts:?}");
        rig.run(MS(patience - 2));
        assert_eq!(rig.closed(), [], "{timeouts:?}");
        rig.run(MS(1));
        assert_eq!(rig.closed(), [(sent + MS(patience), link)], "{timeouts:?}");
        assert_eq!(unacknowledged(&rig, link), 1);
        assert_eq!(rig.link(link).state.name(), "down");
    }
}

#[test]
fn the_time_of_a_frame_counts_from_when_it_was_handed_over() {
    let (mut rig, ports, link) = tcp(&[400]);
    rig.reports_sent = false;
    rig.bytes(ports[0], &float(1));
    let len = rig.sent_on(link)[0].len();
    rig.run(MS(200));
    rig.bytes(ports[0], &float(2));
    assert!(rig.sent_on(link).is_empty(), "the transport is full");
    rig.run(MS(50));
    rig.input(Input::LinkSent { link });
    assert_eq!(rig.sent_on(link), [float(2)]);
    let second = rig.now;
    rig.run(MS(100));
    rig.acked(link, len);
    rig.run(MS(299));
    assert_eq!(rig.closed(), []);
    rig.run(MS(1));
    assert_eq!(rig.closed(), [(second + MS(400), link)]);
}

#[test]
fn acknowledgements_that_are_200_ms_late_do_not_slow_a_cycle_of_4_ms() {
    let (mut rig, ports, link) = tcp(&[100]);
    let len = float(0).len();
    for nth in 0..2_500_u16 {
        rig.bytes(ports[0], &float(nth));
        assert_eq!(rig.sent_on(link), [float(nth)], "at once");
        rig.run(MS(4));
        if nth % 5 == 4 {
            // What was sent in the newest 200 ms is not acknowledged.
            rig.acked(link, len * usize::from(nth + 1).min(50));
        }
    }
    assert_eq!((rig.closed(), unacknowledged(&rig, link)), (vec![], 0));
    assert_eq!(rig.link(link).counters.sent, 2_500);
}

#[test]
fn at_most_64_frames_are_unacknowledged_and_then_the_newest_goes_first() {
    let (mut rig, ports, link) = tcp(&[2_000]);
    let len = float(0).len();
    for nth in 1..=70 {
        rig.bytes(ports[0], &float(nth));
        rig.run(MS(4));
    }
    let sent = rig.sent_on(link);
    assert_eq!(sent.len(), 64);
    assert_eq!(sent.last(), Some(&float(64)));
    rig.run(MS(100));
    assert!(rig.sent_on(link).is_empty(), "the transport would take them, the peer does not");
    rig.acked(link, 64 * len - 1);
    assert!(rig.sent_on(link).is_empty(), "a byte is no frame");
    rig.acked(link, 63 * len);
    assert_eq!(rig.sent_on(link), [float(70)], "65 to 69 were overtaken");
    rig.bytes(ports[0], &float(71));
    assert!(rig.sent_on(link).is_empty());
    rig.acked(link, 0);
    assert_eq!(rig.sent_on(link), [float(71)]);
    assert_eq!(rig.closed(), []);
}

#[test]
fn edges_of_bits_are_kept_while_nothing_can_be_handed_over() {
    let mut cell = Cell::new();
    let up = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.last_port().timeout = MS(2_000);
    let listen = String::try_from("0.0.0.0:50000").unwrap();
    let link = LinkId::of_port(cell.port(Bus::TcpListen { listen }, up));
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.acknowledges = false;
    for _ in 0..64 {
        rig.bytes(port, OFF);
    }
    assert_eq!(rig.sent_on(link).len(), 64);
    for frame in [ON, OFF, ON] {
        rig.bytes(port, frame);
    }
    assert!(rig.sent_on(link).is_empty());
    rig.acked(link, 0);
    assert_eq!(rig.sent_on(link), [ON, OFF, ON]);
    assert_eq!(rig.counters(port).edges_lost, 0);
}

#[test]
fn several_frames_are_acknowledged_in_their_order() {
    let (mut rig, ports, link) = tcp(&[400]);
    let len = float(0).len();
    let mut sent = Vec::new();
    for nth in 1..=4 {
        sent.push(rig.now);
        rig.bytes(ports[0], &float(nth));
        rig.run(MS(50));
    }
    // One and a half of them.
    rig.acked(link, 2 * len + len / 2);
    rig.run(MS(400 - 150 - 1));
    assert_eq!(rig.closed(), []);
    rig.run(MS(1));
    assert_eq!(rig.closed(), [(sent[1] + MS(400), link)], "the second is the oldest");
}

#[test]
fn a_new_connection_begins_from_nothing() {
    let (mut rig, ports, link) = tcp(&[400]);
    for nth in 0..3 {
        rig.bytes(ports[0], &float(nth));
    }
    rig.run(MS(100));
    rig.input(Input::LinkDown { link });
    rig.run(MS(150));
    assert_eq!(rig.link(link).state.name(), "up");
    rig.sent_on(link);
    rig.bytes(ports[0], &float(7));
    let sent = rig.now;
    assert_eq!(rig.sent_on(link), [float(7)]);
    rig.run(MS(300));
    assert_eq!(rig.closed(), [], "frames of the first connection do not count any more");
    rig.acked(link, float(7).len());
    rig.run(MS(100));
    assert_eq!(rig.closed(), [(sent + MS(400), link)], "none of it was acknowledged");
}

#[test]
fn more_left_than_there_was_acknowledges_nothing() {
    let (mut rig, ports, link) = tcp(&[400]);
    let sent = rig.now;
    rig.bytes(ports[0], &float(1));
    for left in [9, 1_000, u32::MAX / 2] {
        rig.input(Input::LinkAcked { link, left });
    }
    rig.run(MS(400));
    assert_eq!(rig.closed(), [(sent + MS(400), link)]);
}

#[test]
fn a_datagram_is_never_waited_for() {
    let mut cell = Cell::new();
    let up = cell.stream(&["FloatInputReg[1]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["FloatInputReg[1]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    for nth in 0..1_000 {
        rig.bytes(port, &float(nth));
        rig.run(MS(4));
    }
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP).len(), 1_000);
    assert_eq!((rig.closed(), unacknowledged(&rig, LinkId::RECIPE_UDP)), (vec![], 0));
}

#[test]
fn what_was_not_acknowledged_is_not_sent_again() {
    let (mut rig, ports, link) = tcp(&[300]);
    rig.bytes(ports[0], &float(1));
    let down = rig.now + MS(300);
    rig.bytes(ports[0], &float(2));
    rig.run(MS(300));
    assert_eq!(rig.closed(), [(down, link)]);
    rig.acknowledges = true;
    rig.sent_on(link);
    rig.run(MS(5_000));
    assert!(rig.sent_on(link).is_empty(), "the sensor has been silent since");
    rig.bytes(ports[0], &float(3));
    assert_eq!(rig.sent_on(link), [float(3)]);
    assert_eq!(rig.closed(), []);
}
