//! All registers, inputs and outputs of the controller.
//!
//! In: values of recipe frames, Modbus writes and programs, and the states of the arm and the machine. Out:
//! the same values on port 2001, Modbus, recipe ports and in programs. Does not know connections or time.
//!
//! System variables are in one process image, as everywhere in `proto_core`; the few other items of the Modbus map are
//! stored separately. An output that can be commanded has two variables, such as `DigitalOutputCommand[1]` and
//! `DigitalSignalStatus[4]`: the second always follows the first.

mod bank;
mod forced;
mod functional;
mod packet;
mod shown;

use std::sync::LazyLock;

use proto_core::sysvar::{Direction, IMAGE_BYTES, SysVar, VarBit};
use proto_core::wire::scalar::Scalar;

use super::motion::{ArmState, Pose};
use forced::Forced;
pub(crate) use forced::PacketItem;
use functional::Functional;
use shown::ShownWords;

use recipe_config::{AnalogInput, BitGroup, InitialTarget};

/// The codes of the state machines.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MachineCodes {
    /// Operation mode, as in the state packet.
    pub mode: u8,
    /// Operation mode, as in holding register 0.
    pub mode_register: u16,
    /// Robot state.
    pub robot: u8,
    /// Program state.
    pub program: u8,
    /// Safety state.
    pub safety: u8,
    /// The axis of a present collision (proto-core/docs/wire/state.md section 2).
    pub collision_axis: Option<u8>,
    /// The newest error's code; 0: none.
    pub error: u32,
    /// Global speed, per cent.
    pub speed_percent: u8,
    /// Whether the servo drives hold the arm.
    pub drives_on: bool,
}

/// The registers, inputs and outputs.
#[derive(Debug, Clone)]
pub struct Registers {
    image: [u8; IMAGE_BYTES],
    /// Cabinet analog inputs: 4 currents in mA, 4 voltages in V.
    analog_in: [f32; 8],
    /// Cabinet analog outputs, in counts as Modbus writes them.
    analog_out: [u16; 8],
    /// Tool analog inputs, V.
    tool_in: [f32; 2],
    /// Tool analog outputs, in counts.
    tool_out: [u16; 2],
    /// Bit 0: S, bit 1: T.
    buttons: u8,
    arm: ArmState,
    target: ArmState,
    status: MachineCodes,
    functional: Functional,
    forced: Forced,
    shown: ShownWords,
}

/// Why an item was not set.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum SetError {
    /// Programs cannot write the item.
    ReadOnly(InitialTarget),
    /// The output shows a state of the controller.
    ShowsState(InitialTarget),
    /// The value is out of range.
    Value {
        /// The item.
        target: InitialTarget,
        /// The value.
        value: f64,
    },
}

impl std::fmt::Display for SetError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::ReadOnly(target) => write!(f, "a program cannot write {target}"),
            Self::ShowsState(target) => write!(f, "{target} shows a state; nothing else can write it"),
            Self::Value { target, value } => write!(f, "{target} cannot be {value}"),
        }
    }
}

impl std::error::Error for SetError {}

impl Default for Registers {
    fn default() -> Self {
        Self {
            image: [0; IMAGE_BYTES],
            analog_in: [0.0; 8],
            analog_out: [0; 8],
            tool_in: [0.0; 2],
            tool_out: [0; 2],
            buttons: 0,
            arm: ArmState::default(),
            target: ArmState::default(),
            status: MachineCodes::default(),
            functional: Functional::default(),
            forced: Forced::default(),
            shown: ShownWords::default(),
        }
    }
}

impl Registers {
    /// The process image.
    pub fn image(&self) -> &[u8; IMAGE_BYTES] {
        &self.image
    }

    /// Lets `write` change the image, then updates dependent variables.
    pub fn write_inputs<R>(&mut self, write: impl FnOnce(&mut [u8; IMAGE_BYTES]) -> R) -> R {
        let before = (self.vector(PLACES.force_end), self.vector(PLACES.tool));
        let inputs_before = self.functional_inputs();
        self.shown.forget();
        let result = write(&mut self.image);
        self.follow();
        self.note_edges(inputs_before);
        self.keep_shown();
        let force = self.vector(PLACES.force_end);
        if (force, self.vector(PLACES.tool)) != before {
            let tool = self.tool();
            self.set_vector(PLACES.flange_force, tool.wrench_in_parent(force.map(f64::from)));
        }
        result
    }

    /// The analog outputs of cabinet and tool, in counts.
    pub fn analog_outputs(&self) -> ([u16; 8], [u16; 2]) {
        (self.analog_out, self.tool_out)
    }

    /// A system variable's value.
    pub fn var(&self, var: SysVar) -> Scalar {
        let bytes = self.image.get(var.image_offset()..).unwrap_or(&[]);
        Scalar::decode(var.ty(), bytes).unwrap_or(Scalar::Byte(0))
    }

    /// The codes of the state machines.
    pub fn status(&self) -> &MachineCodes {
        &self.status
    }

    /// The arm's state.
    pub fn arm(&self) -> &ArmState {
        &self.arm
    }

    /// An item's value, in its unit; a bit is 0 or 1.
    pub fn value(&self, target: InitialTarget) -> f64 {
        match target {
            InitialTarget::Var(var) => self.var(var).as_f64(),
            InitialTarget::VarBit(VarBit { var, bit }) => {
                let byte = self.image.get(var.image_offset()).copied().unwrap_or(0);
                f64::from(byte.checked_shr(bit.into()).unwrap_or(0) & 1)
            }
            InitialTarget::Bit { group, index } => f64::from(self.bit(group, index) as u8),
            InitialTarget::Analog { group, index } => {
                let nth = usize::from(index.saturating_sub(1));
                let value = match group {
                    AnalogInput::CabinetCurrent => self.analog_in.get(nth.min(3)),
                    AnalogInput::CabinetVoltage => self.analog_in.get(nth.min(3) + 4),
                    AnalogInput::Tool => self.tool_in.get(nth),
                };
                value.copied().map_or(0.0, f64::from)
            }
        }
    }

    /// A bit's value.
    pub fn bit(&self, group: BitGroup, index: u8) -> bool {
        let nth = index.saturating_sub(1);
        let byte = match byte_of(group, nth) {
            Some(var) => self.image.get(var.image_offset()).copied().unwrap_or(0),
            None => self.buttons,
        };
        byte >> (nth % 8) & 1 == 1
    }

    /// Sets any item: for initial values, and for inputs that a test drives.
    ///
    /// Bits of a byte that show a state keep showing it.
    ///
    /// # Errors
    /// [`SetError::Value`] if the value is out of range, [`SetError::ShowsState`] if the item shows a state;
    /// nothing changed.
    pub fn force(&mut self, target: InitialTarget, value: f64) -> Result<(), SetError> {
        let wrong = SetError::Value { target, value };
        if self.shows_state(target) {
            return Err(SetError::ShowsState(target));
        }
        match target {
            InitialTarget::Var(var) => {
                let scalar = match Scalar::from_f64(var.ty(), value).map_err(|_| wrong.clone())? {
                    Scalar::Byte(bits) if bits & !var.valid_bits() != 0 => return Err(wrong),
                    scalar => scalar,
                };
                let offset = var.image_offset();
                // The status of an output follows its command, so the command is set.
                let offset = command_of(var).map_or(offset, SysVar::image_offset);
                self.write_inputs(|image| {
                    image.get_mut(offset..).and_then(|bytes| scalar.encode(bytes));
                });
            }
            InitialTarget::VarBit(bit) => {
                let mask = bit.mask().ok_or_else(|| wrong.clone())?;
                let on = match value {
                    0.0 => 0,
                    1.0 => mask,
                    _ => return Err(wrong),
                };
                // The status of an output follows its command, so the command is set.
                let offset = command_of(bit.var).unwrap_or(bit.var).image_offset();
                self.write_inputs(|image| {
                    if let Some(byte) = image.get_mut(offset) {
                        *byte = *byte & !mask | on;
                    }
                });
            }
            InitialTarget::Bit { group, index } => {
                let on = match value {
                    0.0 => false,
                    1.0 => true,
                    _ => return Err(wrong),
                };
                if index == 0 || index > group.count() {
                    return Err(wrong);
                }
                let nth = index - 1;
                match byte_of(group, nth) {
                    Some(var) => self.write_inputs(|image| {
                        if let Some(byte) = image.get_mut(var.image_offset()) {
                            set_bit(byte, nth % 8, on);
                        }
                    }),
                    None => self.set_button(nth, on),
                }
            }
            InitialTarget::Analog { group, index } => {
                self.shown.forget();
                let (low, high) = group.range();
                if index == 0 || index > group.count() || !(low..=high).contains(&value) {
                    return Err(wrong);
                }
                let nth = usize::from(index - 1);
                let slot = match group {
                    AnalogInput::CabinetCurrent => self.analog_in.get_mut(nth),
                    AnalogInput::CabinetVoltage => self.analog_in.get_mut(nth + 4),
                    AnalogInput::Tool => self.tool_in.get_mut(nth),
                };
                if let Some(slot) = slot {
                    *slot = value as f32;
                }
            }
        }
        Ok(())
    }

    /// Sets an item that programs can write: an output register or an output.
    ///
    /// # Errors
    /// [`SetError`]; nothing changed.
    pub fn set_by_program(&mut self, target: InitialTarget, value: f64) -> Result<(), SetError> {
        let writable = match target {
            InitialTarget::Var(var) | InitialTarget::VarBit(VarBit { var, .. }) => {
                command_of(var).is_some()
                    || matches!(
                        var.group(),
                        "DigitalOutputCommand" | "BitOutputReg" | "WordOutputReg" | "FloatOutputReg"
                    )
                    || (var.group() == "DigitalSignalStatus" && var.index() == 8)
            }
            InitialTarget::Bit { group, .. } => {
                matches!(group, BitGroup::Do | BitGroup::ToolDo | BitGroup::Fdo)
            }
            InitialTarget::Analog { .. } => false,
        };
        if writable { self.force(target, value) } else { Err(SetError::ReadOnly(target)) }
    }

    /// Sets all registers and outputs to 0.
    pub fn clear(&mut self) {
        self.write_inputs(|image| {
            for var in SysVar::all().filter(|&var| is_kept(var)) {
                let place = image.get_mut(var.image_offset()..).and_then(|bytes| bytes.get_mut(..var.size()));
                if let Some(bytes) = place {
                    bytes.fill(0);
                }
            }
        });
        self.analog_out = [0; 8];
        self.tool_out = [0; 2];
    }

    /// The tool's frame, from `RobotState[20..25]`.
    pub fn tool(&self) -> Pose {
        Pose::from_pose(&self.vector(PLACES.tool).map(f64::from))
    }

    /// The payload, from `RobotState[26]`, in kg.
    pub fn payload_kg(&self) -> f64 {
        self.payload()[0]
    }

    /// The payload's mass in kg and centre in m, from `RobotState[26..29]`.
    fn payload(&self) -> [f64; 4] {
        let [mass, x, y, z, ..] = self.vector(PLACES.payload).map(f64::from);
        [mass, x, y, z]
    }

    /// Sets the arm's state, actual and commanded.
    pub fn show_arm(&mut self, actual: ArmState, target: ArmState) {
        self.shown.forget();
        self.arm = actual;
        self.target = target;
        let shown = self.image.get_mut(PLACES.robot_state..).unwrap_or(&mut []);
        let values = actual.position.iter().chain(&actual.pose);
        for (place, value) in shown.as_chunks_mut::<4>().0.iter_mut().zip(values) {
            *place = value.to_le_bytes();
        }
    }

    /// Sets the codes of the state machines.
    pub fn show_status(&mut self, status: MachineCodes) {
        if status != self.status {
            self.shown.forget();
            self.status = status;
        }
    }

    /// Six consecutive float variables.
    fn vector(&self, offset: usize) -> [f32; 6] {
        let mut values = [0.0; 6];
        let bytes = self.image.get(offset..).unwrap_or(&[]);
        for (value, bytes) in values.iter_mut().zip(bytes.as_chunks::<4>().0) {
            *value = f32::from_le_bytes(*bytes);
        }
        values
    }

    fn set_vector(&mut self, offset: usize, values: [f64; 6]) {
        let bytes = self.image.get_mut(offset..).unwrap_or(&mut []);
        for (value, bytes) in values.iter().zip(bytes.as_chunks_mut::<4>().0) {
            *bytes = (*value as f32).to_le_bytes();
        }
    }

    /// Copies commands of outputs to their status.
    fn follow(&mut self) {
        for &(command, status, valid_bits) in &PLACES.commanded {
            let bits = self.image[command] & valid_bits;
            self.image[command] = bits;
            self.image[status] = bits;
        }
    }
}

/// Offsets in the image, looked up once.
struct ImageOffsets {
    /// Offsets of a command and of its status, and the valid bits.
    commanded: [(usize, usize, u8); 3],
    force_end: usize,
    force_base: usize,
    flange_force: usize,
    tool: usize,
    payload: usize,
    robot_state: usize,
    functional_inputs: [usize; functional::INPUTS.len()],
    functional_outputs: [usize; functional::OUTPUTS.len()],
}

static PLACES: LazyLock<ImageOffsets> = LazyLock::new(|| {
    let offset = |group, index| named(group, index).map_or(0, SysVar::image_offset);
    ImageOffsets {
        commanded: COMMANDED.map(|(command, status)| {
            let valid_bits = named("DigitalOutputCommand", command).map_or(0, SysVar::valid_bits);
            (offset("DigitalOutputCommand", command), offset("DigitalSignalStatus", status), valid_bits)
        }),
        force_end: offset("ForceEnd", 1),
        force_base: offset("ForceBase", 1),
        flange_force: offset("RobotState", 14),
        tool: offset("RobotState", 20),
        payload: offset("RobotState", 26),
        robot_state: offset("RobotState", 1),
        functional_inputs: functional::offsets(functional::INPUTS),
        functional_outputs: functional::offsets(functional::OUTPUTS),
    }
});

/// Whether the variable keeps a written value: it is neither measured nor an input.
fn is_kept(var: SysVar) -> bool {
    match var.group() {
        "RobotState" => false,
        "DigitalSignalStatus" => var.index() == 8,
        _ => true,
    }
}

/// The command of the output whose status is `var`; `None` if `var` is not a status.
fn command_of(var: SysVar) -> Option<SysVar> {
    if var.direction() == Direction::Input || var.group() != "DigitalSignalStatus" {
        return None;
    }
    let (command, _) = COMMANDED.iter().find(|pair| pair.1 == u32::from(var.index()))?;
    named("DigitalOutputCommand", *command)
}

/// The byte variable that holds bit `nth` (from 0) of the group; `None` for buttons.
fn byte_of(group: BitGroup, nth: u8) -> Option<SysVar> {
    group.var_bit(nth + 1).map(|bit| bit.var)
}

fn set_bit(byte: &mut u8, nth: u8, on: bool) {
    *byte = *byte & !(1 << nth) | u8::from(on) << nth;
}

fn named(group: &str, index: u32) -> Option<SysVar> {
    SysVar::named(group, index).ok()
}

/// The status of `DigitalOutputCommand[a]` is `DigitalSignalStatus[b]`.
const COMMANDED: [(u32, u32); 3] = [(1, 4), (2, 5), (3, 6)];
