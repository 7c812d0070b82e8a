//! Makes device frames from the image.
//!
//! In: the image, the port's bindings and texts. Out: the bytes of a frame. Does not know when one is due.

use super::bindings::{OutputBind, Outputs, number_of};
use super::format::DeviceFormat;
use super::texts::{TextBind, texts_in};
use crate::device::Escape;
use crate::engine::io::ReplyCode;
use crate::image::Image;
use crate::sysvar::Direction;

/// The sources of an output frame's values.
#[derive(Clone, Copy)]
pub(crate) struct Outgoing<'a> {
    pub image: &'a Image,
    /// The bindings of all ports.
    pub bindings: Outputs<'a>,
    pub texts: &'a [TextBind],
    pub frames_sent: u32,
    pub reply: ReplyCode,
}

impl Outgoing<'_> {
    /// Writes an output frame, without escape bytes, to the front of `out`.
    pub(crate) fn write(&self, format: &DeviceFormat, out: &mut [u8]) -> Option<usize> {
        let Outputs { binds: fields, .. } = self.bindings.of(format.bindings);
        let number = |nth: usize| {
            let number = |field| number_of(self.bindings, field, self.image, self.frames_sent, self.reply);
            fields.get(nth).map_or(f64::NAN, number)
        };
        let text = |nth: usize, out: &mut [u8]| {
            let mut texts = texts_in(self.texts, format.bindings, Direction::Output);
            texts.find(|(at, _)| *at == nth)?.1.write(self.image, out)
        };
        format.layout.encode_with(fields.iter().map(OutputBind::element), number, text, out)
    }

    /// Like [`Self::write`], with escape bytes if the recipe has them.
    pub(crate) fn encode(
        &self,
        format: &DeviceFormat,
        escape: Option<Escape>,
        out: &mut [u8],
    ) -> Option<usize> {
        let len = self.write(format, out)?;
        match escape {
            Some(escape) => escape.stuff(len, out),
            None => Some(len),
        }
    }
}
