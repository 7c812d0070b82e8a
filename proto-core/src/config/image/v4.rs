//! Version 4, the newest: the configuration's own types in postcard format.
//!
//! To change one of these types, raise the version and keep a copy of the old type here.

use serde::Serialize;

use super::{ConfigMut, ConfigView, ImageError, item, items};
use crate::config::error::Counted;
use crate::config::{
    BoardAddress, CommandEntry, ControllerLink, Exchange, FieldSpec, FrameSpec, Port, Recipe, SafeValue,
};

/// A whole configuration, borrowed. Postcard writes a struct as its fields, and a list as its length and its items.
#[derive(Serialize)]
struct Payload<'c> {
    controller: &'c ControllerLink,
    network: BoardAddress,
    recipes: &'c [Recipe],
    ports: &'c [Port],
    fields: &'c [FieldSpec],
    commands: &'c [CommandEntry],
    safe_values: &'c [SafeValue],
    exchanges: &'c [Exchange],
    frames: &'c [FrameSpec],
}

pub(super) fn write<'o>(config: ConfigView<'_>, out: &'o mut [u8]) -> postcard::Result<&'o mut [u8]> {
    let ConfigView { controller, network, recipes, ports, fields, commands, safe_values, exchanges, frames } =
        config;
    let network = network.copied().into();
    let payload =
        Payload { controller, network, recipes, ports, fields, commands, safe_values, exchanges, frames };
    postcard::to_slice(&payload, out)
}

pub(super) fn read_head(rest: &mut &[u8], config: &mut ConfigMut<'_>) -> Result<(), ImageError> {
    *config.controller = item(rest)?;
    *config.network = item(rest)?;
    Ok(())
}

/// The lists of [`Payload`] in their order, which is the same in all readable versions.
pub(super) static LISTS: [Counted; 7] = [
    Counted::Recipes,
    Counted::Ports,
    Counted::Fields,
    Counted::Commands,
    Counted::SafeValues,
    Counted::Exchanges,
    Counted::ExchangeFrames,
];

pub(super) fn read_entries(
    list: Counted,
    count: usize,
    rest: &mut &[u8],
    config: &mut ConfigMut<'_>,
) -> Result<(), ImageError> {
    match list {
        Counted::Recipes => items::<Recipe, _>(rest, count, config.recipes),
        Counted::Ports => items::<Port, _>(rest, count, config.ports),
        Counted::Fields => items::<FieldSpec, _>(rest, count, config.fields),
        Counted::Commands => items::<CommandEntry, _>(rest, count, config.commands),
        Counted::SafeValues => items::<SafeValue, _>(rest, count, config.safe_values),
        Counted::Exchanges => items::<Exchange, _>(rest, count, config.exchanges),
        _ => items::<FrameSpec, _>(rest, count, config.frames),
    }
}
