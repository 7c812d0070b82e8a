//! The controller between two threads: the shell's, and that of the Modbus connections.
//!
//! Each reports its events itself and gets the outputs. What the other one has to carry out waits for it here, and is
//! put there while the controller is locked, so that all outputs are carried out in the order in which they came.

use std::collections::{BTreeSet, VecDeque};
use std::io;
use std::net::{SocketAddr, TcpStream};
use std::ops::Deref;
use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use proto_core::time::Instant;
use rustix::event::{EventfdFlags, eventfd};
use serde_json::Value;
use tokio::sync::Notify;

use super::ShellCounters;
use recipe_controller::operations::Operation;
use recipe_controller::{ConnId, Controller, ControllerInput, ControllerOutput};
use recipe_io::clock::Time;

/// What both threads use.
#[derive(Debug)]
pub(super) struct Shared {
    model: Mutex<Model>,
    counters: Mutex<ShellCounters>,
    /// For the shell: something has changed.
    changed: Notify,
    /// Whether the other thread has ended by itself.
    has_failed: AtomicBool,
    bell: Arc<OwnedFd>,
}

/// The controller, and what waits for the threads.
#[derive(Debug)]
pub(super) struct Model {
    controller: Controller,
    /// The time of the newest call: a thread may have read the clock before the other one.
    now: Instant,
    /// The open connections of the other thread.
    modbus: BTreeSet<ConnId>,
    for_modbus: Vec<Task>,
    for_shell: VecDeque<ControllerOutput>,
    /// When the shell calls again by itself.
    until: Instant,
    /// Whether the shell has to look at each change.
    is_watched: bool,
    /// Wakes the other thread (eventfd).
    bell: Arc<OwnedFd>,
}

/// Something to do for the thread of the Modbus connections.
#[derive(Debug)]
pub(super) enum Task {
    Open { conn: ConnId, stream: TcpStream, peer: SocketAddr },
    Send { conn: ConnId, bytes: Vec<u8> },
    Close { conn: ConnId },
    End,
}

impl Shared {
    /// # Errors
    /// If the system has no descriptor left.
    pub(super) fn new(controller: Controller) -> io::Result<Arc<Self>> {
        let bell = Arc::new(eventfd(0, EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC)?);
        let model = Model {
            controller,
            now: Instant::ZERO,
            modbus: BTreeSet::new(),
            for_modbus: Vec::new(),
            for_shell: VecDeque::new(),
            until: Instant::NEVER,
            is_watched: false,
            bell: Arc::clone(&bell),
        };
        Ok(Arc::new(Self {
            model: Mutex::new(model),
            counters: Mutex::default(),
            changed: Notify::new(),
            has_failed: AtomicBool::new(false),
            bell,
        }))
    }

    /// Nobody else uses the controller meanwhile. Must not be called by a thread that has it.
    ///
    /// # Panics
    /// If the other thread has panicked with it.
    pub(super) fn lock(&self) -> MutexGuard<'_, Model> {
        self.model.lock().expect("a panic with the controller ends the shell")
    }

    /// Ends the other thread, even after such a panic.
    pub(super) fn end_modbus(&self) {
        self.model.lock().unwrap_or_else(PoisonError::into_inner).leave(Task::End);
    }

    pub(super) fn count(&self, change: impl FnOnce(&mut ShellCounters)) {
        change(&mut self.counters.lock().expect("counting does not panic"));
    }

    pub(super) fn counters(&self) -> ShellCounters {
        *self.counters.lock().expect("counting does not panic")
    }

    /// Waits until the other thread has changed something.
    ///
    /// # Panics
    /// If that has ended by itself.
    pub(super) async fn changed(&self) {
        self.changed.notified().await;
        assert!(!self.has_failed.load(Ordering::Acquire), "the thread of the Modbus connections has ended");
    }

    /// The other thread has ended without having been asked to.
    pub(super) fn fail(&self) {
        self.has_failed.store(true, Ordering::Release);
        self.changed.notify_one();
    }

    /// What is readable when there is something to do for the thread of the Modbus connections.
    pub(super) fn bell(&self) -> &OwnedFd {
        &self.bell
    }

    /// Reports an event of a Modbus connection. The outputs for such connections are added to `tasks`, after those
    /// that waited for this thread. The shell is woken for all others, for an earlier deadline, and for a change that
    /// somebody waits for: a client that writes without pause wakes it for nothing else.
    pub(super) fn handle_modbus(&self, time: Time, input: ControllerInput<'_>, tasks: &mut Vec<Task>) {
        let mut model = self.lock();
        tasks.append(&mut model.for_modbus);
        let now = model.later(time.now());
        model.controller.handle(now, input);
        let mut tells = model.is_watched && !model.controller.is_at_rest(now);
        loop {
            match model.controller.poll_output(now) {
                ControllerOutput::Sleep { until } => {
                    tells |= until < model.until;
                    break;
                }
                output => match model.task(output) {
                    Ok(task) => tasks.push(task),
                    Err(output) => {
                        model.for_shell.push_back(output);
                        tells = true;
                    }
                },
            }
        }
        drop(model);
        if tells {
            self.changed.notify_one();
        }
    }
}

impl Model {
    /// [`Controller::handle`], for the shell.
    pub(super) fn handle(&mut self, now: Instant, input: ControllerInput<'_>) {
        let now = self.later(now);
        self.controller.handle(now, input);
    }

    /// [`Controller::operate`].
    pub(super) fn operate(&mut self, now: Instant, operation: &Operation) -> Result<Value, String> {
        let now = self.later(now);
        self.controller.operate(now, operation).map_err(|refused| refused.to_string())
    }

    /// [`Controller::note_refused`].
    pub(super) fn note_refused(&mut self, now: Instant, operation: &Operation, error: &str) {
        let now = self.later(now);
        self.controller.note_refused(now, operation, error);
    }

    /// [`Controller::poll_output`], for the shell.
    pub(super) fn poll_output(&mut self, now: Instant) -> ControllerOutput {
        let now = self.later(now);
        if let Some(output) = self.for_shell.pop_front() {
            return output;
        }
        loop {
            let output = self.controller.poll_output(now);
            if let ControllerOutput::Sleep { until } = output {
                self.until = until;
            }
            match self.task(output) {
                Ok(task) => self.leave(task),
                Err(output) => return output,
            }
        }
    }

    /// Whether the shell has to look at each change.
    pub(super) fn watch(&mut self, is_watched: bool) {
        self.is_watched = is_watched;
    }

    /// The outputs for this connection are for the other thread, until the controller closes it.
    pub(super) fn expect_modbus(&mut self, conn: ConnId) {
        self.modbus.insert(conn);
    }

    /// Lets the other thread have the connection; false if the controller has closed it.
    pub(super) fn open_modbus(&mut self, conn: ConnId, stream: TcpStream, peer: SocketAddr) -> bool {
        let is_open = self.modbus.contains(&conn);
        if is_open {
            self.leave(Task::Open { conn, stream, peer });
        }
        is_open
    }

    /// A connection of the other thread has ended; false if the controller has closed it.
    pub(super) fn forget_modbus(&mut self, conn: ConnId) -> bool {
        self.modbus.remove(&conn)
    }

    /// Leaves a task to the other thread.
    pub(super) fn leave(&mut self, task: Task) {
        self.for_modbus.push(task);
        // Fails if so many calls wait that one more changes nothing.
        let _ = rustix::io::write(&self.bell, &1_u64.to_ne_bytes());
    }

    /// What waits for the thread of the Modbus connections.
    pub(super) fn take_tasks(&mut self, tasks: &mut Vec<Task>) {
        tasks.append(&mut self.for_modbus);
    }

    fn task(&mut self, output: ControllerOutput) -> Result<Task, ControllerOutput> {
        match output {
            ControllerOutput::Send { conn, bytes } if self.modbus.contains(&conn) => {
                Ok(Task::Send { conn, bytes })
            }
            ControllerOutput::Close { conn } if self.modbus.remove(&conn) => Ok(Task::Close { conn }),
            output => Err(output),
        }
    }

    fn later(&mut self, now: Instant) -> Instant {
        self.now = self.now.max(now);
        self.now
    }
}

impl Deref for Model {
    type Target = Controller;

    fn deref(&self) -> &Controller {
        &self.controller
    }
}
