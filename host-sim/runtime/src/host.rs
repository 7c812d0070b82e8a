//! Starts and ends runtimes, and runs them in the foreground with `ready` line, statistics and a clean shutdown.
//!
//! A runtime has a thread of its own, or a [`LocalSet`] on a shared [`Worker`]. Either way its tasks end with it.

use std::cell::RefCell;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::mpsc as blocking;
use std::thread::JoinHandle;

use recipe_capture::Watch;
use recipe_io::fairness;
use serde_json::Value;
use tokio::sync::mpsc;
use tokio::task::{LocalSet, spawn_local};
use tracing::warn;

use super::service::Service;
use super::{RunError, RunOptions, Signals};
use crate::client::{RuntimeClient, RuntimeRequest};
use crate::findings::FindingTexts;
use crate::out::print_stderr;
use crate::stdout::{Stdout, StdoutFailure};
pub(super) use crate::worker::STACK;
use crate::worker::{RuntimePlace, SharedRuntime, no_runtime, panicked, runtime};

/// A gateway or a controller that runs on one thread until it is dropped.
pub(super) trait Runtime: 'static {
    /// The addresses and paths for the `ready` line, by name.
    fn ready(&self) -> Value;
    /// A function that returns one line of statistics while the runtime runs.
    fn stats(&self) -> impl Fn() -> Value + 'static;
    /// Runs in a context that allows `spawn_local`; returns only on permanent failure or after a shutdown command.
    fn run(self) -> impl Future<Output = Result<(), RunError>>;
}

/// A runtime that runs on a thread of its own or a shared one. Dropping it ends the runtime and waits until its sockets
/// are closed and its links removed.
#[derive(Debug)]
pub struct Handle {
    ready: Value,
    requests: mpsc::UnboundedSender<RuntimeRequest>,
    pub(super) watch: Watch,
    /// Texts that are added to the statistics.
    pub(super) findings: Option<FindingTexts>,
    home: Option<Home>,
}

/// Where a runtime runs.
#[derive(Debug)]
enum Home {
    /// On its own thread.
    Alone(JoinHandle<Result<(), RunError>>),
    /// On a shared worker.
    Among(SharedRuntime),
}

/// What the foreground runs: one or several runtimes, with or without a console.
pub(crate) trait ForegroundRun {
    /// The actual addresses and paths.
    fn ready(&self) -> &Value;
    /// One line of statistics; `None` if there is none at the moment.
    fn stats(&self) -> Option<Value>;
    /// Clients of all threads that move data; empty if one of them does not run at the moment.
    fn clients(&self) -> Vec<RuntimeClient>;
    fn has_ended(&self) -> bool;
    /// Ends it and waits until it has ended. If it had ended by itself, returns the reason as the error.
    fn shutdown(self: Box<Self>) -> Result<(), RunError>;
}

/// Actions of a runtime's thread after its tasks were dropped. Clones share the list.
#[derive(Default, Clone)]
pub(super) struct AtEnd(Rc<RefCell<Vec<Act>>>);

type Act = Box<dyn FnOnce()>;

impl AtEnd {
    /// Adds an action. It also runs if opening fails.
    pub(super) fn add(&self, act: impl FnOnce() + 'static) {
        self.0.borrow_mut().push(Box::new(act));
    }

    fn run(self) {
        self.0.take().into_iter().for_each(|act| act());
    }
}

/// Opens a runtime and waits until everything is listening.
pub(super) fn start<S: Runtime>(
    place: &RuntimePlace,
    name: &str,
    open: impl AsyncFnOnce(&AtEnd) -> Result<S, RunError> + Send + 'static,
) -> Result<Handle, RunError> {
    let (requests, inbox) = mpsc::unbounded_channel();
    let (opened, outcome) = blocking::channel();
    let open = Box::new(open);
    let opening = Opening { open: Box::new(|at_end| Box::pin(open(at_end))), opened, inbox };
    let home = match place.shared() {
        None => Home::Alone(alone(name, opening)?),
        Some((worker, begin)) => Home::Among(worker.run(place.span.clone(), move || async move {
            let (local, at_end) = (LocalSet::new(), AtEnd::default());
            let ended = fairness::apart(local.run_until(opening.run_as_task(&at_end, begin.wait()))).await;
            drop(local);
            at_end.run();
            ended
        })?),
    };
    match outcome.recv() {
        Ok(Ok(ready)) => {
            Ok(Handle { ready, requests, watch: Watch::new(), findings: None, home: Some(home) })
        }
        Ok(Err(error)) => {
            // Waits until everything is closed, so another attempt can succeed.
            let _ = home.ended();
            Err(error)
        }
        // The thread ended without a result; its own return value has the reason.
        Err(_) => Err(home.ended().err().unwrap_or_else(|| RunError::new(format!("{name} ended")))),
    }
}

fn alone<S: Runtime>(name: &str, opening: Opening<S>) -> Result<JoinHandle<Result<(), RunError>>, RunError> {
    let thread = std::thread::Builder::new().name(name.to_owned()).stack_size(STACK).spawn(move || {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_all().build_local(Default::default());
        let runtime = runtime.map_err(no_runtime)?;
        let at_end = AtEnd::default();
        let ended = runtime.block_on(opening.run_as_task(&at_end, std::future::ready(())));
        // Drops the tasks.
        drop(runtime);
        at_end.run();
        ended
    });
    thread.map_err(|error| RunError::new(format!("cannot start a thread: {error}")))
}

struct Opening<S> {
    open: Open<S>,
    opened: blocking::Sender<Result<Value, RunError>>,
    inbox: mpsc::UnboundedReceiver<RuntimeRequest>,
}

/// Opens a runtime. Function and future are boxed: their large stack frame, with an engine and a configuration, would
/// otherwise be touched on each wake of the runtime.
type Open<S> =
    Box<dyn for<'a> FnOnce(&'a AtEnd) -> Pin<Box<dyn Future<Output = Result<S, RunError>> + 'a>> + Send>;

impl<S: Runtime> Opening<S> {
    /// As [`Self::run`], but as a task: the main future would be polled on each wake of any task.
    async fn run_as_task(
        self,
        at_end: &AtEnd,
        begin: impl Future<Output = ()> + 'static,
    ) -> Result<(), RunError> {
        spawn_local(self.run(at_end.clone(), begin)).await.unwrap_or_else(|_| Err(panicked()))
    }

    /// Opens the runtime, and runs it once `begin` is ready.
    async fn run(self, at_end: AtEnd, begin: impl Future<Output = ()>) -> Result<(), RunError> {
        let Self { open, opened, inbox } = self;
        let runtime = match open(&at_end).await {
            Ok(runtime) => runtime,
            Err(error) => {
                let _ = opened.send(Err(error));
                return Ok(());
            }
        };
        let stats = runtime.stats();
        let _ = opened.send(Ok(runtime.ready()));
        let run = async {
            begin.await;
            runtime.run().await.map_err(RunError::after_start)
        };
        tokio::select! {
            ended = run => ended,
            () = serve(inbox, stats) => Ok(()),
        }
    }
}

/// Answers requests until shutdown.
async fn serve(mut inbox: mpsc::UnboundedReceiver<RuntimeRequest>, stats: impl Fn() -> Value) {
    while let Some(request) = inbox.recv().await {
        match request {
            RuntimeRequest::Stats(answer) => {
                let _ = answer.send(stats());
            }
            RuntimeRequest::Ping(answer) => {
                let _ = answer.send(());
            }
            RuntimeRequest::Shutdown => return,
        }
    }
}

impl Handle {
    /// The actual addresses and paths.
    pub fn ready(&self) -> &Value {
        &self.ready
    }

    /// The address or path called `name` (`"command"`, `"ports/rs485"`); empty if there is none.
    pub fn place(&self, name: &str) -> &str {
        self.ready.pointer(&format!("/{name}")).and_then(Value::as_str).unwrap_or("")
    }

    /// One line of statistics; `None` if the runtime has ended.
    pub fn stats(&self) -> Option<Value> {
        self.client().stats()
    }

    pub(crate) fn client(&self) -> RuntimeClient {
        RuntimeClient { requests: self.requests.clone(), findings: self.findings.clone() }
    }

    /// Frames and calls of the gateway, for any number of subscribers; a controller has none.
    pub fn watch(&self) -> &Watch {
        &self.watch
    }

    /// Whether the runtime has ended by itself.
    pub fn has_ended(&self) -> bool {
        self.home.as_ref().is_none_or(Home::has_ended)
    }

    /// Ends the runtime and waits for it.
    ///
    /// # Errors
    /// If it had ended by itself, the reason.
    pub fn shutdown(mut self) -> Result<(), RunError> {
        self.end()
    }

    fn end(&mut self) -> Result<(), RunError> {
        let _ = self.requests.send(RuntimeRequest::Shutdown);
        self.home.take().map_or(Ok(()), Home::ended)
    }
}

impl ForegroundRun for Handle {
    fn ready(&self) -> &Value {
        self.ready()
    }

    fn stats(&self) -> Option<Value> {
        self.stats()
    }

    fn clients(&self) -> Vec<RuntimeClient> {
        vec![self.client()]
    }

    fn has_ended(&self) -> bool {
        self.has_ended()
    }

    fn shutdown(self: Box<Self>) -> Result<(), RunError> {
        Self::shutdown(*self)
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        let _ = self.end();
    }
}

impl Home {
    fn has_ended(&self) -> bool {
        match self {
            Self::Alone(thread) => thread.is_finished(),
            Self::Among(shared) => shared.has_ended(),
        }
    }

    /// Waits until it has ended.
    fn ended(self) -> Result<(), RunError> {
        match self {
            Self::Alone(thread) => thread.join().unwrap_or_else(|_| Err(panicked())),
            Self::Among(shared) => shared.ended(),
        }
    }
}

/// Prints `ready` and statistics, and ends on a signal.
pub(super) fn foreground(handle: Box<dyn ForegroundRun>, options: &RunOptions) -> Result<(), RunError> {
    let runtime = runtime()?;
    let mut stdout = Stdout::start()
        .map_err(|error| RunError::new(format!("cannot start the thread for statistics: {error}")))?;
    let result = runtime.block_on(async {
        // Signals are handled before `ready` is printed.
        let refused = |error: std::io::Error| RunError::new(format!("signals: {error}"));
        let mut signals = Signals::catch().map_err(refused)?;
        let ready = options.ready.as_ref().map(|file| file.write(handle.ready())).transpose()?;
        let line = format!("ready {}", handle.ready());
        if options.stdout_is_taken {
            print_stderr(line);
        } else {
            stdout.print(line);
        }
        let service = Service::from_environment();
        service.is_ready();
        let mut ticks = options.stats.map(tokio::time::interval);
        let mut check = tokio::time::interval(CHECK_INTERVAL);
        let result = {
            let mut alive = std::pin::pin!(service.keep_alive(|| handle.clients()));
            loop {
                tokio::select! {
                    _ = signals.next() => break Ok(()),
                    () = &mut alive => {}
                    () = tick(&mut ticks) => {
                        if let Some(mut stats) = handle.stats() {
                            stats["lost_lines"] = stdout.lost().into();
                            stdout.print(stats.to_string());
                        }
                    }
                    Some(failure) = stdout.failures.recv() => match failure {
                        StdoutFailure::Closed if options.stats.is_some() => {
                            print_stderr("stdout was closed; ended, because nobody reads the statistics");
                            break Ok(());
                        }
                        // Nothing else is printed to stdout.
                        StdoutFailure::Closed => {}
                        StdoutFailure::NotReady(error) => {
                            break Err(RunError::new(format!("stdout: {error}")).after_start());
                        }
                        StdoutFailure::Lost(error) => warn!(%error, "cannot write statistics to stdout"),
                    },
                    _ = check.tick() => {
                        if handle.has_ended() {
                            break Ok(());
                        }
                    }
                }
            }
        };
        drop(ready);
        service.is_stopping();
        result.and(handle.shutdown())
    });
    stdout.finish();
    result
}

/// Interval at which the foreground checks that the runtime still runs.
const CHECK_INTERVAL: std::time::Duration = std::time::Duration::from_millis(100);

async fn tick(ticks: &mut Option<tokio::time::Interval>) {
    match ticks {
        Some(ticks) => {
            ticks.tick().await;
        }
        None => std::future::pending().await,
    }
}
