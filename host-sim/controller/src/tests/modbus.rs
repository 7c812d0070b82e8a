//! The Modbus map (proto-core/docs/wire/modbus.md, D10-D12), and its agreement with recipes and the state
//! stream.

use proto_core::modbus::map::{Access, COILS, HOLDING, MAP, Space};

use super::*;

fn coil_pattern(nth: u16) -> bool {
    nth.wrapping_mul(0x9E37) >> 7 & 1 == 1
}

fn access(space: Space, address: u16) -> Access {
    let item = MAP.iter().find(|item| item.space == space && (item.first..item.end()).contains(&address));
    item.unwrap().access
}

fn word(address: u16) -> [u8; 2] {
    address.to_be_bytes()
}

#[test]
fn every_address_of_the_map_is_readable_and_only_some_are_writable() {
    let mut cell = robot(&SimConfig::default());
    let c = cell.modbus_client();
    for address in 0..COILS + 2 {
        let [a, b] = word(address);
        let (read, write) = (cell.modbus(c, &[1, a, b, 0, 1]), cell.modbus(c, &[5, a, b, 0xFF, 0]));
        if address >= COILS {
            assert_eq!((read, write), (vec![0x81, 2], vec![0x85, 2]), "coil {address}");
            continue;
        }
        assert_eq!(read, [1, 1, 0], "coil {address}");
        let expected = match access(Space::Coils, address) {
            Access::ReadWrite => vec![5, a, b, 0xFF, 0],
            Access::ReadOnly => vec![0x85, 2],
        };
        assert_eq!(write, expected, "coil {address}");
    }
    for address in 0..HOLDING + 2 {
        let [a, b] = word(address);
        let (read, write) =
            (cell.modbus(c, &[3, a, b, 0, 1]), cell.modbus(c, &[6, a, b, 0x12, address as u8]));
        if address >= HOLDING {
            assert_eq!((read, write), (vec![0x83, 2], vec![0x86, 2]), "register {address}");
            continue;
        }
        assert_eq!(read[..2], [3, 2], "register {address}");
        match access(Space::Holding, address) {
            Access::ReadWrite => {
                assert_eq!(write, [6, a, b, 0x12, address as u8]);
                assert_eq!(cell.modbus(c, &[3, a, b, 0, 1]), [3, 2, 0x12, address as u8]);
            }
            Access::ReadOnly => assert_eq!(write, [0x86, 2], "register {address}"),
        }
    }
    let counters = cell.controller.counters().modbus;
    assert_eq!((counters.violations, counters.open), (0, 1));
    assert!(counters.refusals > 100, "{counters:?}");
}

#[test]
fn coils_are_the_bits_of_recipes_and_of_the_stream() {
    let mut cell = robot(&SimConfig::default());
    let (c, _) = (cell.modbus_client(), cell.state_client());
    // The writable groups, each in one request.
    for (first, count) in [(0_u16, 16_u16), (32, 64), (192, 16), (216, 8)] {
        let [a, b] = word(first);
        let mut pdu = vec![15, a, b, 0, count as u8, (count / 8) as u8];
        for byte in 0..count / 8 {
            pdu.push((0..8).map(|bit| u8::from(coil_pattern(first + 8 * byte + bit)) << bit).sum());
        }
        assert_eq!(cell.modbus(c, &pdu), [15, a, b, 0, count as u8]);
    }
    cell.run_ms(100);
    let packet = cell.packets[0].1;
    let expect = |first: u16, shown: &[u8]| {
        for (nth, &bit) in (first..).zip(shown) {
            assert_eq!(bit == 1, coil_pattern(nth), "coil {nth}");
        }
    };
    expect(0, &packet.functional_bool_inputs);
    expect(32, &packet.bool_inputs);
    expect(192, &packet.digital_outputs);
    expect(216, &packet.tool_outputs[..2]);
    assert_eq!(packet.tool_outputs[2..], [0; 6], "reserved");
    let registers = cell.controller.registers();
    for (nth, name) in [(192, "DO[1]"), (199, "DO[8]"), (207, "DO[16]"), (217, "ToolDO[2]")] {
        assert_eq!(registers.value(target(name)) == 1.0, coil_pattern(nth), "{name}");
    }
    assert_eq!(cell.value("DigitalOutputCommand[1]"), cell.value("DigitalSignalStatus[4]"));
    // One read across all boundaries, from an odd address.
    let answer = cell.modbus(c, &[1, 0, 3, 0, 225]);
    assert_eq!(answer.len(), 2 + 29);
    for nth in 3..228_u16 {
        let shown = answer[2 + usize::from(nth - 3) / 8] >> ((nth - 3) % 8) & 1 == 1;
        let written = access(Space::Coils, nth) == Access::ReadWrite && !(218..224).contains(&nth);
        assert_eq!(shown, written && coil_pattern(nth), "coil {nth}");
    }
    assert_eq!(answer[30] & 0xFE, 0, "behind the last coil");
}

#[test]
fn a_write_that_touches_anything_read_only_changes_nothing() {
    let mut cell = robot(&SimConfig::default());
    let c = cell.modbus_client();
    assert_eq!(cell.modbus(c, &[15, 0, 14, 0, 4, 1, 0xFF]), [0x8F, 2]);
    assert_eq!(cell.modbus(c, &[1, 0, 14, 0, 4]), [1, 1, 0]);
    assert_eq!(cell.modbus(c, &[16, 0, 39, 0, 2, 4, 0, 1, 0, 2]), [0x90, 2]);
    assert_eq!(cell.modbus(c, &[3, 0, 39, 0, 2]), [3, 4, 0, 0, 0, 0]);
    assert_eq!(cell.modbus(c, &[16, 0, 8, 0, 2, 4, 0, 1, 0xFF, 2]), [16, 0, 8, 0, 2]);
    assert_eq!(cell.value("WordInputReg[2]"), f64::from(0xFF02));
    assert_eq!(cell.modbus(c, &[4, 0, 0, 0, 1]), [0x84, 1], "input registers are not there");
    assert_eq!(cell.modbus(c, &[5, 0, 0, 0x12, 0]), [0x85, 3], "neither on nor off");
}

#[test]
fn quantities_are_scaled_signed_and_saturated() {
    let values = [
        ("RobotState[1]", -1.5),
        ("RobotState[2]", 6.0),
        ("RobotState[8]", 5.0),
        ("RobotState[9]", -0.123_45),
        ("AI_C[1]", 12.34),
        ("AI_V[4]", 9.999),
        ("ToolAI[2]", 0.001),
        ("WordOutputReg[32]", 65_535.0),
    ];
    let mut cell = robot(&with_initial(SimConfig::default(), &values));
    let (c, _) = (cell.modbus_client(), cell.state_client());
    let mut read = |address: u8| {
        let answer = cell.modbus(c, &[3, 0, address, 0, 1]);
        i16::from_be_bytes([answer[2], answer[3]])
    };
    assert_eq!((read(92), read(93), read(98)), (-1_500, 6_000, 0));
    assert_eq!((read(106), read(107)), (32_767, -1_235), "5 m does not fit");
    assert_eq!((read(72), read(79), read(89)), (1_234, 9_999, 1));
    assert_eq!(read(71), -1);
    assert_eq!((read(0), read(1), read(2), read(3)), (2, 6, 0, 5));
    // Analog outputs are counts too; the stream has them in mA and V.
    cell.modbus(c, &[16, 0, 83, 0, 2, 4, 0x04, 0xD2, 0x13, 0x88]);
    cell.modbus(c, &[6, 0, 91, 0x03, 0xE8]);
    cell.run_ms(100);
    let packet = cell.packets[0].1;
    assert_eq!((packet.analog_outputs[3], packet.analog_outputs[4]), (12.34, 5.0));
    assert_eq!(packet.tool_analog_outputs, [0.0, 1.0]);
    assert_eq!((packet.analog_inputs[0], packet.analog_inputs[7]), (12.34, 9.999));
}

#[test]
fn speeds_are_shown_while_the_arm_moves() {
    let config =
        with_program(SimConfig::default(), "m", "movej([1.0, -0.785, -1.57, -0.785, 1.57, 0], 1.0);");
    let mut cell = robot(&config);
    let (c, m) = (cell.command_client(), cell.modbus_client());
    assert_eq!(cell.ask(c, "run(m)"), "run start");
    cell.run_ms(900);
    let answer = cell.modbus(m, &[3, 0, 92, 0, 26]);
    let register = |nth: usize| i16::from_be_bytes([answer[2 + 2 * nth], answer[3 + 2 * nth]]);
    let arm = cell.controller.registers().arm();
    assert!((300..1_000).contains(&register(0)), "joint 1 at {} mrad", register(0));
    assert!((500..=1_000).contains(&register(7)), "joint 1 at {} mrad/s", register(7));
    for nth in 0..6 {
        assert_eq!(register(7 + nth), (arm.velocity[nth] * 1e3).round() as i16);
        assert_eq!(register(14 + nth), (arm.pose[nth] * 1e4).round() as i16);
        assert_eq!(register(20 + nth), (arm.tcp_velocity[nth] * 1e4).round() as i16);
    }
    assert!(register(20).abs() + register(21).abs() > 1_000, "the TCP moves sideways");
}

#[test]
fn requests_come_in_any_pieces_and_several_at_once() {
    let request = [0, 1, 0, 0, 0, 6, 255, 3, 0, 0, 0, 4];
    let answer = [0, 1, 0, 0, 0, 11, 255, 3, 8, 0, 2, 0, 6, 0, 0, 0, 5];
    for cut in 0..request.len() {
        let mut cell = robot(&SimConfig::default());
        let c = cell.modbus_client();
        cell.input(ControllerInput::ModbusBytes { conn: c, bytes: &request[..cut] });
        assert_eq!(cell.take(c), b"", "cut at {cut}");
        cell.input(ControllerInput::ModbusBytes { conn: c, bytes: &request[cut..] });
        assert_eq!(cell.take(c), answer, "cut at {cut}");
        let both = [request, request].concat();
        cell.input(ControllerInput::ModbusBytes { conn: c, bytes: &both });
        assert_eq!(cell.take(c), [answer, answer].concat());
    }
    let mut cell = robot(&SimConfig::default());
    let c = cell.modbus_client();
    cell.input(ControllerInput::ModbusBytes { conn: c, bytes: &[0, 1, 0, 7, 0, 6, 1, 3, 0, 0, 0, 1] });
    assert_eq!(cell.closed, [c], "not Modbus");
    assert_eq!(cell.controller.counters().modbus.violations, 1);
    cell.input(ControllerInput::ModbusBytes { conn: c, bytes: &request });
    assert_eq!(cell.take(c), b"");
}

#[test]
fn a_later_dialect_keeps_the_mode_in_the_units_digit() {
    let mut cell = robot(&with_dialect(SimConfig::default(), "v2.6"));
    let c = cell.modbus_client();
    assert_eq!(cell.modbus(c, &[3, 0, 0, 0, 1]), [3, 2, 0, 2]);
}

#[test]
fn registers_that_were_read_again_and_again_follow_the_arm() {
    let config = r#"
[robot]
power = "enabled"
[[program]]
name = "work.jspf"
script = "movej([1.0, 0, 0, 0, 0, 0], 1.0);"
"#;
    let mut cell = TestController::from_toml(config).unwrap();
    let (c, m) = (cell.command_client(), cell.modbus_client());
    // The joints' velocities; the controller keeps what is often read.
    let read = |cell: &mut TestController| {
        let answers: Vec<_> = (0..6).map(|_| cell.modbus(m, &[3, 0, 99, 0, 7])).collect();
        assert!(answers.iter().all(|answer| *answer == answers[0]), "{answers:?}");
        answers[0].clone()
    };
    let at_rest = read(&mut cell);
    assert_eq!(at_rest[2..], [0; 14]);
    cell.order(c, "run(\"work.jspf\")");
    let mut moved = 0;
    while cell.controller.program_name().is_some() {
        cell.run_ms(4);
        moved += usize::from(read(&mut cell) != at_rest);
    }
    assert!(moved > 100, "{moved} cycles");
    cell.run_ms(100);
    assert_eq!(read(&mut cell), at_rest);
}

#[test]
fn a_written_coil_has_its_function_at_once_however_quiet_it_was() {
    let config = r#"
[robot]
power = "enabled"
[functions]
start = "work.jspf"
inputs = { "BitInputReg[1].0" = "start" }
[[program]]
name = "work.jspf"
script = "loop { wait_ms(10); }"
"#;
    let mut cell = TestController::from_toml(config).unwrap();
    let m = cell.modbus_client();
    for _ in 0..6 {
        cell.modbus(m, &[3, 0, 0, 0, 118]);
    }
    assert_eq!(cell.controller.program_name(), None);
    cell.modbus(m, &[5, 0, 0, 0xFF, 0]);
    assert_eq!(cell.controller.program_name(), Some("work.jspf"), "no time has passed");
}
