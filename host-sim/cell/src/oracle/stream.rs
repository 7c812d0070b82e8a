//! The packets in the state stream (proto-core/docs/wire/state.md section 3, D8), checked by their decoded fields.

use proto_core::wire::state::StatePacket;

/// The packets of one connection.
#[derive(Debug, Clone, Default)]
pub(super) struct Stream {
    /// The newest packet, and the newest one from a controller that has started.
    newest: Option<StatePacket>,
    started: Option<StatePacket>,
    wrong_in_a_row: u32,
}

impl Stream {
    /// Whether these bytes are the next packet. After three misaligned packets in a row, no bytes are.
    pub(super) fn takes(&mut self, bytes: &[u8]) -> bool {
        let Ok(packet) = StatePacket::parse(bytes) else { return false };
        if self.wrong_in_a_row >= 3 || !is_packet(&packet) || self.is_elsewhere(&packet) {
            self.wrong_in_a_row += 1;
            return false;
        }
        self.wrong_in_a_row = 0;
        if is_started(&packet) {
            self.started = Some(packet);
        }
        self.newest = Some(packet);
        true
    }

    /// Whether the codes differ and the arm is more than 0.5 rad or m from its previous position.
    fn is_elsewhere(&self, packet: &StatePacket) -> bool {
        let (Some(started), Some(newest)) = (&self.started, &self.newest) else { return false };
        let tcp = if is_started(packet) { 0 } else { 3 };
        let before = newest.joint_position[..6].iter().chain(&newest.tcp_pose[..tcp]);
        let now = packet.joint_position[..6].iter().chain(&packet.tcp_pose[..tcp]);
        let is_far =
            |(before, now): (&f32, &f32)| before.is_finite() && now.is_finite() && (before - now).abs() > 0.5;
        codes(started) != codes(packet) && before.zip(now).any(is_far)
    }
}

fn codes(packet: &StatePacket) -> [u8; 4] {
    [packet.operation_mode, packet.robot_state, packet.program_state, packet.safety_state]
}

fn is_started(packet: &StatePacket) -> bool {
    let unknown = [
        packet.operation_mode > 2,
        packet.robot_state > 7,
        packet.program_state > 5,
        packet.safety_state > 15 && packet.safety_state != 99,
    ];
    let unknown = unknown.into_iter().filter(|unknown| *unknown).count();
    packet.robot_state != 0 && packet.safety_state != 0 && packet.safety_state != 1 && unknown < 2
}

fn is_packet(packet: &StatePacket) -> bool {
    let is_within = |value: f32, most: f32| value.is_finite() && value.abs() <= most;
    let joints = packet.joint_position[..6].iter().filter(|joint| !is_within(**joint, 1_000.0)).count();
    let bools = [
        &packet.functional_inputs[..],
        &packet.functional_outputs,
        &packet.digital_inputs,
        &packet.digital_outputs,
        &packet.functional_bool_inputs,
        &packet.functional_bool_outputs,
        &packet.bool_inputs,
        &packet.bool_outputs,
        &packet.tool_inputs[..2],
        &packet.tool_outputs[..2],
        &packet.tool_buttons,
    ];
    let bools = bools.into_iter().flatten().filter(|bool| **bool > 1).count();
    joints < 3 && bools <= 8 && (is_started(packet) || strange(packet) < 3)
}

/// Number of quantities that are not finite, too large for their unit, or tiny.
fn strange(packet: &StatePacket) -> usize {
    let joints = [
        (packet.joint_position, 1_000.0),
        (packet.target_joint_position, 1_000.0),
        (packet.joint_velocity, 20.0),
        (packet.target_joint_velocity, 20.0),
        (packet.joint_acceleration, 2_000.0),
        (packet.target_joint_acceleration, 2_000.0),
        (packet.joint_torque, 2_000.0),
        (packet.target_joint_torque, 2_000.0),
        (packet.joint_current, 20_000.0),
    ];
    let tcp = [
        (packet.tcp_pose, 20.0),
        (packet.target_tcp_pose, 20.0),
        (packet.tcp_velocity, 20.0),
        (packet.target_tcp_velocity, 20.0),
        (packet.tcp_acceleration, 2_000.0),
        (packet.target_tcp_acceleration, 2_000.0),
        (packet.tool_frame, 20.0),
        (packet.work_object_frame, 20.0),
    ];
    let joints =
        joints.into_iter().flat_map(|(values, most)| values.into_iter().take(6).map(move |v| (v, most)));
    let tcp = tcp.into_iter().flat_map(|(values, most)| values.into_iter().map(move |v| (v, most)));
    let analog = packet.analog_inputs.into_iter().map(|value| (value, 100.0));
    let is_strange = |(value, most): &(f32, f32)| {
        let size = value.abs();
        !value.is_finite() || size > *most || size > 0.0 && size < 2_f32.powi(-119)
    };
    joints.chain(tcp).chain(analog).filter(is_strange).count()
}

#[cfg(test)]
mod tests {
    use proto_core::wire::state::{LEN, StateStream};

    use super::*;

    /// Compares the engine's check with this one, for a packet rotated by every number of bytes, unchanged and with
    /// implausible items.
    #[test]
    fn both_readings_agree() {
        let mut packet = StatePacket { robot_state: 6, safety_state: 5, ..StatePacket::ZERO };
        packet.joint_position = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1, 0.0];
        packet.target_joint_position = packet.joint_position;
        packet.joint_torque = [0.3, 41.2, 17.9, 1.1, -0.2, 0.0, 0.0];
        packet.drive_status = [0x0637; 7];
        packet.tcp_pose = [0.41, -0.2, 0.63, 3.1, 0.02, -1.57];
        let mut kinds = [0; 2];
        for (from, to) in [(0, 0), (0, 12), (368, 380), (420, 428), (720, 729), (1449, 1452)] {
            let mut right = packet.to_bytes();
            let mut changed = right;
            changed[from..to].fill(0xFF);
            for turned in 0..LEN {
                let (mut engine, mut model) = (StateStream::new(), Stream::default());
                right[1450] = turned as u8 % 6;
                let shifted: Vec<u8> = changed[turned..].iter().chain(&changed[..turned]).copied().collect();
                for bytes in [&right[..], &shifted, &right, &shifted, &shifted, &shifted] {
                    let taken = engine.next_packet(&mut &bytes[..]).unwrap().is_ok();
                    assert_eq!(model.takes(bytes), taken, "{from}..{to} turned by {turned}");
                    kinds[usize::from(taken)] += 1;
                }
            }
        }
        assert!(kinds.into_iter().all(|count| count > 1_000), "{kinds:?}");
    }
}
