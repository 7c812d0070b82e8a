//! The format of a device frame, and matching of received bytes against formats.
//!
//! In: bytes or CAN data, and the bindings with a frame's elements. Out: a frame, or why there is none (yet). Applies
//! nothing.

use super::bindings::InputBind;
use crate::config::Span;
use crate::device::{Element, FrameLayout, Probe};
use crate::engine::rejection::Rejection;
use crate::wire::can::{CanFrame, CanKey};

#[derive(Debug, Clone)]
pub(crate) struct DeviceFormat {
    pub layout: FrameLayout,
    /// Its id on a CAN bus.
    pub key: CanKey,
    /// Its range in the bindings of its direction, which have its elements.
    pub bindings: Span,
}

impl DeviceFormat {
    /// About how many steps it takes to see that bytes are not this frame.
    pub(crate) fn effort(&self) -> usize {
        self.layout.lengths().1.saturating_add(usize::from(self.bindings.len))
    }

    /// Whether a frame that was found is this one.
    pub(crate) fn is_frame(&self, bindings: &[InputBind], frame: &[u8]) -> bool {
        probe(self, bindings, frame) == Probe::Frame(frame.len())
    }
}

/// Matches bytes against all formats: a frame takes precedence over a partial frame, and a partial frame over a wrong
/// checksum.
pub(crate) fn probe_all(formats: &[DeviceFormat], bindings: &[InputBind], bytes: &[u8]) -> Probe {
    let probes = formats.iter().map(|format| probe(format, bindings, bytes));
    probes.fold(Probe::No(0), better)
}

/// The better of two matches of the same bytes.
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

/// The format of a whole frame.
pub(crate) fn judge<'f>(
    formats: &'f [DeviceFormat],
    bindings: &[InputBind],
    frame: &[u8],
) -> Result<(usize, &'f DeviceFormat), Rejection> {
    let mut verdict = Rejection::WrongLength;
    for (nth, format) in formats.iter().enumerate() {
        let layout = &format.layout;
        let (shortest, longest) = layout.lengths();
        let why = match layout.probe_whole(elements(format.bindings.of(bindings)), frame) {
            Probe::Frame(_) => return Ok((nth, format)),
            Probe::Wrong(_) => Rejection::Checksum,
            Probe::Other(_) => Rejection::OtherDevice,
            Probe::No(_) if (shortest..=longest).contains(&frame.len()) => Rejection::OtherDevice,
            Probe::No(_) | Probe::Partial(_) => Rejection::WrongLength,
        };
        // The reason closest to a match is the most useful one.
        verdict = match (verdict, why) {
            (Rejection::Checksum, _) | (_, Rejection::Checksum) => Rejection::Checksum,
            (Rejection::OtherDevice, _) | (_, Rejection::OtherDevice) => Rejection::OtherDevice,
            _ => Rejection::WrongLength,
        };
    }
    Err(verdict)
}

/// The format of CAN data with this id, or why there is none: frames with the same id differ in constants.
pub(crate) fn judge_can<'f, T>(
    formats: impl Iterator<Item = (T, &'f DeviceFormat)>,
    bindings: &[InputBind],
    frame: &CanFrame,
) -> Result<(T, &'f DeviceFormat), Rejection> {
    let mut why = Rejection::ForeignId;
    for (what, format) in formats.filter(|(_, format)| format.key == frame.key()) {
        let fields = elements(format.bindings.of(bindings));
        let probe = format.layout.probe_whole(fields, frame.data());
        why = match (probe, why) {
            (Probe::Frame(_), _) => return Ok((what, format)),
            // Valid except for a constant: another device's frame, whatever the other formats say.
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
