//! The request queue of the store task. Console and edge node send requests through it and wait for the results.

use core::cell::{Cell, RefCell};

use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::mutex::Mutex;
use embassy_sync::signal::Signal;
use embassy_time::Instant;
use heapless::String;
use proto_core::config::Bus;
use proto_core::config::image::{ImageError, MAX_IMAGE, Scan};
use proto_core::time::Duration as Span;
use recipe_api::revisions::{Refused, Revision, Revisions};
use recipe_store::{KeepError, SlotMarks};
use recipe_update::{BoardName, Downgrade, Header, Slot};

use crate::journal::Truncated;
use crate::update::{self, Build, Incoming, WaitsFor};

/// A request to the store task.
#[derive(Debug, Clone)]
pub enum StoreRequest {
    /// Store the image in `StoreHandle::image`.
    Put {
        /// Revision that the image was derived from.
        base: Revision,
        /// CRC-32 of the image.
        digest: u32,
        /// Its length in bytes.
        len: usize,
    },
    /// Run a revision on trial.
    Apply {
        /// Number of the revision; `None` for the waiting one.
        number: Option<u32>,
        /// Duration of the trial.
        trial: Span,
    },
    /// Make the configuration on trial the live one.
    Confirm,
    /// End the trial; return to the live configuration.
    RollBack,
    /// Store this access key.
    Claim([u8; 16]),
    /// Write the piece of a firmware in `StoreHandle::image` to the free slot.
    Piece {
        /// Offset from the beginning of the header, in bytes.
        offset: u32,
        /// Its length in bytes.
        len: usize,
        /// Whether it may be older than the running firmware.
        downgrade: Downgrade,
    },
    /// Run the received firmware on trial.
    TryFirmware {
        /// Duration of the trial, in seconds.
        confirm_s: u16,
        /// Whether it may be older than the running firmware.
        downgrade: Downgrade,
    },
    /// Confirm the firmware on trial.
    ConfirmFirmware,
    /// End the trial; return to the previous firmware.
    EndFirmware,
    /// Store the settings of the edge node in `StoreHandle::image`.
    Edge {
        /// Their length in bytes.
        len: usize,
        /// Whether they enable publishing.
        publishes: bool,
        /// Whether the board restarts afterwards.
        restart: bool,
    },
}

/// Why a request failed; nothing has changed.
#[derive(Debug, Clone, Copy)]
pub enum Failed {
    /// Refused by the rules for configurations.
    Refused(Refused),
    /// Refused by the rules for firmware.
    Firmware(update::UpdateError),
    /// The store cannot be written.
    Store(KeepError),
}

/// The firmware's state for readers.
#[derive(Debug, Clone, Copy)]
pub struct FirmwareView {
    /// The board's name.
    pub board: BoardName,
    /// The slot that the program runs in.
    pub slot: Option<Slot>,
    /// Build of the running firmware.
    pub build: Option<Build>,
    /// Why the firmware cannot be updated; `None` if it can.
    pub cannot: Option<&'static str>,
    /// The public key of the loader.
    pub key: Option<[u8; 32]>,
    /// The marks of the store.
    pub marks: SlotMarks,
    /// Deadline of the running firmware's trial, and what it waits for.
    pub trial: Option<(Instant, WaitsFor)>,
    /// Header of the complete firmware in the other slot.
    pub other: Option<Header>,
    /// The firmware being received, or received last.
    pub incoming: Option<Incoming>,
}

/// Maximum length of the text of [`StoreHandle::failure`], in bytes.
pub const MAX_FAILURE: usize = 160;
/// Bytes of an image per read; a multiple of a flash word.
pub const PART: usize = 512;

/// Shared by the store task and its clients.
pub struct StoreHandle {
    pub(super) revisions: RefCell<Option<Revisions>>,
    pub(super) running: Cell<Option<u32>>,
    pub(super) failure: RefCell<String<MAX_FAILURE>>,
    /// The lock is taken; there is one change at a time.
    pub(super) is_taken: Cell<bool>,
    pub(super) image: RefCell<&'static mut [u8; MAX_IMAGE]>,
    /// How far the image was validated. One for all connections, because only the holder of the lock has an image.
    scan: RefCell<Scan>,
    pub(super) requests: Signal<NoopRawMutex, StoreRequest>,
    pub(super) done: Signal<NoopRawMutex, Result<u32, Failed>>,
    pub(super) part_requests: Signal<NoopRawMutex, (u32, usize)>,
    pub(super) part: RefCell<[u8; PART]>,
    pub(super) part_len: Signal<NoopRawMutex, Option<usize>>,
    /// bdSeq of a session that begins, and whether it was stored.
    pub(super) session: Signal<NoopRawMutex, u8>,
    pub(super) session_kept: Signal<NoopRawMutex, bool>,
    pub(super) readers: Mutex<NoopRawMutex, ()>,
    pub(super) firmware: Cell<Option<FirmwareView>>,
    /// A request has been admitted since the start.
    pub(super) was_reached: Cell<bool>,
}

impl StoreHandle {
    /// A handle before its store task runs. `image` is the buffer for images to be stored.
    pub fn new(image: &'static mut [u8; MAX_IMAGE]) -> Self {
        Self {
            revisions: RefCell::new(None),
            running: Cell::new(None),
            failure: RefCell::new(String::new()),
            is_taken: Cell::new(false),
            image: RefCell::new(image),
            scan: RefCell::new(Scan::new()),
            requests: Signal::new(),
            done: Signal::new(),
            part_requests: Signal::new(),
            part: RefCell::new([0; PART]),
            part_len: Signal::new(),
            session: Signal::new(),
            session_kept: Signal::new(),
            readers: Mutex::new(()),
            firmware: Cell::new(None),
            was_reached: Cell::new(false),
        }
    }

    /// Passes the revisions to `look`; `None` until the store has been read, or if its marks are invalid.
    pub fn look<R>(&self, look: impl FnOnce(&Revisions) -> R) -> Option<R> {
        self.revisions.borrow().as_ref().map(look)
    }

    /// Number of the running configuration; `None` if it is not in the store.
    pub fn running(&self) -> Option<u32> {
        self.running.get()
    }

    /// The firmware's state; `None` while the store is being read.
    pub fn firmware(&self) -> Option<FirmwareView> {
        self.firmware.get()
    }

    /// Notes that an admitted request has reached this board.
    pub fn note_reached(&self) {
        self.was_reached.set(true);
    }

    /// Passes to `look` why the first configuration that was tried at the start does not run; empty if it runs.
    pub fn failure<R>(&self, look: impl FnOnce(&str) -> R) -> R {
        look(&self.failure.borrow())
    }

    /// Records why a configuration does not run.
    pub fn failed(&self, why: &impl core::fmt::Display) {
        let mut failure = self.failure.borrow_mut();
        failure.clear();
        let _ = core::fmt::Write::write_fmt(&mut Truncated(&mut failure), format_args!("{why}"));
    }

    /// Takes the lock for a change; `None` if another change holds it.
    pub fn take(&self) -> Option<StoreLock<'_>> {
        (!self.is_taken.replace(true)).then_some(StoreLock { handle: self, is_asked: false })
    }

    /// Stores the bdSeq of a session; only the edge node calls this. Returns whether it was stored. Waits while the
    /// store is being written.
    pub async fn keep_session(&self, bd_seq: u8) -> bool {
        self.session_kept.reset();
        self.session.signal(bd_seq);
        self.session_kept.wait().await
    }

    /// Copies part of an image from `offset` on, a multiple of [`PART`], and returns the number of bytes: [`PART`], or
    /// fewer at the end. `None` if there is no such revision. Waits while the store is being written.
    pub async fn part(&self, number: u32, offset: usize, into: &mut [u8]) -> Option<usize> {
        let _guard = self.readers.lock().await;
        self.part_len.reset();
        self.part_requests.signal((number, offset));
        let len = self.part_len.wait().await?;
        let part = self.part.borrow();
        into.iter_mut().zip(part.iter().take(len)).for_each(|(place, byte)| *place = *byte);
        Some(len)
    }
}

/// Permission to make one change.
pub struct StoreLock<'a> {
    handle: &'a StoreHandle,
    /// The request was sent: the store task releases the lock.
    is_asked: bool,
}

impl StoreLock<'_> {
    /// Writes to the image buffer.
    pub fn fill(&mut self, offset: usize, bytes: &[u8]) {
        let mut image = self.handle.image.borrow_mut();
        for (place, byte) in image.iter_mut().skip(offset).zip(bytes) {
            *place = *byte;
        }
    }

    /// Passes the first `len` bytes of the image buffer to `look`.
    pub fn look<R>(&self, len: usize, look: impl FnOnce(&[u8]) -> R) -> R {
        look(self.handle.image.borrow().get(..len).unwrap_or(&[]))
    }

    /// Begins to validate the image buffer.
    pub fn begin_scan(&self) {
        *self.handle.scan.borrow_mut() = Scan::new();
    }

    /// Validates some more of the first `len` bytes of the image buffer. Returns whether there is more to do.
    pub fn scan(&self, len: usize) -> Result<bool, ImageError> {
        self.look(len, |bytes| self.handle.scan.borrow_mut().step(bytes))
    }

    /// Passes the buses of the image's ports to `look`, once all of it was validated.
    pub fn buses<R>(&self, look: impl FnOnce(&[Bus]) -> R) -> R {
        look(self.handle.scan.borrow().buses())
    }

    /// Sends the request and waits for its result. Returns the number of the revision.
    ///
    /// # Errors
    /// The request was refused or failed; nothing has changed.
    pub async fn request(mut self, request: StoreRequest) -> Result<u32, Failed> {
        self.handle.done.reset();
        self.is_asked = true;
        self.handle.requests.signal(request);
        self.handle.done.wait().await
    }
}

impl Drop for StoreLock<'_> {
    fn drop(&mut self) {
        if !self.is_asked {
            self.handle.is_taken.set(false);
        }
    }
}
