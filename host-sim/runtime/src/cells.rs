//! Several gateways in one process, on a given number of threads.
//!
//! Each has its own engine, devices, connections and console, and knows nothing of the others. They share threads
//! because a gateway sleeps several times in 4 ms, and sleeping costs more than the work in between.

use std::num::NonZeroUsize;
use std::sync::Arc;

use proto_core::config::GatewayConfig;
use proto_core::time::Duration;
use recipe_io::handover::Handover;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use serde_json::{Map, Value, json};
use tracing::{error_span, warn};

use crate::client::RuntimeClient;
use crate::console::{ConfigFile, Supervised};
use crate::gateway::{Observers, spawn};
use crate::host::{self, ForegroundRun};
use crate::worker::{Begin, RuntimePlace, Worker};
use crate::{RunError, RunOptions};

/// A cell of a process that serves several.
#[derive(Debug)]
pub struct Cell {
    /// The unique name of the cell in `ready`, the statistics and the log.
    pub name: String,
    /// The gateway's configuration.
    pub config: Box<GatewayConfig>,
    /// The file that the configuration was read from, which a console needs.
    pub file: ConfigFile,
    /// Options of this gateway alone: devices, console. Options of the foreground have no effect.
    pub options: RunOptions,
}

/// Runs the gateways of several cells on `threads` threads until Ctrl-C, SIGTERM or SIGHUP. None starts before all are
/// listening; if one ends by itself, all end.
///
/// # Errors
/// The name of a cell that could not start, and the reason. Everything that was opened is closed.
pub fn run(cells: Vec<Cell>, threads: NonZeroUsize, options: &RunOptions) -> Result<(), RunError> {
    raise_file_limit();
    let workers: Vec<_> =
        (0..threads.get().min(cells.len())).map(|_| Worker::start("gateways")).collect::<Result<_, _>>()?;
    let (begins, begin) = Begin::channel();
    let count = cells.len() as u64;
    let mut started = Vec::with_capacity(cells.len());
    for ((nth, cell), worker) in (0..).zip(cells).zip(workers.iter().cycle()) {
        let span = error_span!("cell", name = cell.name);
        let begin = begin.and_later(Duration::from_micros(nth * CYCLE.as_micros() / count));
        let place = RuntimePlace::among(Arc::clone(worker), begin, span);
        let name = cell.name.clone();
        let run = start(cell, place).map_err(|error| error.of(&name))?;
        started.push((name, run));
    }
    // The cells keep their workers alive.
    drop(workers);
    // All cells listen now.
    let _ = begins.send(true);
    host::foreground(Box::new(Cells::new(started)), options)
}

/// The usual cycle, over which the starts of the cells are spread so that they do not contend in each cycle.
const CYCLE: Duration = Duration::from_millis(4);

fn start(cell: Cell, place: RuntimePlace) -> Result<Box<dyn ForegroundRun>, RunError> {
    let Cell { config, file, options, .. } = cell;
    // The span for threads that are started here.
    let _of = place.span.clone().entered();
    if let Some(console) = &options.console {
        return Ok(Box::new(Supervised::start(file, &options, console, None, place)?));
    }
    let observers = Observers::of(&options);
    let handle = spawn(*config, options.binds, options.scheduling, observers, Handover::default(), &place)?;
    Ok(Box::new(handle))
}

struct Cells {
    ready: Value,
    cells: Vec<(String, Box<dyn ForegroundRun>)>,
}

impl Cells {
    fn new(cells: Vec<(String, Box<dyn ForegroundRun>)>) -> Self {
        let ready = cells.iter().map(|(name, run)| (name.clone(), run.ready().clone()));
        Self { ready: by_name(ready), cells }
    }
}

impl ForegroundRun for Cells {
    fn ready(&self) -> &Value {
        &self.ready
    }

    fn stats(&self) -> Option<Value> {
        let stats = self.cells.iter().filter_map(|(name, run)| Some((name.clone(), run.stats()?)));
        Some(by_name(stats))
    }

    fn clients(&self) -> Vec<RuntimeClient> {
        let clients: Vec<_> = self.cells.iter().map(|(_, run)| run.clients()).collect();
        match clients.iter().any(Vec::is_empty) {
            true => Vec::new(),
            false => clients.concat(),
        }
    }

    fn has_ended(&self) -> bool {
        self.cells.iter().any(|(_, run)| run.has_ended())
    }

    fn shutdown(self: Box<Self>) -> Result<(), RunError> {
        let mut result = Ok(());
        for (name, run) in self.cells {
            result = result.and(run.shutdown().map_err(|error| error.of(&name)));
        }
        result
    }
}

fn by_name(cells: impl Iterator<Item = (String, Value)>) -> Value {
    json!({ "cells": Map::from_iter(cells) })
}

/// Raises the soft limit of open files, usually 1024: a cell needs more than ten.
fn raise_file_limit() {
    let limit = getrlimit(Resource::Nofile);
    let raised = Rlimit { current: limit.maximum, ..limit };
    if let Err(error) = setrlimit(Resource::Nofile, raised) {
        warn!(%error, "cannot raise the limit of open files");
    }
}
