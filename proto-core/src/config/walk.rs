//! Walks over the frames of a recipe, their fields and their variables.
//!
//! They are written out: the checks, the plan and the engine walk many times when they start, and a
//! chain of adapters asks each of its parts at every step, also those that only devices have.

use core::slice::Iter;

use super::{CanFramePart, Exchange, FieldSpec, FrameSpec, Span};
use crate::sysvar::{Direction, SysVar};

/// The field ranges of one part: one for a stream part, one for each CAN frame.
#[derive(Debug, Clone)]
pub(crate) struct PartFrames<'c> {
    pub(super) stream: Option<Span>,
    pub(super) can: Iter<'c, CanFramePart>,
}

impl Iterator for PartFrames<'_> {
    type Item = Span;

    fn next(&mut self) -> Option<Span> {
        let can = self.can.next().map(|frame| frame.fields);
        can.or_else(|| self.stream.take())
    }
}

/// The same and those of the frames of exchanges behind them, counted.
#[derive(Debug, Clone)]
pub(crate) struct Frames<'c> {
    pub(super) parts: PartFrames<'c>,
    pub(super) exchanges: Iter<'c, Exchange>,
    /// The exchange that the newest frame is of, and whether the frame is its reply; `None` if it is of a part.
    pub(super) of: Option<(&'c Exchange, bool)>,
    /// What is left of that exchange: its pending answer and its refusal.
    pub(super) others: [Option<Span>; 2],
    pub(super) frames: &'c [FrameSpec],
    pub(super) pool: &'c [FieldSpec],
    pub(super) part: Direction,
    pub(super) count: u8,
}

impl Iterator for Frames<'_> {
    type Item = (u8, Span);

    fn next(&mut self) -> Option<(u8, Span)> {
        let span = self.parts.next().or_else(|| self.of_exchanges())?;
        let nth = self.count;
        self.count = nth.wrapping_add(1);
        Some((nth, span))
    }
}

impl<'c> Frames<'c> {
    /// The exchange that the newest frame is of, and whether the frame is its reply; `None` if it is of a part.
    pub(crate) fn exchange(&self) -> Option<(&'c Exchange, bool)> {
        self.of
    }

    #[inline(never)]
    fn of_exchanges(&mut self) -> Option<Span> {
        if let Some(span) = self.others.iter_mut().find_map(Option::take) {
            self.of = self.of.map(|(exchange, _)| (exchange, false));
            return Some(span);
        }
        for exchange in self.exchanges.by_ref() {
            let Some(span) = exchange.fields(self.frames, self.part) else { continue };
            self.of = Some((exchange, true));
            if self.part == Direction::Input {
                self.others = exchange.other_answers(self.frames, self.pool);
            }
            return Some(span);
        }
        None
    }
}

/// The fields of these frames, each with the frame's number and its own.
#[derive(Debug, Clone)]
pub(super) struct FrameFieldIter<'c> {
    pub(super) frames: Frames<'c>,
    pub(super) pool: &'c [FieldSpec],
    /// What is left of a frame.
    pub(super) fields: Iter<'c, FieldSpec>,
    pub(super) frame: u8,
    pub(super) count: u8,
}

impl<'c> Iterator for FrameFieldIter<'c> {
    type Item = (u8, u8, &'c FieldSpec);

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(field) = self.fields.next() {
                let nth = self.count;
                self.count = nth.wrapping_add(1);
                return Some((self.frame, nth, field));
            }
            let (frame, span) = self.frames.next()?;
            (self.frame, self.count, self.fields) = (frame, 0, span.of(self.pool).iter());
        }
    }
}

/// The variables of these fields.
#[derive(Debug, Clone)]
pub(super) struct FrameVariables<'c> {
    pub(super) fields: FrameFieldIter<'c>,
    /// What is left of a field.
    pub(super) variables: Variables,
}

impl Iterator for FrameVariables<'_> {
    type Item = SysVar;

    fn next(&mut self) -> Option<SysVar> {
        loop {
            if let Some(var) = self.variables.next() {
                return Some(var);
            }
            let (_, _, field) = self.fields.next()?;
            self.variables = field.all_variables();
        }
    }
}

/// The variables of a field: words that follow each other, then single ones.
#[derive(Debug, Clone)]
pub(super) struct Variables {
    /// Ordinals of the words that are left: the first, and the first behind them.
    pub(super) words: (usize, usize),
    pub(super) others: [Option<SysVar>; 2],
}

impl Variables {
    /// None at all.
    pub(super) const NONE: Self = Self { words: (0, 0), others: [None; 2] };
}

impl Iterator for Variables {
    type Item = SysVar;

    fn next(&mut self) -> Option<SysVar> {
        let (next, end) = &mut self.words;
        while next < end {
            let word = SysVar::from_ordinal(*next);
            *next = next.saturating_add(1);
            if word.is_some() {
                return word;
            }
        }
        let [first, second] = &mut self.others;
        first.take().or_else(|| second.take())
    }
}
