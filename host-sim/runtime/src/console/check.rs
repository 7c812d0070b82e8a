//! Checks the text of a configuration: whether it can run, or one mistake with its place.

use std::sync::Arc;

use proto_core::config::{GatewayConfig, MAX_PORTS};
use proto_core::engine::Engine;
use recipe_capture::Decoder;
use recipe_config::SimConfig;
use recipe_config::board::image_of;
use recipe_config::file::{self, Config, FileError, Source, Text};
use recipe_controller::Controller;
use recipe_export::Model;
use serde_json::{Map, Value, json};

/// A gateway that can be started, and the decoder of its frames.
#[derive(Debug, Clone)]
pub(super) struct Prepared {
    pub(super) config: Arc<GatewayConfig>,
    pub(super) decoder: Arc<Decoder>,
}

/// Prepares everything that a gateway of this text needs to start.
pub(super) fn prepare(name: &str, toml: &str, overrides: &[String]) -> Result<Prepared, Box<Mistake>> {
    let config = gateway(name, toml, overrides)?;
    let model = Model::parse(Text { name, toml }, overrides).map_err(Mistake::of_file)?;
    Ok(Prepared { config: config.into(), decoder: Arc::new(Decoder::new(&model)) })
}

pub(super) fn gateway(
    name: &str,
    toml: &str,
    overrides: &[String],
) -> Result<Box<GatewayConfig>, Box<Mistake>> {
    let config = file::parse_gateway(Text { name, toml }, overrides).map_err(Mistake::of_file)?;
    has_room(&config)?;
    Ok(config)
}

/// The image of a gateway's text, as `host-sim image` makes it.
pub(super) fn image(toml: &str) -> Result<Vec<u8>, Box<Mistake>> {
    let config = gateway(NAME, toml, &[])?;
    image_of(&config).map_err(|error| Mistake::of_whole(&error))
}

fn has_room(config: &GatewayConfig) -> Result<(), Box<Mistake>> {
    Engine::<MAX_PORTS>::new(config).map(|_| ()).map_err(|error| Mistake::of_whole(&error))
}

fn can_be_built(config: &SimConfig) -> Result<(), Box<Mistake>> {
    Controller::new(config).map(|_| ()).map_err(|error| Mistake::of_whole(&error))
}

/// The report on the text of a gateway's or a controller's configuration.
pub(super) fn report(toml: &str) -> Value {
    let checked = file::parse(Text { name: NAME, toml }, &[]).map_err(Mistake::of_file);
    let checked = checked.and_then(|config| match config {
        Config::Gateway(config) => {
            has_room(&config)?;
            let view = config.view();
            let warnings = view.warnings().map(|warning| view.describe_warning(warning).to_string());
            let frames = file::parse_frames(Text { name: NAME, toml }, &[]).map_err(Mistake::of_file)?;
            let of_file = recipe_config::negative_numbers(&frames).into_iter();
            let of_file = of_file.chain(recipe_config::orders_before_values(&frames)).map(|(_, said)| said);
            let warnings: Vec<_> = warnings.chain(of_file).collect();
            Ok(json!({ "ok": true, "kind": "gateway", "warnings": warnings }))
        }
        Config::Controller(config) => {
            can_be_built(&config)?;
            Ok(json!({ "ok": true, "kind": "controller", "warnings": [] }))
        }
    });
    checked.unwrap_or_else(|mistake| {
        let mut report = mistake.json();
        report.insert("ok".to_owned(), json!(false));
        Value::Object(report)
    })
}

/// The name of a text that came in a request.
pub(super) const NAME: &str = "config";

#[derive(Debug)]
pub(super) struct Mistake {
    message: String,
    key: String,
    place: Option<(usize, usize)>,
}

impl Mistake {
    fn of_file(error: FileError) -> Box<Self> {
        let place = match error.source {
            Source::File { line, column, .. } => Some((line, column)),
            Source::WholeFile { .. } | Source::Override { .. } => None,
        };
        Box::new(Self { message: error.message, key: error.key, place })
    }

    fn of_whole(error: &impl ToString) -> Box<Self> {
        Box::new(Self { message: error.to_string(), key: String::new(), place: None })
    }

    /// `error`, and if they are known `key`, `line` and `column`.
    pub(super) fn json(&self) -> Map<String, Value> {
        let mut shown = Map::new();
        shown.insert("error".to_owned(), json!(self.message));
        if !self.key.is_empty() {
            shown.insert("key".to_owned(), json!(self.key));
        }
        if let Some((line, column)) = self.place {
            shown.insert("line".to_owned(), json!(line));
            shown.insert("column".to_owned(), json!(column));
        }
        shown
    }
}

impl std::fmt::Display for Mistake {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some((line, column)) = self.place {
            write!(f, "{line}:{column}: ")?;
        }
        if !self.key.is_empty() {
            write!(f, "{}: ", self.key)?;
        }
        f.write_str(&self.message)
    }
}
