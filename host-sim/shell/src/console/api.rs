//! The endpoints: what each operation answers.

use std::rc::Rc;

use proto_core::time::Duration;
use recipe_net::timer::now;
use recipe_remote::key::SCHEME;
use recipe_remote::nonces::MAX_AGE;
use recipe_remote::response::{Kind, Status};
use recipe_remote::revisions::{Refused, Revision, TRIAL};
use recipe_remote::route::{Operation, Served};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::oneshot;
use tracing::{info, warn};

use super::http::{Reply, Request};
use super::supervisor::{Command, Failed, View, What, left_of};
use super::{Server, Source, check, pendant};

impl Server {
    /// Carries out a request.
    pub(super) async fn carry_out(&self, request: Request<'_>) -> Reply {
        match (request.admitted.operation, &self.source) {
            (Operation::Info, _) => self.info(),
            (Operation::Nonce, _) => {
                let nonce = self.guard.borrow_mut().nonce(now());
                let age = MAX_AGE.as_millis() / 1_000;
                Reply::json(
                    Status::OK,
                    &json!({ "nonce": nonce.as_str(), "scheme": SCHEME, "max_age_s": age }),
                )
            }
            (operation @ (Operation::Status | Operation::Values | Operation::Metrics), source) => {
                let Some(snapshot) = self.snapshots.newest(source).await else { return nothing_runs() };
                let (kind, text) = match operation {
                    Operation::Values => (Kind::Json, snapshot.values()),
                    Operation::Metrics => (Kind::Metrics, snapshot.metrics()),
                    _ => (Kind::Json, Some(snapshot.status())),
                };
                text.map_or_else(nothing_runs, |text| Reply::text(kind, text))
            }
            (Operation::Check, _) => match std::str::from_utf8(&request.body) {
                Ok(toml) => Reply::json(Status::OK, &check::report(toml)),
                Err(error) => Reply::error(Status::BAD_REQUEST, &format!("not UTF-8: {error}")),
            },
            (Operation::Config, Source::Gateway { shared, .. }) => config(&shared.view(), &request),
            (Operation::Revisions, Source::Gateway { shared, .. }) => {
                Reply::json(Status::OK, &revisions(&shared.view()))
            }
            (Operation::Pendant, Source::Controller { control, .. }) => {
                info!(peer = %request.peer, body = %String::from_utf8_lossy(&request.body), "pendant");
                pendant::operate(*control, &request.body).await
            }
            (operation, Source::Gateway { .. }) => self.change(operation, request).await,
            // The table of routes has no others.
            (_, Source::Controller { .. }) => Reply::error(Status::NOT_FOUND, "there is no such path"),
        }
    }

    fn info(&self) -> Reply {
        let role = match self.source.served() {
            Served::Gateway => "gateway",
            Served::Controller => "controller",
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
        if let Source::Gateway { shared, .. } = &self.source {
            let view = shared.view();
            info["places"] = view.ready.clone();
            info["revision"] = json!(view.revisions.as_ref().and_then(|revisions| revisions.running()));
        }
        Reply::json(Status::OK, &info)
    }

    /// Requests that change the configuration, or what runs.
    async fn change(&self, operation: Operation, request: Request<'_>) -> Reply {
        let Source::Gateway { shared, commands } = &self.source else { return nothing_runs() };
        let what = match operation {
            Operation::PutConfig => match put(&request, &shared.view().overrides.clone()) {
                Ok(what) => what,
                Err(reply) => return reply,
            },
            Operation::Apply => match arguments::<ApplyArguments>(&request.body) {
                Ok(ApplyArguments { confirm_s, revision }) => {
                    What::Apply { number: revision, trial: Duration::from_millis((confirm_s * 1e3) as u64) }
                }
                Err(reply) => return reply,
            },
            Operation::Confirm | Operation::Rollback => match arguments::<NoArguments>(&request.body) {
                Ok(NoArguments {}) if operation == Operation::Confirm => What::Confirm,
                Ok(NoArguments {}) => What::RollBack,
                Err(reply) => return reply,
            },
            _ => return Reply::error(Status::NOT_FOUND, "there is no such path"),
        };
        let (answer, answered) = oneshot::channel();
        let peer = request.peer.ip().to_canonical();
        let done = match commands.send(Command { peer, what, answer }) {
            Ok(()) => answered.await.ok(),
            Err(_) => None,
        };
        let done = done.unwrap_or_else(|| Err(Failed::Tried("the gateway is ending".to_owned())));
        let view = shared.view();
        match done {
            Ok(revision) => {
                // At the level that is shown if nobody asks for another: a person has to see it.
                warn!(%peer, revision, what = name(operation), "done for a client of the console");
                let status = if operation == Operation::PutConfig { Status::CREATED } else { Status::OK };
                let mut shown = revisions(&view);
                shown["revision"] = json!(revision);
                let reply = Reply::json(status, &shown);
                match view.revisions.as_ref().and_then(|revisions| revisions.revision(revision)) {
                    Some(revision) => reply.with("ETag", etag(revision)),
                    None => reply,
                }
            }
            Err(Failed::Refused(refused)) => {
                warn!(%peer, what = name(operation), ?refused, "refused to a client of the console");
                refusal(refused)
            }
            Err(Failed::Tried(why)) => {
                let mut shown = revisions(&view);
                shown["error"] = json!(why);
                Reply::json(
                    if operation == Operation::Apply { Status::CONFLICT } else { Status::INTERNAL },
                    &shown,
                )
            }
        }
    }
}

/// The text of the configuration that runs, or of the one that was asked for.
fn config(view: &View, request: &Request<'_>) -> Reply {
    let Some(revisions) = &view.revisions else { return nothing_runs() };
    let number = match request.head.query("revision").map(str::parse) {
        None => revisions.running().unwrap_or(revisions.live()),
        Some(Ok(number)) => number,
        Some(Err(_)) => return Reply::error(Status::BAD_REQUEST, "revision must be a number"),
    };
    match (revisions.revision(number), view.texts.get(&number)) {
        (Some(revision), _) if request.head.if_none_match == Some(etag(revision).as_str()) => {
            let reply =
                Reply { status: Status::NOT_MODIFIED, kind: Kind::Toml, body: "".into(), fields: Vec::new() };
            reply.with("ETag", etag(revision))
        }
        (Some(revision), Some(text)) => {
            Reply::text(Kind::Toml, Rc::from(&**text)).with("ETag", etag(revision))
        }
        _ => refusal(Refused::Unknown),
    }
}

/// The revisions, and what happens to them.
fn revisions(view: &View) -> Value {
    let Some(revisions) = &view.revisions else { return json!({ "kept": [] }) };
    let kept: Vec<_> = view
        .entries
        .iter()
        .map(|entry| {
            let etag = revisions.revision(entry.number).map(etag);
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
    show("base", revisions.base().map(|base| Value::from(etag(base))));
    show(
        "last",
        revisions.last().map(|(number, ended)| json!({ "revision": number, "ended": ended.name() })),
    );
    show("failure", view.failure.clone().map(Value::from));
    shown
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

/// The arguments in a body; none at all is an empty object.
fn arguments<T: serde::de::DeserializeOwned>(body: &[u8]) -> Result<T, Reply> {
    let body = if body.is_empty() { b"{}" } else { body };
    serde_json::from_slice(body).map_err(|error| Reply::error(Status::BAD_REQUEST, &error.to_string()))
}

/// A configuration to store: refused here if it could not run.
fn put(request: &Request<'_>, overrides: &[String]) -> Result<What, Reply> {
    let Some(base) = request.head.if_match else {
        let text = "If-Match is needed: the ETag of the revision that this one was made from";
        return Err(Reply::error(Status::PRECONDITION_REQUIRED, text));
    };
    let Some(base) = parse_etag(base) else {
        return Err(Reply::error(
            Status::PRECONDITION_FAILED,
            "If-Match must be one ETag, such as \"3-0badcafe\"",
        ));
    };
    let toml = String::from_utf8(request.body.clone());
    let toml = toml.map_err(|error| Reply::error(Status::UNPROCESSABLE, &format!("not UTF-8: {error}")))?;
    match check::gateway(check::NAME, &toml, overrides) {
        Ok(_) => Ok(What::Put { base, toml }),
        Err(mistake) => Err(Reply::json(Status::UNPROCESSABLE, &Value::Object(mistake.json()))),
    }
}

fn etag(revision: Revision) -> String {
    format!("\"{}-{:08x}\"", revision.number, revision.digest)
}

fn parse_etag(text: &str) -> Option<Revision> {
    let (number, digest) = text.strip_prefix('"')?.strip_suffix('"')?.split_once('-')?;
    let revision = Revision { number: number.parse().ok()?, digest: u32::from_str_radix(digest, 16).ok()? };
    (etag(revision) == text).then_some(revision)
}

fn refusal(refused: Refused) -> Reply {
    let (status, text) = match refused {
        Refused::Busy => (Status::CONFLICT, "something else is being done; try again".to_owned()),
        Refused::OnTrial => {
            (Status::CONFLICT, "a revision is on trial; confirm it or roll it back first".to_owned())
        }
        Refused::NotOnTrial => (Status::CONFLICT, "no revision is on trial".to_owned()),
        Refused::Changed(base) => {
            let text = format!("the configuration was changed meanwhile; the newest is {}", etag(base));
            return Reply::error(Status::PRECONDITION_FAILED, &text).with("ETag", etag(base));
        }
        Refused::NothingWaits => (Status::CONFLICT, "no stored revision waits; name one".to_owned()),
        Refused::Unknown => (Status::NOT_FOUND, "there is no such revision".to_owned()),
        Refused::Runs => (Status::CONFLICT, "it is live already".to_owned()),
        Refused::Trial => {
            let seconds = |at: &Duration| at.as_millis() / 1_000;
            let (min, max) = (seconds(TRIAL.start()), seconds(TRIAL.end()));
            (Status::BAD_REQUEST, format!("confirm_s is out of range; allowed: {min}..={max}"))
        }
        Refused::NoPrevious => (Status::CONFLICT, "no other revision was live before".to_owned()),
        other => (Status::CONFLICT, format!("refused: {other:?}")),
    };
    Reply::error(status, &text)
}

fn nothing_runs() -> Reply {
    Reply::error(Status::UNAVAILABLE, "nothing runs at the moment; try again")
}

/// For the log.
fn name(operation: Operation) -> &'static str {
    match operation {
        Operation::PutConfig => "store",
        Operation::Apply => "apply",
        Operation::Confirm => "confirm",
        Operation::Rollback => "roll back",
        _ => "",
    }
}
