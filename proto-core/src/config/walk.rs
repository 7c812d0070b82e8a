//! Iterators over the frames of a recipe, their fields and their variables, and queries that use them.
//!
//! They are written by hand: the checks, the plan and the engine iterate many times at the start, and a chain of
//! adapters would check each of its parts in every step, even those that only devices have.

use core::slice::Iter;

use super::error::{ExchangeKey, Place, PortKey};
use super::recipe::{PartFrames, Variables};
use super::{ConfigView, Exchange, FieldSpec, FrameSpec, OutputBinding, Port, Recipe, Span};
use crate::sysvar::{Direction, SysVar, VarBit};

/// Iterates over the frames of a part and those of the exchanges after them, with their numbers.
#[derive(Debug, Clone)]
pub(crate) struct Frames<'c> {
    parts: PartFrames<'c>,
    exchanges: Iter<'c, Exchange>,
    /// The exchange of the newest frame, and whether the frame is its reply; `None` for a frame of a part.
    of: Option<(&'c Exchange, bool)>,
    /// The remaining frames of that exchange: its pending answer and its refusal.
    others: [Option<Span>; 2],
    frames: &'c [FrameSpec],
    pool: &'c [FieldSpec],
    part: Direction,
    count: u8,
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
    /// The exchange of the newest frame, and whether the frame is its reply; `None` for a frame of a part.
    pub(crate) fn exchange(&self) -> Option<(&'c Exchange, bool)> {
        self.of
    }

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

/// Iterates over the fields of the frames, each with the frame's number and its own index.
#[derive(Debug, Clone)]
pub(super) struct FrameFieldIter<'c> {
    frames: Frames<'c>,
    pool: &'c [FieldSpec],
    /// The remaining fields of the frame.
    fields: Iter<'c, FieldSpec>,
    frame: u8,
    count: u8,
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

/// Iterates over the variables of the fields.
#[derive(Debug, Clone)]
pub(super) struct FrameVariables<'c> {
    fields: FrameFieldIter<'c>,
    /// The remaining variables of the field.
    variables: Variables,
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

impl<'c> ConfigView<'c> {
    /// The exchanges of a recipe.
    pub fn exchanges_of(self, recipe: &Recipe) -> &'c [Exchange] {
        recipe.exchanges.of(self.exchanges)
    }

    /// The ranges of the fields of one part of `recipe`, with the frame's number: 0 in a stream, otherwise the index of
    /// the CAN frame. The frames of the exchanges follow, counted after those of the part.
    pub(crate) fn frames_of(self, recipe: &'c Recipe, part: Direction) -> Frames<'c> {
        let exchanges = self.exchanges_of(recipe).iter();
        let (frames, pool) = (self.frames, self.fields);
        let (of, others) = (None, [None; 2]);
        Frames { parts: recipe.part_frames(part), exchanges, of, others, frames, pool, part, count: 0 }
    }

    /// Whether frames are received (input) or sent (output).
    pub(crate) fn has_frames(self, recipe: &'c Recipe, part: Direction) -> bool {
        self.frames_of(recipe, part).next().is_some()
    }

    /// The fields of one part of `recipe`, with the number of the frame (see `frames_of`) and the index of the field in
    /// it.
    pub fn fields_of(
        self,
        recipe: &'c Recipe,
        part: Direction,
    ) -> impl Iterator<Item = (u8, u8, &'c FieldSpec)> {
        self.frame_fields(recipe, part)
    }

    fn frame_fields(self, recipe: &'c Recipe, part: Direction) -> FrameFieldIter<'c> {
        let frames = self.frames_of(recipe, part);
        FrameFieldIter { frames, pool: self.fields, fields: [].iter(), frame: 0, count: 0 }
    }

    /// The input variables that a field port writes as a whole.
    pub fn written_by(self, recipe: &'c Recipe) -> impl Iterator<Item = SysVar> + 'c {
        let fields = self.frame_fields(recipe, Direction::Input);
        FrameVariables { fields, variables: Variables::NONE }
    }

    /// Whether a field of one part of `recipe` is bound to the variable.
    pub(crate) fn carries(self, recipe: &'c Recipe, part: Direction, var: SysVar) -> bool {
        let mut frames = self.frames_of(recipe, part);
        frames.any(|(_, span)| span.of(self.fields).iter().any(|field| field.is_bound_to(var)))
    }

    /// The input variables that a field port owns: those that its frames write, and those for its health.
    pub fn owned_by(self, port: &'c Port, recipe: &'c Recipe) -> impl Iterator<Item = SysVar> + 'c {
        self.written_by(recipe).chain(self.status_variables(0, port, recipe).map(|(_, var)| var))
    }

    /// The input variables that report something about the port with this index to the robot: its health, and the
    /// outcome of events. Each with its place.
    pub(crate) fn status_variables(
        self,
        index: u8,
        port: &'c Port,
        recipe: &'c Recipe,
    ) -> impl Iterator<Item = (Place, SysVar)> + 'c {
        let health = Place::Port { port: index, key: PortKey::Health };
        let outcomes = (0..).zip(self.exchanges_of(recipe)).flat_map(move |(exchange, of)| {
            let place = Place::Exchange { recipe: port.recipe, exchange, key: ExchangeKey::Outcome };
            of.outcome.variables().map(move |var| (place, var))
        });
        port.health.iter().map(move |(_, var)| (health, var)).chain(outcomes)
    }

    /// Whether the output part of a field port shows a value of the controller's state packet.
    pub(crate) fn shows_state(self) -> bool {
        let shows = |field: &FieldSpec| matches!(field.source(), Some(OutputBinding::State { .. }));
        self.field_ports()
            .any(|(_, _, recipe)| self.fields_of(recipe, Direction::Output).any(|(_, _, field)| shows(field)))
    }

    /// The bits that a field port writes individually.
    pub fn bits_written_by(self, recipe: &'c Recipe) -> impl Iterator<Item = VarBit> + 'c {
        self.fields_of(recipe, Direction::Input).filter_map(|(_, _, field)| field.bit())
    }

    /// Whether a field port writes the variable.
    pub(super) fn is_owned(self, var: SysVar) -> bool {
        self.field_ports().any(|(_, port, recipe)| {
            self.carries(recipe, Direction::Input, var)
                || self.status_variables(0, port, recipe).any(|(_, own)| own == var)
        })
    }
}
