//! Port 2001.

use proto_core::wire::state::{LEN, StateView};

use super::*;

const MOVE: &str = "movej([1.0, -1.2, -1.0, 0.3, 0.9, -0.5], 1.0);";

#[test]
fn packets_come_on_a_fixed_grid_to_every_client() {
    let mut cell = robot(&SimConfig::default());
    cell.run_ms(350);
    assert_eq!(cell.packets, []);
    let first = cell.state_client();
    cell.run_ms(500);
    let times: Vec<_> = cell.packets.iter().map(|packet| packet.0.as_micros() / 1_000).collect();
    assert_eq!(times, [1_400, 1_500, 1_600, 1_700, 1_800]);
    assert_eq!(cell.controller.counters().missed_state_packets, 0, "nobody missed the earlier ones");
    // A late call sends one packet, counts the others and stays on the grid.
    cell.now += Duration::from_millis(260);
    cell.run_ms(90);
    let times: Vec<_> = cell.packets.iter().skip(5).map(|packet| packet.0.as_micros() / 1_000).collect();
    assert_eq!(times, [2_110, 2_200]);
    assert_eq!(cell.controller.counters().missed_state_packets, 2);
    cell.input(ControllerInput::StateClosed { conn: first });
    cell.packets.clear();
    cell.run_ms(300);
    assert_eq!(cell.packets, []);
}

#[test]
fn every_field_is_filled() {
    let values = [
        ("DI[3]", 1.0),
        ("DI[16]", 1.0),
        ("DO[9]", 1.0),
        ("FDI[1]", 1.0),
        ("FDO[8]", 1.0),
        ("ToolDI[2]", 1.0),
        ("ToolDO[1]", 1.0),
        ("ToolButton[2]", 1.0),
        ("AI_C[4]", 20.0),
        ("AI_V[1]", 5.0),
        ("ToolAI[1]", 7.5),
        ("FloatInputReg[32]", 1.25),
        ("FloatOutputReg[1]", -2.5),
        ("WordInputReg[32]", 65_535.0),
        ("WordOutputReg[1]", 7.0),
        ("BitInputReg[2]", 128.0),
        ("BitOutputReg[10]", 1.0),
        ("ForceBase[3]", -4.5),
        ("RobotState[22]", 0.1),
        ("RobotState[26]", 2.0),
    ];
    let config = with_program(with_initial(SimConfig::default(), &values), "m", MOVE);
    let mut cell = robot(&config);
    let (c, _) = (cell.command_client(), cell.state_client());
    cell.ask(c, "run(m)");
    cell.run_ms(1_000);
    let packet = cell.packets[8].1;
    let on = |bits: &[u8]| {
        bits.iter().enumerate().filter(|bit| *bit.1 == 1).map(|bit| bit.0 + 1).collect::<Vec<_>>()
    };
    assert_eq!(on(&packet.digital_inputs), [3, 16]);
    assert_eq!(on(&packet.digital_outputs), [9]);
    assert_eq!((on(&packet.functional_inputs), on(&packet.functional_outputs)), (vec![1], vec![8]));
    assert_eq!((on(&packet.tool_inputs), on(&packet.tool_outputs)), (vec![2], vec![1]));
    assert_eq!(packet.tool_buttons, [0, 1]);
    assert_eq!((packet.analog_inputs[3], packet.analog_inputs[4]), (20.0, 5.0));
    assert_eq!(packet.tool_analog_inputs, [7.5, 0.0]);
    assert_eq!((packet.float_inputs[31], packet.float_outputs[0]), (1.25, -2.5));
    assert_eq!((packet.word_inputs[31], packet.word_outputs[0]), (65_535, 7));
    assert_eq!((on(&packet.functional_bool_inputs), on(&packet.bool_outputs)), (vec![16], vec![57]));
    assert_eq!(packet.base_force[2], -4.5);
    assert_eq!(packet.tool_frame[2], 0.1);
    for (name, field) in [
        ("position", packet.joint_position),
        ("velocity", packet.joint_velocity),
        ("acceleration", packet.joint_acceleration),
        ("torque", packet.joint_torque),
        ("current", packet.joint_current),
        ("temperature", packet.joint_temperature),
        ("target position", packet.target_joint_position),
        ("target velocity", packet.target_joint_velocity),
        ("target acceleration", packet.target_joint_acceleration),
        ("target torque", packet.target_joint_torque),
    ] {
        assert!(field[..6].iter().all(|item| *item != 0.0 && item.is_finite()), "{name}: {field:?}");
        assert_eq!(field[6], 0.0, "{name}: the 7th is reserved");
    }
    for (name, field) in [
        ("pose", packet.tcp_pose),
        ("velocity", packet.tcp_velocity),
        ("acceleration", packet.tcp_acceleration),
        ("target pose", packet.target_tcp_pose),
        ("target velocity", packet.target_tcp_velocity),
        ("target acceleration", packet.target_tcp_acceleration),
    ] {
        assert!(field.iter().all(|item| *item != 0.0 && item.is_finite()), "TCP {name}: {field:?}");
    }
    assert_eq!(packet.drive_status, [0x0637; 7]);
    assert_eq!(
        (packet.operation_mode, packet.robot_state, packet.program_state, packet.safety_state),
        (2, 6, 2, 5)
    );
    let mut bytes = [0xA5; LEN];
    packet.encode(&mut bytes).unwrap();
    assert_eq!(StateView::new(&bytes).unwrap().check_alignment(), Ok(()));
}

#[test]
fn the_arm_moves_smoothly_from_packet_to_packet() {
    let mut cell = robot(&with_program(SimConfig::default(), "m", MOVE));
    let (c, _) = (cell.command_client(), cell.state_client());
    cell.run_ms(200);
    cell.ask(c, "run(m)");
    cell.run_ms(4_000);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
    for pair in cell.packets.windows(2) {
        for joint in 0..6 {
            let moved = pair[1].1.joint_position[joint] - pair[0].1.joint_position[joint];
            assert!(moved.abs() <= 0.1001, "no joint is faster than 1 rad/s: {moved} in 100 ms");
        }
    }
    let last = cell.packets.last().unwrap().1;
    assert_eq!(last.joint_position[..6], [1.0, -1.2, -1.0, 0.3, 0.9, -0.5]);
    assert_eq!(last.joint_velocity, [0.0; 7]);
    assert_eq!(last.tcp_velocity, [0.0; 6]);
}
