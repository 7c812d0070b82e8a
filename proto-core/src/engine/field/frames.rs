//! Applies frames of a field port as a whole or not at all. Device frames are applied field by field, in
//! `device_frame.rs`.
//!
//! In: the payload of a frame that was found, with its layout. Out: values in the store, commands, and counters. Does
//! not know how frames are found.

use super::bindings::{InputBind, InputTo, fit};
use crate::engine::counters::{PortCounters, bump};
use crate::engine::io::{PortId, ReplyCode};
use crate::engine::link::command::CommandLink;
use crate::engine::link::command_tables::Picked;
use crate::engine::rejection::Rejection;
use crate::engine::values::store::Store;
use crate::image::{ImageBytes, InputSet};
use crate::recipe::model::Mode;
use crate::recipe::{Applied, CanFrameLayout, StreamLayout, ValueError, Values};
use crate::wire::scalar::Scalar;

/// The frames accepted in one call.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Accepted {
    pub frames: u32,
    /// Variables of the newest frame, those whose link is up.
    pub set: InputSet,
}

pub(crate) struct FrameContext<'a> {
    pub mode: Mode,
    pub bindings: &'a [InputBind],
    pub reply: &'a mut ReplyCode,
    pub counters: &'a mut PortCounters,
    pub port: PortId,
    pub store: &'a mut Store,
    pub commands: Option<&'a mut CommandLink>,
}

impl<'a> FrameContext<'a> {
    // Takes the parts of a port one by one, because the port's codec is borrowed meanwhile.
    pub(crate) fn new(
        (port, mode): (PortId, Mode),
        reply: &'a mut ReplyCode,
        counters: &'a mut PortCounters,
        bindings: &'a [InputBind],
        store: &'a mut Store,
        commands: Option<&'a mut CommandLink>,
    ) -> Self {
        Self { mode, bindings, reply, counters, port, store, commands }
    }
}

impl FrameContext<'_> {
    /// Counts a rejection and returns it.
    pub(crate) fn rejected(&mut self, why: Rejection) -> Result<(), Rejection> {
        let counters = &mut *self.counters;
        bump(match why {
            Rejection::NoInput => &mut counters.rejected_no_input,
            Rejection::Remote => &mut counters.rejected_remote,
            Rejection::ForeignId => &mut counters.rejected_id,
            Rejection::WrongLength | Rejection::Malformed => &mut counters.rejected_length,
            Rejection::Checksum => &mut counters.rejected_checksum,
            Rejection::OtherDevice => &mut counters.rejected_other_device,
            Rejection::Repeated => &mut counters.rejected_counter,
            Rejection::Unreadable | Rejection::Escape => &mut counters.rejected_unreadable,
            Rejection::NotFinite => &mut counters.rejected_not_finite,
            _ => &mut counters.rejected_out_of_range,
        });
        Err(why)
    }

    /// Applies a frame as a whole or not at all, and counts it in `accepted`.
    // Returning the set in the result would copy it byte by byte, because the result's tag is one byte.
    pub(crate) fn take(
        &mut self,
        layout: &impl InputLayout,
        payload: &[u8],
        slot: usize,
        accepted: &mut Accepted,
    ) -> Result<(), Rejection> {
        match self.mode {
            Mode::Realtime => match layout.apply(payload, self.store.image.bytes_mut()) {
                Ok(applied) => {
                    if applied.masked > 0 {
                        bump(&mut self.counters.masked);
                    }
                }
                Err(_) => return self.rejected(Rejection::NotFinite),
            },
            // With a context of its own, so that the one of the other mode can stay in registers.
            Mode::User => self.again().take_user(layout, payload, slot)?,
        }
        bump(&mut self.counters.frames_in);
        accepted.frames = accepted.frames.wrapping_add(1);
        accepted.set = self.store.accepted(slot, self.counters);
        Ok(())
    }

    fn again(&mut self) -> FrameContext<'_> {
        let commands = self.commands.as_deref_mut();
        FrameContext::new(
            (self.port, self.mode),
            self.reply,
            self.counters,
            self.bindings,
            self.store,
            commands,
        )
    }

    /// Applies the values of a user-defined frame, all or none.
    // The cost is in docs/performance.md section 1, like that of the other attributes here.
    #[inline(never)]
    fn take_user(&mut self, layout: &impl InputLayout, payload: &[u8], slot: usize) -> Result<(), Rejection> {
        if layout.check(payload).is_err() {
            return self.rejected(Rejection::NotFinite);
        }
        let frame = self.store.frames.get(slot).ok_or(Rejection::NoInput)?;
        let bindings = frame.bindings.of(self.bindings);
        if !fit(bindings, layout.values(payload)) {
            return self.rejected(Rejection::OutOfRange);
        }
        for (binding, value) in bindings.iter().zip(layout.values(payload)) {
            self.apply_user(&binding.to, value);
        }
        if let Some(link) = &mut self.commands {
            link.frame_ends();
        }
        Ok(())
    }

    pub(crate) fn apply_user(&mut self, binding: &InputTo, value: Scalar) {
        match *binding {
            InputTo::Unused
            | InputTo::Fixed { .. }
            | InputTo::Counter(_)
            // Only in device frames.
            | InputTo::Ruled { .. }
            | InputTo::Rule(_) => {}
            InputTo::Variable { .. } => {
                if let Some((var, value)) = binding.bound(value) {
                    // Cannot fail: all values were checked before the first was applied.
                    let _ = self.store.image.set(var, value);
                }
            }
            InputTo::Bits { var, mask } => {
                let on = if value.as_f64() == 0.0 { 0 } else { mask };
                self.store.image.set_bits(var, mask, on);
            }
            InputTo::Command(field) => {
                if let Some(link) = &mut self.commands {
                    let nth = self.counters.commands.wrapping_add(1);
                    match link.value(field, value, (self.port, nth), self.store.now) {
                        Picked::Nothing => {}
                        Picked::Unknown => bump(&mut self.counters.commands_unknown),
                        Picked::Based => bump(&mut self.counters.commands_based),
                        Picked::Command { reply, is_dropped } => {
                            self.counters.commands = nth;
                            *self.reply = reply;
                            if is_dropped {
                                bump(&mut self.counters.commands_dropped);
                            }
                        }
                    }
                }
            }
        }
    }
}

/// The operations of a frame's layout, for streams and CAN.
pub(crate) trait InputLayout {
    fn apply(&self, payload: &[u8], image: &mut ImageBytes) -> Result<Applied, ValueError>;
    fn check(&self, payload: &[u8]) -> Result<(), ValueError>;
    fn values<'v>(&'v self, payload: &'v [u8]) -> Values<'v>;
}

impl InputLayout for StreamLayout {
    fn apply(&self, payload: &[u8], image: &mut ImageBytes) -> Result<Applied, ValueError> {
        Self::apply(self, payload, image)
    }
    fn check(&self, payload: &[u8]) -> Result<(), ValueError> {
        Self::check(self, payload)
    }
    fn values<'v>(&'v self, payload: &'v [u8]) -> Values<'v> {
        Self::values(self, payload)
    }
}

impl InputLayout for CanFrameLayout<'_> {
    #[inline(always)]
    fn apply(&self, payload: &[u8], image: &mut ImageBytes) -> Result<Applied, ValueError> {
        Self::apply(self, payload, image)
    }
    fn check(&self, payload: &[u8]) -> Result<(), ValueError> {
        Self::check(self, payload)
    }
    fn values<'v>(&'v self, payload: &'v [u8]) -> Values<'v> {
        Self::values(self, payload)
    }
}
