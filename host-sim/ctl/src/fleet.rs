//! Commands for several gateways of an inventory.
//!
//! In: an inventory, a command. Out: the answer of each gateway. Each is asked by a thread of its own, at most
//! [`MAX_AT_ONCE`] at a time; a gateway that does not answer delays no other.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use recipe_api::key::Key;
use recipe_config::file::load_inventory;
use serde_json::{Map, Value, json};

use crate::address::Address;
use crate::answer::Answer;
use crate::client::Client;
use crate::failure::{Failure, Verdict};
use crate::key_file;
use crate::stop::Stop;
use crate::table::{Look, TableCell, TableView, TextTable};

/// Maximum number of gateways that are asked at a time.
pub const MAX_AT_ONCE: usize = 16;

/// One gateway of an inventory, with its address and key.
#[derive(Debug, Clone)]
pub struct Member {
    name: String,
    address: Address,
    host: Option<Address>,
    key: Option<Key>,
}

impl Member {
    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// A client for the gateway.
    ///
    /// # Errors
    /// If the host name cannot be resolved.
    pub fn client(&self, timeout: Duration, stop: Stop) -> Result<Client, Failure> {
        let client = Client::new(self.address.clone(), self.key.clone(), timeout, stop)?;
        Ok(client.known_as(self.host.clone()))
    }
}

/// Reads an inventory and its keys; with names in `only`, just those gateways.
///
/// # Errors
/// A mistake in the file, with its place; an unreadable key; a name that is not in the inventory.
pub fn members(path: &Path, only: &[String]) -> Result<Vec<Member>, Failure> {
    let listed = load_inventory(path, |address| address.parse::<Address>().map(|_| ()))?;
    for name in only {
        if !listed.iter().any(|one| one.name == *name) {
            let names: Vec<_> = listed.iter().map(|one| one.name.as_str()).collect();
            return Err(Failure::wrong(format!(
                "--only {name}: {} has no such gateway; it has {}",
                path.display(),
                names.join(", ")
            )));
        }
    }
    let wanted = listed.into_iter().filter(|one| only.is_empty() || only.contains(&one.name));
    wanted
        .map(|one| {
            let parsed = |text: &str| text.parse::<Address>().map_err(Failure::wrong);
            let address = parsed(&one.address)?;
            let host = one.host.as_deref().map(parsed).transpose()?;
            let key = one.key.as_deref().map(key_file::read).transpose()?;
            Ok(Member { name: one.name, address, host, key })
        })
        .collect()
}

/// How a change is rolled out to an inventory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rollout {
    /// Number of gateways in a batch; the next batch begins once this one has ended.
    pub batch: usize,
    /// Begin no further batch once a gateway has failed.
    pub stop_on_failure: bool,
}

/// The results of a command at the gateways of an inventory.
#[derive(Debug)]
pub struct Outcomes(Vec<(String, MemberOutcome)>);

#[derive(Debug)]
enum MemberOutcome {
    Answered(Box<Answer>),
    Failed(Failure),
    /// An earlier gateway has failed, or Ctrl-C was pressed.
    NotBegun,
}

/// Asks all gateways. Without a rollout all are one batch.
pub fn ask(
    members: &[Member],
    rollout: Option<Rollout>,
    timeout: Duration,
    stop: &Stop,
    work: &(dyn Fn(&Client) -> Result<Answer, Failure> + Sync),
) -> Outcomes {
    let batch = rollout.map_or(members.len(), |rollout| rollout.batch).max(1);
    let mut outcomes = Vec::new();
    let mut has_failed = false;
    for members in members.chunks(batch) {
        let is_over = stop.is_asked() || has_failed && rollout.is_some_and(|rollout| rollout.stop_on_failure);
        let found = match is_over {
            true => members.iter().map(|_| MemberOutcome::NotBegun).collect(),
            false => side_by_side(
                members,
                stop,
                |_| MemberOutcome::NotBegun,
                |member| {
                    let answer = member.client(timeout, stop.clone()).and_then(|client| work(&client));
                    match answer {
                        Ok(answer) => MemberOutcome::Answered(Box::new(answer)),
                        Err(failure) => MemberOutcome::Failed(failure),
                    }
                },
            ),
        };
        has_failed |= found.iter().any(|outcome| !matches!(outcome, MemberOutcome::Answered(_)));
        outcomes.extend(members.iter().map(|member| member.name.clone()).zip(found));
    }
    Outcomes(outcomes)
}

/// The result of `work` for each item, at most [`MAX_AT_ONCE`] at a time; `not_begun` for items that had not begun when
/// the end was requested.
pub(crate) fn side_by_side<I: Sync, T: Send>(
    items: &[I],
    stop: &Stop,
    not_begun: impl Fn(&I) -> T,
    work: impl Fn(&I) -> T + Sync,
) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let found: Vec<Mutex<T>> = items.iter().map(|item| Mutex::new(not_begun(item))).collect();
    std::thread::scope(|scope| {
        for _ in 0..items.len().min(MAX_AT_ONCE) {
            scope.spawn(|| {
                while !stop.is_asked()
                    && let nth = next.fetch_add(1, Relaxed)
                    && let (Some(item), Some(place)) = (items.get(nth), found.get(nth))
                {
                    let result = work(item);
                    *place.lock().unwrap_or_else(PoisonError::into_inner) = result;
                }
            });
        }
    });
    found.into_iter().map(|place| place.into_inner().unwrap_or_else(PoisonError::into_inner)).collect()
}

impl Outcomes {
    /// Whether all have answered without a problem; a failure names those that have not answered.
    pub fn verdict(&self) -> Result<Verdict, Failure> {
        let failed = self.0.iter().filter(|(_, outcome)| !matches!(outcome, MemberOutcome::Answered(_)));
        let names: Vec<_> = failed.map(|(name, _)| name.as_str()).collect();
        if !names.is_empty() {
            let (count, all) = (names.len(), self.0.len());
            return Err(Failure::refused(format!("{count} of {all} gateways failed: {}", names.join(", "))));
        }
        let is_well = |(_, outcome): &(String, MemberOutcome)| match outcome {
            MemberOutcome::Answered(answer) => answer.verdict() == Verdict::Well,
            _ => false,
        };
        Ok(if self.0.iter().all(is_well) { Verdict::Well } else { Verdict::Trouble })
    }

    /// A table with a row for each gateway.
    pub fn table(&self, view: TableView) -> String {
        let headings: Vec<&str> = self
            .0
            .iter()
            .find_map(|(_, outcome)| match outcome {
                MemberOutcome::Answered(answer) => Some(answer.row.iter().map(|(name, _)| *name).collect()),
                _ => None,
            })
            .unwrap_or_default();
        let has_failures = self.0.iter().any(|(_, outcome)| !matches!(outcome, MemberOutcome::Answered(_)));
        let mut all = vec!["gateway"];
        all.extend(&headings);
        if has_failures {
            all.push("failure");
        }
        let mut table = TextTable::new(&all);
        for (name, outcome) in &self.0 {
            let mut cells = vec![TableCell::of(name)];
            match outcome {
                MemberOutcome::Answered(answer) => {
                    cells.extend(answer.row.iter().map(|(_, cell)| cell.clone()))
                }
                other => {
                    cells.extend(headings.iter().map(|_| TableCell::default()));
                    let why = match other {
                        MemberOutcome::Failed(failure) => failure.message(),
                        _ => "not begun",
                    };
                    cells.push(TableCell::of(why).look(Look::Wrong));
                }
            }
            table.row(cells);
        }
        table.show(view)
    }

    /// The complete answers, one below the other.
    pub fn sections(&self, view: TableView) -> String {
        let mut text = String::new();
        for (name, outcome) in &self.0 {
            let body = match outcome {
                MemberOutcome::Answered(answer) => answer.text(view),
                MemberOutcome::Failed(failure) => format!("{}\n", failure.message()),
                MemberOutcome::NotBegun => "not begun\n".into(),
            };
            text += &format!("== {}\n{body}\n", crate::shown::line(name));
        }
        text
    }

    /// One document with all answers, on one line.
    pub fn json(&self) -> String {
        let entry = |outcome: &MemberOutcome| match outcome {
            MemberOutcome::Answered(answer) => json!({ "ok": true, "answer": answer.document }),
            MemberOutcome::Failed(failure) => json!({ "ok": false, "error": failure.message() }),
            MemberOutcome::NotBegun => json!({ "ok": false, "error": "not begun" }),
        };
        let all: Map<String, Value> =
            self.0.iter().map(|(name, outcome)| (name.clone(), entry(outcome))).collect();
        crate::shown::json(&all.into()) + "\n"
    }
}
