//! Configuration files: TOML to checked types, or one message that says where and what is wrong.
//!
//! In: a file and its `--set` overrides. Out: `GatewayConfig` or `SimConfig`. Every mistake is one
//! [`FileError`]; the keys are those of docs/configuration.md.

mod bindings;
mod checksums;
mod coils;
mod commands;
mod controller;
mod device;
mod document;
mod encoding;
mod error;
mod exchanges;
mod frames;
mod framings;
mod functions;
mod gateway;
mod input_rules;
mod inventory;
mod lines;
mod modbus;
mod model;
mod names;
mod network;
mod order;
mod reader;
mod recipes;
mod rtu_frames;
mod sendable;
mod sources;
mod sparkplug;

use std::path::Path;

use proto_core::config::GatewayConfig;
use proto_core::recipe::model::Mode;
use proto_core::wire::dialect::Dialect;

pub use error::{FileError, Source};
pub use inventory::{Listed, load_inventory, parse_inventory};
pub use modbus::function_name;
pub use sparkplug::{ReportRule, SparkplugFile, load_sparkplug, parse_sparkplug};

use super::device::{AnyRecipe, DeviceRecipe};
use super::keys;
use super::sim::SimConfig;
use document::SourceTree;
use model::{FileRecipe, Flavour};
use reader::{Result, TableReader, TableValue};

/// A file of either kind.
#[derive(Debug, Clone, PartialEq)]
pub enum Config {
    /// For the gateway.
    Gateway(Box<GatewayConfig>),
    /// For the simulated controller.
    Controller(Box<SimConfig>),
}

/// A configuration text and its name in messages.
#[derive(Debug, Clone, Copy)]
pub struct Text<'a> {
    /// The file's name.
    pub name: &'a str,
    /// Its content.
    pub toml: &'a str,
}

/// Reads a file of either kind.
///
/// # Errors
/// The first mistake, with its place.
pub fn load(path: &Path, overrides: &[String]) -> Result<Config> {
    with_text(path, |text| parse(text, overrides))
}

/// Reads a gateway file.
///
/// # Errors
/// The first mistake, with its place.
pub fn load_gateway(path: &Path, overrides: &[String]) -> Result<Box<GatewayConfig>> {
    with_text(path, |text| parse_gateway(text, overrides))
}

/// Reads a controller file.
///
/// # Errors
/// The first mistake, with its place.
pub fn load_controller(path: &Path, overrides: &[String]) -> Result<SimConfig> {
    with_text(path, |text| parse_controller(text, overrides))
}

/// Reads the recipes of a file of either kind, with the names of their fields.
///
/// # Errors
/// The first mistake in any of the recipes, with its place.
pub fn load_recipes(path: &Path, overrides: &[String]) -> Result<Vec<AnyRecipe>> {
    with_text(path, |text| parse_recipes(text, overrides))
}

/// Reads the recipes of a file of either kind as frames with the names and bindings of their fields, including recipes
/// that the controller can have; `None` for a recipe of system variables.
///
/// # Errors
/// The first mistake in any of the recipes, with its place.
pub fn load_frames(path: &Path, overrides: &[String]) -> Result<Vec<Option<DeviceRecipe>>> {
    with_text(path, |text| parse_frames(text, overrides))
}

/// As [`load`], from a text.
///
/// # Errors
/// The first mistake, with its place.
pub fn parse(text: Text<'_>, overrides: &[String]) -> Result<Config> {
    let document = SourceTree::parse(text.name, text.toml, overrides)?;
    match kind_of(&document)? {
        Flavour::Gateway => gateway::read(&document).map(Config::Gateway),
        Flavour::Controller => {
            let config = controller::read(&document).map_err(|error| name_kind(&document, error))?;
            Ok(Config::Controller(Box::new(config)))
        }
    }
}

/// As [`load_gateway`], from a text.
///
/// # Errors
/// The first mistake, with its place.
pub fn parse_gateway(text: Text<'_>, overrides: &[String]) -> Result<Box<GatewayConfig>> {
    let document = SourceTree::parse(text.name, text.toml, overrides)?;
    if let Ok(Flavour::Controller) = kind_of(&document)
        && has_own_section(&document)
    {
        return Err(document.whole_file_error(
            "this is a controller file, not a gateway file; run it with host-sim controller -c FILE",
        ));
    }
    gateway::read(&document)
}

/// As [`load_controller`], from a text.
///
/// # Errors
/// The first mistake, with its place.
pub fn parse_controller(text: Text<'_>, overrides: &[String]) -> Result<SimConfig> {
    let document = SourceTree::parse(text.name, text.toml, overrides)?;
    if let Ok(Flavour::Gateway) = kind_of(&document) {
        return Err(document.whole_file_error(
            "this is a gateway file, not a controller file; run it with host-sim gateway -c FILE",
        ));
    }
    controller::read(&document)
}

/// As [`load_recipes`], from a text.
///
/// # Errors
/// The first mistake in any of the recipes, with its place.
pub fn parse_recipes(text: Text<'_>, overrides: &[String]) -> Result<Vec<AnyRecipe>> {
    Ok(read_recipes(text, overrides)?.iter().map(FileRecipe::named).collect())
}

/// As [`load_frames`], from a text.
///
/// # Errors
/// The first mistake in any of the recipes, with its place.
pub fn parse_frames(text: Text<'_>, overrides: &[String]) -> Result<Vec<Option<DeviceRecipe>>> {
    let recipes = read_recipes(text, overrides)?;
    let framed = |recipe: &FileRecipe| (recipe.mode == Mode::User).then(|| recipe.to_device());
    Ok(recipes.iter().map(framed).collect())
}

fn read_recipes(text: Text<'_>, overrides: &[String]) -> Result<Vec<FileRecipe>> {
    let document = SourceTree::parse(text.name, text.toml, overrides)?;
    let flavour = kind_of(&document)?;
    let keys = match flavour {
        Flavour::Gateway => &keys::top::GATEWAY,
        Flavour::Controller => &keys::top::CONTROLLER,
    };
    let root = TableReader::root(&document, keys).map_err(|error| name_kind(&document, error))?;
    recipes::read_all(&root, flavour).map_err(|error| name_kind(&document, error))
}

/// An error found after the file was read, at the place of `key` or at the nearest place that exists. `key` consists of
/// names; an item of an array is given by its `name`.
pub fn error_at(path: &Path, overrides: &[String], key: &[&str], message: impl ToString) -> FileError {
    with_text(path, |text| Ok(error_in(text, overrides, key, message))).unwrap_or_else(|error| error)
}

/// As [`error_at`], in a text.
pub fn error_in(text: Text<'_>, overrides: &[String], key: &[&str], message: impl ToString) -> FileError {
    let message = message.to_string();
    match SourceTree::parse(text.name, text.toml, overrides) {
        Ok(document) => match document.find(key) {
            Some(at) => document.error(at, &key.join("."), message.as_str()),
            None => document.whole_file_error(format!("{}: {message}", key.join("."))),
        },
        Err(error) => error,
    }
}

/// Calls `read` with the text of a file.
///
/// # Errors
/// If the file cannot be read, or the errors of `read`.
pub fn with_text<T>(path: &Path, read: impl FnOnce(Text<'_>) -> Result<T>) -> Result<T> {
    let name = path.display().to_string();
    match std::fs::read_to_string(path) {
        Ok(toml) => read(Text { name: &name, toml: &toml }),
        Err(error) => Err(FileError {
            source: Source::WholeFile { file: name },
            key: String::new(),
            message: format!("cannot be read: {error}"),
        }),
    }
}

/// A gateway file has a `[controller]`. A controller file has none, and may omit all of its own sections.
fn kind_of(document: &SourceTree) -> Result<Flavour> {
    match (document.root.get("controller").is_some(), has_own_section(document)) {
        (true, false) => Ok(Flavour::Gateway),
        (false, _) => Ok(Flavour::Controller),
        (true, true) => Err(document.whole_file_error(
            "both a gateway's section ([controller]) and a controller's ([listen], [robot], [initial], [[program]]); \
             these are two files",
        )),
    }
}

/// Whether the file has a section that only controller files have.
fn has_own_section(document: &SourceTree) -> bool {
    ["listen", "robot", "initial", "program"].iter().any(|key| document.root.get(key).is_some())
}

/// Adds a hint to an error in a file that is taken for a controller file only because `[controller]` is missing.
fn name_kind(document: &SourceTree, mut error: FileError) -> FileError {
    if document.root.get("controller").is_none() && !has_own_section(document) {
        error.message += " (without [controller] it is read as a controller file; a gateway file has that)";
    }
    error
}

fn known_dialect<'a>(item: &TableValue<'_>, name: &'a str) -> Result<&'a str> {
    match Dialect::named(name) {
        Some(_) => Ok(name),
        None => {
            let names: Vec<_> = Dialect::NAMES.iter().map(|name| format!("{name:?}")).collect();
            let meant = names::did_you_mean(name, Dialect::NAMES.into_iter());
            Err(item.error(format!("there is no dialect {name:?}; there are {}{meant}", names.join(", "))))
        }
    }
}
