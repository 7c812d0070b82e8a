//! Connects an edge node to its broker, and executes everything that the node requests.

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

/// A source of values.
pub trait Sampler {
    /// Writes the current values into their places.
    fn sample(&mut self, node: &NodeCounters, values: &mut [Option<Value>]) -> impl Future<Output = Sampled>;
}

/// The result of taking a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sampled {
    /// The values were written, and the devices in this bit set work.
    Alive(u32),
    /// No values are available at the moment.
    Nothing,
    /// The catalog is about to change, so the node has to end.
    Changed,
}

/// Receives what a node wants stored, and what happens to it.
pub trait Listener {
    /// Stores the number of the session so that it survives restarts.
    fn keep(&mut self, bd_seq: u8);
    /// The births were sent.
    fn online(&mut self);
    /// There is no session, for this reason. `error` tells more if the connection failed.
    fn failed(&mut self, failure: SessionFailure, error: Option<&io::Error>);
}

/// Drives a node until it has ended, because `end` became `true` or the sampler returned [`Sampled::Changed`].
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
    // After a pause, the next tick comes one period later: missed samples cannot be taken afterwards.
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let places = (0..=catalog.devices()).map(|nth| match nth.checked_sub(1) {
        None => catalog.metrics(recipe_sparkplug::catalog::Owner::Node),
        Some(device) => catalog.metrics(recipe_sparkplug::catalog::Owner::Device(device as u8)),
    });
    let mut samples = Samples { values: vec![None; places.sum()], misses: 0 };
    // So that the first births already have values and time stamps.
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
        // Samples continue while a connection is being established.
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
    /// Number of samples in a row without values.
    misses: u32,
}

impl Samples {
    /// Gives the node one sample and the time. Returns `true` if the node has to end.
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
    /// Why the last connection failed.
    error: Option<io::Error>,
    was_online: bool,
    logged: Option<SessionFailure>,
}

impl SessionDriver {
    /// Executes the outputs of the node until it waits. Returns whether to open a connection, and until when the node
    /// waits.
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
                // On a host there are no other tasks to let run: continue at once.
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
            // The node decides what comes next.
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
    // A node that waits for nothing is polled occasionally anyway.
    TokioInstant::now() + left.min(LONGEST)
}

/// Size of the buffers for sending and receiving in bytes.
const BUFFER: usize = 8_192;
/// How long the broker may accept no data.
const WRITE_TIME: Duration = Duration::from_secs(10);
/// The longest time between two polls of a node.
const LONGEST: Duration = Duration::from_secs(3_600);
/// After this many samples in a row without values, all values are unknown.
const MAX_MISSES: u32 = 5;
/// 2024-01-01 in milliseconds since 1970. An earlier system time is not valid.
const OF_2024: u64 = 1_704_067_200_000;
