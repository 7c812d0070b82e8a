//! Shared by the tests of devices: a running port, its events, and clients.

use std::cell::RefCell;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::rc::Rc;
use std::time::Duration;

use proto_core::config::{Parity, Rs485};
use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;
use rustix::fs::OFlags;
use tokio::sync::Notify;
use tokio::task::{JoinHandle, LocalSet};

use super::exchange::{PortEvent, PortTx};
use super::port::{BusSettings, OpenPort};
use crate::timer::now;

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Seen {
    Up,
    Down,
    Bytes(Vec<u8>),
    Frame(CanFrame),
    Sent,
}

#[derive(Default)]
struct Log {
    events: RefCell<Vec<(Instant, Seen)>>,
    wake: Notify,
}

/// A port that runs as a local task. Its events wait until a test takes them.
pub(super) struct PortTask {
    pub(super) place: String,
    pub(super) tx: Rc<PortTx>,
    log: Rc<Log>,
    task: JoinHandle<()>,
}

impl PortTask {
    pub(super) async fn start(bind: &str, bus: BusSettings) -> Self {
        Self::of(OpenPort::open(&bind.parse().unwrap(), bus).await.unwrap())
    }

    pub(super) fn of(port: OpenPort) -> Self {
        let (place, tx) = (port.place(), port.tx());
        let log = Rc::new(Log::default());
        let sink = Rc::clone(&log);
        let task = tokio::task::spawn_local(async move {
            let ended = port.run(|event| {
                let event = match event {
                    PortEvent::Up => Seen::Up,
                    PortEvent::Down => Seen::Down,
                    PortEvent::Bytes(bytes) => Seen::Bytes(bytes.to_vec()),
                    PortEvent::Frame { frame } => Seen::Frame(frame),
                    PortEvent::Bus(state) => panic!("{state:?}: no device of these tests knows it"),
                    PortEvent::Sent => Seen::Sent,
                };
                sink.events.borrow_mut().push((now(), event));
                sink.wake.notify_one();
            });
            panic!("the port ended: {:?}", ended.await);
        });
        Self { place, tx, log, task }
    }

    pub(super) async fn next(&self) -> (Instant, Seen) {
        loop {
            if !self.log.events.borrow().is_empty() {
                return self.log.events.borrow_mut().remove(0);
            }
            self.log.wake.notified().await;
        }
    }

    /// An event that has come already.
    pub(super) fn try_next(&self) -> Option<Seen> {
        let mut events = self.log.events.borrow_mut();
        (!events.is_empty()).then(|| events.remove(0).1)
    }

    #[track_caller]
    pub(super) fn expect(&self, expected: Seen) -> impl Future<Output = Instant> {
        let at = std::panic::Location::caller();
        async move {
            let (time, seen) = self.next().await;
            assert_eq!(seen, expected, "at {at}");
            time
        }
    }

    pub(super) async fn bytes(&self, count: usize) -> Vec<u8> {
        let mut all = Vec::new();
        while all.len() < count {
            match self.next().await.1 {
                Seen::Bytes(bytes) => all.extend(bytes),
                other => panic!("{other:?} instead of bytes"),
            }
        }
        all
    }
}

impl Drop for PortTask {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// A line with 8 data bits, no parity, and an idle gap of 50 ms.
pub(super) fn serial(baud: u32) -> BusSettings {
    BusSettings::Serial(Rs485 {
        baud,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: proto_core::time::Duration::from_millis(50),
        turnaround: proto_core::time::Duration::ZERO,
        echo: proto_core::config::Echo::No,
    })
}

/// Runs a test with a directory of its own, in a tokio runtime as production code has it.
pub(super) fn run(test: impl AsyncFnOnce(&Path)) {
    let dir = tempfile::tempdir().unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let limit = Duration::from_secs(30);
    let local = LocalSet::new();
    local.block_on(&runtime, async {
        tokio::time::timeout(limit, test(dir.path())).await.expect("the test hangs");
    });
}

/// A program with the terminal open.
pub(super) struct TerminalClient(pub(super) File);

impl TerminalClient {
    pub(super) fn open(link: &str) -> Self {
        let flags = i32::try_from((OFlags::NOCTTY | OFlags::NONBLOCK).bits()).unwrap();
        Self(OpenOptions::new().read(true).write(true).custom_flags(flags).open(link).unwrap())
    }

    pub(super) fn read(&mut self) -> Vec<u8> {
        let mut buf = vec![0; 4_096];
        match self.0.read(&mut buf) {
            Ok(count) => buf.truncate(count),
            Err(error) => {
                assert_eq!(error.kind(), io::ErrorKind::WouldBlock);
                buf.clear();
            }
        }
        buf
    }

    pub(super) async fn read_exact(&mut self, count: usize) -> Vec<u8> {
        let mut all = Vec::new();
        while all.len() < count {
            let more = self.read();
            if more.is_empty() {
                tokio::task::yield_now().await;
            }
            all.extend(more);
        }
        all
    }
}

/// Whether nothing is at the path, not even a dangling link.
pub(super) fn is_gone(path: &str) -> bool {
    fs::symlink_metadata(path).is_err()
}
