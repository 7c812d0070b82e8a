//! The interface description, table by table: each of its rows on every interface that shows it.

use proto_core::sysvar::{Direction, ModbusPlace, SysVar};
use proto_core::wire::scalar::Scalar;
use proto_core::wire::state::OperationMode;

use super::*;

/// A value that no other variable has; bytes keep to their valid bits.
fn pattern(nth: usize, var: SysVar) -> Scalar {
    let value = match var.ty() {
        ScalarType::Byte => f64::from((nth as u8).wrapping_mul(37) & var.valid_bits()),
        ScalarType::Word => (1_000 + 13 * nth) as f64,
        _ => nth as f64 / 8.0 - 3.0,
    };
    Scalar::from_f64(var.ty(), value).unwrap()
}

fn names(direction: Direction) -> Vec<(SysVar, String)> {
    SysVar::all().filter(|var| var.direction() == direction).map(|var| (var, var.to_string())).collect()
}

/// The variable's value over Modbus, and what it should be there; `None` if it has no place.
fn over_modbus(cell: &mut TestController, conn: ConnId, var: SysVar, value: Scalar) -> Option<(u16, u16)> {
    let (pdu, expected) = match var.modbus()? {
        ModbusPlace::Coils { first, count } => {
            let Scalar::Byte(bits) = value else { return None };
            ([1, 0, first as u8, 0, count as u8], u16::from(bits))
        }
        ModbusPlace::Register { address } => {
            let Scalar::Word(word) = value else { return None };
            ([3, 0, address as u8, 0, 1], word)
        }
        ModbusPlace::Scaled { address, per_unit } => {
            let scaled = (value.as_f64() * f64::from(per_unit)).round() as i16;
            ([3, 0, address as u8, 0, 1], scaled as u16)
        }
    };
    let answer = cell.modbus(conn, &pdu);
    let shown = match answer[1] {
        1 => u16::from(answer[2]),
        _ => u16::from_be_bytes([answer[2], answer[3]]),
    };
    Some((shown, expected))
}

/// The variable's value in the newest state packet; `None` if it has no place.
fn in_packet(cell: &TestController, var: SysVar) -> Option<Scalar> {
    let place = var.stream()?;
    let packet = cell.controller.registers().packet(None);
    let bytes = &packet[usize::from(place.offset)..usize::from(place.offset + place.len)];
    Some(match var.ty() {
        ScalarType::Byte => {
            Scalar::Byte(bytes.iter().rev().fold(0, |bits, &bit| bits << 1 | bit) & var.valid_bits())
        }
        ty => Scalar::decode(ty, bytes)?,
    })
}

#[test]
fn every_system_input_of_a_recipe_reaches_its_interface() {
    let inputs = names(Direction::Input);
    assert_eq!(inputs.len(), 3 + 10 + 32 + 32 + 6 + 6);
    let all: Vec<&str> = inputs.iter().map(|(_, name)| name.as_str()).collect();
    let recipe = stream_recipe(Mode::Realtime, system(&all), system(&["RobotState[8]"]));
    let mut cell = robot(&one_port(rs485(), recipe));
    let mut frame = vec![0xFF, 0xFF];
    for (nth, &(var, _)) in inputs.iter().enumerate() {
        let mut bytes = [0; 8];
        let len = pattern(nth, var).encode(&mut bytes).unwrap();
        frame.extend(&bytes[..len]);
    }
    frame.extend([0xEE, 0xEE]);
    cell.port_bytes(0, &frame);
    cell.run_ms(10);
    let c = cell.modbus_client();
    let (mut coils, mut streamed) = (0, 0);
    for (nth, (var, name)) in inputs.iter().enumerate() {
        let value = pattern(nth, *var);
        assert_eq!(cell.value(name), value.as_f64(), "{name}");
        if let Some((shown, expected)) = over_modbus(&mut cell, c, *var, value) {
            assert_eq!(shown, expected, "{name} over Modbus");
            coils += 1;
        }
        if let Some(shown) = in_packet(&cell, *var) {
            assert_eq!(shown, value, "{name} in the stream");
            streamed += 1;
        }
    }
    assert_eq!((coils, streamed), (45, 77), "all that have a place there");
    // Outputs that are commanded are shown by their status; forces by flange and base.
    for (command, status) in [(1, 4), (2, 5), (3, 6)] {
        let shown = cell.value(&format!("DigitalSignalStatus[{status}]"));
        assert_eq!(shown, cell.value(&format!("DigitalOutputCommand[{command}]")));
    }
    for nth in 1..=6 {
        let base = cell.value(&format!("ForceBase[{nth}]"));
        assert_eq!(cell.value(&format!("base_force[{nth}]")), base);
        let flange = cell.value(&format!("RobotState[{}]", 13 + nth));
        assert_eq!(
            (cell.value(&format!("flange_force[{nth}]")), flange),
            (flange, cell.value(&format!("ForceEnd[{nth}]")))
        );
    }
}

#[test]
fn every_system_output_is_sent_by_a_recipe_as_other_interfaces_show_it() {
    let outputs = names(Direction::Output);
    assert_eq!(outputs.len(), 8 + 32 + 10 + 32 + 32);
    let all: Vec<&str> = outputs.iter().map(|(_, name)| name.as_str()).collect();
    let recipe = stream_recipe(Mode::Realtime, system(&["DigitalOutputCommand[1]"]), system(&all));
    let mut config = one_port(rs485(), recipe);
    for (nth, (var, name)) in outputs.iter().enumerate() {
        // The motion shows the arm's position.
        let follows = var.group() == "RobotState" && var.index() <= 13;
        let is_status = var.group() == "DigitalSignalStatus" && (4..=6).contains(&var.index());
        let value = pattern(nth, *var).as_f64();
        if is_status {
            config = with_initial(config, &[(&format!("DigitalOutputCommand[{}]", var.index() - 3), value)]);
        } else if !follows {
            config = with_initial(config, &[(name, value)]);
        }
    }
    let mut cell = robot(&config);
    cell.run_ms(8);
    let Out::Bytes(frame) = &cell.sent.last().unwrap().2 else { panic!() };
    let fields = frame[2..frame.len() - 2].to_vec();
    let c = cell.modbus_client();
    let mut rest = &fields[..];
    let (mut shown_elsewhere, mut nonzero) = (0, 0);
    for (var, name) in &outputs {
        let value = Scalar::decode(var.ty(), rest).unwrap();
        rest = &rest[var.ty().size()..];
        assert_eq!(value.as_f64(), cell.value(name), "{name}");
        nonzero += usize::from(value.as_f64() != 0.0);
        if let Some((shown, expected)) = over_modbus(&mut cell, c, *var, value) {
            assert_eq!(shown, expected, "{name} over Modbus");
            shown_elsewhere += 1;
        }
        if let Some(shown) = in_packet(&cell, *var) {
            assert_eq!(shown, value, "{name} in the stream");
            shown_elsewhere += 1;
        }
    }
    assert!(rest.is_empty() && nonzero > 90, "{nonzero}");
    assert_eq!(shown_elsewhere, 63 + 107, "Modbus and the stream");
}

#[test]
fn a_sensors_force_in_the_tcp_frame_is_shown_at_the_flange() {
    // 0.1 m in front of the flange, turned by a right angle about its axis.
    let tool = [("RobotState[22]", 0.1), ("RobotState[25]", std::f64::consts::FRAC_PI_2)];
    let recipe = stream_recipe(Mode::Realtime, system(&["ForceEnd[1..6]"]), system(&["RobotState[14..19]"]));
    let mut cell = robot(&with_initial(one_port(rs485(), recipe), &tool));
    let force: Vec<u8> = [10.0_f32, 0.0, 5.0, 0.0, 0.0, 2.0].into_iter().flat_map(f32::to_le_bytes).collect();
    cell.port_bytes(0, &[&[0xFF, 0xFF][..], &force, &[0xEE, 0xEE]].concat());
    let shown = |cell: &TestController| {
        [14, 15, 16, 17, 18, 19].map(|nth| (cell.value(&format!("RobotState[{nth}]")) * 1e4).round() / 1e4)
    };
    assert_eq!(shown(&cell), [0.0, 10.0, 5.0, -1.0, 0.0, 2.0]);
    cell.set_value("RobotState[22]", 0.2);
    assert_eq!(shown(&cell), [0.0, 10.0, 5.0, -2.0, 0.0, 2.0], "another tool");
}

#[test]
fn every_type_of_a_field_reaches_a_program_and_leaves_it() {
    use ScalarType::{Byte, Char, Double, Dword, Float, Int, Short, Word};
    let types = [Byte, Char, Word, Short, Dword, Int, Float, Double];
    let recipe = stream_recipe(Mode::User, user(&types), user(&types));
    let script = "let list1 = comm_recv(\"p\"); comm_send(\"p\", list1);";
    let mut cell = robot(&with_program(one_port(rs485(), recipe), "t", script));
    let c = cell.command_client();
    cell.ask(c, "run(t)");
    let payload = [
        &[200, 0xFE][..],
        &65_000_u16.to_le_bytes(),
        &(-300_i16).to_le_bytes(),
        &4_000_000_000_u32.to_le_bytes(),
        &(-70_000_i32).to_le_bytes(),
        &1.5_f32.to_le_bytes(),
        &(-0.1_f64).to_le_bytes(),
    ]
    .concat();
    cell.port_bytes(0, &[&[0xFF, 0xFF][..], &payload, &[0xEE, 0xEE]].concat());
    cell.run_ms(10);
    assert_eq!(
        cell.controller.program_variables()["list1"],
        serde_json::json!([200, -2, 65_000, -300, 4_000_000_000_u32, -70_000, 1.5, -0.1])
    );
    assert_eq!(cell.sent[0].2, Out::Bytes([&[0xFF, 0xFF][..], &payload, &[0xFE, 0xFE]].concat()));
}

#[test]
fn the_states_are_the_same_on_every_interface() {
    let config = with_program(with_power(SimConfig::default(), Power::Off), "t", "loop { wait_ms(10); }");
    let mut cell = robot(&config);
    let (c, d, m) = (cell.command_client(), cell.command_client(), cell.modbus_client());
    cell.state_client();
    let mut seen = Vec::new();
    let mut look = |cell: &mut TestController| {
        cell.run_ms(100);
        let reply = cell.ask(d, "state");
        let codes: Vec<u8> = reply.split(':').map(|code| code.parse().unwrap()).collect();
        let packet = cell.packets.last().unwrap().1;
        let streamed = [packet.robot_state, packet.program_state, packet.safety_state, packet.operation_mode];
        assert_eq!(codes, streamed, "state and stream");
        let answer = cell.modbus(m, &[3, 0, 0, 0, 8]);
        assert_eq!(answer[2..10], [0, codes[3], 0, codes[0], 0, codes[1], 0, codes[2]], "Modbus");
        assert_eq!(answer[10..], [0; 8], "registers 4 to 7 are reserved");
        seen.push(reply);
    };
    look(&mut cell);
    for command in ["poweron", "enable", "run(t)", "pause"] {
        cell.order(c, command);
        look(&mut cell);
    }
    cell.controller.enter_reduced(cell.now);
    look(&mut cell);
    cell.controller.delay_transitions(Duration::from_millis(500));
    for command in ["resume", "pause", "stop"] {
        cell.ask(c, command);
        look(&mut cell);
        cell.run_ms(1_000);
    }
    for mode in [OperationMode::Manual, OperationMode::Auto] {
        cell.controller.set_mode(mode);
        look(&mut cell);
    }
    assert_eq!(
        seen,
        [
            "4:0:4:2", "5:0:5:2", "6:0:5:2", "6:2:5:2", "6:3:5:2", "6:3:12:2", "6:2:12:2", "6:4:12:2",
            "6:1:12:2", "6:0:12:0", "6:0:12:1"
        ]
    );
}

#[test]
fn every_place_of_a_collision_is_shown() {
    for axis in (1..=6).chain(11..=16).chain([20]) {
        let mut cell = robot(&SimConfig::default());
        cell.state_client();
        cell.controller.collide(cell.now, axis);
        cell.run_ms(100);
        let packet = cell.packets[0].1;
        assert_eq!((packet.collision, packet.collision_axis, packet.safety_state), (1, axis, 7));
        cell.controller.clear_stop(cell.now);
        cell.run_ms(100);
        let packet = cell.packets[1].1;
        assert_eq!((packet.collision, packet.collision_axis), (0, 0));
    }
}
