//! Version 3, the newest: the configuration's own types, as postcard writes them one after the other.
//!
//! A change of one of these types raises the version, and leaves a copy of the old type here.

use serde::Serialize;

use super::{ConfigMut, ConfigView, ImageError, item, items};
use crate::config::error::Counted;
use crate::config::{
    BoardAddress, CommandEntry, ControllerLink, Exchange, FieldSpec, FrameSpec, Port, Recipe, SafeValue,
};

/// A whole configuration, borrowed. Postcard writes a struct as its fields, and a list as its length
/// and its items.
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

pub(super) fn read(rest: &mut &[u8], config: &mut ConfigMut<'_>) -> Result<(), ImageError> {
    *config.controller = item(rest)?;
    *config.network = item(rest)?;
    items::<Recipe, _>(rest, Counted::Recipes, config.recipes)?;
    items::<Port, _>(rest, Counted::Ports, config.ports)?;
    items::<FieldSpec, _>(rest, Counted::Fields, config.fields)?;
    items::<CommandEntry, _>(rest, Counted::Commands, config.commands)?;
    items::<SafeValue, _>(rest, Counted::SafeValues, config.safe_values)?;
    items::<Exchange, _>(rest, Counted::Exchanges, config.exchanges)?;
    items::<FrameSpec, _>(rest, Counted::ExchangeFrames, config.frames)
}
