//! A thread shared by several runtimes: one wake-up serves all of them, so they sleep less often than on threads of
//! their own.

use std::io;
use std::pin::Pin;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use proto_core::time::Duration;
use recipe_io::timer::{Timer, now};
use tokio::sync::{mpsc, watch};
use tokio::task::{LocalSet, spawn_local};
use tracing::{Instrument, Span};

use crate::RunError;

/// Stack size: an engine is built by value, and unoptimised code has several copies of it on the stack.
pub(super) const STACK: usize = 16 << 20;

/// A thread or a runtime panicked.
pub(super) fn panicked() -> RunError {
    RunError::new("a thread panicked").after_start()
}

pub(super) fn runtime() -> Result<tokio::runtime::Runtime, RunError> {
    tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(no_runtime)
}

pub(super) fn no_runtime(error: io::Error) -> RunError {
    RunError::new(format!("cannot start the runtime: {error}"))
}

/// Where a runtime runs.
#[derive(Debug, Clone)]
pub(crate) struct RuntimePlace {
    pub(crate) span: Span,
    shared: Option<(Arc<Worker>, Begin)>,
}

impl RuntimePlace {
    /// On its own thread.
    pub(crate) fn alone() -> Self {
        Self { span: Span::none(), shared: None }
    }

    /// On a shared thread. The runtime is opened at once, and runs after `begin`.
    pub(crate) const fn among(worker: Arc<Worker>, begin: Begin, span: Span) -> Self {
        Self { span, shared: Some((worker, begin)) }
    }

    pub(super) fn shared(&self) -> Option<(Arc<Worker>, Begin)> {
        self.shared.clone()
    }
}

/// The moment at which opened runtimes start to run.
#[derive(Debug, Clone)]
pub(crate) struct Begin {
    begins: watch::Receiver<bool>,
    after: Duration,
}

impl Begin {
    /// Begins when `true` is sent; never if the sender is dropped before.
    pub(crate) fn channel() -> (watch::Sender<bool>, Self) {
        let (begins, begin) = watch::channel(false);
        (begins, Self { begins: begin, after: Duration::ZERO })
    }

    /// The same moment plus `after`.
    pub(crate) fn and_later(&self, after: Duration) -> Self {
        Self { begins: self.begins.clone(), after }
    }

    pub(super) async fn wait(mut self) {
        if self.begins.wait_for(|begins| *begins).await.is_err() {
            std::future::pending().await
        }
        if self.after > Duration::ZERO
            && let Ok(timer) = Timer::new()
            && timer.arm(now() + self.after).is_ok()
        {
            // If the timer fails, the runtime begins at once.
            let _ = timer.expired().await;
        }
    }
}

type Job = Box<dyn FnOnce() -> Pin<Box<dyn Future<Output = ()>>> + Send>;

/// A thread for any number of runtimes. It ends when the last reference is dropped.
#[derive(Debug)]
pub(crate) struct Worker {
    jobs: Option<mpsc::UnboundedSender<Job>>,
    thread: Option<JoinHandle<()>>,
}

impl Worker {
    pub(crate) fn start(name: &str) -> Result<Arc<Self>, RunError> {
        let (jobs, mut inbox) = mpsc::unbounded_channel::<Job>();
        // Built here, where an error can be returned.
        let runtime = runtime()?;
        let thread = std::thread::Builder::new().name(name.to_owned()).stack_size(STACK).spawn(move || {
            LocalSet::new().block_on(&runtime, async {
                while let Some(job) = inbox.recv().await {
                    spawn_local(job());
                }
            });
        });
        let thread = thread.map_err(|error| RunError::new(format!("cannot start a thread: {error}")))?;
        Ok(Arc::new(Self { jobs: Some(jobs), thread: Some(thread) }))
    }

    pub(super) fn run<F>(
        self: Arc<Self>,
        span: Span,
        runtime: impl FnOnce() -> F + Send + 'static,
    ) -> Result<SharedRuntime, RunError>
    where
        F: Future<Output = Result<(), RunError>> + 'static,
    {
        let end = Arc::<RuntimeEnd>::default();
        let outcome = EndGuard(Arc::clone(&end));
        let job: Job = Box::new(move || {
            Box::pin(
                async move {
                    let ended = runtime().await;
                    outcome.is(ended);
                }
                .instrument(span),
            )
        });
        let sent = self.jobs.as_ref().is_some_and(|jobs| jobs.send(job).is_ok());
        match sent {
            true => Ok(SharedRuntime { end, _worker: self }),
            false => Err(panicked()),
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            // A panic of a runtime is reported by its `EndGuard`.
            let _ = thread.join();
        }
    }
}

#[derive(Debug)]
pub(super) struct SharedRuntime {
    end: Arc<RuntimeEnd>,
    /// Keeps the worker alive while the runtime runs.
    _worker: Arc<Worker>,
}

impl SharedRuntime {
    pub(super) fn has_ended(&self) -> bool {
        self.end.result().is_some()
    }

    pub(super) fn ended(self) -> Result<(), RunError> {
        let result = self.end.result();
        let mut result = self
            .end
            .ended
            .wait_while(result, |result| result.is_none())
            .unwrap_or_else(PoisonError::into_inner);
        result.take().unwrap_or(Ok(()))
    }
}

#[derive(Debug, Default)]
struct RuntimeEnd {
    result: Mutex<Option<Result<(), RunError>>>,
    ended: Condvar,
}

impl RuntimeEnd {
    fn result(&self) -> MutexGuard<'_, Option<Result<(), RunError>>> {
        self.result.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn set(&self, result: Result<(), RunError>) {
        self.result().get_or_insert(result);
        self.ended.notify_all();
    }
}

/// Reports the end of a runtime, even if it panics.
struct EndGuard(Arc<RuntimeEnd>);

impl EndGuard {
    fn is(self, result: Result<(), RunError>) {
        self.0.set(result);
    }
}

impl Drop for EndGuard {
    fn drop(&mut self) {
        self.0.set(Err(panicked()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host::{self, Handle, Runtime};
    use serde_json::{Value, json};
    use std::sync::mpsc::{Receiver, Sender, channel};

    /// Reports that it runs, then waits forever or panics.
    struct TestRuntime {
        runs: Sender<()>,
        panics: bool,
    }

    impl Runtime for TestRuntime {
        fn ready(&self) -> Value {
            Value::Null
        }

        fn stats(&self) -> impl Fn() -> Value + 'static {
            || json!("alive")
        }

        async fn run(self) -> Result<(), RunError> {
            let _ = self.runs.send(());
            assert!(!self.panics, "as it was told to");
            std::future::pending().await
        }
    }

    fn opened(worker: &Arc<Worker>, begin: &Begin, panics: bool) -> (Handle, Receiver<()>) {
        let (runs, has_run) = channel();
        let place = RuntimePlace::among(Arc::clone(worker), begin.clone(), Span::none());
        let handle = host::start(&place, "told", async move |_| Ok(TestRuntime { runs, panics })).unwrap();
        (handle, has_run)
    }

    #[test]
    fn none_runs_before_all_are_open_and_each_ends_alone() {
        let worker = Worker::start("test").unwrap();
        let (begins, begin) = Begin::channel();
        let (left, left_runs) = opened(&worker, &begin, false);
        let (right, right_runs) = opened(&worker, &begin, false);
        for _ in 0..2 {
            assert_eq!((left.stats(), right.stats()), (Some(json!("alive")), Some(json!("alive"))));
        }
        assert!(left_runs.try_recv().is_err() && right_runs.try_recv().is_err(), "not yet");
        begins.send(true).unwrap();
        left_runs.recv().unwrap();
        right_runs.recv().unwrap();
        left.shutdown().unwrap();
        assert!(!right.has_ended());
        assert_eq!(right.stats(), Some(json!("alive")));
        drop(worker);
        assert_eq!(right.stats(), Some(json!("alive")), "its thread is there as long as it is");
        right.shutdown().unwrap();
    }

    #[test]
    fn one_that_panics_ends_with_an_error_and_the_others_go_on() {
        let worker = Worker::start("test").unwrap();
        let (begins, begin) = Begin::channel();
        let (left, left_runs) = opened(&worker, &begin, true);
        let (right, right_runs) = opened(&worker, &begin, false);
        begins.send(true).unwrap();
        left_runs.recv().unwrap();
        right_runs.recv().unwrap();
        assert_eq!(left.shutdown(), Err(panicked()));
        assert_eq!(right.stats(), Some(json!("alive")));
        right.shutdown().unwrap();
    }

    #[test]
    fn one_that_does_not_open_says_why() {
        let worker = Worker::start("test").unwrap();
        let (_begins, begin) = Begin::channel();
        let place = RuntimePlace::among(worker, begin, Span::none());
        let refused =
            host::start(&place, "told", async |_| Err::<TestRuntime, _>(RunError::new("no device")));
        assert_eq!(refused.unwrap_err().to_string(), "no device");
    }
}
