//! Requests to a runtime, from any thread.

use std::sync::mpsc as blocking;

use serde_json::Value;
use tokio::sync::{mpsc, oneshot};

use crate::findings::FindingTexts;

/// Asks one runtime for statistics, or whether it responds.
#[derive(Debug, Clone)]
pub(crate) struct RuntimeClient {
    pub(super) requests: mpsc::UnboundedSender<RuntimeRequest>,
    /// Findings come from another thread than the statistics.
    pub(super) findings: Option<FindingTexts>,
}

impl RuntimeClient {
    /// One line of statistics; `None` if the runtime has ended.
    pub(crate) fn stats(&self) -> Option<Value> {
        let (answer, stats) = blocking::channel();
        self.requests.send(RuntimeRequest::Stats(answer)).ok()?;
        let mut stats = stats.recv().ok()?;
        if let Some(findings) = &self.findings {
            stats["findings"] = findings.to_json();
        }
        Some(stats)
    }

    pub(crate) async fn answers(&self) -> bool {
        let (answer, answered) = oneshot::channel();
        self.requests.send(RuntimeRequest::Ping(answer)).is_ok() && answered.await.is_ok()
    }

    #[cfg(test)]
    pub(super) fn channel() -> (Self, mpsc::UnboundedReceiver<RuntimeRequest>) {
        let (requests, inbox) = mpsc::unbounded_channel();
        (Self { requests, findings: None }, inbox)
    }
}

#[derive(Debug)]
pub(super) enum RuntimeRequest {
    Stats(blocking::Sender<Value>),
    /// Answered if the thread works.
    Ping(oneshot::Sender<()>),
    Shutdown,
}
