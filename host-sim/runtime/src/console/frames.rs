//! Frames by name for a stream, and as a capture.
//!
//! In: records of the gateway's watch, queued for each client. Out: the data of an event `frames`, or the blocks of a
//! capture. Records that a client does not read in time are dropped for this client and counted.

use std::sync::Arc;
use std::time::Duration;

use proto_core::engine::{TapDirection, TapPlace, TapVerdict};
use proto_core::time::Instant;
use proto_core::wire::can::CanId;
use recipe_api::key::Hex;
use recipe_capture::pcapng::{Pcapng, Scope};
use recipe_capture::{Arrived, Cell, Frame, Interest, Next, Record, Subscription, Watch, What};
use serde_json::{Value, json};

/// Frames for one stream.
#[derive(Debug)]
pub(super) struct FrameEvents {
    subscription: Subscription,
    port: Option<String>,
    cell: Option<Arc<Cell>>,
}

impl FrameEvents {
    /// Frames from now on, of this port or of all ports.
    pub(super) fn of(watch: &Watch, port: Option<String>) -> Self {
        Self { subscription: subscribe(watch), port, cell: None }
    }

    /// The data of the next event: at most [`AT_ONCE`] waiting frames; `None` if none wait.
    pub(super) fn event(&mut self) -> Option<(Value, u64)> {
        let (mut frames, mut lost) = (Vec::new(), 0);
        while frames.len() < AT_ONCE
            && let Next::Record(Arrived { record, missed }) = self.subscription.next(Duration::ZERO)
        {
            let Record { at, lost: before, what } = &*record;
            lost += missed;
            match what {
                What::Began(cell) => self.cell = Some(Arc::clone(cell)),
                What::Frame(frame) => {
                    lost += u64::from(*before);
                    frames.extend(self.cell.as_ref().and_then(|cell| self.shown(cell, *at, frame)));
                }
                What::Pass(_) => {}
            }
        }
        let is_there = !frames.is_empty() || lost > 0;
        is_there.then(|| (json!({ "frames": frames, "lost": lost }), lost))
    }

    /// A frame of a port.
    fn shown(&self, cell: &Cell, at: Instant, frame: &Frame) -> Option<Value> {
        let TapPlace::Port(port) = frame.place else { return None };
        let port = cell.port(port)?;
        if self.port.as_ref().is_some_and(|only| *only != port.name) {
            return None;
        }
        let mut shown = json!({
            "time_us": at.as_micros(),
            "port": port.name,
            "direction": if frame.direction == TapDirection::In { "in" } else { "out" },
            "bytes": Hex(&frame.bytes).to_string(),
        });
        match frame.can_id {
            None => {}
            Some(CanId::Standard(id)) => shown["id"] = json!(id),
            Some(CanId::Extended(id)) => {
                shown["id"] = json!(id);
                shown["extended"] = json!(true);
            }
        }
        if frame.len != frame.bytes.len() {
            shown["len"] = json!(frame.len);
        }
        if let TapVerdict::Rejected(why) = frame.verdict {
            // As in `last_rejection` of the status.
            shown["verdict"] = json!(why);
            shown["text"] = json!(why.text());
            return Some(shown);
        }
        shown["verdict"] = json!("frame");
        if let Some((topic, values)) = cell.decoder.decode(&port.name, frame) {
            shown["name"] = json!(topic.name);
            shown["values"] = values;
        }
        Some(shown)
    }
}

pub(super) struct CaptureStream {
    subscription: Subscription,
    capture: Pcapng,
}

impl CaptureStream {
    /// Records from now on, of this port or of all ports.
    pub(super) fn of(watch: &Watch, port: Option<String>) -> Self {
        Self { subscription: subscribe(watch), capture: Pcapng::new(Scope { port, links: false }) }
    }

    /// The blocks of the waiting records, at most about [`MAX_BLOCKS`] bytes; often none.
    pub(super) fn blocks(&mut self) -> Vec<u8> {
        let mut blocks = Vec::new();
        while blocks.len() < MAX_BLOCKS
            && let Next::Record(arrived) = self.subscription.next(Duration::ZERO)
        {
            blocks.extend(self.capture.blocks(&arrived));
        }
        blocks
    }
}

fn subscribe(watch: &Watch) -> Subscription {
    watch.subscribe(Interest { frames: true, passes: false }, QUEUE)
}

/// Records that wait for a client: more than a second of busy ports.
const QUEUE: usize = 4_096;
/// Maximum number of frames in an event.
const AT_ONCE: usize = 256;
/// Maximum number of bytes of a capture that are made at once.
const MAX_BLOCKS: usize = 64 << 10;
