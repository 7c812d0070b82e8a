//! The result of a batch, or of one machine's share of it, as a document; and merging the documents of all shares.
//!
//! In: a finished batch, or the documents of its shares. Out: a [`Part`], plain data for serde. Does not know files.
//! A share that is missing, duplicated or of another batch is refused.

use std::collections::BTreeMap;
use std::fmt;

use proto_core::time::Duration;
use serde::{Deserialize, Serialize};

use super::batch::{Failure, split};
use super::{Batch, Share, Total};
use crate::{FaultKind, Invariant};

/// A share of a batch, and its results.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Part {
    /// The version of this format: [`FORMAT`].
    pub soak: u32,
    /// The version of the program that ran it.
    pub version: String,
    /// The batch's seed.
    pub seed: u64,
    /// The name of its [`super::Level`].
    pub faults: String,
    /// Virtual time of the whole batch, in microseconds.
    pub virtual_us: u64,
    /// The cells of the batch, in order.
    pub cells: Vec<PartCell>,
    /// Which share this is, such as `2/3`.
    pub shard: String,
    /// Wall time in microseconds; in a merged document the longest of all shares.
    pub wall_us: u64,
    /// Index of the first run of the share.
    pub first_run: usize,
    /// The digests of the share's runs as hexadecimal digits; `None` for an unfinished run.
    pub digests: Vec<Option<String>>,
    /// The sums of the share's finished runs.
    pub sums: Sums,
    /// The failure that ended the share.
    pub failure: Option<PartFailure>,
}

/// A cell of a batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartCell {
    /// Its name.
    pub name: String,
    /// How the cell was chosen, for the command that repeats a run; `None` if all embedded cells run.
    pub chosen: Option<String>,
    /// A hash of the configuration and of the first moments of the cell, which another build may change.
    pub fingerprint: String,
}

/// Sums of runs, as in [`Total`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sums {
    /// Number of entries in the traces.
    pub events: u64,
    /// Number of values that were checked.
    pub writes: u64,
    /// Number of runs of each cell, and their virtual time in microseconds.
    pub cells: BTreeMap<String, (usize, u64)>,
    /// Number of frames received and sent, by cell and port.
    pub ports: BTreeMap<String, BTreeMap<String, (u64, u64)>>,
    /// Number of sends and receives, by kind of link.
    pub links: BTreeMap<String, (u64, u64)>,
    /// Number of faults by name.
    pub faults: BTreeMap<String, u64>,
    /// Number of checks by the invariant's name.
    pub checks: BTreeMap<String, u64>,
    /// Number of outcomes of events by name.
    pub outcomes: BTreeMap<String, u64>,
}

/// A failed run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartFailure {
    /// Index of the run in the batch.
    pub run: usize,
    /// Seed of the run itself.
    pub seed: u64,
    /// The cell's name.
    pub cell: String,
    /// Time since the run's start in microseconds.
    pub after_us: u64,
    /// The violation, with its invariant.
    pub what: String,
}

/// Why documents cannot be merged into one batch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NotOneBatch {
    /// Index of the faulty document; `None` if it concerns all of them.
    pub nth: Option<usize>,
    /// The reason.
    pub why: String,
}

impl fmt::Display for NotOneBatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.why)
    }
}

impl std::error::Error for NotOneBatch {}

impl Part {
    /// The document of a finished batch. `chosen` says for each cell how it was chosen.
    pub fn of(batch: &Batch, chosen: &[String], wall_us: u64) -> Self {
        let total = batch.total();
        let runs = batch.share_runs();
        let fingerprints = batch.fingerprints().into_iter().enumerate();
        Self {
            soak: FORMAT,
            version: VERSION.to_owned(),
            seed: batch.seed(),
            faults: batch.level().name().to_owned(),
            virtual_us: batch.whole_span().as_micros(),
            cells: fingerprints
                .map(|(nth, (name, fingerprint))| PartCell {
                    name,
                    chosen: chosen.get(nth).cloned(),
                    fingerprint: format!("{fingerprint:016x}"),
                })
                .collect(),
            shard: batch.share().to_string(),
            wall_us,
            first_run: runs.start,
            digests: batch.digests().map(|digest| digest.map(|digest| format!("{digest:016x}"))).collect(),
            sums: Sums::of(&total),
            failure: batch.failure().map(PartFailure::from),
        }
    }

    /// The sums, with one hash of all finished runs.
    ///
    /// # Errors
    /// The reason, if the document contradicts itself.
    pub fn total(&self) -> Result<Total, String> {
        let (_, of) = split(Duration::from_micros(self.virtual_us), self.cells.len());
        let share: Share = self.shard.parse().map_err(|error| format!("shard: {:?}: {error}", self.shard))?;
        let runs = share.runs(of);
        if self.cells.is_empty() || self.virtual_us == 0 {
            return Err("cells, virtual_us: a batch has at least one cell, and takes time".into());
        }
        if self.first_run != runs.start || self.digests.len() != runs.len() {
            return Err(format!(
                "first_run, digests: {} runs from {}; shard {share} of this batch has {} from {}",
                self.digests.len(),
                self.first_run,
                runs.len(),
                runs.start
            ));
        }
        let mut total = self.sums.total()?;
        total.of = runs.len();
        for (run, digest) in runs.zip(&self.digests) {
            let Some(digest) = digest else { continue };
            let is_hex = digest.len() == 16 && digest.bytes().all(|byte| byte.is_ascii_hexdigit());
            let digest = is_hex.then(|| u64::from_str_radix(digest, 16).ok()).flatten();
            let digest =
                digest.ok_or_else(|| format!("digests: that of run {run} is not 16 hexadecimal digits"))?;
            total.fold(run, digest);
        }
        let finished = self.digests.iter().flatten().count();
        if total.runs != finished {
            return Err(format!("sums.cells: {} runs; there are {finished} digests", total.runs));
        }
        Ok(total)
    }

    /// Merges the documents of all shares into one, as if one machine had run them.
    ///
    /// # Errors
    /// [`NotOneBatch`] if a share is missing, incomplete or duplicated, or if the shares are of different batches.
    pub fn merge(parts: &[Self]) -> Result<Self, NotOneBatch> {
        let of = |nth: usize, why: String| NotOneBatch { nth: Some(nth), why };
        let all = |why: &str| NotOneBatch { nth: None, why: why.to_owned() };
        let first = parts.first().ok_or_else(|| all("there is nothing to merge"))?;
        let mut by_share = BTreeMap::new();
        for (nth, part) in parts.iter().enumerate() {
            part.differs_from(first).map_err(|why| of(nth, why))?;
            let total = part.total().map_err(|why| of(nth, why))?;
            let share: Share = part.shard.parse().map_err(|_| of(nth, "shard: it cannot be read".into()))?;
            if part.failure.is_none() && total.runs < total.of {
                let why = format!(
                    "shard {share} was interrupted: {} of {} runs were finished; run it again",
                    total.runs, total.of
                );
                return Err(of(nth, why));
            }
            if by_share.insert(share, part).is_some() {
                return Err(of(nth, format!("shard {share} is there twice")));
            }
        }
        let number = by_share.keys().next().map_or(1, |share| share.of());
        let missing: Vec<_> = (1..=number)
            .filter_map(|nth| Share::new(nth, number))
            .filter(|share| !by_share.contains_key(share))
            .map(|share| share.to_string())
            .collect();
        match &missing[..] {
            [] => {}
            [one] => return Err(all(&format!("shard {one} is missing"))),
            several => return Err(all(&format!("shards are missing: {}", several.join(", ")))),
        }
        let mut merged = Self { shard: Share::default().to_string(), first_run: 0, ..first.clone() };
        merged.digests.clear();
        merged.sums = Sums::default();
        merged.failure = None;
        for part in by_share.into_values() {
            merged.digests.extend(part.digests.iter().cloned());
            merged.sums.add(&part.sums);
            merged.wall_us = merged.wall_us.max(part.wall_us);
            // Parts are in the order of runs, so the first failure is the earliest one.
            merged.failure = merged.failure.or_else(|| part.failure.clone());
        }
        Ok(merged)
    }

    /// The reason why this document belongs to another batch than `first`.
    fn differs_from(&self, first: &Self) -> Result<(), String> {
        if self.soak != FORMAT || self.version != VERSION {
            return Err(format!(
                "it is of host-sim {} (format {}); this is {VERSION} (format {FORMAT})",
                self.version, self.soak
            ));
        }
        let differs = |option: &str, this: &dyn fmt::Display, that: &dyn fmt::Display| {
            Err(format!("it was run with {option} {this}, the first file with {that}"))
        };
        if self.seed != first.seed {
            return differs("--seed", &self.seed, &first.seed);
        }
        if self.faults != first.faults {
            return differs("--faults", &self.faults, &first.faults);
        }
        if self.virtual_us != first.virtual_us {
            let hours = |part: &Self| part.virtual_us as f64 / 3.6e9;
            return differs("--hours", &hours(self), &hours(first));
        }
        let shares = |part: &Self| part.shard.split_once('/').map_or("?", |(_, of)| of).to_owned();
        if shares(self) != shares(first) {
            return Err(format!("it is shard {}, the first file is {}", self.shard, first.shard));
        }
        let names = |part: &Self| {
            let names: Vec<_> = part.cells.iter().map(|cell| cell.name.as_str()).collect();
            names.join(", ")
        };
        if names(self) != names(first) {
            return Err(format!("it has the cells {}, the first file {}", names(self), names(first)));
        }
        let mut cells = self.cells.iter().zip(&first.cells);
        match cells.find(|(this, that)| this.fingerprint != that.fingerprint) {
            Some((cell, _)) => Err(format!(
                "cell {} is not that of the first file: another configuration, or another build of host-sim",
                cell.name
            )),
            None => Ok(()),
        }
    }
}

impl From<Failure> for PartFailure {
    fn from(failure: Failure) -> Self {
        Self {
            run: failure.run,
            seed: failure.seed,
            cell: failure.cell,
            after_us: failure.after.as_micros(),
            what: failure.what.to_string(),
        }
    }
}

impl Sums {
    fn of(total: &Total) -> Self {
        let mut ports: BTreeMap<String, BTreeMap<String, (u64, u64)>> = BTreeMap::new();
        for ((cell, port), &frames) in &total.ports {
            ports.entry(cell.clone()).or_default().insert(port.clone(), frames);
        }
        Self {
            events: total.events,
            writes: total.writes,
            cells: total
                .cells
                .iter()
                .map(|(name, (runs, span))| (name.clone(), (*runs, span.as_micros())))
                .collect(),
            ports,
            links: total.links.clone(),
            faults: total.faults.iter().map(|(kind, &times)| (kind.name().to_owned(), times)).collect(),
            checks: total.checks.iter().map(|(what, &times)| (what.name().to_owned(), times)).collect(),
            outcomes: total.outcomes.clone(),
        }
    }

    fn total(&self) -> Result<Total, String> {
        let mut total = Total { events: self.events, writes: self.writes, ..Total::default() };
        total.links = self.links.clone();
        total.outcomes = self.outcomes.clone();
        for (name, &(runs, span_us)) in &self.cells {
            let span = Duration::from_micros(span_us);
            total.runs = total.runs.saturating_add(runs);
            total.span = total.span + span;
            total.cells.insert(name.clone(), (runs, span));
        }
        for (cell, ports) in &self.ports {
            for (port, &frames) in ports {
                total.ports.insert((cell.clone(), port.clone()), frames);
            }
        }
        for (name, &times) in &self.faults {
            let kind = FaultKind::ALL.into_iter().find(|kind| kind.name() == name);
            total
                .faults
                .insert(kind.ok_or_else(|| format!("sums.faults: no fault is called {name:?}"))?, times);
        }
        for (name, &times) in &self.checks {
            let what = Invariant::ALL.into_iter().find(|what| what.name() == name);
            let what = what.ok_or_else(|| format!("sums.checks: no invariant is called {name:?}"))?;
            total.checks.insert(what, times);
        }
        Ok(total)
    }

    fn add(&mut self, other: &Self) {
        self.events = self.events.saturating_add(other.events);
        self.writes = self.writes.saturating_add(other.writes);
        for (name, &(runs, span_us)) in &other.cells {
            let sum = self.cells.entry(name.clone()).or_default();
            *sum = (sum.0.saturating_add(runs), sum.1.saturating_add(span_us));
        }
        for (cell, ports) in &other.ports {
            add_pairs(self.ports.entry(cell.clone()).or_default(), ports);
        }
        add_pairs(&mut self.links, &other.links);
        for (sums, others) in [
            (&mut self.faults, &other.faults),
            (&mut self.checks, &other.checks),
            (&mut self.outcomes, &other.outcomes),
        ] {
            for (name, times) in others {
                let sum = sums.entry(name.clone()).or_default();
                *sum = sum.saturating_add(*times);
            }
        }
    }
}

fn add_pairs(sums: &mut BTreeMap<String, (u64, u64)>, others: &BTreeMap<String, (u64, u64)>) {
    for (name, pair) in others {
        let sum = sums.entry(name.clone()).or_default();
        *sum = (sum.0.saturating_add(pair.0), sum.1.saturating_add(pair.1));
    }
}

/// The version of the document format.
pub const FORMAT: u32 = 2;
const VERSION: &str = env!("CARGO_PKG_VERSION");
