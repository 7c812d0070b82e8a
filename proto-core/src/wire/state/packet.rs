//! The table of the packet's fields (docs/wire/state.md section 2), and the plain value.

use super::view::{LEN, StateError, StateView};
use crate::wire::scalar::ScalarType;

/// The kind of a field's content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Content {
    /// Quantities, registers or codes.
    Values,
    /// Bools, one byte each; the first `real` of them exist, the others are reserved.
    Bools {
        /// Number of bools that exist.
        real: u8,
    },
    /// Reserved; passed through as received.
    Reserved,
}

/// One row of the packet's table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FieldPlace {
    /// The field's name in [`StatePacket`].
    pub name: &'static str,
    /// Offset of the first item.
    pub offset: u16,
    /// Type of an item.
    pub ty: ScalarType,
    /// Number of items.
    pub count: u16,
    /// Kind of the items.
    pub content: Content,
}

impl FieldPlace {
    /// Size of the field in bytes.
    pub const fn size(&self) -> usize {
        (self.count as usize).saturating_mul(self.ty.size())
    }
}

/// An item's type: its scalar type and its little-endian bytes (D1).
trait StateItem: Copy {
    const TYPE: ScalarType;
    const ZERO: Self;
    fn read_all(items: &mut [Self], bytes: &[u8]);
    fn write_all(items: &[Self], out: &mut [u8]);
}

macro_rules! item {
    ($ty:ident, $scalar:ident, $size:literal) => {
        impl StateItem for $ty {
            const TYPE: ScalarType = ScalarType::$scalar;
            const ZERO: Self = 0 as Self;

            fn read_all(items: &mut [Self], bytes: &[u8]) {
                for (item, bytes) in items.iter_mut().zip(bytes.as_chunks::<$size>().0) {
                    *item = Self::from_le_bytes(*bytes);
                }
            }

            fn write_all(items: &[Self], out: &mut [u8]) {
                for (item, bytes) in items.iter().zip(out.as_chunks_mut::<$size>().0) {
                    *bytes = item.to_le_bytes();
                }
            }
        }
    };
}

item!(u8, Byte, 1);
item!(u16, Word, 2);
item!(u32, Dword, 4);
item!(f32, Float, 4);

/// A field's type: one item, or an array of them.
trait StateField: Sized {
    const TYPE: ScalarType;
    const COUNT: u16;
    const ZERO: Self;
    fn fill(&mut self, bytes: &[u8]);
    fn write(&self, out: &mut [u8]);
}

impl<T: StateItem> StateField for T {
    const TYPE: ScalarType = T::TYPE;
    const COUNT: u16 = 1;
    const ZERO: Self = T::ZERO;

    fn fill(&mut self, bytes: &[u8]) {
        T::read_all(core::slice::from_mut(self), bytes);
    }

    fn write(&self, out: &mut [u8]) {
        T::write_all(&[*self], out);
    }
}

impl<T: StateItem, const N: usize> StateField for [T; N] {
    const TYPE: ScalarType = T::TYPE;
    const COUNT: u16 = N as u16;
    const ZERO: Self = [T::ZERO; N];

    fn fill(&mut self, bytes: &[u8]) {
        T::read_all(self, bytes);
    }

    fn write(&self, out: &mut [u8]) {
        T::write_all(self, out);
    }
}

/// Generates the table, the value with its decoding and encoding, and the view's accessors from the rows.
macro_rules! packet {
    ($($(#[$doc:meta])* $offset:literal: $name:ident: $ty:ty = $content:expr;)*) => {
        /// Every field of the packet, in order.
        pub const FIELDS: &[FieldPlace] = &[
            $(FieldPlace {
                name: stringify!($name),
                offset: $offset,
                ty: <$ty as StateField>::TYPE,
                count: <$ty as StateField>::COUNT,
                content: $content,
            },)*
        ];

        /// One packet as a plain value. It includes reserved items, so decoding and encoding keep every packet
        /// unchanged.
        ///
        /// Bools are bytes, 0 or 1. The codes of the four state machines are numbers; see [`StateView::states`] and
        /// [`Dialect`](crate::wire::dialect::Dialect).
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct StatePacket {
            $($(#[$doc])* pub $name: $ty,)*
        }

        impl StatePacket {
            /// All zero.
            pub const ZERO: Self = Self { $($name: <$ty as StateField>::ZERO,)* };

            pub(super) fn fill(&mut self, bytes: &[u8; LEN]) {
                $(self.$name.fill(bytes.get($offset..).unwrap_or(&[]));)*
            }

            pub(super) fn write(&self, out: &mut [u8; LEN]) {
                $(self.$name.write(out.get_mut($offset..).unwrap_or(&mut []));)*
            }
        }

        impl StateView<'_> {
            $(
                $(#[$doc])*
                pub fn $name(&self) -> $ty {
                    let mut field = <$ty as StateField>::ZERO;
                    field.fill(self.as_bytes().get($offset..).unwrap_or(&[]));
                    field
                }
            )*
        }
    };
}

use Content::{Bools, Reserved, Values};

packet! {
    /// Joint position, actual, rad; the 7th of every joint field is reserved.
    0: joint_position: [f32; 7] = Values;
    /// Joint velocity, actual, rad/s.
    28: joint_velocity: [f32; 7] = Values;
    /// Joint acceleration, actual, rad/s².
    56: joint_acceleration: [f32; 7] = Values;
    /// Joint torque, actual, Nm.
    84: joint_torque: [f32; 7] = Values;
    /// Joint position, target, rad.
    112: target_joint_position: [f32; 7] = Values;
    /// Joint velocity, target, rad/s.
    140: target_joint_velocity: [f32; 7] = Values;
    /// Joint acceleration, target, rad/s².
    168: target_joint_acceleration: [f32; 7] = Values;
    /// Joint torque, target, Nm.
    196: target_joint_torque: [f32; 7] = Values;
    /// Joint temperature; its data is reserved.
    224: joint_temperature: [f32; 7] = Values;
    /// Joint current, per mille of the rated current.
    252: joint_current: [f32; 7] = Values;
    /// Servo drives' error ids.
    280: drive_error: [u32; 7] = Values;
    /// Servo drives' status words.
    308: drive_status: [u32; 7] = Values;
    /// Reserved.
    336: reserved_336: [u8; 32] = Reserved;
    /// TCP pose in the base frame, actual: X, Y, Z in m, Rx, Ry, Rz in rad.
    368: tcp_pose: [f32; 6] = Values;
    /// TCP velocity, actual, m/s and rad/s.
    392: tcp_velocity: [f32; 6] = Values;
    /// TCP acceleration, actual, m/s² and rad/s².
    416: tcp_acceleration: [f32; 6] = Values;
    /// Force on the flange, actual, N and Nm.
    440: flange_force: [f32; 6] = Values;
    /// TCP pose, target.
    464: target_tcp_pose: [f32; 6] = Values;
    /// TCP velocity, target.
    488: target_tcp_velocity: [f32; 6] = Values;
    /// TCP acceleration, target.
    512: target_tcp_acceleration: [f32; 6] = Values;
    /// Force on the flange, theoretical.
    536: theoretical_flange_force: [f32; 6] = Values;
    /// Force on the base in the base frame, actual.
    560: base_force: [f32; 6] = Values;
    /// Force on the base in the base frame, theoretical.
    584: theoretical_base_force: [f32; 6] = Values;
    /// Active tool frame, m and rad.
    608: tool_frame: [f32; 6] = Values;
    /// Active work-object frame without the tool's offset, m and rad.
    632: work_object_frame: [f32; 6] = Values;
    /// Reserved; the global speed in later controller versions (see [`StateView::global_speed`]).
    656: reserved_656: [u8; 64] = Reserved;
    /// Functional digital inputs 1..8.
    720: functional_inputs: [u8; 8] = Bools { real: 8 };
    /// Functional digital outputs 1..8.
    728: functional_outputs: [u8; 8] = Bools { real: 8 };
    /// Digital inputs 1..16.
    736: digital_inputs: [u8; 16] = Bools { real: 16 };
    /// Digital outputs 1..16.
    752: digital_outputs: [u8; 16] = Bools { real: 16 };
    /// Analog inputs: four currents, then four voltages.
    768: analog_inputs: [f32; 8] = Values;
    /// Analog outputs; their data is reserved.
    800: analog_outputs: [f32; 8] = Values;
    /// Float registers, input.
    832: float_inputs: [f32; 32] = Values;
    /// Float registers, output.
    960: float_outputs: [f32; 32] = Values;
    /// Functional bool registers, input.
    1088: functional_bool_inputs: [u8; 16] = Bools { real: 16 };
    /// Functional bool registers, output.
    1104: functional_bool_outputs: [u8; 16] = Bools { real: 16 };
    /// Bool registers, input.
    1120: bool_inputs: [u8; 64] = Bools { real: 64 };
    /// Bool registers, output.
    1184: bool_outputs: [u8; 64] = Bools { real: 64 };
    /// Word registers, input.
    1248: word_inputs: [u16; 32] = Values;
    /// Word registers, output.
    1312: word_outputs: [u16; 32] = Values;
    /// Reserved.
    1376: reserved_1376: [u8; 32] = Reserved;
    /// Tool digital inputs; two are real.
    1408: tool_inputs: [u8; 8] = Bools { real: 2 };
    /// Tool digital outputs; two are real.
    1416: tool_outputs: [u8; 8] = Bools { real: 2 };
    /// Tool analog inputs, 0..=10 V.
    1424: tool_analog_inputs: [f32; 2] = Values;
    /// Tool analog outputs; their data is reserved.
    1432: tool_analog_outputs: [f32; 2] = Values;
    /// Tool buttons S and T.
    1440: tool_buttons: [u8; 2] = Bools { real: 2 };
    /// Reserved.
    1442: reserved_1442: [u8; 6] = Reserved;
    /// Operation mode.
    1448: operation_mode: u8 = Values;
    /// Robot state.
    1449: robot_state: u8 = Values;
    /// Program state.
    1450: program_state: u8 = Values;
    /// Safety state.
    1451: safety_state: u8 = Values;
    /// 1: a collision was detected.
    1452: collision: u8 = Values;
    /// Where the collision was: 1..=6 joint; 11..=16 base sensor X, Y, Z, Rx, Ry, Rz; 20 end sensor.
    1453: collision_axis: u8 = Values;
    /// Reserved.
    1454: reserved_1454: [u8; 2] = Reserved;
    /// The robot's newest error code.
    1456: error_code: u32 = Values;
    /// Reserved.
    1460: reserved_1460: [u8; 8] = Reserved;
}

impl StateView<'_> {
    /// The packet as a plain value.
    pub fn to_packet(&self) -> StatePacket {
        let mut packet = StatePacket::ZERO;
        packet.fill(self.as_bytes());
        packet
    }

    /// Like [`Self::to_packet`], but decodes into an existing packet, to avoid a second packet on the stack.
    pub fn read_into(&self, packet: &mut StatePacket) {
        packet.fill(self.as_bytes());
    }
}

impl StatePacket {
    /// Decodes one packet.
    ///
    /// # Errors
    /// [`StateError`] if `bytes` does not have the length of a packet. The content is not checked; see
    /// [`StateView::check_alignment`].
    pub fn parse(bytes: &[u8]) -> Result<Self, StateError> {
        Ok(StateView::new(bytes)?.to_packet())
    }

    /// Writes the packet to the front of `out` and returns its length.
    ///
    /// # Errors
    /// [`StateError`], with nothing written, when `out` is too short.
    pub fn encode(&self, out: &mut [u8]) -> Result<usize, StateError> {
        let available = out.len();
        let target =
            out.first_chunk_mut().ok_or(StateError::WrongLength { expected: LEN, actual: available })?;
        self.write(target);
        Ok(LEN)
    }

    /// Encodes the packet.
    pub fn to_bytes(&self) -> [u8; LEN] {
        let mut bytes = [0; LEN];
        self.write(&mut bytes);
        bytes
    }
}

impl Default for StatePacket {
    fn default() -> Self {
        Self::ZERO
    }
}
