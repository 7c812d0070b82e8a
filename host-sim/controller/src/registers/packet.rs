//! The registers in the state packet of port 2001 (proto-core/docs/wire/state.md section 2).

use std::ops::Range;
use std::sync::LazyLock;

use proto_core::modbus::map::unscaled;
use proto_core::sysvar::SysVar;
use proto_core::wire::scalar::ScalarError;
use proto_core::wire::state::{LEN, StatePacket};

use super::bank::{COUNTS_PER_MA, COUNTS_PER_V};
use super::{PLACES, PacketItem, Registers};
use crate::motion::{Loads, Payload};

impl Registers {
    /// The state packet of 1468 bytes. `global_speed` is the offset of the global speed, if the dialect has one.
    pub fn packet(&self, global_speed: Option<u16>) -> Box<[u8; LEN]> {
        let (arm, target, status) = (&self.arm, &self.target, &self.status);
        let loads = self.loads();
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
            theoretical_flange_force: loads.flange.map(|item| item as f32),
            base_force: self.vector(PLACES.force_base),
            theoretical_base_force: loads.base.map(|item| item as f32),
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
        // Cannot fail: the buffer has a packet's length.
        let _ = packet.encode(&mut bytes[..]);
        self.put_variables(&mut bytes);
        if let Some(place) = global_speed.and_then(|offset| bytes.get_mut(usize::from(offset))) {
            *place = status.speed_percent;
        }
        self.forced.put(&mut bytes);
        bytes
    }

    /// Loads of the arm and its payload in the present position and motion.
    fn loads(&self) -> Loads {
        let [mass_kg, centre_m @ ..] = self.payload();
        let [x, y, z, ..] = self.arm.tcp_acceleration.map(f64::from);
        let [q1, q2, q3, q4, q5, q6, _] = self.arm.position.map(f64::from);
        Loads::of(&[q1, q2, q3, q4, q5, q6], [x, y, z], &Payload { mass_kg, centre_m })
    }

    /// Shows this value in packets from now on, in place of the model's value.
    pub(crate) fn force_in_packet(&mut self, item: PacketItem, value: f64) -> Result<(), ScalarError> {
        self.forced.set(item, value)
    }

    /// Ends [`Self::force_in_packet`].
    pub(crate) fn release_in_packet(&mut self, item: PacketItem) {
        self.forced.release(item);
    }

    fn put_variables(&self, packet: &mut [u8; LEN]) {
        for PacketRange { image, packet: place } in SHOWN.iter() {
            let value = self.image.get(image.clone());
            let (Some(shown), Some(value)) = (packet.get_mut(place.clone()), value) else { continue };
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

/// The place of a variable.
struct PacketRange {
    image: Range<usize>,
    packet: Range<usize>,
}

/// The variables in the packet, looked up once.
static SHOWN: LazyLock<Vec<PacketRange>> = LazyLock::new(|| {
    let place = |var: SysVar| {
        let (shown, image) = (var.stream()?, var.image_offset());
        let offset = usize::from(shown.offset);
        Some(PacketRange {
            image: image..image + var.size(),
            packet: offset..offset + usize::from(shown.len),
        })
    };
    SysVar::all().filter_map(place).collect()
});

/// Status words of the servo drives as in CiA 402: operation enabled, switch on disabled.
const DRIVE_ENABLED: u32 = 0x0637;
const DRIVE_DISABLED: u32 = 0x0650;
