//! Recipes of a file as the builder of configurations takes them.

use proto_core::config::{
    CanFields, CommandEntry, ConfigError, ConfigErrorKind, Counted, ExchangeBuilder, ExchangeFrame,
    FieldSpec, InputBinding, MAX_ALL_FIELDS, MAX_COMMAND_TEXT, MAX_COMMANDS, MAX_EXCHANGES, MAX_RECIPES,
    Recipe, Span,
};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::Direction;

use super::super::model::{FileExchange, FileField, FilePart, FileRecipe};
use super::super::reader::Spot;
use super::super::{FileError, sources};
use super::{Assembly, Result};
use crate::device::ExchangeKind;

/// The fields of each frame.
type Frames = Vec<Vec<FieldSpec>>;

impl Assembly<'_> {
    pub(super) fn add_recipe(&mut self, from: &FileRecipe) -> Result<()> {
        if self.config.recipes.is_full() {
            return Err(self.error(&from.spot, format!("too many recipes; at most {MAX_RECIPES}")));
        }
        let input = self.frames(from.input.as_ref())?;
        let output = self.frames(from.output.as_ref())?;
        let mut exchanges: Vec<Vec<Frames>> = Vec::new();
        for one in &from.exchanges {
            exchanges.push(one.parts().iter().map(|part| self.frames(part.as_ref())).collect::<Result<_>>()?);
        }
        let exchanges: Vec<_> =
            from.exchanges.iter().zip(&exchanges).map(|(one, frames)| one.builder(frames)).collect();
        let (can_input, can_output) = (can_frames(&from.input, &input), can_frames(&from.output, &output));
        let mut recipe = match from.mode {
            Mode::Realtime => Recipe::realtime(&from.name),
            Mode::User => Recipe::user(&from.name),
        };
        recipe = recipe.exchanges(&exchanges).on_stale(from.on_stale.unwrap_or_default());
        if let Some(part) = &from.input {
            recipe = match from.is_can() {
                true => recipe.can_input(&can_input),
                false => recipe.stream_input(&part.head, &part.tail, first(&input)),
            };
            recipe = recipe.framing(Direction::Input, part.framing.0, part.framing.1);
        }
        if let Some(part) = &from.output {
            recipe = match from.is_can() {
                true => recipe.can_output(&can_output),
                false => recipe.stream_output(&part.head, &part.tail, first(&output)),
            };
            recipe = recipe.framing(Direction::Output, part.framing.0, part.framing.1);
            recipe = recipe.on_stale(part.sending.on_stale).send(part.sending.send);
        }
        match self.config.add_recipe(&recipe) {
            Ok(_) => Ok(()),
            Err(error) => Err(self.refused_recipe(from, error)),
        }
    }

    /// The place in the file of what exceeds a capacity.
    fn refused_recipe(&self, from: &FileRecipe, error: ConfigError) -> FileError {
        match error.kind {
            ConfigErrorKind::TooMany { what: Counted::Fields, .. } => {
                let parts = [&from.input, &from.output]
                    .into_iter()
                    .chain(from.exchanges.iter().flat_map(FileExchange::parts));
                let mut fields =
                    parts.flatten().flat_map(|part| part.frames.iter().flat_map(|frame| &frame.fields));
                let first = fields.nth(MAX_ALL_FIELDS - self.config.fields.len());
                let message = format!("too many fields; at most {MAX_ALL_FIELDS} in all recipes together");
                self.error(first.map_or(&from.spot, |field| &field.spot), message)
            }
            ConfigErrorKind::TooMany { what: Counted::Exchanges | Counted::ExchangeFrames, .. } => {
                let (mut exchanges, mut frames) = (self.config.exchanges.len(), self.config.frames.len());
                let first = from.exchanges.iter().find(|one| {
                    let is_framed = matches!(one.kind, ExchangeKind::Frames);
                    exchanges += 1;
                    frames += one.parts().into_iter().flatten().filter(|_| is_framed).count();
                    exchanges.max(frames) > MAX_EXCHANGES
                });
                let message = format!(
                    "too many exchanges; at most {MAX_EXCHANGES}, and as many frames, in all recipes together"
                );
                self.error(first.map_or(&from.spot, |one| &one.spot), message)
            }
            _ => self.refused(error),
        }
    }

    fn frames(&mut self, part: Option<&FilePart>) -> Result<Frames> {
        let frames = part.into_iter().flat_map(|part| &part.frames);
        frames.map(|frame| frame.fields.iter().map(|field| self.field_spec(field)).collect()).collect()
    }

    fn field_spec(&mut self, field: &FileField) -> Result<FieldSpec> {
        let mut spec = field.spec();
        if let (Some(commands), Some(to)) = (&field.named.commands, spec.target_mut()) {
            let start = self.config.commands.len() as u16;
            for (entry, spot) in commands.entries.iter().zip(&field.commands) {
                self.add_command(entry, spot)?;
            }
            let table = Span { start, len: commands.entries.len() as u16 };
            *to = InputBinding::Commands { table, when: commands.when };
        }
        if let (Some(name), Some(spot), Some(from)) = (&field.named.of_port, &field.port, spec.source_mut()) {
            *from = sources::of_port(*from, name, &self.port_names)
                .map_err(|message| self.error(spot, message))?;
        }
        Ok(spec)
    }

    fn add_command(&mut self, (first, last, text): &(i64, i64, String), spot: &Spot) -> Result<()> {
        let Ok(bounded) = heapless::String::try_from(text.as_str()) else {
            let message = format!("the command has {} bytes; at most {MAX_COMMAND_TEXT}", text.len());
            return Err(self.error(spot, message));
        };
        self.commands.push(spot.clone());
        self.config.commands.push(CommandEntry { first: *first, last: *last, text: bounded }).map_err(|_| {
            self.error(spot, format!("too many commands; at most {MAX_COMMANDS} in all recipes together"))
        })
    }
}

/// The fields of a part that has one frame.
fn first(frames: &Frames) -> &[FieldSpec] {
    frames.first().map_or(&[], |fields| &fields[..])
}

fn can_frames<'s>(part: &Option<FilePart>, fields: &'s Frames) -> Vec<CanFields<'s>> {
    let frames = part.iter().flat_map(|part| &part.frames);
    frames.zip(fields).map(|(frame, fields)| CanFields::new(frame.id, &fields[..])).collect()
}

impl FileExchange {
    /// The frames to the device and from it.
    fn parts(&self) -> [&Option<FilePart>; 4] {
        [&self.output, &self.input, &self.pending, &self.refusal]
    }

    fn builder<'s>(&'s self, fields: &'s [Frames]) -> ExchangeBuilder<'s> {
        let [output, input, ..] = self.parts();
        let fields = |nth: usize| fields.get(nth).map_or(&[][..], first);
        let frame = |part: &'s Option<FilePart>, nth: usize| {
            let part = part.as_ref()?;
            Some(match part.frames.first().filter(|_| self.is_can) {
                Some(frame) if self.remote && nth == 0 => ExchangeFrame::remote(frame.id),
                Some(frame) => ExchangeFrame::can(frame.id, fields(nth)),
                None => ExchangeFrame::stream(&part.head, &part.tail, fields(nth)),
            })
        };
        let peer = self.settings.peer;
        let exchange = match self.kind {
            ExchangeKind::Master(operation) => {
                ExchangeBuilder::packed(peer, operation, false, (fields(0), fields(1)))
            }
            ExchangeKind::Slave(operation) => {
                ExchangeBuilder::packed(peer, operation, true, (fields(1), fields(0)))
            }
            ExchangeKind::Frames => {
                let [request, reply] = [frame(output, 0), frame(input, 1)];
                ExchangeBuilder::frames(request, reply, frame(&self.pending, 2), frame(&self.refusal, 3))
            }
        };
        exchange.settings(self.settings, self.retries)
    }
}
