//! The frames of a device that no recipe of the controller can describe: found, taken, and made.
//!
//! In: bytes and CAN frames, and the port's bindings with their elements. Out: frames that were found, which
//! `device_frame.rs` applies, and frames when they are due. Recipes of the controller's own kinds do not come here.

use heapless::Vec;

use super::bindings::{InputBind, Outputs};
use super::frames::{Accepted, FrameContext};
use super::line::Line;
use super::output::Downward;
use super::port::{Codec, FieldPort, came, keep_why};
use super::sender::{DIGEST_SEED, digest};
use super::whole::{MAX_TEXTS, Outgoing, Reader, TextBind, texts_of};
use crate::config::{CanFramePart, ConfigView, Counted, DeviceFrame, Parts, Recipe, Rs485, Span};
use crate::device::{Cutter, Element, Escape, Found, FrameLayout, Framer, Probe};
use crate::engine::build_error::{BuildError, one_too_many};
use crate::engine::counters::bump;
use crate::engine::link::command::CommandLink;
use crate::engine::rejection::Rejection;
use crate::engine::tap::Tap;
use crate::engine::values::store::Store;
use crate::image::Image;
use crate::sysvar::Direction;
use crate::time::Instant;
use crate::wire::can::{CanFrame, CanId};

/// Maximum number of frames of one port with a device's own frames, both ways together.
pub(crate) const MAX_DEVICE_FRAMES: usize = 18;

/// One frame of the device.
#[derive(Debug, Clone)]
pub(crate) struct DeviceFormat {
    pub layout: FrameLayout,
    /// Its id on a CAN bus.
    pub id: CanId,
    /// Its range of the bindings of its direction, which have its elements.
    pub bindings: Span,
}

/// The frames of a device, and what finds them in a stream.
#[derive(Debug, Clone)]
pub(crate) struct DeviceCodec {
    /// The input frames, then the output frames.
    pub formats: Vec<DeviceFormat, MAX_DEVICE_FRAMES>,
    pub inputs: u8,
    /// `None` on a CAN bus.
    pub reader: Option<Reader>,
    /// What output frames are sent with.
    pub escape: Option<Escape>,
    pub texts: Vec<TextBind, MAX_TEXTS>,
    /// Bytes outside whole frames that have been counted.
    pub skipped_bytes: u32,
    /// The line of the exchanges, if the recipe has any.
    pub line: Option<Line>,
}

impl DeviceCodec {
    /// Whether silence has something to end.
    pub(crate) fn has_begun(&self) -> bool {
        self.reader.as_ref().is_some_and(Reader::has_begun)
    }

    /// Number of bindings of the input frames, and of the output frames.
    pub(crate) fn fields(&self) -> (u16, u16) {
        let sum = |formats: &[DeviceFormat]| {
            formats.iter().map(|format| format.bindings.len).fold(0, u16::saturating_add)
        };
        (sum(self.input()), sum(self.output()))
    }

    fn input(&self) -> &[DeviceFormat] {
        self.formats.get(..usize::from(self.inputs)).unwrap_or(&[])
    }

    fn output(&self) -> &[DeviceFormat] {
        self.formats.get(usize::from(self.inputs)..).unwrap_or(&[])
    }
}

/// What the bytes are, seen as any of the frames: a frame wins over more bytes that are needed, and
/// these over a wrong checksum.
fn probe_all(formats: &[DeviceFormat], bindings: &[InputBind], bytes: &[u8]) -> Probe {
    let probes = formats.iter().map(|format| probe(format, bindings, bytes));
    probes.fold(Probe::No(0), better)
}

/// What bytes are that can be seen in two ways.
pub(crate) fn better(one: Probe, other: Probe) -> Probe {
    match (one, other) {
        (Probe::Frame(len), _) | (_, Probe::Frame(len)) => Probe::Frame(len),
        (Probe::Other(len), _) | (_, Probe::Other(len)) => Probe::Other(len),
        (Probe::Partial(one), Probe::Partial(other)) => Probe::Partial(one.min(other)),
        (Probe::Partial(missing), _) | (_, Probe::Partial(missing)) => Probe::Partial(missing),
        (Probe::Wrong(len), _) | (_, Probe::Wrong(len)) => Probe::Wrong(len),
        (Probe::No(one), Probe::No(other)) => Probe::No(one.saturating_add(other)),
    }
}

pub(crate) fn probe(format: &DeviceFormat, bindings: &[InputBind], bytes: &[u8]) -> Probe {
    format.layout.probe(elements(format.bindings.of(bindings)), bytes)
}

/// The frame that CAN data with this id are, or why they are none: frames with one id differ in
/// constants.
pub(crate) fn judge_can<'f, T>(
    formats: impl Iterator<Item = (T, &'f DeviceFormat)>,
    bindings: &[InputBind],
    frame: &CanFrame,
) -> Result<(T, &'f DeviceFormat), Rejection> {
    let mut why = Rejection::ForeignId;
    for (what, format) in formats.filter(|(_, format)| format.id == frame.id()) {
        let fields = elements(format.bindings.of(bindings));
        let probe = format.layout.probe_whole(fields, frame.data());
        why = match (probe, why) {
            (Probe::Frame(_), _) => return Ok((what, format)),
            // Right but for a constant: another one than this, whatever the others are.
            (Probe::Other(_), _) | (_, Rejection::OtherDevice) => Rejection::OtherDevice,
            (Probe::Wrong(_), _) | (_, Rejection::Checksum) => Rejection::Checksum,
            (Probe::No(_), _) if frame.data().len() == format.layout.lengths().0 => Rejection::OtherDevice,
            _ => Rejection::WrongLength,
        };
    }
    Err(why)
}

pub(crate) fn elements(bindings: &[InputBind]) -> impl Iterator<Item = Element> {
    bindings.iter().map(InputBind::element)
}

impl DeviceCodec {
    /// The frames of a recipe, whose bindings will begin at these places.
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
                    .push(DeviceFormat { layout, id, bindings })
                    .map_err(|_| one_too_many(Counted::DeviceFrames, MAX_DEVICE_FRAMES))?;
                if part == Direction::Input {
                    codec.inputs = codec.inputs.saturating_add(1);
                }
            }
        }
        Ok(codec)
    }
}

impl FieldPort {
    /// Reads the frames in `rest`; see [`FieldPort::frames`].
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
        let framer = match &mut self.codec {
            Codec::Device(DeviceCodec { inputs: 0, .. }) => {
                self.not_asked_for(bytes, tap, now);
                return accepted;
            }
            Codec::Device(DeviceCodec { reader: Some(Reader::Whole { .. }), .. }) => {
                *rest = bytes;
                return self.whole_frames(rest, bindings, store, commands, tap);
            }
            Codec::Device(DeviceCodec {
                formats,
                inputs,
                texts,
                reader: Some(Reader::Search(framer)),
                ..
            }) => Some((formats.get(..usize::from(*inputs)).unwrap_or(&[]), texts, framer)),
            _ => None,
        };
        let Some((formats, texts, framer)) = framer else { return accepted };
        let (reply, counters) = (&mut self.reply, &mut self.counters);
        let mut frames = FrameContext::new((self.id, self.mode), reply, counters, bindings, store, commands);
        let effort = formats
            .iter()
            .map(|format| format.layout.lengths().1.saturating_add(usize::from(format.bindings.len)));
        let effort = effort.fold(0, usize::saturating_add);
        while let Some(found) =
            framer.next_frame(&mut left, effort, |bytes| probe_all(formats, bindings, bytes))
        {
            let (frame, verdict) = match found {
                Found::Frame(frame) => {
                    let is_this = |format: &&DeviceFormat| matches!(probe(format, bindings, frame), Probe::Frame(len) if len == frame.len());
                    let taken =
                        (0..).zip(formats).find(|(_, format)| is_this(format)).map(|(nth, format)| {
                            let slot = usize::from(self.first_frame).saturating_add(nth);
                            frames.take_device(format, texts, frame, slot, &mut accepted)
                        });
                    (frame, taken.unwrap_or(Err(Rejection::NoFrame)))
                }
                Found::Other(frame) => (frame, frames.rejected(Rejection::OtherDevice)),
                Found::Wrong(frame) => (frame, frames.rejected(Rejection::Checksum)),
            };
            tap.record(|| came(self.id, now, verdict, None, [frame, &[], &[]]));
            keep_why(&mut self.last_rejection, verdict, frames.store, None, frame);
            // What is held can hold further frames, so only the rest of the chunk waits.
            if verdict.is_ok() && frames.store.watches_bits && !left.is_empty() {
                break;
            }
        }
        *rest = left;
        self.note_skipped(bytes, tap, now);
        self.sender.frames_accepted(accepted.frames, usable, &mut self.counters, now);
        accepted
    }

    /// Counts what the search for frames has skipped, in these bytes or those held before.
    pub(crate) fn note_skipped(&mut self, bytes: &[u8], tap: &mut Tap, now: Instant) {
        let Codec::Device(DeviceCodec { reader: Some(Reader::Search(framer)), skipped_bytes, .. }) =
            &mut self.codec
        else {
            return;
        };
        let stats = framer.stats();
        self.counters.resync_bytes = stats.skipped_bytes;
        // The bytes of a frame with a wrong checksum were reported as that.
        let noise = stats.noise_bytes.wrapping_sub(*skipped_bytes);
        if noise > 0 {
            *skipped_bytes = stats.noise_bytes;
            self.no_frame(bytes, noise as usize, tap, now);
        }
    }

    /// A frame from the bus; see [`FieldPort::can`].
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

    /// The frame of the device that is due.
    pub(crate) fn next_device(
        &mut self,
        image: &Image,
        bindings: Outputs<'_>,
        out: &mut [u8],
        now: Instant,
    ) -> Option<Downward> {
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
                    // What was sent last is still the newest. The frames of a cycle belong together.
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
            Some(_) => Downward::Bytes(len),
            None => Downward::Can(CanFrame::cut(format.id, frame)),
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
