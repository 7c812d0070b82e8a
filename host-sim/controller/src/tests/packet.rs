//! What the state packet shows beside system variables, and what a test can set there.

use super::*;

fn next(cell: &mut TestController) -> proto_core::wire::state::StatePacket {
    cell.run_ms(100);
    cell.packets.last().unwrap().1
}

#[test]
fn theoretical_forces_are_those_of_weight_and_payload() {
    let payload = [("RobotState[26]", 2.0), ("RobotState[29]", 0.1)];
    let mut cell = robot(&with_initial(SimConfig::default(), &payload));
    cell.state_client();
    let packet = next(&mut cell);
    let force = packet.theoretical_flange_force;
    let size = force[..3].iter().map(|item| item * item).sum::<f32>().sqrt();
    assert!((size - 19.62).abs() < 1e-3 && force[3..].iter().any(|item| item.abs() > 0.5), "{force:?}");
    assert!((packet.theoretical_base_force[2] + 206.01).abs() < 1e-2, "{:?}", packet.theoretical_base_force);
    assert_eq!((packet.flange_force, packet.base_force), ([0.0; 6], [0.0; 6]), "no sensor has measured");
    let mut empty = robot(&SimConfig::default());
    empty.state_client();
    assert_eq!(next(&mut empty).theoretical_flange_force, [0.0; 6]);
}

#[test]
fn every_item_of_the_packet_can_be_set() {
    use proto_core::wire::state::{FIELDS, LEN};
    let mut cell = robot(&SimConfig::default());
    cell.run_ms(0);
    let before = cell.controller.registers().packet(None);
    for place in FIELDS {
        for nth in 1..=place.count {
            let name = match place.count {
                1 => place.name.to_owned(),
                _ => format!("{}[{nth}]", place.name),
            };
            let old = cell.value(&name);
            let new = if old == 1.0 { 0.0 } else { 1.0 };
            cell.controller.force_item(&name, new).unwrap();
            assert_eq!(cell.value(&name), new, "{name}");
        }
        let packet = cell.controller.registers().packet(None);
        let own = usize::from(place.offset)..usize::from(place.offset) + place.size();
        let status = usize::from(FIELDS.iter().find(|place| place.name == "drive_status").unwrap().offset);
        for at in (0..LEN).filter(|at| !own.contains(at) && !(status..status + 28).contains(at)) {
            assert_eq!(packet[at], before[at], "{} has changed byte {at}", place.name);
        }
        assert_ne!(packet[own.clone()], before[own.clone()], "{}", place.name);
        for nth in 1..=place.count {
            let name = format!("{}[{nth}]", place.name);
            cell.controller.release_item(&name).unwrap();
        }
        assert_eq!(cell.controller.registers().packet(None)[..], before[..], "{}", place.name);
    }
}

#[test]
fn drive_errors_and_frames_are_set_by_name() {
    let script = "log(get(\"drive_error[2]\")); log(get(\"work_object_frame[1]\"));";
    let mut cell = robot(&with_program(SimConfig::default(), "t", script));
    let c = cell.command_client();
    cell.state_client();
    assert_eq!(next(&mut cell).drive_error, [0; 7]);
    cell.set_value("drive_error[2]", f64::from(0x7305));
    cell.set_value("work_object_frame[1]", 0.25);
    cell.set_value("collision", 1.0);
    cell.set_value("collision_axis", 14.0);
    let packet = next(&mut cell);
    assert_eq!(packet.drive_error, [0, 0x7305, 0, 0, 0, 0, 0]);
    assert_eq!(packet.drive_status, [0x0637, 0x0618, 0x0637, 0x0637, 0x0637, 0x0637, 0x0637]);
    assert_eq!(packet.work_object_frame, [0.25, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!((packet.collision, packet.collision_axis, packet.safety_state), (1, 14, 5));
    cell.ask(c, "run(t)");
    cell.run_ms(10);
    assert_eq!(cell.controller.program_log().collect::<Vec<_>>(), ["29445", "0.25"]);
    // A code that no version has.
    cell.set_value("safety_state", 77.0);
    assert_eq!(next(&mut cell).safety_state, 77);
    assert_eq!(cell.ask(c, "state"), "6:0:5:2", "only the packet shows it");
    cell.controller.release_item("safety_state").unwrap();
    cell.controller.release_item("drive_error[2]").unwrap();
    let packet = next(&mut cell);
    assert_eq!((packet.safety_state, packet.drive_error, packet.drive_status), (5, [0; 7], [0x0637; 7]));
    // A restart ends the rest.
    cell.controller.restart(cell.now);
    assert_eq!(cell.value("work_object_frame[1]"), 0.0);

    let error = |cell: &mut TestController, name: &str, value: f64| {
        cell.controller.force_item(name, value).unwrap_err().to_string()
    };
    assert_eq!(
        error(&mut cell, "drive_error[2]", 0.5),
        "drive_error[2]: 0.5 is not an integer, but a dword must be"
    );
    assert_eq!(error(&mut cell, "collision", 256.0), "collision: 256 does not fit in a byte (0..=255)");
    assert_eq!(error(&mut cell, "DI[1]", 2.0), "DI[1]: cannot be 2");
    assert_eq!(error(&mut cell, "DI[17]", 1.0), "DI[17]: there is only DI[1..16]");
    for wrong in ["drive_error[8]", "drive_error", "drive_error[0]", "nothing"] {
        assert!(
            error(&mut cell, wrong, 1.0).ends_with("and items of the state packet, such as drive_error[1]")
        );
        assert!(cell.controller.release_item(wrong).is_err());
        assert!(cell.controller.item(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn a_test_reads_items_of_every_kind() {
    let mut cell = robot(&with_initial(SimConfig::default(), &[("DI[3]", 1.0), ("AI_V[1]", 2.5)]));
    cell.run_ms(0);
    let values = [
        "DI[3]",
        "AI_V[1]",
        "enabled",
        "running",
        "robot_state",
        "digital_inputs[3]",
        "drive_status[7]",
        "speed",
    ];
    assert_eq!(values.map(|name| cell.value(name)), [1.0, 2.5, 1.0, 0.0, 6.0, 1.0, f64::from(0x0637), 100.0]);
}
