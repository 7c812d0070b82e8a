//! Ports whose frames end where a tail, escape bytes or silence says so, and the texts in frames of
//! devices.
//!
//! In: bytes, and the news that the line was silent. Out: values in the store. Which bytes are a
//! frame is the cutter's business, what is in it the layout's.

use heapless::Vec;

use super::bindings::{InputBind, OutputBind, Outputs, number_of};
use super::device::{DeviceCodec, DeviceFormat, elements};
use super::frames::{Accepted, FrameContext};
use super::port::{Codec, FieldPort, came, keep_why};
use crate::config::{ConfigView, FieldSpec, Span, Words};
use crate::device::{ByteOrder, Cutter, Escape, FrameLayout, Framer, Ignored, Piece, Probe};
use crate::engine::counters::add;
use crate::engine::io::ReplyCode;
use crate::engine::link::command::CommandLink;
use crate::engine::rejection::Rejection;
use crate::engine::tap::Tap;
use crate::engine::values::store::Store;
use crate::image::{Image, bind_to_variable};
use crate::modbus::rtu::Slave;
use crate::sysvar::{Direction, SysVar};
use crate::time::{Duration, Instant};
use crate::wire::scalar::Scalar;

/// Maximum number of texts of one port, both ways together.
pub(crate) const MAX_TEXTS: usize = 8;

/// Finds frames in a stream.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant, reason = "without an allocator there is no box to put the larger one in")]
pub(crate) enum Reader {
    /// By their fields.
    Search(Framer),
    /// By what stands between them. `heard` is when the newest bytes came.
    Whole { cutter: Cutter, heard: Instant },
    /// As the requests of a master.
    Slave(Slave),
}

impl Reader {
    /// Whether silence has something to end.
    pub(crate) fn has_begun(&self) -> bool {
        match self {
            Self::Search(framer) => !framer.held().is_empty(),
            Self::Whole { cutter, .. } => cutter.has_begun(),
            // It has its own deadline.
            Self::Slave(_) => false,
        }
    }

    /// The bytes of a frame that has begun.
    pub(crate) fn held(&self) -> &[u8] {
        match self {
            Self::Search(framer) => framer.held(),
            Self::Whole { cutter, .. } => cutter.held(),
            Self::Slave(_) => &[],
        }
    }

    /// Drops them, and returns how many they were.
    pub(crate) fn discard(&mut self) -> usize {
        match self {
            Self::Search(framer) => framer.discard(),
            Self::Whole { cutter, .. } => cutter.discard(),
            Self::Slave(slave) => slave.discard(),
        }
    }
}

/// Where a text goes to, or comes from.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TextBind {
    pub direction: Direction,
    /// The place of its element among the bindings of its direction.
    pub binding: u16,
    pub words: Option<Words>,
    pub length: Option<SysVar>,
    pub count: Option<SysVar>,
    pub ignored: Ignored,
}

/// The texts of a recipe, whose bindings begin at these places.
pub(crate) fn texts_of(
    config: ConfigView<'_>,
    recipe: &crate::config::Recipe,
    starts: [u16; 2],
) -> Option<Vec<TextBind, MAX_TEXTS>> {
    let mut texts = Vec::new();
    for (direction, start) in [Direction::Input, Direction::Output].into_iter().zip(starts) {
        let fields = config.fields_of(recipe, direction).map(|(_, _, field)| field);
        for (binding, field) in (start..).zip(fields.filter(|field| field.element().is_some())) {
            let (words, length, count, ignored) = match *field {
                FieldSpec::TextInput { to, length_to, count_to, ignored, .. } => {
                    (to, length_to, count_to, ignored)
                }
                FieldSpec::TextOutput { from, length_from, .. } => {
                    (Some(from), length_from, None, Ignored::NONE)
                }
                _ => continue,
            };
            texts.push(TextBind { direction, binding, words, length, count, ignored }).ok()?;
        }
    }
    Some(texts)
}

impl TextBind {
    /// Whether it is an input text of the frame with these bindings.
    pub(crate) fn is_in(&self, bindings: Span) -> bool {
        self.direction == Direction::Input
            && self.binding.checked_sub(bindings.start).is_some_and(|at| at < bindings.len)
    }

    /// Whether it is the input text of this binding.
    pub(crate) fn is_input(&self, binding: u16) -> bool {
        self.direction == Direction::Input && self.binding == binding
    }

    /// The variables that an input text becomes.
    pub(crate) fn variables(&self) -> impl Iterator<Item = SysVar> + use<> {
        let words = self.words.into_iter().flat_map(Words::iter);
        words.chain(self.length).chain(self.count)
    }

    /// Whether there is room for a text of `len` characters.
    fn has_room(&self, len: usize) -> bool {
        self.words.is_none_or(|words| len <= words.room())
    }

    /// Puts an input text into its variables; `nth` is the number of the frame.
    fn apply(&self, text: &[u8], nth: u32, image: &mut Image) {
        let mut pairs = text.chunks(2);
        for var in self.words.into_iter().flat_map(Words::iter) {
            let pair = pairs.next().unwrap_or(&[]);
            let character = |at: usize| pair.get(at).copied().unwrap_or(0);
            let pair = [character(0), character(1)];
            let is_low_first = self.words.is_some_and(|words| words.order == ByteOrder::Little);
            let word = if is_low_first { u16::from_le_bytes(pair) } else { u16::from_be_bytes(pair) };
            // Validation has refused everything but words.
            let _ = image.set(var, Scalar::Word(word));
        }
        for (var, number) in [(self.length, text.len() as u32), (self.count, u32::from(nth as u16))] {
            if let Some((var, value)) =
                var.and_then(|var| Some((var, bind_to_variable(var, Scalar::Dword(number), 1.0, 0.0)?)))
            {
                let _ = image.set(var, value);
            }
        }
    }

    /// Writes an output text to the front of `out`, and returns its length.
    fn write(&self, image: &Image, out: &mut [u8]) -> Option<usize> {
        let words = self.words?;
        let len = self.length.map(|var| image.value(var).as_f64() as usize);
        if len.is_some_and(|len| len > words.room()) {
            return None;
        }
        let mut written = 0_usize;
        for var in words.iter() {
            let word = image.value(var).as_f64() as u16;
            let pair = if words.order == ByteOrder::Little { word.to_le_bytes() } else { word.to_be_bytes() };
            for character in pair {
                let is_end = len.map_or(character == 0, |len| written >= len);
                if is_end {
                    return Some(written);
                }
                *out.get_mut(written)? = character;
                written = written.saturating_add(1);
            }
        }
        Some(written)
    }
}

/// The texts among some bindings, with their places in them.
fn texts_in(
    texts: &[TextBind],
    bindings: Span,
    direction: Direction,
) -> impl Iterator<Item = (usize, &TextBind)> {
    texts.iter().filter(move |text| text.direction == direction).filter_map(move |text| {
        let at = text.binding.checked_sub(bindings.start)?;
        (at < bindings.len).then_some((usize::from(at), text))
    })
}

impl FrameContext<'_> {
    /// The texts of an input frame, each with its place among the frame's fields, and the text if there is room for it.
    pub(crate) fn texts<'t>(
        &self,
        texts: &'t [TextBind],
        format: &'t DeviceFormat,
        frame: &'t [u8],
    ) -> impl Iterator<Item = (usize, &'t TextBind, Result<&'t [u8], Rejection>)>
    where
        Self: 't,
    {
        let bindings = format.bindings.of(self.bindings);
        texts_in(texts, format.bindings, Direction::Input).map(move |(at, text)| {
            let found = match format.layout.text(elements(bindings), frame, at) {
                Some(found) if text.has_room(found.len()) => Ok(found),
                Some(_) => Err(Rejection::OutOfRange),
                None => Err(Rejection::Unreadable),
            };
            (at, text, found)
        })
    }

    /// Whether one of the texts of an input frame says that there is nothing to say.
    pub(crate) fn is_ignored(&self, texts: &[TextBind], format: &DeviceFormat, frame: &[u8]) -> bool {
        let bindings = format.bindings.of(self.bindings);
        let mut may_be =
            texts_in(texts, format.bindings, Direction::Input).filter(|(_, text)| !text.ignored.is_empty());
        may_be.any(|(at, text)| {
            let found = format.layout.text(elements(bindings), frame, at);
            found.is_some_and(|found| text.ignored.has(found))
        })
    }

    /// Puts the texts of an input frame into their variables, but those for which there is no room.
    pub(crate) fn take_texts(&mut self, texts: &[TextBind], format: &DeviceFormat, frame: &[u8]) {
        let bindings = format.bindings.of(self.bindings);
        let nth = self.counters.frames_in.wrapping_add(1);
        for (at, text) in texts_in(texts, format.bindings, Direction::Input) {
            if let Some(found) = format.layout.text(elements(bindings), frame, at)
                && text.has_room(found.len())
            {
                text.apply(found, nth, &mut self.store.image);
            }
        }
    }
}

/// What a whole frame is.
fn judge<'f>(
    formats: &'f [DeviceFormat],
    bindings: &[InputBind],
    frame: &[u8],
) -> Result<(usize, &'f DeviceFormat), Rejection> {
    let mut verdict = Rejection::WrongLength;
    for (nth, format) in formats.iter().enumerate() {
        let layout: &FrameLayout = &format.layout;
        let (shortest, longest) = layout.lengths();
        let why = match layout.probe_whole(elements(format.bindings.of(bindings)), frame) {
            Probe::Frame(_) => return Ok((nth, format)),
            Probe::Wrong(_) => Rejection::Checksum,
            Probe::Other(_) => Rejection::OtherDevice,
            Probe::No(_) if (shortest..=longest).contains(&frame.len()) => Rejection::OtherDevice,
            Probe::No(_) | Probe::Partial(_) => Rejection::WrongLength,
        };
        // What is nearest to a frame says most.
        verdict = match (verdict, why) {
            (Rejection::Checksum, _) | (_, Rejection::Checksum) => Rejection::Checksum,
            (Rejection::OtherDevice, _) | (_, Rejection::OtherDevice) => Rejection::OtherDevice,
            _ => Rejection::WrongLength,
        };
    }
    Err(verdict)
}

impl FieldPort {
    /// Whether silence ends frames on this port, and one has begun.
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

    /// Reads the frames in `rest`, or the one that silence has ended if it is empty.
    pub(crate) fn whole_frames(
        &mut self,
        rest: &mut &[u8],
        bindings: &[InputBind],
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        tap: &mut Tap,
    ) -> Accepted {
        let mut accepted = Accepted::default();
        let (now, usable, bytes) = (store.now, self.is_usable(), *rest);
        let is_overdue = |heard: Instant, idle_gap: Duration| now >= heard + idle_gap;
        let Codec::Device(DeviceCodec { reader: Some(Reader::Whole { cutter, heard }), .. }) = &self.codec
        else {
            return accepted;
        };
        if cutter.ends_by_silence()
            && cutter.has_begun()
            && !bytes.is_empty()
            && is_overdue(*heard, self.line.idle_gap)
        {
            // These bytes may have waited: nobody knows whether there was silence before them.
            self.discard_partial(tap, now);
        }
        let Codec::Device(DeviceCodec {
            formats,
            inputs,
            reader: Some(Reader::Whole { cutter, heard }),
            texts,
            skipped_bytes,
            ..
        }) = &mut self.codec
        else {
            return accepted;
        };
        let formats = formats.get(..usize::from(*inputs)).unwrap_or(&[]);
        let tail = formats.first().map_or(&[][..], |format| format.layout.tail());
        let (reply, counters) = (&mut self.reply, &mut self.counters);
        let mut frames = FrameContext::new((self.id, self.mode), reply, counters, bindings, store, commands);
        let mut left = core::mem::take(rest);
        if !bytes.is_empty() {
            *heard = now;
        }
        let mut silence = bytes.is_empty();
        loop {
            let piece = if core::mem::take(&mut silence) {
                cutter.silence()
            } else {
                cutter.next_piece(&mut left, tail)
            };
            let Some(piece) = piece else { break };
            let (frame, verdict) = match piece {
                Piece::Whole(frame) => match judge(formats, bindings, frame) {
                    Ok((nth, format)) => {
                        let slot = usize::from(self.first_frame).saturating_add(nth);
                        (frame, frames.take_device(format, texts, frame, slot, &mut accepted))
                    }
                    Err(why) => (frame, frames.rejected(why)),
                },
                Piece::TooLong(frame) => (frame, frames.rejected(Rejection::WrongLength)),
                Piece::BadEscape(frame) => (frame, frames.rejected(Rejection::Escape)),
                Piece::Cut(frame) => {
                    add(&mut frames.counters.discarded_bytes, frame.len());
                    (frame, Err(Rejection::Partial))
                }
            };
            tap.record(|| came(self.id, now, verdict, None, [frame, &[], &[]]));
            keep_why(&mut self.last_rejection, verdict, frames.store, None, frame);
            if verdict.is_ok() && frames.store.watches_bits && !left.is_empty() {
                break;
            }
        }
        *rest = left;
        let skipped = cutter.skipped_bytes().wrapping_sub(*skipped_bytes);
        *skipped_bytes = cutter.skipped_bytes();
        if skipped > 0 {
            add(&mut self.counters.resync_bytes, skipped as usize);
            self.no_frame(bytes, skipped as usize, tap, now);
        }
        self.sender.frames_accepted(accepted.frames, usable, &mut self.counters, now);
        accepted
    }
}

/// What output frames are made from.
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

    /// The same with escape bytes, if there are any.
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
