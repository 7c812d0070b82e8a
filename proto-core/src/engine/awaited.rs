//! What may come on a port with exchanges, and what a frame that came is.
//!
//! In: the request on its way, and the frames that come unasked. Out: the frame's part in it. Applies
//! nothing.

use super::device_port::{DeviceFormat, better, elements, probe};
use super::exchanges::{Asks, InputFormat, Item};
use super::line::{Flight, OwnRequest};
use super::user::InputBind;
use crate::device::Probe;
use crate::modbus::rtu::{self, Expected, REFUSAL_LEN};

/// What a received frame is.
pub(super) enum Heard<'i> {
    /// The echo of the own request.
    Echo,
    /// The awaited reply; the data of a Modbus frame, or the frame.
    Reply(Option<&'i InputFormat>),
    /// The device refuses the request.
    Refusal,
    /// A frame that comes unasked, and its place in the store.
    Unasked(&'i DeviceFormat, usize),
}

/// What may come now.
#[derive(Clone, Copy)]
pub(super) struct Awaited<'i> {
    /// The frames of the recipe's part.
    pub formats: &'i [DeviceFormat],
    pub first_frame: u8,
    pub items: &'i [Item],
    pub flight: Option<Flight>,
    /// The echo of the request comes before its reply.
    pub echo: Option<OwnRequest>,
    pub bindings: &'i [InputBind],
}

impl<'i> Awaited<'i> {
    pub(super) fn asked(&self) -> Option<&'i Item> {
        self.items.get(usize::from(self.flight?.exchange))
    }

    pub(super) fn expected(&self) -> Option<Expected> {
        self.flight?.expected
    }

    /// The reply and the refusal that a device's own frames are.
    pub(super) fn answers(&self) -> impl Iterator<Item = &'i DeviceFormat> {
        let item = self.asked().filter(|_| self.echo.is_none());
        let item = item.filter(|item| matches!(item.asks, Asks::Frame | Asks::Remote { .. }));
        let reply = |item: &'i Item| item.reply.iter().map(|reply| &reply.format).chain(&item.refusal);
        item.into_iter().flat_map(reply)
    }

    pub(super) fn unasked(&self) -> impl Iterator<Item = (&'i DeviceFormat, usize)> {
        let part = (usize::from(self.first_frame)..).zip(self.formats).map(|(slot, format)| (format, slot));
        let others = self.items.iter().filter(|item| matches!(item.asks, Asks::Nothing));
        let others = others.filter_map(|item| item.reply.as_ref());
        part.chain(others.map(|reply| (&reply.format, usize::from(reply.slot))))
    }

    /// What bytes of a line are.
    pub(super) fn probe(&self, bytes: &[u8]) -> Probe {
        let mut best = match self.expected().filter(|_| self.echo.is_none()) {
            Some(expected) => match expected.probe(bytes) {
                rtu::Probe::No => Probe::No(1),
                rtu::Probe::Partial => Probe::Partial(1),
                rtu::Probe::Reply(len) => Probe::Frame(len),
                rtu::Probe::Refused(_) => Probe::Frame(REFUSAL_LEN),
                rtu::Probe::Wrong => Probe::Wrong(expected.len_of(bytes)),
            },
            None => Probe::No(1),
        };
        if let Some(echo) = &self.echo {
            best = echo.probe(bytes);
        }
        for format in self.all() {
            best = better(best, probe(format, self.bindings, bytes));
        }
        let Probe::Other(_) = best else { return best };
        // One of ours may begin with what is a shorter frame by chance: a byte that is the same as that of
        // the shorter one's checksum goes on with a right checksum.
        let begun = |format: &DeviceFormat| match probe(format, self.bindings, bytes) {
            Probe::Partial(missing) => {
                let fields = elements(format.bindings.of(self.bindings));
                format.layout.agrees(fields, bytes).then_some(missing)
            }
            _ => None,
        };
        self.all().filter_map(begun).min().map_or(best, Probe::Partial)
    }

    /// The frames that may come, but for those of Modbus.
    fn all(&self) -> impl Iterator<Item = &'i DeviceFormat> {
        self.answers().chain(self.unasked().map(|(format, _)| format))
    }

    /// What a frame of a line is that [`Self::probe`] has found.
    pub(super) fn heard(&self, frame: &[u8]) -> Option<Heard<'i>> {
        let is = |format: &DeviceFormat| matches!(probe(format, self.bindings, frame), Probe::Frame(len) if len == frame.len());
        if let Some(echo) = &self.echo {
            if echo.probe(frame) == Probe::Frame(frame.len()) {
                return Some(Heard::Echo);
            }
        } else if let Some(expected) = self.expected() {
            match expected.probe(frame) {
                rtu::Probe::Reply(_) => return Some(Heard::Reply(self.asked()?.reply.as_ref())),
                rtu::Probe::Refused(_) => return Some(Heard::Refusal),
                _ => {}
            }
        }
        self.answer(is).or_else(|| {
            let (format, slot) = self.unasked().find(|(format, _)| is(format))?;
            Some(Heard::Unasked(format, slot))
        })
    }

    pub(super) fn answer(&self, is: impl Fn(&DeviceFormat) -> bool) -> Option<Heard<'i>> {
        let found = self.answers().find(|answer| is(answer))?;
        let reply = self.asked()?.reply.as_ref();
        let reply = reply.filter(|reply| core::ptr::eq(&reply.format, found));
        Some(reply.map_or(Heard::Refusal, |reply| Heard::Reply(Some(reply))))
    }
}
