//! The controller's clock: waits, and how a stepped clock moves.
//!
//! A stepped clock moves from one deadline to the next while a client waits. At each instant it stands until everything
//! sent has left and everything received is handled, so a run depends on its clients and not on the speed of the
//! machine.

use std::rc::Rc;

use proto_core::time::{Duration, Instant};
use tokio::sync::oneshot;
use tokio::task::yield_now;
use tracing::warn;

use super::{ControllerRuntime, Outward};
use recipe_controller::Condition;
use recipe_controller::operations::time;
use recipe_io::fairness::is_anyone_busy;
use recipe_io::timer;

/// A client that waits for an instant or a condition.
#[derive(Debug)]
pub(super) struct WaitingClient {
    until: Instant,
    timeout_s: f64,
    /// With the number of the first event that counts.
    condition: Option<(Condition, u64)>,
    held: bool,
    answer: oneshot::Sender<Result<(), String>>,
}

impl ControllerRuntime {
    /// Moves a stepped clock by this time; returns when it has arrived and everything is handled.
    pub(super) async fn advance_clock(&self, seconds: f64) -> Result<(), String> {
        if !self.clock.is_stepped() {
            return Err("the clock runs by itself; `advance` needs --time stepped, `wait` does not".into());
        }
        let until = self.clock.now() + time("seconds", seconds).map_err(|refused| refused.0)?;
        self.await_turn(until, seconds, None).await
    }

    /// Waits until the condition holds; a stepped clock moves meanwhile.
    pub(super) async fn wait_for(&self, condition: Condition, timeout_s: f64) -> Result<(), String> {
        let until = self.clock.now() + time("timeout_s", timeout_s).map_err(|refused| refused.0)?;
        let since = self.controller.borrow().newest_event() + 1;
        let holds = self.controller.borrow().holds(&condition, since);
        match holds.map_err(|error| error.to_string())? {
            true if !self.clock.is_stepped() => Ok(()),
            _ => self.await_turn(until, timeout_s, Some((condition, since))).await,
        }
    }

    async fn await_turn(
        &self,
        until: Instant,
        timeout_s: f64,
        condition: Option<(Condition, u64)>,
    ) -> Result<(), String> {
        let alarm = self.clock.alarm().map_err(|error| format!("cannot create a timer: {error}"))?;
        let (answer, mut answered) = oneshot::channel();
        self.waits.borrow_mut().push(WaitingClient { until, timeout_s, condition, held: false, answer });
        self.check_waits();
        let over = || Err("the controller ends".to_owned());
        if self.clock.is_stepped() {
            self.moved.notify_one();
            return answered.await.unwrap_or_else(|_| over());
        }
        alarm.arm(until).map_err(|error| error.to_string())?;
        tokio::select! {
            biased;
            answer = &mut answered => return answer.unwrap_or_else(|_| over()),
            expired = alarm.expired() => expired.map_err(|error| error.to_string())?,
        }
        self.answer_waits();
        answered.await.unwrap_or_else(|_| over())
    }

    /// Notes which conditions hold now and, unless the clock is stepped, answers their waits.
    pub(super) fn check_waits(&self) {
        if self.waits.borrow().is_empty() {
            return;
        }
        let controller = self.controller.borrow();
        let mut any = false;
        for waiting in self.waits.borrow_mut().iter_mut().filter(|waiting| !waiting.held) {
            let condition = waiting.condition.as_ref();
            waiting.held =
                condition.is_some_and(|(condition, since)| controller.holds(condition, *since) == Ok(true));
            any |= waiting.held;
        }
        drop(controller);
        if any && !self.clock.is_stepped() {
            self.answer_waits();
        }
    }

    /// Answers waits whose condition has held or whose time is over.
    fn answer_waits(&self) {
        let now = self.clock.now();
        let mut waits = self.waits.borrow_mut();
        waits.retain(|waiting| !waiting.answer.is_closed());
        for waiting in waits.extract_if(.., |waiting| waiting.held || waiting.until <= now) {
            let answer = match &waiting.condition {
                Some((condition, since)) if !waiting.held => {
                    let unmet = self.controller.borrow().unmet(condition, *since).join("; ");
                    Err(format!("not within {} s: {unmet}", waiting.timeout_s))
                }
                _ => Ok(()),
            };
            // Fails if the client has left.
            let _ = waiting.answer.send(answer);
        }
    }

    /// Moves a stepped clock while there are waits.
    pub(super) async fn keep_stepping(self: Rc<Self>) {
        loop {
            if self.waits.borrow().is_empty() {
                self.moved.notified().await;
                continue;
            }
            self.settle().await;
            self.answer_waits();
            let until = self.waits.borrow().iter().map(|waiting| waiting.until).min();
            if let Some(until) = until {
                self.clock.step_to(until.min(self.clock.next_deadline()));
            }
        }
    }

    /// Serves sockets and devices until nothing more happens at this instant.
    async fn settle(&self) {
        let began = timer::now();
        let (mut quiet_rounds, mut quiet_since) = (0, began);
        while quiet_rounds < QUIET_ROUNDS || timer::now().saturating_since(quiet_since) < MIN_QUIET {
            let before = self.activity.get();
            for port in &self.ports {
                if let Outward::Device(tx) = port {
                    tx.look();
                }
            }
            // All sockets are polled and all tasks run before this continues.
            yield_now().await;
            let now = timer::now();
            let is_quiet = self.activity.get() == before
                && !self.clock.has_due()
                && !is_anyone_busy()
                && !self.is_sending(now);
            if is_quiet {
                quiet_rounds += 1;
            } else {
                (quiet_rounds, quiet_since) = (0, now);
            }
            if now.saturating_since(began) >= MAX_SETTLE {
                if let Some(more) = self.log_limit.allow(now) {
                    warn!(more, "clients do not pause: the clock moves on without waiting for them");
                }
                return;
            }
        }
    }

    /// Whether data waits for a peer that has read some lately.
    fn is_sending(&self, now: Instant) -> bool {
        let is_recent =
            |since: Option<Instant>| since.is_some_and(|since| now.saturating_since(since) < MAX_BLOCKED);
        let port = |port: &Outward| match port {
            Outward::Tcp(connection) => {
                connection.borrow().as_ref().is_some_and(|connection| is_recent(connection.blocked_since()))
            }
            Outward::Device(_) | Outward::UdpServer | Outward::Udp(_) => false,
        };
        self.connections.borrow().values().any(|client| is_recent(client.connection.blocked_since()))
            || self.lingering.borrow().iter().any(|connection| is_recent(connection.blocked_since()))
            || self.control_clients.borrow().iter().any(|client| is_recent(client.blocked_since()))
            || self.ports.iter().any(port)
            || self.kernel_sends.borrow().values().any(|&since| is_recent(Some(since)))
    }
}

/// Rounds of all tasks without an event after which an instant is over; several, as an event may pass several tasks.
const QUIET_ROUNDS: u32 = 4;
/// Minimum time without an event, for data that the kernel passes on with a thread of its own.
const MIN_QUIET: Duration = Duration::from_micros(30);
/// How long a stepped clock waits for a peer that reads nothing.
const MAX_BLOCKED: Duration = Duration::from_millis(200);
/// How long a stepped clock stands at one instant for clients that never pause.
const MAX_SETTLE: Duration = Duration::from_secs(1);
