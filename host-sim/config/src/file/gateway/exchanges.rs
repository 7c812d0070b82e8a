//! The exchanges of a recipe, as the configuration has them.

use proto_core::config::{Exchange, FrameSpec, MAX_EXCHANGES, Place, Span, Transaction};
use proto_core::sysvar::Direction;

use super::super::model::{FileExchange, FilePart, FileRecipe};
use super::{Builder, Result, delimiter};
use crate::device::ExchangeKind;

impl Builder<'_> {
    pub(super) fn add_exchanges(&mut self, recipe: u8, from: &FileRecipe) -> Result<Span> {
        let start = self.config.exchanges.len() as u16;
        // The frames of exchanges are counted on behind those of the parts.
        let frames = |part: Direction| from.part(part).map_or(0, |part| part.frames.len()) as u8;
        let mut numbers = [frames(Direction::Input), frames(Direction::Output)];
        for (nth, exchange) in from.exchanges.iter().enumerate() {
            let Ok(number) = u8::try_from(nth) else { break };
            for (key, spot) in &exchange.spots {
                let place = Place::Exchange { recipe, exchange: number, key: *key };
                self.spots.insert(place, spot.clone());
            }
            let (transaction, pending) = self.transaction(recipe, exchange, &mut numbers)?;
            let added = Exchange { transaction, pending, ..exchange.settings };
            if self.config.exchanges.push(added.repeated(exchange.retries)).is_err() {
                return Err(self.too_many(exchange));
            }
        }
        Ok(Span { start, len: self.config.exchanges.len() as u16 - start })
    }

    fn too_many(&self, exchange: &FileExchange) -> super::super::FileError {
        let message = format!(
            "too many exchanges; at most {MAX_EXCHANGES}, and as many frames, in all recipes together"
        );
        self.error(&exchange.spot, message)
    }

    /// The frames, and the pending answer.
    fn transaction(
        &mut self,
        recipe: u8,
        from: &FileExchange,
        numbers: &mut [u8; 2],
    ) -> Result<(Transaction, Option<u8>)> {
        let [inputs, outputs] = numbers;
        let output = self.frame_fields(recipe, Direction::Output, from.output.as_ref(), outputs)?;
        let input = self.frame_fields(recipe, Direction::Input, from.input.as_ref(), inputs)?;
        let fields = |span: Option<Span>| span.unwrap_or_default();
        match from.kind {
            ExchangeKind::Frames => {}
            ExchangeKind::Master(operation) => {
                return Ok((
                    Transaction::Rtu { operation, written: fields(output), read: fields(input) },
                    None,
                ));
            }
            ExchangeKind::Slave(operation) => {
                return Ok((
                    Transaction::Served { operation, written: fields(input), read: fields(output) },
                    None,
                ));
            }
        }
        let pending = self.other_fields(recipe, from.pending.as_ref(), inputs)?;
        let refusal = self.other_fields(recipe, from.refusal.as_ref(), inputs)?;
        let request = self.add_frame(from, from.output.as_ref(), output, from.remote)?;
        let reply = self.add_frame(from, from.input.as_ref(), input, false)?;
        let pending = self.add_frame(from, from.pending.as_ref(), pending, false)?;
        let refusal = self.add_frame(from, from.refusal.as_ref(), refusal, false)?;
        Ok((Transaction::Frames { request, reply, refusal }, pending))
    }

    /// The fields of a pending answer or a refusal. Without values, nothing of it has a place of its own in later
    /// checks.
    fn other_fields(&mut self, recipe: u8, file: Option<&FilePart>, next: &mut u8) -> Result<Option<Span>> {
        let has_values = |file: &FilePart| file.fields().iter().any(|field| field.spec().has_value());
        let mut none = u8::MAX;
        let number = if file.is_some_and(has_values) { next } else { &mut none };
        self.frame_fields(recipe, Direction::Input, file, number)
    }

    /// The fields of a frame, which takes the next number.
    fn frame_fields(
        &mut self,
        recipe: u8,
        part: Direction,
        file: Option<&FilePart>,
        number: &mut u8,
    ) -> Result<Option<Span>> {
        let Some(file) = file else { return Ok(None) };
        self.spots.insert(Place::Frame { recipe, part, frame: *number }, file.spot.clone());
        let span = self.add_fields(recipe, part, *number, file.fields())?;
        *number = number.saturating_add(1);
        Ok(Some(span))
    }

    fn add_frame(
        &mut self,
        exchange: &FileExchange,
        file: Option<&FilePart>,
        fields: Option<Span>,
        remote: bool,
    ) -> Result<Option<u8>> {
        let (Some(file), Some(fields)) = (file, fields) else { return Ok(None) };
        let is_can = exchange.is_can;
        let frame = FrameSpec {
            id: file.frames.first().filter(|_| is_can).map(|frame| frame.id),
            remote,
            head: delimiter(&file.head),
            tail: delimiter(&file.tail),
            fields,
        };
        let index = self.config.frames.len() as u8;
        match self.config.frames.push(frame) {
            Ok(()) => Ok(Some(index)),
            Err(_) => Err(self.too_many(exchange)),
        }
    }
}
