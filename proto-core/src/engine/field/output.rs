//! The frames that a field port sends, made from the image or from the bindings of a user-defined recipe.
//!
//! In: the image, when the port's sender has a frame due. Out: bytes or CAN frames, one per call. Does not know when a
//! frame is due.

use super::bindings::{Outputs, values};
use super::codec::Codec;
use super::port::{FieldPort, fields_before};
use super::sender::{DIGEST_SEED, digest};
use crate::engine::counters::{add, bump};
use crate::image::Image;
use crate::recipe::model::Mode;
use crate::time::Instant;
use crate::wire::can::CanFrame;

/// A frame to send to the field; bytes are given by their length.
pub(crate) enum FieldFrame {
    Bytes(usize),
    Can(CanFrame),
}

impl FieldPort {
    /// The frame that is due, if its values may be shown.
    pub(crate) fn next_output(
        &mut self,
        image: &Image,
        bindings: Outputs<'_>,
        out: &mut [u8],
        now: Instant,
    ) -> Option<FieldFrame> {
        if !self.sender.may_show(image, now) {
            bump(&mut self.counters.stale_cycles);
            self.sender.dismiss();
            return None;
        }
        match self.codec {
            Codec::Stream { .. } => self.next_stream(image, bindings.of(self.outputs), out, now),
            Codec::Can { .. } => self.next_can(image, bindings.of(self.outputs), now),
            Codec::Device(_) => self.next_device(image, bindings, out, now),
        }
    }

    fn next_stream(
        &mut self,
        image: &Image,
        bindings: Outputs<'_>,
        out: &mut [u8],
        now: Instant,
    ) -> Option<FieldFrame> {
        let Codec::Stream { output: Some(layout), .. } = &self.codec else {
            self.sender.dismiss();
            return None;
        };
        let encoded = match self.mode {
            Mode::Realtime => layout.encode(image.bytes(), out).ok(),
            Mode::User => {
                let values = values(bindings.binds, image, self.sender.frames_sent, self.reply);
                layout.encode_values(&values, out).ok()
            }
        };
        let frame = encoded.and_then(|len| out.get(..len));
        match frame {
            Some(frame) if self.sender.is_news(|| digest(DIGEST_SEED, frame), now) => {
                let len = frame.len();
                bump(&mut self.counters.frames_out);
                add(&mut self.counters.bytes_out, len);
                self.sender.handed_over();
                Some(FieldFrame::Bytes(len))
            }
            _ => {
                self.sender.dismiss();
                None
            }
        }
    }

    fn next_can(&mut self, image: &Image, bindings: Outputs<'_>, now: Instant) -> Option<FieldFrame> {
        if self.sender.next_can == 0 && !self.can_is_news(image, bindings, now) {
            self.sender.dismiss();
            return None;
        }
        let nth = self.sender.next_can;
        let Some((frame, is_last)) = self.can_frame(nth, image, bindings) else {
            self.sender.dismiss();
            return None;
        };
        bump(&mut self.counters.frames_out);
        add(&mut self.counters.bytes_out, frame.data().len());
        if is_last {
            self.sender.handed_over();
        } else {
            self.sender.next_can = nth.saturating_add(1);
        }
        Some(FieldFrame::Can(frame))
    }

    /// The `nth` frame of the cycle, and whether it is the last.
    fn can_frame(&self, nth: usize, image: &Image, bindings: Outputs<'_>) -> Option<(CanFrame, bool)> {
        let Codec::Can { output: Some(layout), .. } = &self.codec else { return None };
        let frame = layout.frame(nth)?;
        let is_last = nth.saturating_add(1) >= layout.frame_count();
        let frame = match self.mode {
            Mode::Realtime => frame.encode(image.bytes()),
            Mode::User => {
                let row = bindings.binds.get(fields_before(layout, nth)..).unwrap_or(&[]);
                let row = row.get(..frame.fields().count()).unwrap_or(&[]);
                let values = values(row, image, self.sender.frames_sent, self.reply);
                frame.encode_values(&values).ok()?
            }
        };
        Some((frame, is_last))
    }

    fn can_is_news(&mut self, image: &Image, bindings: Outputs<'_>, now: Instant) -> bool {
        if !self.sender.sends_changes() {
            return true;
        }
        let mut hash = DIGEST_SEED;
        let mut nth = 0_usize;
        while let Some((frame, _)) = self.can_frame(nth, image, bindings) {
            hash = digest(hash, frame.data());
            nth = nth.saturating_add(1);
        }
        self.sender.is_news(|| hash, now)
    }
}
