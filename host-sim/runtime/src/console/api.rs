//! The endpoints: the reply to each operation.

use std::ops::RangeInclusive;
use std::rc::Rc;

use proto_core::time::Duration;
use recipe_api::key::SCHEME;
use recipe_api::nonces::MAX_AGE;
use recipe_api::response::{ContentType, StatusCode};
use recipe_api::revisions::{Etag, Refused, base_of};
use recipe_api::route::ApiOperation;
use recipe_io::timer::now;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::oneshot;
use tracing::{info, warn};

use super::http::HttpRequest;
use super::reading::{host_name, nothing_runs, revisions};
use super::reply::HttpReply;
use super::supervisor::{ActionError, SupervisorAction, SupervisorCommand, SupervisorView};
use super::{ConsoleServer, ConsoleSource, check, pendant};

impl ConsoleServer {
    pub(super) async fn execute(&self, request: HttpRequest<'_>) -> HttpReply {
        match (request.admitted.operation, &self.source) {
            (ApiOperation::Page, _) => HttpReply::page(request.head.if_none_match),
            (ApiOperation::Nonce, _) => {
                let nonce = self.guard.borrow_mut().nonce(now());
                let age = MAX_AGE.as_millis() / 1_000;
                HttpReply::json(
                    StatusCode::OK,
                    &json!({ "nonce": nonce.as_str(), "scheme": SCHEME, "max_age_s": age }),
                )
            }
            (ApiOperation::Check, _) => match std::str::from_utf8(&request.body) {
                Ok(toml) => match request.head.query("image") {
                    None => HttpReply::json(StatusCode::OK, &check::report(toml)),
                    Some("1") => image(toml),
                    Some(_) => HttpReply::error(StatusCode::BAD_REQUEST, "image is out of range; allowed: 1"),
                },
                Err(error) => HttpReply::error(StatusCode::BAD_REQUEST, &format!("not UTF-8: {error}")),
            },
            (ApiOperation::Config, ConsoleSource::Gateway { shared, .. }) => config(&shared.view(), &request),
            (ApiOperation::Revisions, ConsoleSource::Gateway { shared, .. }) => {
                HttpReply::json(StatusCode::OK, &revisions(&shared.view()))
            }
            (ApiOperation::Pendant, ConsoleSource::Controller { control, .. }) => {
                info!(peer = %request.peer, body = %String::from_utf8_lossy(&request.body), "pendant");
                pendant::operate(*control, &request.body).await
            }
            (ApiOperation::Identify, ConsoleSource::Gateway { .. }) => self.identify(&request),
            (
                ApiOperation::Update
                | ApiOperation::PutUpdate
                | ApiOperation::TryUpdate
                | ApiOperation::ConfirmUpdate
                | ApiOperation::EndUpdate,
                _,
            ) => HttpReply::error(
                StatusCode::NOT_IMPLEMENTED,
                "this gateway is a program; it is updated as a package, as it was installed",
            ),
            (ApiOperation::Edge | ApiOperation::PutEdge, _) => HttpReply::error(
                StatusCode::NOT_IMPLEMENTED,
                "this gateway is a program; its edge node is given with --sparkplug, and its log says how it does",
            ),
            (
                operation @ (ApiOperation::PutConfig
                | ApiOperation::Apply
                | ApiOperation::Confirm
                | ApiOperation::Rollback),
                ConsoleSource::Gateway { .. },
            ) => self.change(operation, request).await,
            (operation, _) => self.read(operation, &request.head).await,
        }
    }

    /// Lets a person in front of several machines find this one.
    fn identify(&self, request: &HttpRequest<'_>) -> HttpReply {
        let IdentifyArguments { s } = match arguments(&request.body) {
            Ok(arguments) => arguments,
            Err(reply) => return reply,
        };
        if !IDENTIFY.contains(&s) {
            let text = format!("s is out of range; allowed: {}..={}", IDENTIFY.start(), IDENTIFY.end());
            return HttpReply::error(StatusCode::BAD_REQUEST, &text);
        }
        let name = host_name().unwrap_or_default();
        let peer = request.peer.ip().to_canonical();
        warn!(%peer, name, console = %self.address, "this is the gateway that somebody looks for");
        HttpReply::json(StatusCode::OK, &json!({}))
    }

    /// Handles requests that change the configuration or what runs.
    async fn change(&self, operation: ApiOperation, request: HttpRequest<'_>) -> HttpReply {
        let ConsoleSource::Gateway { shared, commands, .. } = &self.source else { return nothing_runs() };
        let what = match operation {
            ApiOperation::PutConfig => {
                // The view must not stay locked while the text is parsed and an engine is built.
                let overrides = shared.view().overrides.clone();
                match put(&request, &overrides) {
                    Ok(what) => what,
                    Err(reply) => return reply,
                }
            }
            ApiOperation::Apply => match arguments::<ApplyArguments>(&request.body) {
                Ok(ApplyArguments { confirm_s, revision }) => SupervisorAction::Apply {
                    number: revision,
                    trial: Duration::from_millis((confirm_s * 1e3) as u64),
                },
                Err(reply) => return reply,
            },
            ApiOperation::Confirm | ApiOperation::Rollback => match arguments::<NoArguments>(&request.body) {
                Ok(NoArguments {}) if operation == ApiOperation::Confirm => SupervisorAction::Confirm,
                Ok(NoArguments {}) => SupervisorAction::RollBack,
                Err(reply) => return reply,
            },
            _ => return HttpReply::error(StatusCode::NOT_FOUND, "there is no such path"),
        };
        let (answer, answered) = oneshot::channel();
        let peer = request.peer.ip().to_canonical();
        let done = match commands.send(SupervisorCommand { peer, what, answer }) {
            Ok(()) => answered.await.ok(),
            Err(_) => None,
        };
        let done = done.unwrap_or_else(|| Err(ActionError::Tried("the gateway is ending".to_owned())));
        let view = shared.view();
        match done {
            Ok(revision) => {
                // `warn` is shown by default: a person has to see it.
                warn!(%peer, revision, what = name(operation), "done for a client of the console");
                let status =
                    if operation == ApiOperation::PutConfig { StatusCode::CREATED } else { StatusCode::OK };
                let mut shown = revisions(&view);
                shown["revision"] = json!(revision);
                let reply = HttpReply::json(status, &shown);
                match view.revisions.as_ref().and_then(|revisions| revisions.revision(revision)) {
                    Some(revision) => reply.with("ETag", Etag(revision)),
                    None => reply,
                }
            }
            Err(ActionError::Refused(refused)) => {
                warn!(%peer, what = name(operation), ?refused, "refused to a client of the console");
                refusal(refused)
            }
            Err(ActionError::Tried(why)) => {
                let mut shown = revisions(&view);
                shown["error"] = json!(why);
                HttpReply::json(
                    if operation == ApiOperation::Apply {
                        StatusCode::CONFLICT
                    } else {
                        StatusCode::INTERNAL
                    },
                    &shown,
                )
            }
        }
    }
}

/// The board image of a configuration, or the first mistake in its text.
fn image(toml: &str) -> HttpReply {
    match check::image(toml) {
        Ok(bytes) => HttpReply::image(bytes),
        Err(mistake) => HttpReply::json(StatusCode::UNPROCESSABLE, &Value::Object(mistake.json())),
    }
}

/// The text of the running configuration, or of the requested revision.
fn config(view: &SupervisorView, request: &HttpRequest<'_>) -> HttpReply {
    let Some(revisions) = &view.revisions else { return nothing_runs() };
    let number = match request.head.query("revision").map(str::parse) {
        None => revisions.running().unwrap_or(revisions.live()),
        Some(Ok(number)) => number,
        Some(Err(_)) => return HttpReply::error(StatusCode::BAD_REQUEST, "revision must be a number"),
    };
    match (revisions.revision(number), view.texts.get(&number)) {
        (Some(revision), _) if request.head.if_none_match.and_then(Etag::parse) == Some(revision) => {
            HttpReply::new(StatusCode::NOT_MODIFIED, ContentType::Toml, "").with("ETag", Etag(revision))
        }
        (Some(revision), Some(text)) => {
            HttpReply::text(ContentType::Toml, Rc::from(&**text)).with("ETag", Etag(revision))
        }
        _ => refusal(Refused::Unknown),
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ApplyArguments {
    #[serde(default = "default_trial")]
    confirm_s: f64,
    revision: Option<u32>,
}

fn default_trial() -> f64 {
    60.0
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoArguments {}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct IdentifyArguments {
    #[serde(default = "default_identify")]
    s: u32,
}

fn default_identify() -> u32 {
    10
}

/// Seconds for which a board identifies itself. A host writes one line to its log.
const IDENTIFY: RangeInclusive<u32> = 1..=600;

/// Parses the arguments in a body. An empty body counts as an empty object.
fn arguments<T: serde::de::DeserializeOwned>(body: &[u8]) -> Result<T, HttpReply> {
    let body = if body.is_empty() { b"{}" } else { body };
    // `from_slice::<T>` would accept an array as the fields of a struct.
    let object = serde_json::from_slice(body).map(Value::Object);
    object
        .and_then(serde_json::from_value)
        .map_err(|error| HttpReply::error(StatusCode::BAD_REQUEST, &error.to_string()))
}

/// A configuration to store: refused here if it could not run.
fn put(request: &HttpRequest<'_>, overrides: &[String]) -> Result<SupervisorAction, HttpReply> {
    let base = base_of(request.head.if_match.map(Etag::parse))?;
    let toml = String::from_utf8(request.body.clone());
    let toml =
        toml.map_err(|error| HttpReply::error(StatusCode::UNPROCESSABLE, &format!("not UTF-8: {error}")))?;
    match check::gateway(check::NAME, &toml, overrides) {
        Ok(_) => Ok(SupervisorAction::Put { base, toml }),
        Err(mistake) => Err(HttpReply::json(StatusCode::UNPROCESSABLE, &Value::Object(mistake.json()))),
    }
}

fn refusal(refused: Refused) -> HttpReply {
    let reply = HttpReply::error(refused.status(), &refused.to_string());
    match refused {
        Refused::Changed(base) => reply.with("ETag", Etag(base)),
        _ => reply,
    }
}

fn name(operation: ApiOperation) -> &'static str {
    match operation {
        ApiOperation::PutConfig => "store",
        ApiOperation::Apply => "apply",
        ApiOperation::Confirm => "confirm",
        ApiOperation::Rollback => "roll back",
        _ => "",
    }
}
