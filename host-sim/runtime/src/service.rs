//! Notifications to the service manager: ready, alive, stopping.
//!
//! systemd gives a service of `Type=notify` a socket in `NOTIFY_SOCKET`, and with `WatchdogSec=` a timeout in
//! `WATCHDOG_USEC`. The watchdog is notified only after all threads that move the robots' data have answered, so a run
//! whose main thread alone is alive is restarted. Without a service manager nothing is done.

use std::time::Duration;

use sd_notify::NotifyState;
use tracing::warn;

use super::client::RuntimeClient;

/// The service manager, from this process's environment.
pub(super) struct Service {
    /// The watchdog timeout.
    patience: Option<Duration>,
}

impl Service {
    pub(super) fn from_environment() -> Self {
        Self { patience: sd_notify::watchdog_enabled() }
    }

    pub(super) fn is_ready(&self) {
        tell(&[NotifyState::Ready, NotifyState::Status("running")]);
    }

    pub(super) fn is_stopping(&self) {
        tell(&[NotifyState::Stopping, NotifyState::Status("ending")]);
    }

    /// Notifies the watchdog as long as each thread answers. Never returns.
    pub(super) async fn keep_alive(&self, threads: impl Fn() -> Vec<RuntimeClient>) {
        self.each_beat(threads, || tell(&[NotifyState::Watchdog])).await;
    }

    async fn each_beat(&self, threads: impl Fn() -> Vec<RuntimeClient>, say: impl Fn()) {
        let Some(patience) = self.patience else { return std::future::pending().await };
        let mut beat = tokio::time::interval(patience / BEATS);
        beat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            beat.tick().await;
            // Empty while a configuration is being replaced.
            let threads = threads();
            let mut works = !threads.is_empty();
            for thread in threads {
                works &= thread.answers().await;
            }
            if works {
                say();
            }
        }
    }
}

/// Notifications per watchdog timeout.
const BEATS: u32 = 3;

fn tell(news: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(news) {
        warn!(%error, "the service manager cannot be told");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::client::RuntimeRequest;
    use std::cell::Cell;

    #[tokio::test(start_paused = true)]
    async fn a_thread_that_does_not_answer_is_not_said_to_work() {
        let (thread, mut inbox) = RuntimeClient::channel();
        let (works, mut other) = RuntimeClient::channel();
        let always_works = async {
            while let Some(RuntimeRequest::Ping(answer)) = other.recv().await {
                let _ = answer.send(());
            }
        };
        let service = Service { patience: Some(Duration::from_secs(3)) };
        let said = Cell::new(0);
        let works_for_a_while = async {
            let mut held = Vec::new();
            while let Some(RuntimeRequest::Ping(answer)) = inbox.recv().await {
                if held.is_empty() && said.get() < 4 {
                    let _ = answer.send(());
                } else {
                    // It hangs.
                    held.push(answer);
                }
            }
        };
        tokio::select! {
            () = service.each_beat(|| vec![works.clone(), thread.clone()], || said.set(said.get() + 1)) => unreachable!("it goes on"),
            () = works_for_a_while => unreachable!("the service is there"),
            () = always_works => unreachable!("the service is there"),
            () = tokio::time::sleep(Duration::from_secs(60)) => {}
        }
        assert_eq!(said.get(), 4);
    }

    #[tokio::test(start_paused = true)]
    async fn without_a_watchdog_nothing_is_asked() {
        let (thread, mut inbox) = RuntimeClient::channel();
        let service = Service { patience: None };
        tokio::select! {
            () = service.keep_alive(|| vec![thread.clone()]) => unreachable!("it goes on"),
            () = tokio::time::sleep(Duration::from_secs(60)) => {}
        }
        assert!(inbox.try_recv().is_err());
    }
}
