//! Finds the reply to a request among the bytes of a line (docs/wire/modbus-rtu.md section 4).
//!
//! In: what is expected, received bytes, ends of bursts. Out: the reply. Does not know time.
//!
//! The reply is found wherever it begins, so that a false byte before it, when a transceiver
//! switches over, does no harm. Looking is bounded: each place where it could begin is looked at
//! once, and after [`MAX_WRONG`] wrong CRCs no further.

use super::super::Exception;
use super::adu::{FrameLen, MAX_ADU, is_right, reply_len};
use super::operation::{Expected, Probe};

/// Replies with wrong CRCs that are looked at for one request.
const MAX_WRONG: u8 = 8;

#[derive(Debug, Clone)]
pub(super) struct Receiver {
    buffer: [u8; MAX_ADU],
    len: usize,
    /// Where the reply may begin.
    start: usize,
    expected: Option<Expected>,
    /// Length and CRC of the own request, whose echo comes first.
    echo: Option<(usize, [u8; 2])>,
    found: Option<Found>,
    wrong: u8,
    /// The beginning of the burst is not held any more.
    cut: bool,
    stray: u32,
}

/// What answers the request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Found {
    /// The frame of the reply.
    Reply { at: usize, len: usize },
    /// The slave refuses the request.
    Refused(Exception),
}

impl Receiver {
    pub(super) const fn new() -> Self {
        Self {
            buffer: [0; MAX_ADU],
            len: 0,
            start: 0,
            expected: None,
            echo: None,
            found: None,
            wrong: 0,
            cut: false,
            stray: 0,
        }
    }

    /// A request was sent, and this answers it.
    pub(super) fn begin(&mut self, expected: Option<Expected>, echo: Option<(usize, [u8; 2])>) {
        self.drop_held();
        (self.expected, self.echo) = (expected, echo);
        (self.found, self.wrong) = (None, 0);
    }

    /// Nothing is expected any more. A reply that was found stays until the next request.
    pub(super) fn end(&mut self) {
        if self.found.is_none() {
            self.drop_held();
        }
        (self.expected, self.echo) = (None, None);
    }

    pub(super) fn take(&mut self, bytes: &[u8]) {
        let mut bytes = bytes.iter();
        while self.found.is_none()
            && let Some(expected) = self.expected
            && let Some(&byte) = bytes.next()
        {
            self.push(byte);
            if self.echo.is_some() {
                self.look_for_echo();
            } else {
                self.look(&expected);
            }
        }
        self.count_stray(bytes.len());
    }

    /// The line was silent: what follows is another frame. True if a whole frame of the slave that
    /// was asked, with the function that was asked, was not the reply.
    pub(super) fn end_burst(&mut self) -> bool {
        if self.found.is_some() {
            return false;
        }
        let held = self.held(0);
        let other = !self.cut
            && self.echo.is_none()
            && self.expected.is_some_and(|expected| expected.is_from(held))
            && reply_len(held) == FrameLen::Known(held.len())
            && is_right(held);
        self.drop_held();
        other
    }

    /// Whether bytes are held that a silence would end.
    pub(super) const fn in_burst(&self) -> bool {
        self.len != 0 && self.found.is_none()
    }

    pub(super) const fn found(&self) -> Option<Found> {
        self.found
    }

    /// Whether a reply with a wrong CRC came, and none with a right one.
    pub(super) const fn is_wrong(&self) -> bool {
        self.wrong != 0 && self.found.is_none()
    }

    /// The bytes of a reply that was found.
    pub(super) fn frame(&self, at: usize, len: usize) -> &[u8] {
        self.held(at).get(..len).unwrap_or(&[])
    }

    /// Bytes that belong to no reply.
    pub(super) const fn stray(&self) -> u32 {
        self.stray
    }

    fn held(&self, from: usize) -> &[u8] {
        self.buffer.get(from..self.len).unwrap_or(&[])
    }

    fn look_for_echo(&mut self) {
        let Some((len, crc)) = self.echo else { return };
        let held = self.held(0);
        let Some(tail) = held.len().checked_sub(len).and_then(|at| held.get(at..)) else { return };
        if tail.ends_with(&crc) && is_right(tail) {
            let before = held.len().saturating_sub(len);
            self.count_stray(before);
            (self.len, self.start, self.cut, self.echo) = (0, 0, false, None);
        }
    }

    fn look(&mut self, expected: &Expected) {
        while self.start < self.len {
            match expected.probe(self.held(self.start)) {
                Probe::Partial if self.wrong < MAX_WRONG => return,
                Probe::Reply(len) => self.find(Found::Reply { at: self.start, len }),
                Probe::Refused(exception) => self.find(Found::Refused(exception)),
                probe => {
                    self.wrong = self.wrong.saturating_add(u8::from(probe == Probe::Wrong));
                    self.start = self.start.saturating_add(1);
                    continue;
                }
            }
            return;
        }
    }

    fn find(&mut self, found: Found) {
        self.count_stray(self.start);
        self.found = Some(found);
    }

    fn push(&mut self, byte: u8) {
        if self.len >= MAX_ADU {
            self.make_room();
        }
        if let Some(slot) = self.buffer.get_mut(self.len) {
            *slot = byte;
            self.len = self.len.saturating_add(1);
        }
    }

    /// Drops bytes before the place where what is looked for may begin.
    #[cold]
    fn make_room(&mut self) {
        let needless = match self.echo {
            Some((len, _)) => self.len.saturating_sub(len.saturating_sub(1)),
            None => self.start,
        };
        let needless = needless.max(1).min(self.len);
        for at in 0..self.len.saturating_sub(needless) {
            let byte = self.buffer.get(at.saturating_add(needless)).copied().unwrap_or(0);
            if let Some(slot) = self.buffer.get_mut(at) {
                *slot = byte;
            }
        }
        self.len = self.len.saturating_sub(needless);
        self.start = self.start.saturating_sub(needless);
        self.cut = true;
        self.count_stray(needless);
    }

    fn drop_held(&mut self) {
        if self.found.is_none() {
            self.count_stray(self.len);
        }
        (self.len, self.start, self.cut) = (0, 0, false);
    }

    fn count_stray(&mut self, bytes: usize) {
        self.stray = self.stray.saturating_add(u32::try_from(bytes).unwrap_or(u32::MAX));
    }
}
