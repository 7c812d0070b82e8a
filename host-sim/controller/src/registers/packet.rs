//! The registers in the state packet of port 2001 (proto-core/docs/wire/state.md section 2).

use proto_core::modbus::map::unscaled;
use proto_core::sysvar::SysVar;
use proto_core::wire::state::{LEN, StatePacket};

use super::bank::{COUNTS_PER_MA, COUNTS_PER_V};
use super::{PLACES, Registers};

impl Registers {
    /// The state packet of 1468 bytes. `global_speed` is the offset of the global speed, if the dialect has
    /// one.
    pub fn packet(&self, global_speed: Option<u16>) -> Box<[u8; LEN]> {
        let (arm, target, status) = (&self.arm, &self.target, &self.status);
        let mut packet = StatePacket {
            joint_position: arm.position,
            joint_velocity: arm.velocity,
            joint_acceleration: arm.acceleration,
            joint_torque: arm.torque,
            joint_temperature: arm.temperature,
            joint_current: arm.current,
            target_joint_position: target.position,
            target_joint_velocity: target.velocity,
            target_joint_acceleration: target.acceleration,
            target_joint_torque: target.torque,
            drive_status: [if status.drives_on { DRIVE_ENABLED } else { DRIVE_DISABLED }; 7],
            tcp_velocity: arm.tcp_velocity,
            tcp_acceleration: arm.tcp_acceleration,
            target_tcp_pose: target.pose,
            target_tcp_velocity: target.tcp_velocity,
            target_tcp_acceleration: target.tcp_acceleration,
            base_force: self.vector(PLACES.force_base),
            analog_inputs: self.analog_in,
            tool_analog_inputs: self.tool_in,
            tool_analog_outputs: self.tool_out.map(|counts| unscaled(counts, COUNTS_PER_V)),
            tool_buttons: [self.buttons & 1, self.buttons >> 1 & 1],
            operation_mode: status.mode,
            robot_state: status.robot,
            program_state: status.program,
            safety_state: status.safety,
            collision: u8::from(status.collision_axis.is_some()),
            collision_axis: status.collision_axis.unwrap_or(0),
            error_code: status.error,
            ..StatePacket::ZERO
        };
        for (nth, (value, counts)) in packet.analog_outputs.iter_mut().zip(self.analog_out).enumerate() {
            *value = unscaled(counts, if nth < 4 { COUNTS_PER_MA } else { COUNTS_PER_V });
        }
        let mut bytes = Box::new([0; LEN]);
        // It cannot fail: the buffer has a packet's length.
        let _ = packet.encode(&mut bytes[..]);
        self.put_variables(&mut bytes);
        if let Some(place) = global_speed.and_then(|offset| bytes.get_mut(usize::from(offset))) {
            *place = status.speed_percent;
        }
        bytes
    }

    /// Writes every system variable that is in the packet.
    fn put_variables(&self, packet: &mut [u8; LEN]) {
        for var in SysVar::all() {
            let Some(place) = var.stream() else { continue };
            let (offset, len) = (usize::from(place.offset), usize::from(place.len));
            let value = self.image.get(var.image_offset()..).and_then(|bytes| bytes.get(..var.size()));
            let (Some(shown), Some(value)) = (packet.get_mut(offset..offset + len), value) else { continue };
            match value {
                [bits] => {
                    for (nth, byte) in shown.iter_mut().enumerate() {
                        *byte = bits >> nth & 1;
                    }
                }
                value => shown.copy_from_slice(value),
            }
        }
    }
}

/// Status words of the servo drives as in CiA 402: operation enabled, switch on disabled.
const DRIVE_ENABLED: u32 = 0x0637;
const DRIVE_DISABLED: u32 = 0x0650;
