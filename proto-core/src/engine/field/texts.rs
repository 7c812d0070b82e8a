//! Texts in device frames: to variables and from them.

use heapless::Vec;

use super::format::{DeviceFormat, elements};
use super::frames::FrameContext;
use crate::config::{ConfigView, FieldSpec, Recipe, Span, Words};
use crate::device::{ByteOrder, Ignored};
use crate::engine::rejection::Rejection;
use crate::image::{Image, bind_to_variable};
use crate::sysvar::{Direction, SysVar};
use crate::wire::scalar::Scalar;

/// Maximum number of texts of one port, input and output together.
pub(crate) const MAX_TEXTS: usize = 8;

/// The target or source of a text.
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

/// The texts of a recipe; its bindings begin at these places.
pub(crate) fn texts_of(
    config: ConfigView<'_>,
    recipe: &Recipe,
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

    pub(crate) fn is_input(&self, binding: u16) -> bool {
        self.direction == Direction::Input && self.binding == binding
    }

    /// The variables that an input text sets.
    pub(crate) fn variables(&self) -> impl Iterator<Item = SysVar> + use<> {
        let words = self.words.into_iter().flat_map(Words::iter);
        words.chain(self.length).chain(self.count)
    }

    /// Whether a text of `len` characters fits.
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
            // Cannot fail: validation has refused all other types.
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

    /// Writes an output text to the front of `out` and returns its length.
    pub(crate) fn write(&self, image: &Image, out: &mut [u8]) -> Option<usize> {
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

/// The texts among some bindings, each with its place there.
pub(crate) fn texts_in(
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
    /// The texts of an input frame, each with its place among the frame's fields, and the text if it fits.
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

    /// Whether a text of an input frame is one that is configured to be ignored.
    pub(crate) fn is_ignored(&self, texts: &[TextBind], format: &DeviceFormat, frame: &[u8]) -> bool {
        let bindings = format.bindings.of(self.bindings);
        let mut may_be =
            texts_in(texts, format.bindings, Direction::Input).filter(|(_, text)| !text.ignored.is_empty());
        may_be.any(|(at, text)| {
            let found = format.layout.text(elements(bindings), frame, at);
            found.is_some_and(|found| text.ignored.has(found))
        })
    }

    /// Puts the texts of an input frame into their variables, except those that do not fit.
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
