//! The endpoints that read: documents that are made when somebody asks for them.

use std::borrow::Cow;
use std::rc::Rc;
use std::sync::Arc;

use proto_core::config::GatewayConfig;
use recipe_api::request::HttpHead;
use recipe_api::response::{ContentType, StatusCode};
use recipe_api::revisions::Etag;
use recipe_api::route::{ApiOperation, Served};
use recipe_config::FileKind;
use recipe_config::file::Text;
use recipe_export::dbc::{self, DbcError};
use recipe_export::{Model, lua, map};
use recipe_io::timer::now;
use serde_json::{Map, Value, json};

use super::reply::HttpReply;
use super::snapshots::Snapshot;
use super::supervisor::{SupervisorView, left_of};
use super::{ConsoleServer, ConsoleSource, check};
use crate::log::MAX_NEWEST;

impl ConsoleServer {
    /// Answers requests that only read.
    pub(super) async fn read(&self, operation: ApiOperation, head: &HttpHead<'_>) -> HttpReply {
        match operation {
            ApiOperation::Info => HttpReply::json(StatusCode::OK, &self.info()),
            ApiOperation::Log => self.log(head),
            ApiOperation::Bundle => HttpReply::json(StatusCode::OK, &self.bundle().await),
            ApiOperation::Schema => {
                HttpReply::json(StatusCode::OK, &recipe_config::schema(FileKind::Gateway))
            }
            ApiOperation::ExportDbc | ApiOperation::ExportLua | ApiOperation::ExportMap => {
                self.export(operation, head).unwrap_or_else(|refused| refused)
            }
            _ => {
                let Some(snapshot) = self.snapshots.newest(&self.source).await else { return nothing_runs() };
                match operation {
                    ApiOperation::Status => HttpReply::text(ContentType::Json, snapshot.status()),
                    ApiOperation::Values => text(ContentType::Json, snapshot.values()),
                    ApiOperation::Metrics => text(ContentType::Metrics, snapshot.metrics()),
                    ApiOperation::Doctor => match self.findings(&snapshot).await {
                        Some(findings) => HttpReply::json(StatusCode::OK, &json!({ "findings": findings })),
                        None => nothing_runs(),
                    },
                    _ => HttpReply::error(StatusCode::NOT_FOUND, "there is no such path"),
                }
            }
        }
    }

    fn info(&self) -> Value {
        let role = match self.source.served() {
            Served::Controller => "controller",
            _ => "gateway",
        };
        let mut info = json!({
            "role": role,
            "version": env!("CARGO_PKG_VERSION"),
            "api": "v1",
            "uptime_s": now().saturating_since(self.started).as_millis() / 1_000,
            "can_be_changed": self.guard.borrow().has_key(),
            "console": {
                "address": self.address,
                "connections": self.connections.get(),
                "streams": self.streams.get(),
                "requests": self.guard.borrow().counters(),
                "counters": self.counters.get(),
            },
        });
        if let Some(name) = host_name() {
            info["name"] = json!(name);
        }
        if let Some(port) = self.peer {
            info["peer_port"] = json!(port);
        }
        if let ConsoleSource::Gateway { shared, .. } = &self.source {
            let view = shared.view();
            info["places"] = view.ready.clone();
            let running = view.revisions.as_ref().and_then(|revisions| revisions.running());
            if let Some(revision) = running.filter(|_| view.config.is_some()) {
                info["revision"] = json!(revision);
            }
        }
        info
    }

    fn log(&self, head: &HttpHead<'_>) -> HttpReply {
        let count = match head.query("lines").map(str::parse) {
            None => MAX_NEWEST,
            Some(Ok(count)) if (1..=MAX_NEWEST).contains(&count) => count,
            Some(_) => {
                let text = format!("lines is out of range; allowed: 1..={MAX_NEWEST}");
                return HttpReply::error(StatusCode::BAD_REQUEST, &text);
            }
        };
        let text: String = self.log_lines(count).iter().flat_map(|line| [line, "\n"]).collect();
        HttpReply::text(ContentType::Text, text.into())
    }

    fn log_lines(&self, count: usize) -> Vec<String> {
        self.log.as_ref().map_or_else(Vec::new, |log| log.newest(count))
    }

    /// Findings; `None` while no gateway runs.
    async fn findings(&self, snapshot: &Snapshot) -> Option<Value> {
        let looked = match snapshot.unexplained() {
            Some(failed) => self.snapshots.look_at_controller(failed, snapshot).await,
            None => None,
        };
        snapshot.findings(looked).map(|findings| json!(findings))
    }

    /// All readable documents, for support. Unknown ones are absent.
    async fn bundle(&self) -> Value {
        let mut bundle = Map::new();
        let mut put = |name: &str, value: Option<Value>| {
            if let Some(value) = value {
                bundle.insert(name.to_owned(), value);
            }
        };
        put("info", Some(self.info()));
        if let Some(snapshot) = self.snapshots.newest(&self.source).await {
            let json = |text: Rc<str>| serde_json::from_str(&text).ok();
            put("status", json(snapshot.status()));
            put("values", snapshot.values().and_then(json));
            put("metrics", snapshot.metrics().map(|text| json!(&*text)));
            put("doctor", self.findings(&snapshot).await);
        }
        if let ConsoleSource::Gateway { shared, .. } = &self.source {
            let view = shared.view();
            put("revisions", Some(revisions(&view)));
            put("config", view.running_text().map(|text| json!(&*text)));
        }
        put("log", Some(json!(self.log_lines(MAX_NEWEST))));
        Value::Object(bundle)
    }

    /// Exports of the running configuration for other tools.
    fn export(&self, operation: ApiOperation, head: &HttpHead<'_>) -> Result<HttpReply, HttpReply> {
        let ConsoleSource::Gateway { shared, .. } = &self.source else { return Err(nothing_runs()) };
        let (toml, overrides) = {
            let view = shared.view();
            (view.running_text().ok_or_else(nothing_runs)?, view.overrides.clone())
        };
        let wrong =
            |error: &dyn std::fmt::Display| HttpReply::error(StatusCode::UNPROCESSABLE, &error.to_string());
        let model = Model::parse(Text { name: check::NAME, toml: &toml }, &overrides);
        let model = model.map_err(|error| wrong(&error))?;
        let text = match operation {
            ApiOperation::ExportDbc => {
                let port = port_of(head)?;
                dbc::dbc(&model, port.as_deref()).map_err(|error| match &error {
                    DbcError::NoPort { .. } | DbcError::NoCan => {
                        HttpReply::error(StatusCode::NOT_FOUND, &error.to_string())
                    }
                    DbcError::SharedId { id, ports: [one, other] } => wrong(&format_args!(
                        "ports {one} and {other} have different frames with id {id:#X}; choose one with ?port=NAME"
                    )),
                    _ => wrong(&error),
                })?.text
            }
            ApiOperation::ExportLua => lua::lua(&model).map_err(|error| wrong(&error))?,
            _ => map::map(&model, map::Style::Markdown),
        };
        Ok(HttpReply::text(ContentType::Text, text.into()))
    }

    /// The field port that an argument names, if there is one.
    pub(super) fn field_port(&self, head: &HttpHead<'_>) -> Result<Option<String>, HttpReply> {
        let Some(port) = port_of(head)? else { return Ok(None) };
        let ConsoleSource::Gateway { shared, .. } = &self.source else { return Err(nothing_runs()) };
        let config: Arc<GatewayConfig> = shared.view().config.clone().ok_or_else(nothing_runs)?;
        let names: Vec<_> = config.view().field_ports().map(|(_, port, _)| port.name.as_str()).collect();
        match names.contains(&&*port) {
            true => Ok(Some(port.into_owned())),
            false => {
                let text = format!("there is no field port {port:?}; there are {}", names.join(", "));
                Err(HttpReply::error(StatusCode::NOT_FOUND, &text))
            }
        }
    }
}

fn text(kind: ContentType, text: Option<Rc<str>>) -> HttpReply {
    text.map_or_else(nothing_runs, |text| HttpReply::text(kind, text))
}

/// The argument `port`. A name may have any character, so this argument is percent-decoded.
fn port_of<'a>(head: &HttpHead<'a>) -> Result<Option<Cow<'a, str>>, HttpReply> {
    let Some(port) = head.query("port") else { return Ok(None) };
    let decoded =
        decoded(port).ok_or_else(|| HttpReply::error(StatusCode::BAD_REQUEST, "port is not well encoded"));
    decoded.map(Some)
}

/// Percent-decodes a text.
fn decoded(text: &str) -> Option<Cow<'_, str>> {
    if !text.contains('%') {
        return Some(text.into());
    }
    let mut bytes = Vec::new();
    let mut rest = text.as_bytes();
    while let Some((&byte, behind)) = rest.split_first() {
        rest = behind;
        bytes.push(match byte {
            b'%' => {
                let (digits, behind) = rest.split_at_checked(2)?;
                rest = behind;
                let digits = digits.iter().all(u8::is_ascii_hexdigit).then_some(digits)?;
                u8::from_str_radix(str::from_utf8(digits).ok()?, 16).ok()?
            }
            byte => byte,
        });
    }
    String::from_utf8(bytes).ok().map(Cow::Owned)
}

pub(super) fn revisions(view: &SupervisorView) -> Value {
    let Some(revisions) = &view.revisions else { return json!({ "kept": [] }) };
    let kept: Vec<_> = view
        .entries
        .iter()
        .map(|entry| {
            let etag = revisions.revision(entry.number).map(|revision| Etag(revision).to_string());
            json!({ "revision": entry.number, "etag": etag, "stored_at": entry.stored_at, "from": entry.from })
        })
        .collect();
    let mut shown = json!({ "live": revisions.live(), "kept": kept });
    let mut show = |key: &str, value: Option<Value>| {
        if let Some(value) = value {
            shown[key] = value;
        }
    };
    show("running", revisions.running().map(Value::from));
    show("previous", revisions.previous().map(Value::from));
    show("waiting", revisions.waiting().map(Value::from));
    let trial = left_of(revisions.trial());
    show("trial", trial.map(|(number, left_s)| json!({ "revision": number, "left_s": left_s })));
    show("base", revisions.base().map(|base| Value::from(Etag(base).to_string())));
    show(
        "last",
        revisions.last().map(|(number, ended)| json!({ "revision": number, "ended": ended.name() })),
    );
    show("failure", view.failure.clone().map(Value::from));
    shown
}

pub(super) fn nothing_runs() -> HttpReply {
    HttpReply::error(StatusCode::UNAVAILABLE, "nothing runs at the moment; try again")
}

pub(super) fn host_name() -> Option<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").ok()?;
    Some(name.trim().to_owned()).filter(|name| !name.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_ports_are_decoded_and_nothing_is_guessed() {
        assert_eq!(decoded("rs485-1").as_deref(), Some("rs485-1"));
        assert_eq!(decoded("a%26b%3d%E5%8A%9B").as_deref(), Some("a&b=力"));
        for wrong in ["%", "%2", "%2x", "%+1", "%FF", "a%E5b"] {
            assert_eq!(decoded(wrong), None, "{wrong}");
        }
    }
}
