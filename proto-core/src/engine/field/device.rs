//! Device frames, which no recipe of the controller can describe: finds received ones, and makes those to send.
//!
//! In: bytes and CAN frames, and the port's bindings with their elements. Out: frames that were found, which
//! `device_frame.rs` applies, and frames to send when they are due. Does not know the controller's own kinds of
//! recipes.

use heapless::Vec;

use super::bindings::{InputBind, Outputs};
use super::codec::{Codec, DeviceCodec, MAX_DEVICE_FRAMES, Reader};
use super::format::{DeviceFormat, judge, judge_can, probe_all};
use super::frames::{Accepted, FrameContext};
use super::outgoing::Outgoing;
use super::output::FieldFrame;
use super::port::{FieldPort, came, keep_why};
use super::sender::{DIGEST_SEED, digest};
use super::texts::{MAX_TEXTS, texts_of};
use crate::config::{CanFramePart, ConfigView, Counted, DeviceFrame, Parts, Recipe, Rs485, Span};
use crate::device::{Cutter, Found, Framer, Piece};
use crate::engine::build_error::{BuildError, one_too_many};
use crate::engine::counters::{add, bump};
use crate::engine::link::command::CommandLink;
use crate::engine::rejection::Rejection;
use crate::engine::tap::Tap;
use crate::engine::values::store::Store;
use crate::image::Image;
use crate::sysvar::Direction;
use crate::time::Instant;
use crate::wire::can::{CanFrame, CanId, CanKey};

impl DeviceCodec {
    /// The frames of a recipe; the bindings of its inputs and outputs begin at these places.
    #[inline(never)]
    pub(crate) fn new(
        config: ConfigView<'_>,
        index: u8,
        recipe: &Recipe,
        [mut next_input, mut next_output]: [u16; 2],
        line: Option<&Rs485>,
    ) -> Result<Self, BuildError> {
        let texts = texts_of(config, recipe, [next_input, next_output]);
        let mut codec = Self {
            formats: Vec::new(),
            inputs: 0,
            reader: None,
            escape: recipe.stream_part(Direction::Output).and_then(|part| part.escape),
            texts: texts.ok_or(one_too_many(Counted::Texts, MAX_TEXTS))?,
            skipped_bytes: 0,
            line: None,
        };
        let ids: [&[CanFramePart]; 2] = match &recipe.parts {
            Parts::Can { input, output } => [input, output],
            Parts::Stream { .. } => {
                let cut = recipe.stream_part(Direction::Input);
                let cutter = cut.and_then(|part| Cutter::new(part.framing, part.escape));
                let served = config.exchanges_of(recipe).iter().find(|exchange| exchange.is_served());
                let slave = served.zip(line).and_then(|(exchange, line)| line.slave(exchange.peer));
                codec.reader = Some(match (slave, cutter) {
                    (Some(slave), _) => Reader::Slave(slave),
                    (None, Some(cutter)) => Reader::Whole { cutter, heard: Instant::ZERO },
                    (None, None) if recipe.exchanges.len > 0 => Reader::Search(Framer::of_replies()),
                    (None, None) => Reader::Search(Framer::new()),
                });
                [&[], &[]]
            }
        };
        for (part, ids, next) in
            [(Direction::Input, ids[0], &mut next_input), (Direction::Output, ids[1], &mut next_output)]
        {
            for frame in config.device_frames(recipe, part) {
                let DeviceFrame { elements, layout } =
                    DeviceFrame::new(frame.carrier, part, frame.delimiters, frame.fields).map_err(
                        |error| BuildError::Layout { recipe: index, part, frame: frame.nth, error },
                    )?;
                let bindings = Span { start: *next, len: elements.len() as u16 };
                *next = next.saturating_add(bindings.len);
                let id = ids.get(usize::from(frame.nth)).map_or(CanId::Standard(0), |frame| frame.id);
                codec
                    .formats
                    .push(DeviceFormat { layout, key: CanKey::of(id), bindings })
                    .map_err(|_| one_too_many(Counted::DeviceFrames, MAX_DEVICE_FRAMES))?;
                if part == Direction::Input {
                    codec.inputs = codec.inputs.saturating_add(1);
                }
            }
        }
        Ok(codec)
    }
}

/// The format of a frame that was found, with its number.
type AsFormat<'f> = Result<(usize, &'f DeviceFormat), Rejection>;

fn found_by_search<'f, 'b>(
    found: Found<'b>,
    formats: &'f [DeviceFormat],
    bindings: &[InputBind],
) -> (&'b [u8], AsFormat<'f>) {
    match found {
        Found::Frame(frame) => {
            let found = (0..).zip(formats).find(|(_, format)| format.is_frame(bindings, frame));
            (frame, found.ok_or(Rejection::NoFrame))
        }
        Found::Other(frame) => (frame, Err(Rejection::OtherDevice)),
        Found::Wrong(frame) => (frame, Err(Rejection::Checksum)),
    }
}

fn found_whole<'f, 'b>(
    piece: Piece<'b>,
    formats: &'f [DeviceFormat],
    bindings: &[InputBind],
) -> (&'b [u8], AsFormat<'f>) {
    match piece {
        Piece::Whole(frame) => (frame, judge(formats, bindings, frame)),
        Piece::TooLong(frame) => (frame, Err(Rejection::WrongLength)),
        Piece::BadEscape(frame) => (frame, Err(Rejection::Escape)),
        Piece::Cut(frame) => (frame, Err(Rejection::Partial)),
    }
}

impl FieldPort {
    /// Reads the frames in `rest`; if it is empty, the frame that silence has ended. See [`FieldPort::frames`].
    pub(crate) fn device_frames(
        &mut self,
        rest: &mut &[u8],
        bindings: &[InputBind],
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        tap: &mut Tap,
    ) -> Accepted {
        let mut accepted = Accepted::default();
        let (now, usable, bytes) = (store.now, self.is_usable(), *rest);
        let mut left = core::mem::take(rest);
        if matches!(self.codec, Codec::Device(DeviceCodec { inputs: 0, .. })) {
            self.reject_without_input(bytes, tap, now);
            return accepted;
        }
        self.discard_waiting(bytes, tap, now);
        let Codec::Device(DeviceCodec { formats, inputs, texts, reader: Some(reader), .. }) = &mut self.codec
        else {
            return accepted;
        };
        let formats = formats.get(..usize::from(*inputs)).unwrap_or(&[]);
        let tail = formats.first().map_or(&[][..], |format| format.layout.tail());
        let effort = formats.iter().map(DeviceFormat::effort).fold(0, usize::saturating_add);
        let (reply, counters) = (&mut self.reply, &mut self.counters);
        let mut frames = FrameContext::new((self.id, self.mode), reply, counters, bindings, store, commands);
        if let Reader::Whole { heard, .. } = reader
            && !bytes.is_empty()
        {
            *heard = now;
        }
        let mut is_silent = bytes.is_empty();
        loop {
            let found = match reader {
                Reader::Search(framer) => {
                    let found =
                        framer.next_frame(&mut left, effort, |bytes| probe_all(formats, bindings, bytes));
                    found.map(|found| found_by_search(found, formats, bindings))
                }
                Reader::Whole { cutter, .. } => {
                    let is_silent = core::mem::take(&mut is_silent);
                    let piece = if is_silent { cutter.silence() } else { cutter.next_piece(&mut left, tail) };
                    piece.map(|piece| found_whole(piece, formats, bindings))
                }
                Reader::Slave(_) => None,
            };
            let Some((frame, found)) = found else { break };
            let verdict = match found {
                Ok((nth, format)) => {
                    let slot = usize::from(self.first_frame).saturating_add(nth);
                    frames.take_device(format, texts, frame, slot, &mut accepted)
                }
                // Not counted here: the search counts bytes that are no frame.
                Err(why @ Rejection::NoFrame) => Err(why),
                Err(why @ Rejection::Partial) => {
                    add(&mut frames.counters.discarded_bytes, frame.len());
                    Err(why)
                }
                Err(why) => frames.rejected(why),
            };
            tap.record(|| came(self.id, now, verdict, None, [frame, &[], &[]]));
            keep_why(&mut self.last_rejection, verdict, frames.store, None, frame);
            // The framer may hold more frames, so only the rest of the chunk is left for the next call.
            if verdict.is_ok() && frames.store.watches_bits && !left.is_empty() {
                break;
            }
        }
        *rest = left;
        self.note_skipped(bytes, tap, now);
        self.sender.frames_accepted(accepted.frames, usable, &mut self.counters, now);
        accepted
    }

    /// Bytes that come after silence should have ended a frame may have waited, so it is unknown whether there was
    /// silence before them: discards the partial frame.
    fn discard_waiting(&mut self, bytes: &[u8], tap: &mut Tap, now: Instant) {
        if let Codec::Device(DeviceCodec { reader: Some(Reader::Whole { cutter, heard }), .. }) = &self.codec
            && cutter.ends_by_silence()
            && cutter.has_begun()
            && !bytes.is_empty()
            && now >= *heard + self.line.idle_gap
        {
            self.discard_partial(tap, now);
        }
    }

    /// Counts bytes that belong to no frame, in these bytes or those held before.
    pub(crate) fn note_skipped(&mut self, bytes: &[u8], tap: &mut Tap, now: Instant) {
        let Codec::Device(DeviceCodec { reader: Some(reader), skipped_bytes, .. }) = &mut self.codec else {
            return;
        };
        let skipped = match reader {
            Reader::Search(framer) => {
                let stats = framer.stats();
                self.counters.resync_bytes = stats.skipped_bytes;
                // The bytes of a frame with a wrong checksum were reported with that frame.
                let noise = stats.noise_bytes.wrapping_sub(*skipped_bytes);
                *skipped_bytes = stats.noise_bytes;
                noise
            }
            Reader::Whole { cutter, .. } => {
                let skipped = cutter.skipped_bytes().wrapping_sub(*skipped_bytes);
                *skipped_bytes = cutter.skipped_bytes();
                add(&mut self.counters.resync_bytes, skipped as usize);
                skipped
            }
            Reader::Slave(_) => 0,
        };
        if skipped > 0 {
            self.no_frame(bytes, skipped as usize, tap, now);
        }
    }

    /// Whether silence ends frames on this port, and there is a partial frame.
    pub(crate) fn ends_by_silence(&self) -> bool {
        let Codec::Device(DeviceCodec { reader: Some(Reader::Whole { cutter, .. }), .. }) = &self.codec
        else {
            return false;
        };
        cutter.ends_by_silence() && cutter.has_begun()
    }

    /// These bytes are lost; what they began cannot be trusted.
    pub(crate) fn lose(&mut self, bytes: &[u8]) {
        let Codec::Device(DeviceCodec { reader: Some(Reader::Whole { cutter, .. }), formats, .. }) =
            &mut self.codec
        else {
            return;
        };
        let tail = formats.first().map_or(&[][..], |format| format.layout.tail());
        let mut rest = bytes;
        while cutter.next_piece(&mut rest, tail).is_some() {}
        cutter.discard();
    }

    /// Reads a CAN frame; see [`FieldPort::can`].
    pub(crate) fn device_can(
        &mut self,
        frame: &CanFrame,
        bindings: &[InputBind],
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        accepted: &mut Accepted,
    ) -> Result<(), Rejection> {
        let (now, usable) = (store.now, self.is_usable());
        let Codec::Device(device) = &self.codec else { return Ok(()) };
        let (reply, counters) = (&mut self.reply, &mut self.counters);
        let mut frames = FrameContext::new((self.id, self.mode), reply, counters, bindings, store, commands);
        if device.inputs == 0 {
            frames.rejected(Rejection::NoInput)?;
        }
        if frame.is_remote() {
            frames.rejected(Rejection::Remote)?;
        }
        let (nth, format) = match judge_can((0..).zip(device.input()), bindings, frame) {
            Ok(found) => found,
            Err(why) => return frames.rejected(why),
        };
        let slot = usize::from(self.first_frame).saturating_add(nth);
        frames.take_device(format, &device.texts, frame.data(), slot, accepted)?;
        self.sender.frames_accepted(1, usable, &mut self.counters, now);
        Ok(())
    }

    /// The device frame that is due.
    pub(crate) fn next_device(
        &mut self,
        image: &Image,
        bindings: Outputs<'_>,
        out: &mut [u8],
        now: Instant,
    ) -> Option<FieldFrame> {
        let Codec::Device(device) = &self.codec else { return None };
        let nth = self.sender.next_can;
        let (frames_sent, reply) = (self.sender.frames_sent, self.reply);
        let outgoing = Outgoing { image, bindings, texts: &device.texts, frames_sent, reply };
        let encode = |format: &DeviceFormat, out: &mut [u8]| outgoing.encode(format, device.escape, out);
        let formats = device.output();
        let may_lack_one = formats.len() > 1 && bindings.are_limited(self.outputs);
        if nth == 0 && (self.sender.sends_changes() || may_lack_one) {
            let mut hash = DIGEST_SEED;
            for format in formats {
                let Some(len) = encode(format, out) else {
                    // The frame sent last is still the newest. The frames of a cycle belong together.
                    bump(&mut self.counters.stale_cycles);
                    self.sender.dismiss();
                    return None;
                };
                hash = digest(hash, out.get(..len).unwrap_or(&[]));
            }
            if !self.sender.is_news(|| hash, now) {
                self.sender.dismiss();
                return None;
            }
        }
        let Some((format, len)) = formats.get(nth).and_then(|format| Some((format, encode(format, out)?)))
        else {
            bump(&mut self.counters.stale_cycles);
            self.sender.dismiss();
            return None;
        };
        let frame = out.get(..len).unwrap_or(&[]);
        let downward = match device.reader {
            Some(_) => FieldFrame::Bytes(len),
            None => FieldFrame::Can(CanFrame::cut(format.key.id(), frame)),
        };
        let is_last = nth.saturating_add(1) >= formats.len();
        self.counters.sent(len);
        if is_last {
            self.sender.handed_over();
        } else {
            self.sender.next_can = nth.saturating_add(1);
        }
        Some(downward)
    }
}
