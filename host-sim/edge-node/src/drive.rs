//! Connects an edge node to its broker and executes its outputs.

use std::io;
use std::time::{Duration, SystemTime};

use proto_core::time::Instant;
use recipe_io::timer::now;
use recipe_sparkplug::catalog::Catalog;
use recipe_sparkplug::node::{EdgeNode, Input, NodeCounters, NodeOutput, SessionFailure};
use recipe_sparkplug::value::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::sync::watch;
use tokio::time::{Instant as TokioInstant, MissedTickBehavior, interval, sleep_until, timeout};

use crate::broker::{Broker, BrokerConnection, close};

/// The source of values.
pub trait Sampler {
    /// Writes the present values to their places.
    fn sample(&mut self, node: &NodeCounters, values: &mut [Option<Value>]) -> impl Future<Output = Sampled>;
}

/// The result of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sampled {
    /// The values were written, and these devices work.
    Alive(u32),
    /// There are no values at the moment.
    Nothing,
    /// The metrics will change: the node is to die.
    Changed,
}

/// Stores and reports what a node requests.
pub trait Listener {
    /// Stores the session number, which must survive restarts.
    fn keep(&mut self, bd_seq: u8);
    /// The births were sent.
    fn online(&mut self);
    /// There is no session, for this reason; an error of the connection has details.
    fn failed(&mut self, failure: SessionFailure, error: Option<&io::Error>);
}

/// Drives a node until it has died, because `end` became true or the sampler returned [`Sampled::Changed`].
pub async fn drive<const METRICS: usize, const HISTORY: usize>(
    node: &mut EdgeNode<METRICS, HISTORY>,
    catalog: &impl Catalog,
    broker: &Broker,
    period: Duration,
    sampler: &mut impl Sampler,
    listener: &mut impl Listener,
    mut end: watch::Receiver<bool>,
) {
    let mut ticks = interval(period);
    // After a pause, the next tick is a period later: values are sampled now, not for missed ticks.
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let places = (0..=catalog.devices()).map(|nth| match nth.checked_sub(1) {
        None => catalog.metrics(recipe_sparkplug::catalog::Owner::Node),
        Some(device) => catalog.metrics(recipe_sparkplug::catalog::Owner::Device(device as u8)),
    });
    let mut samples = Samples { values: vec![None; places.sum()], misses: 0 };
    // The first births already have values and timestamps.
    samples.take(node, catalog, sampler).await;
    ticks.tick().await;
    let mut driver = SessionDriver { stream: None, error: None, was_online: false, logged: None };
    let (mut buf, mut rx) = (vec![0; BUFFER], vec![0; BUFFER]);
    loop {
        let (is_opening, until) = driver.drain(node, catalog, &mut buf, listener).await;
        if node.has_ended() {
            return;
        }
        let deadline = deadline(until);
        let open = async {
            match is_opening {
                true => broker.connect().await,
                false => std::future::pending().await,
            }
        };
        tokio::pin!(open);
        // Sampling continues while a connection is being made.
        loop {
            let stream = async {
                match &mut driver.stream {
                    Some(stream) => stream.read(&mut rx).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                opened = &mut open => {
                    match opened {
                        Ok(stream) => {
                            (driver.stream, driver.error) = (Some(stream), None);
                            node.handle(now(), Input::Opened, catalog);
                        }
                        Err(error) => {
                            driver.error = Some(error);
                            node.handle(now(), Input::Closed, catalog);
                        }
                    }
                    break;
                }
                read = stream => {
                    match read {
                        Ok(count @ 1..) => node.handle(now(), Input::Bytes(&rx[..count]), catalog),
                        Ok(0) => driver.lost(node, catalog, None),
                        Err(error) => driver.lost(node, catalog, Some(error)),
                    }
                    break;
                }
                _ = ticks.tick() => {
                    let is_changed = samples.take(node, catalog, sampler).await;
                    if !is_opening || is_changed {
                        break;
                    }
                }
                () = sleep_until(deadline) => break,
                _ = end.wait_for(|is_ending| *is_ending) => {
                    node.handle(now(), Input::End, catalog);
                    break;
                }
            }
        }
    }
}

struct Samples {
    values: Vec<Option<Value>>,
    /// Number of consecutive samples without values.
    misses: u32,
}

impl Samples {
    /// Gives the node one sample and the time. Returns true if the node is to die.
    async fn take<const METRICS: usize, const HISTORY: usize>(
        &mut self,
        node: &mut EdgeNode<METRICS, HISTORY>,
        catalog: &impl Catalog,
        sampler: &mut impl Sampler,
    ) -> bool {
        let sampled = sampler.sample(&node.counters(), &mut self.values).await;
        let at = now();
        if let Some(utc_ms) = utc_ms() {
            node.handle(at, Input::Time { utc_ms }, catalog);
        }
        match sampled {
            Sampled::Alive(alive) => {
                self.misses = 0;
                node.handle(at, Input::Sample { values: &self.values, alive }, catalog);
            }
            Sampled::Nothing => {
                self.misses = self.misses.saturating_add(1);
                if self.misses == MAX_MISSES {
                    node.handle(at, Input::Sample { values: &[], alive: 0 }, catalog);
                }
            }
            Sampled::Changed => node.handle(at, Input::End, catalog),
        }
        sampled == Sampled::Changed
    }
}

struct SessionDriver {
    stream: Option<Box<dyn BrokerConnection>>,
    /// Why there is no connection.
    error: Option<io::Error>,
    was_online: bool,
    logged: Option<SessionFailure>,
}

impl SessionDriver {
    /// Executes the node's outputs until it waits. Returns whether to connect, and the end of the wait.
    async fn drain<const METRICS: usize, const HISTORY: usize>(
        &mut self,
        node: &mut EdgeNode<METRICS, HISTORY>,
        catalog: &impl Catalog,
        buf: &mut [u8],
        listener: &mut impl Listener,
    ) -> (bool, Instant) {
        let mut is_opening = false;
        let until = loop {
            match node.poll_output(now(), catalog, buf) {
                NodeOutput::Open => is_opening = true,
                // Continue without yielding: a host measures a birth in one go.
                NodeOutput::Busy => {}
                NodeOutput::Keep { bd_seq } => listener.keep(bd_seq),
                NodeOutput::Send(bytes) => {
                    let Some(stream) = &mut self.stream else { continue };
                    let written = timeout(WRITE_TIME, stream.write_all(bytes)).await;
                    match written.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into())) {
                        Ok(()) => {}
                        Err(error) => self.lost(node, catalog, Some(error)),
                    }
                }
                NodeOutput::Close => {
                    is_opening = false;
                    if let Some(stream) = self.stream.take() {
                        close(stream).await;
                    }
                }
                NodeOutput::Sleep { until } => break until,
            }
        };
        if let Some(stream) = &mut self.stream
            && let Err(error) = timeout(WRITE_TIME, stream.flush())
                .await
                .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
        {
            self.lost(node, catalog, Some(error));
            // The node decides what follows.
            return Box::pin(self.drain(node, catalog, buf, listener)).await;
        }
        match (node.is_online(), node.failure()) {
            (true, _) if !self.was_online => {
                (self.was_online, self.logged) = (true, None);
                listener.online();
            }
            (false, Some(failure)) if self.was_online || self.logged != Some(failure) => {
                (self.was_online, self.logged) = (false, Some(failure));
                listener.failed(failure, self.error.as_ref());
            }
            _ => {}
        }
        (is_opening, until)
    }

    fn lost<const METRICS: usize, const HISTORY: usize>(
        &mut self,
        node: &mut EdgeNode<METRICS, HISTORY>,
        catalog: &impl Catalog,
        error: Option<io::Error>,
    ) {
        (self.stream, self.error) = (None, error);
        node.handle(now(), Input::Closed, catalog);
    }
}

fn utc_ms() -> Option<u64> {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).ok()?;
    u64::try_from(since.as_millis()).ok().filter(|ms| *ms >= OF_2024)
}

fn deadline(until: Instant) -> TokioInstant {
    let left = Duration::from_micros(until.saturating_since(now()).as_micros());
    // A node without a deadline is polled after this time all the same.
    TokioInstant::now() + left.min(LONGEST)
}

/// Length of the node's chunks, and of a read.
const BUFFER: usize = 8_192;
/// How long the broker may read nothing.
const WRITE_TIME: Duration = Duration::from_secs(10);
/// Maximum time between two polls of a node.
const LONGEST: Duration = Duration::from_secs(3_600);
/// Number of samples without values after which the values are unknown.
const MAX_MISSES: u32 = 5;
/// Milliseconds from 1970 to 2024.
const OF_2024: u64 = 1_704_067_200_000;
