//! Functional inputs and outputs among the registers: rising edges of inputs that can trigger a function, and bits that
//! show a state of the controller (D27).

use proto_core::sysvar::SysVar;
use recipe_config::InitialTarget;

use super::{PLACES, Registers, named, set_bit};

/// Edges and shown bits.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Functional {
    risen: Risen,
    /// For each byte of functional outputs, the bits that show a state, and their present values.
    shown: [(u8, u8); OUTPUTS.len()],
}

/// Inputs with a rising edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Risen {
    bytes: [u8; INPUTS.len()],
    buttons: u8,
}

impl Risen {
    pub(crate) fn has(&self, item: InitialTarget) -> bool {
        match (item.var_bit(), item) {
            (Some(bit), _) => {
                let place = INPUTS.iter().position(|&(group, index)| named(group, index) == Some(bit.var));
                place.is_some_and(|nth| self.bytes[nth] & bit.mask().unwrap_or(0) != 0)
            }
            (None, InitialTarget::Bit { index, .. }) => self.buttons >> index.saturating_sub(1) & 1 == 1,
            _ => false,
        }
    }
}

impl Registers {
    /// The inputs that have risen since the last call; `None` if none has.
    pub(crate) fn take_risen(&mut self) -> Option<Risen> {
        let risen = std::mem::take(&mut self.functional.risen);
        (risen != Risen::default()).then_some(risen)
    }

    /// Shows a state in this output from now on. Other writers cannot change the output then.
    pub(crate) fn show_state(&mut self, item: InitialTarget, on: bool) {
        let Some(bit) = item.var_bit() else { return };
        let place = OUTPUTS.iter().position(|&(group, index)| named(group, index) == Some(bit.var));
        if let Some((mask, bits)) = place.map(|nth| &mut self.functional.shown[nth]) {
            *mask |= bit.mask().unwrap_or(0);
            set_bit(bits, bit.bit, on);
        }
        self.keep_shown();
    }

    pub(super) fn shows_state(&self, item: InitialTarget) -> bool {
        let Some(bit) = item.var_bit() else { return false };
        let place = OUTPUTS.iter().position(|&(group, index)| named(group, index) == Some(bit.var));
        place.is_some_and(|nth| self.functional.shown[nth].0 & bit.mask().unwrap_or(0) != 0)
    }

    pub(super) fn functional_inputs(&self) -> [u8; INPUTS.len()] {
        PLACES.functional_inputs.map(|offset| self.image[offset])
    }

    pub(super) fn note_edges(&mut self, before: [u8; INPUTS.len()]) {
        let after = self.functional_inputs();
        for (risen, (before, after)) in self.functional.risen.bytes.iter_mut().zip(before.iter().zip(after)) {
            *risen |= after & !before;
        }
    }

    /// Sets a button of the tool, counted from 0.
    pub(super) fn set_button(&mut self, nth: u8, on: bool) {
        let before = self.buttons;
        set_bit(&mut self.buttons, nth, on);
        self.functional.risen.buttons |= self.buttons & !before;
    }

    /// Restores the shown bits after a write.
    pub(super) fn keep_shown(&mut self) {
        for (&offset, &(mask, bits)) in PLACES.functional_outputs.iter().zip(&self.functional.shown) {
            let byte = &mut self.image[offset];
            let kept = *byte & !mask | bits & mask;
            if *byte != kept {
                *byte = kept;
                self.shown.forget();
            }
        }
    }
}

/// The bytes of functional inputs; the tool's buttons are no variable.
pub(super) const INPUTS: [(&str, u32); 3] =
    [("BitInputReg", 1), ("BitInputReg", 2), ("DigitalSignalStatus", 7)];
pub(super) const OUTPUTS: [(&str, u32); 3] =
    [("BitOutputReg", 1), ("BitOutputReg", 2), ("DigitalSignalStatus", 8)];

/// Offsets in the image.
pub(super) fn offsets<const N: usize>(vars: [(&str, u32); N]) -> [usize; N] {
    vars.map(|(group, index)| named(group, index).map_or(0, SysVar::image_offset))
}
