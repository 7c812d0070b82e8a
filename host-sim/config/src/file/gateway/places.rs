//! Maps places of the configuration to places in the file.

use proto_core::config::{ControllerKey, NetworkKey, Place, RecipeKey};
use proto_core::sysvar::Direction;

use super::super::lines::key_name;
use super::super::model::{FileField, FilePart, FileRecipe};
use super::super::reader::{Spot, TableReader};
use super::Assembly;

impl Assembly<'_> {
    /// The place in the file, if it has one.
    pub(super) fn spot(&self, place: Place) -> Option<Spot> {
        let recipe = |index: u8| self.recipes.get(usize::from(index));
        match place {
            Place::Controller(key) => self.key_of_section("controller", controller_key(key)),
            Place::Network(key) => self.key_of_section("network", network_key(key)),
            Place::Recipe { recipe: index, key } => Some(recipe(index)?.spot_of_key(key).clone()),
            Place::Part { recipe: index, part } => Some(recipe(index)?.part(part)?.spot.clone()),
            Place::Frame { recipe: index, part, frame } => {
                Some(recipe(index)?.frames(part).nth(frame.into())?.0.clone())
            }
            Place::Field { recipe: index, part, frame, field } => {
                let (_, fields) = recipe(index)?.frames(part).nth(frame.into())?;
                Some(fields.get(usize::from(field))?.spot.clone())
            }
            Place::Exchange { recipe: index, exchange, key } => {
                let spots = &recipe(index)?.exchanges.get(usize::from(exchange))?.spots;
                spots.iter().find(|(known, _)| *known == key).map(|(_, spot)| spot.clone())
            }
            Place::Command { entry } => self.commands.get(usize::from(entry)).cloned(),
            Place::Port { port, key } => Some(spot_in(self.ports.get(usize::from(port))?, key_name(key))),
            Place::SafeValue { entry } => self.safe_values.get(usize::from(entry)).cloned(),
            _ => None,
        }
    }

    fn key_of_section(&self, section: &str, key: &str) -> Option<Spot> {
        Some(spot_in(&self.root.optional(section)?.any_table().ok()?, key))
    }
}

/// The place of a key; that of its table if it is absent.
fn spot_in(table: &TableReader<'_>, key: &str) -> Spot {
    table.optional(key).map_or(table.spot.clone(), |item| item.spot)
}

fn controller_key(key: ControllerKey) -> &'static str {
    match key {
        ControllerKey::Dialect => "dialect",
        ControllerKey::Ports => "ports",
        ControllerKey::RecipeLink => "recipe_link",
        _ => "address",
    }
}

fn network_key(key: NetworkKey) -> &'static str {
    match key {
        NetworkKey::Router => "router",
        NetworkKey::Dns => "dns",
        _ => "address",
    }
}

impl FileRecipe {
    fn spot_of_key(&self, key: RecipeKey) -> &Spot {
        let send = || self.output.as_ref()?.sending.send_spot.as_ref();
        match key {
            RecipeKey::Name => &self.name_spot,
            RecipeKey::Send => send().unwrap_or(&self.spot),
            _ => &self.spot,
        }
    }

    /// The frames of a part in the order of [`Place::Frame`]: those of exchanges come after those of the part, pending
    /// replies and refusals only if they have values.
    fn frames(&self, part: Direction) -> impl Iterator<Item = (&Spot, &[FileField])> {
        let of_exchanges = self.exchanges.iter().flat_map(move |exchange| match part {
            Direction::Output => [exchange.output.as_ref(), None, None],
            Direction::Input => {
                [exchange.input.as_ref(), with_values(&exchange.pending), with_values(&exchange.refusal)]
            }
        });
        let own = self.part(part).into_iter().flat_map(|part| &part.frames);
        let of_exchanges = of_exchanges.flatten().map(|part| (&part.spot, part.fields()));
        own.map(|frame| (&frame.spot, &frame.fields[..])).chain(of_exchanges)
    }
}

fn with_values(part: &Option<FilePart>) -> Option<&FilePart> {
    part.as_ref().filter(|part| part.fields().iter().any(|field| field.spec().has_value()))
}
