//! Field to controller: what is written, when, and what never is (docs/engine.md section 5).

mod rig;

use proto_core::engine::{BusState, Input, LinkId, PortId, PortState};
use proto_core::wire::scalar::Scalar;
use rig::*;

const ON: &[u8] = &[0xFF, 0xFF, 1, 0xEE, 0xEE];
const OFF: &[u8] = &[0xFF, 0xFF, 0, 0xEE, 0xEE];

/// Worked example 2: DigitalOutputCommand[1] from an RS-485 device.
fn digital_output() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    (cell.rig(), port)
}

#[test]
fn nothing_is_written_before_the_first_valid_frame() {
    let (mut rig, port) = digital_output();
    rig.run(MS(5_000));
    rig.bytes(port, &[0xFF, 0xFF, 1, 0xEE, 0x00]);
    rig.run(MS(5_000));
    assert_eq!(rig.take_written(), []);
    assert!(rig.sent_on(LinkId::MODBUS).is_empty());
}

#[test]
fn the_worked_example_switches_coil_192() {
    let (mut rig, port) = digital_output();
    rig.run(MS(10));
    rig.bytes(port, ON);
    assert_eq!(rig.take_written(), [coils(192, 1)], "in the same pass");
    rig.bytes(port, ON);
    assert_eq!(rig.take_written(), [coils(192, 1)], "an unchanged value is written again");
    assert_eq!(rig.counters(port).frames_in, 2);
}

#[test]
fn a_frame_is_found_however_it_is_cut_and_polluted() {
    let (mut rig, port) = digital_output();
    rig.run(MS(10));
    for cut in 0..=ON.len() {
        rig.bytes(port, &ON[..cut]);
        rig.bytes(port, &ON[cut..]);
        assert_eq!(rig.take_written(), [coils(192, 1)], "cut at {cut}");
    }
    for byte in ON {
        rig.bytes(port, &[*byte]);
    }
    assert_eq!(rig.take_written(), [coils(192, 1)], "byte by byte");

    let accepted = rig.counters(port).frames_in;
    for (garbage, what) in [
        (&[0x12, 0x34, 0xFF][..], "garbage with half a head"),
        (&[0xFF, 0xFF, 1, 0xEE][..], "a frame that breaks off"),
        (&[0xFF, 0xFF, 1, 0xEE, 0xED][..], "a wrong tail"),
        (&[0xFF, 0xFF, 0xFF][..], "heads only"),
        (&[0xFF, 0xFF, 1, 0xFE, 0xFE][..], "a frame of another recipe"),
    ] {
        rig.bytes(port, &[garbage, OFF].concat());
        assert_eq!(rig.take_written(), [coils(192, 0)], "{what}");
    }
    let counters = rig.counters(port);
    assert_eq!(counters.frames_in, accepted + 5);
    assert_eq!(counters.resync_bytes, 3 + 4 + 5 + 3 + 5, "every byte of it is counted");
}

#[test]
fn a_partial_frame_is_discarded_after_silence() {
    let (mut rig, port) = digital_output();
    rig.run(MS(10));
    rig.bytes(port, &ON[..3]);
    rig.run(MS(51));
    rig.bytes(port, &ON[3..]);
    assert_eq!(rig.take_written(), []);
    assert_eq!(rig.counters(port).discarded_bytes, 3);
    rig.bytes(port, ON);
    assert_eq!(rig.take_written(), [coils(192, 1)]);
}

#[test]
fn edges_within_one_transaction_are_two_writes() {
    let (mut rig, port) = digital_output();
    rig.run(MS(10));
    rig.modbus_answers = false;
    rig.bytes(port, OFF);
    let first = rig.sent_on(LinkId::MODBUS).remove(0);
    for frame in [ON, OFF, ON, ON] {
        rig.bytes(port, frame);
    }
    assert!(rig.sent_on(LinkId::MODBUS).is_empty(), "one transaction in flight");
    rig.modbus_answers = true;
    let answer = rig.answer(&first);
    rig.link_bytes(LinkId::MODBUS, &answer);
    let written = rig.take_written();
    assert_eq!(written, [coils(192, 0), coils(192, 1), coils(192, 0), coils(192, 1)]);
    assert_eq!(rig.counters(port).edges_lost, 0);
}

#[test]
fn neighbours_are_coalesced_and_strangers_left_alone() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["BitInputReg[3..5]", "WordInputReg[4..6]", "DigitalOutputCommand[3]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[255, 255, 1, 2, 0x84, 4, 0, 5, 0, 6, 1, 0xFF, 238, 238]);
    let bits = [1_u8, 2, 0x84].iter().flat_map(|byte| (0..8).map(move |bit| byte >> bit & 1 == 1));
    let mut written = rig.take_written();
    written.sort_by_key(|write| format!("{write:?}"));
    assert_eq!(
        written,
        [
            Written::Coils(216, vec![true, true]),
            Written::Coils(32, bits.collect()),
            Written::Registers(11, vec![4, 5, 0x0106]),
        ]
    );
    assert_eq!(rig.counters(port).masked, 1, "six reserved bits of the tool outputs were set");
}

#[test]
fn a_timeout_writes_the_safe_value_once_and_holds_the_rest() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1..2]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 0.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[255, 255, 0xFF, 0xFF, 238, 238]);
    rig.take_written();
    rig.run(MS(99));
    assert_eq!(rig.take_written(), []);
    rig.run(MS(1));
    assert_eq!(rig.take_written(), [coils(192, 0)]);
    rig.run(MS(10_000));
    assert_eq!(rig.take_written(), [], "once");
    assert_eq!(rig.counters(port).timeouts, 1);
}

#[test]
fn a_safe_value_that_fell_due_while_the_link_was_down_is_written_when_it_is_up() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1..2]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[255, 255, 1, 1, 238, 238]);
    rig.reachable.clear();
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.bytes(port, &[255, 255, 2, 2, 238, 238]);
    assert_eq!(rig.counters(port).undelivered, 1);
    rig.run(MS(500));
    rig.take_written();
    rig.reachable = (0..16).collect();
    rig.run(MS(5_000));
    assert_eq!(rig.take_written(), [coils(192, 4)], "the safe value, and nothing stale");
}

#[test]
fn a_write_that_was_under_way_when_the_link_broke_is_not_repeated() {
    let (mut rig, port) = digital_output();
    rig.run(MS(10));
    rig.modbus_answers = false;
    rig.bytes(port, ON);
    rig.bytes(port, OFF);
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.modbus_answers = true;
    rig.run(MS(50));
    rig.sent_on(LinkId::MODBUS);
    rig.run(MS(5_000));
    assert!(rig.sent_on(LinkId::MODBUS).is_empty());
    rig.bytes(port, ON);
    assert_eq!(rig.take_written(), [coils(192, 1)]);
}

#[test]
fn an_exception_is_counted_and_the_next_frame_gets_through() {
    let (mut rig, port) = digital_output();
    rig.run(MS(10));
    rig.map.exception = Some(proto_core::modbus::Exception::DeviceBusy);
    rig.bytes(port, ON);
    assert_eq!(rig.link(LinkId::MODBUS).counters.refused, 1);
    rig.map.exception = None;
    rig.bytes(port, ON);
    assert_eq!(rig.take_written(), [coils(192, 1)]);
}

#[test]
fn a_slow_controller_gets_the_newest_word_and_no_value_older_than_the_timeout() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]", "WordInputReg[1]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    let frame = |bit: u8, word: u8| [255, 255, bit, word, 0, 238, 238];
    rig.bytes(port, &frame(0, 0));
    let first = rig.sent_on(LinkId::MODBUS).remove(0);
    // 300 ms without an answer, a changing bit every 50 ms.
    for n in 1..=6 {
        rig.run(MS(50));
        rig.bytes(port, &frame(n % 2, n));
    }
    rig.modbus_answers = true;
    let answer = rig.answer(&first);
    rig.take_written();
    rig.link_bytes(LinkId::MODBUS, &answer);
    let written = rig.take_written();
    assert!(written.contains(&Written::Registers(8, vec![6])), "the newest word wins: {written:?}");
    let bits: Vec<_> = written.iter().filter(|write| matches!(write, Written::Coils(..))).collect();
    // Values of 200, 250 and 300 ms are within the timeout of 100 ms; older edges are not replayed.
    assert_eq!(bits, [&coils(192, 0), &coils(192, 1), &coils(192, 0)]);
    assert_eq!(rig.counters(port).values_expired, 3);
}

#[test]
fn frames_that_are_not_finite_or_too_many_are_rejected_whole() {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1..2]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["ForceEnd[1..2]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let frame = |a: f32, b: f32| [&[255, 255][..], &a.to_le_bytes(), &b.to_le_bytes(), &[238, 238]].concat();
    rig.bytes(port, &frame(1.0, f32::NAN));
    assert!(rig.sent_on(LinkId::RECIPE_UDP).is_empty());
    assert_eq!(rig.engine.image().value(var("ForceEnd[1]")), Scalar::Float(0.0), "not half of it");
    rig.bytes(port, &frame(1.0, 2.0));
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [frame(1.0, 2.0)]);
    let counters = rig.counters(port);
    assert_eq!((counters.rejected_not_finite, counters.frames_in), (1, 1));
}

#[test]
fn a_force_sensor_is_passed_on_frame_by_frame() {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1..6]"], &[]);
    cell.recipe_link(up);
    let fields = cell.system(&["ForceEnd[1..6]"]);
    let input = cell.part(&[0x48, 0xAA], &[0x0D, 0x0A], fields);
    let sensor = cell.recipe(
        proto_core::recipe::model::Mode::Realtime,
        proto_core::config::Parts::Stream { input, output: None },
    );
    let port = cell.rs485(sensor);
    let mut rig = cell.rig();
    rig.run(MS(10));
    for n in 0..960_u32 {
        let forces: Vec<u8> = (0..6).flat_map(|axis| (n as f32 + axis as f32).to_le_bytes()).collect();
        rig.bytes(port, &[&[0x48, 0xAA][..], &forces, &[0x0D, 0x0A]].concat());
        rig.run(proto_core::time::Duration::from_micros(1_041));
        let up = rig.sent_on(LinkId::RECIPE_UDP);
        assert_eq!(up, [[&[255, 255][..], &forces, &[238, 238]].concat()]);
    }
}

/// A recipe link whose frame carries a neighbour that no port sends.
fn shared_frame() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let up = cell.stream(&["DigitalOutputCommand[1]", "WordInputReg[1]", "FloatInputReg[2]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    (cell.rig(), port)
}

#[test]
fn nothing_is_read_back_for_a_frame_that_comes_from_one_field_frame() {
    let mut cell = Cell::new();
    let up = cell.stream(&["DigitalOutputCommand[1..2]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["DigitalOutputCommand[1..2]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    assert!(rig.engine.links().all(|link| link.id == LinkId::RECIPE_UDP), "no state stream is needed");
    rig.run(MS(10));
    rig.bytes(port, &[255, 255, 1, 2, 238, 238]);
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [[255, 255, 1, 2, 238, 238]]);

    // A safe value for one of them only: the other is read back when the port falls silent.
    cell.safe("DigitalOutputCommand[1]", 0.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[255, 255, 1, 2, 238, 238]);
    rig.sent_on(LinkId::RECIPE_UDP);
    rig.run(MS(100));
    assert!(rig.sent_on(LinkId::RECIPE_UDP).is_empty(), "it is not known what the other is now");
    rig.link_bytes(LinkId::STATE, &state_packet(0, 0.0, 0));
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [[255, 255, 0, 0, 238, 238]]);
}

fn state_packet(word: u16, float: f32, outputs: u8) -> Vec<u8> {
    let mut packet = vec![0; 1468];
    for bit in 0..8 {
        packet[752 + bit] = outputs >> bit & 1;
    }
    packet[1248..1250].copy_from_slice(&word.to_le_bytes());
    packet[836..840].copy_from_slice(&float.to_le_bytes());
    packet
}

#[test]
fn neighbours_in_a_shared_frame_are_read_back_never_zeroed() {
    let (mut rig, port) = shared_frame();
    rig.run(MS(10));
    rig.bytes(port, ON);
    assert!(rig.sent_on(LinkId::RECIPE_UDP).is_empty(), "the neighbours are not known yet");
    assert_eq!(rig.counters(port).withheld, 1);
    rig.link_bytes(LinkId::STATE, &state_packet(0x1234, 2.5, 0xF0));
    let frame = |bits: u8| [&[255, 255, bits, 0x34, 0x12][..], &2.5_f32.to_le_bytes(), &[238, 238]].concat();
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [frame(1)], "ours is ours, theirs is theirs");
    rig.bytes(port, OFF);
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [frame(0)]);
}

#[test]
fn a_read_back_that_is_old_holds_the_frame_back() {
    let (mut rig, port) = shared_frame();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &state_packet(7, 1.0, 0));
    rig.run(MS(501));
    rig.bytes(port, ON);
    assert!(rig.sent_on(LinkId::RECIPE_UDP).is_empty());
    assert_eq!(rig.counters(port).withheld, 1);
}

#[test]
fn a_port_that_falls_silent_on_hold_gives_its_variable_back() {
    let mut cell = Cell::new();
    let up = cell.stream(&["DigitalOutputCommand[1..2]"], &[]);
    cell.recipe_link(up);
    let first = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let second = cell.stream(&["DigitalOutputCommand[2]"], &[]);
    let (a, b) = (cell.rs485(first), cell.rs485(second));
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(a, ON);
    rig.bytes(b, ON);
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [vec![255, 255, 1, 1, 238, 238]]);
    rig.run(MS(150));
    // Another client switched DO1..8 meanwhile: b's frames must not switch them back.
    rig.link_bytes(LinkId::STATE, &state_packet(0, 0.0, 0xA5));
    rig.bytes(b, OFF);
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [vec![255, 255, 0xA5, 0, 238, 238]]);
}

#[test]
fn what_a_silent_owner_sent_last_does_not_pass_for_read_back() {
    let mut cell = Cell::new();
    let up = cell.stream(&["DigitalOutputCommand[1..2]"], &[]);
    cell.recipe_link(up);
    let first = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let second = cell.stream(&["DigitalOutputCommand[2]"], &[]);
    let (a, b) = (cell.rs485(first), cell.rs485(second));
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(a, ON);
    rig.run(MS(50));
    // The packet is recent, but DO1..8 were a's when it came.
    rig.link_bytes(LinkId::STATE, &state_packet(0, 0.0, 0xA5));
    rig.run(MS(51));
    rig.sent_on(LinkId::RECIPE_UDP);
    rig.bytes(b, OFF);
    assert!(rig.sent_on(LinkId::RECIPE_UDP).is_empty());
    assert_eq!((rig.counters(a).withheld, rig.counters(b).withheld), (1, 1));
    rig.link_bytes(LinkId::STATE, &state_packet(0, 0.0, 0x5A));
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [vec![255, 255, 0x5A, 0, 238, 238]]);
}

#[test]
fn edges_wait_for_a_transport_that_is_busy() {
    let (mut rig, port) = {
        let mut cell = Cell::new();
        let up = cell.stream(&["DigitalOutputCommand[1]"], &[]);
        cell.recipe_link(up);
        let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
        let port = cell.rs485(recipe);
        (cell.rig(), port)
    };
    rig.run(MS(10));
    rig.reports_sent = false;
    for frame in [ON, OFF, ON] {
        rig.bytes(port, frame);
    }
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [ON]);
    rig.input(Input::LinkSent { link: LinkId::RECIPE_UDP });
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [OFF]);
    rig.input(Input::LinkSent { link: LinkId::RECIPE_UDP });
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [ON]);
    rig.input(Input::LinkSent { link: LinkId::RECIPE_UDP });
    assert!(rig.sent_on(LinkId::RECIPE_UDP).is_empty());
}

#[test]
fn a_value_received_while_the_link_was_down_goes_up_as_it_is_not_as_zero() {
    let mut cell = Cell::new();
    let up = cell.stream(&["DigitalOutputCommand[1..2]"], &[]);
    cell.recipe_link(up);
    let first = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let second = cell.stream(&["DigitalOutputCommand[2]"], &[]);
    let a = cell.rs485(first);
    cell.last_port().timeout = MS(1_000);
    let b = cell.rs485(second);
    let mut rig = cell.rig();
    rig.reachable.clear();
    rig.run(MS(10));
    rig.input(Input::LinkDown { link: LinkId::RECIPE_UDP });
    rig.reachable = (0..16).collect();
    rig.bytes(a, ON);
    rig.run(MS(500));
    rig.bytes(b, ON);
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [vec![255, 255, 1, 1, 238, 238]]);
}

#[test]
fn two_links_with_one_variable_each_write_their_own() {
    let mut cell = Cell::new();
    let first = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    cell.recipe_link(first);
    let second = cell.stream(&["DigitalOutputCommand[1..2]"], &[]);
    let listen = heapless::String::try_from("127.0.0.1:50000").unwrap();
    let tcp = LinkId::of_port(cell.port(proto_core::config::Bus::TcpListen { listen }, second));
    let one = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let two = cell.stream(&["DigitalOutputCommand[2]"], &[]);
    let (a, b) = (cell.rs485(one), cell.rs485(two));
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.reports_sent = false;
    for frame in [ON, OFF, ON] {
        rig.bytes(a, frame);
    }
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [ON]);
    assert!(rig.sent_on(tcp).is_empty(), "steps of one variable do not overtake each other on two links");
    rig.reports_sent = true;
    rig.input(Input::LinkSent { link: LinkId::RECIPE_UDP });
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [OFF, ON]);
    rig.bytes(b, ON);
    assert_eq!(rig.sent_on(tcp), [vec![255, 255, 1, 1, 238, 238]]);
    // The other link's loss is none of the first one's business.
    rig.reachable.remove(&tcp.0);
    rig.input(Input::LinkDown { link: tcp });
    rig.bytes(a, OFF);
    assert_eq!(rig.sent_on(LinkId::RECIPE_UDP), [OFF]);
    assert_eq!(rig.counters(a).undelivered, 0);
}

#[test]
fn values_that_are_dropped_with_their_link_are_counted() {
    let (mut rig, port) = digital_output();
    rig.run(MS(10));
    rig.modbus_answers = false;
    for frame in [ON, OFF, ON, OFF] {
        rig.bytes(port, frame);
    }
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    assert_eq!(rig.counters(port).values_expired, 3, "all but the one under way");
}

#[test]
fn can_frames_are_taken_by_id_and_length() {
    let mut cell = Cell::new();
    let recipe = cell.can(&[(1, &["DigitalOutputCommand[1]"]), (5, &["WordInputReg[1..2]"])], &[]);
    let port = cell.can_port(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 1, &[1]);
    assert_eq!(rig.take_written(), [coils(192, 1)]);
    rig.can(port, 5, &[1, 0, 2, 0]);
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![1, 2])]);
    rig.can(port, 2, &[1]);
    rig.can(port, 1, &[1, 2]);
    rig.can(port, 5, &[1]);
    let remote = proto_core::wire::can::CanFrame::remote(proto_core::wire::can::CanId::Standard(1), 1);
    rig.input(Input::PortCan { port, frame: remote.unwrap() });
    assert_eq!(rig.take_written(), []);
    let counters = rig.counters(port);
    assert_eq!((counters.rejected_id, counters.rejected_length, counters.rejected_remote), (1, 2, 1));
    assert_eq!(counters.frames_in, 2);
}

#[test]
fn each_can_frame_has_its_own_timeout() {
    let mut cell = Cell::new();
    let recipe = cell.can(&[(1, &["DigitalOutputCommand[1]"]), (5, &["DigitalOutputCommand[2]"])], &[]);
    let port = cell.can_port(recipe);
    cell.safe("DigitalOutputCommand[1]", 0.0);
    cell.safe("DigitalOutputCommand[2]", 0.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 1, &[1]);
    rig.can(port, 5, &[1]);
    rig.run(MS(60));
    rig.can(port, 5, &[1]);
    rig.take_written();
    rig.run(MS(60));
    assert_eq!(rig.take_written(), [coils(192, 0)], "only id 1 is overdue");
    assert_eq!(rig.counters(port).timeouts, 1);
}

#[test]
fn two_ports_never_wait_for_each_other_for_ever() {
    let mut cell = Cell::new();
    let first = cell.stream(&["WordInputReg[1]"], &[]);
    let second = cell.stream(&["WordInputReg[32]"], &[]);
    let (a, b) = (cell.rs485(first), cell.rs485(second));
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    let frame = |word: u8| [255, 255, word, 0, 238, 238];
    rig.bytes(a, &frame(1));
    rig.bytes(b, &frame(1));
    let mut written = Vec::new();
    for n in 2..20 {
        let request = rig.sent_on(LinkId::MODBUS).remove(0);
        rig.bytes(a, &frame(n));
        let answer = rig.answer(&request);
        rig.link_bytes(LinkId::MODBUS, &answer);
        written.extend(rig.take_written());
    }
    assert!(written.contains(&Written::Registers(39, vec![1])), "{written:?}");
}

#[test]
fn a_ports_state_tells_silence_from_bus_off_and_from_a_device_that_is_gone() {
    let mut cell = Cell::new();
    let recipe = cell.can(&[(1, &["DigitalOutputCommand[1]"]), (2, &["DigitalOutputCommand[2]"])], &[]);
    let port = cell.can_port(recipe);
    let recipe = cell.stream(&[], &["RobotState[8..11]"]);
    let shows = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    assert_eq!(rig.engine.port_state(shows), Some(PortState::Working), "nothing is expected from it");
    assert_eq!(rig.engine.port_state(port), Some(PortState::Silent), "before the first frame");
    rig.can(port, 1, &[1]);
    assert_eq!(rig.engine.port_state(port), Some(PortState::Silent), "one id of two");
    rig.can(port, 2, &[1]);
    assert_eq!(rig.engine.port_state(port), Some(PortState::Working));
    rig.run(MS(60));
    rig.can(port, 2, &[1]);
    rig.run(MS(60));
    assert_eq!(rig.engine.port_state(port), Some(PortState::Silent), "one id is overdue");
    rig.can(port, 1, &[1]);
    rig.can(port, 2, &[1]);
    rig.input(Input::PortBus { port, state: BusState::BusOff });
    assert_eq!(rig.engine.port_state(port), Some(PortState::BusOff));
    rig.input(Input::PortBus { port, state: BusState::Passive });
    assert_eq!(rig.engine.port_state(port), Some(PortState::Working));
    rig.input(Input::PortDown { port });
    assert_eq!(rig.engine.port_state(port), Some(PortState::Gone));
    assert_eq!(rig.engine.port_state(PortId(7)), None);
}

#[test]
fn a_safe_value_that_its_owner_overtakes_grows_old_as_any_other() {
    let (mut rig, port) = guarded();
    rig.modbus_answers = false;
    rig.bytes(port, ON);
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 1, "and no answer for 500 ms");
    // Overdue after 100 ms: the safe value waits. 50 ms later the owner is back.
    rig.run(MS(150));
    for _ in 0..4 {
        rig.bytes(port, ON);
        rig.run(MS(20));
    }
    assert_eq!(rig.counters(port).values_expired, 1, "the safe value of 100 ms, at 230 ms");
    rig.modbus_answers = true;
    for _ in 0..20 {
        rig.bytes(port, ON);
        rig.run(MS(20));
    }
    assert!(!rig.take_written().contains(&coils(192, 4)), "the owner is back");
}
