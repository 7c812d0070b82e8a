//! Request queue of the store task, for the console and the edge node; they wait here for the result.

use core::cell::{Cell, RefCell};

use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::mutex::Mutex;
use embassy_sync::signal::Signal;
use embassy_time::Instant;
use heapless::String;
use proto_core::config::image::MAX_IMAGE;
use proto_core::time::Duration as Span;
use recipe_api::revisions::{Refused, Revision, Revisions};
use recipe_store::{KeepError, SlotMarks};
use recipe_update::{BoardName, Downgrade, Header, Slot};

use crate::update::{self, Build, Incoming, WaitsFor};

/// What a client asks for.
#[derive(Debug, Clone)]
pub enum StoreRequest {
    /// Keep the image of this length in `StoreHandle::image`, which was made from a revision.
    Put {
        /// That revision.
        base: Revision,
        /// The image's digest.
        digest: u32,
        /// Its length in bytes.
        len: usize,
    },
    /// Run one on trial; without a number the one that waits.
    Apply {
        /// Its number.
        number: Option<u32>,
        /// How long.
        trial: Span,
    },
    /// Keep what is on trial.
    Confirm,
    /// Return to what ran before.
    RollBack,
    /// Take this key.
    Claim([u8; 16]),
    /// Take the piece of a firmware of this length in `StoreHandle::image`.
    Piece {
        /// Where it begins, counted from the beginning of the header.
        offset: u32,
        /// Its length in bytes.
        len: usize,
        /// Whether it may be older than what runs.
        downgrade: Downgrade,
    },
    /// Run the firmware that was received on trial.
    TryFirmware {
        /// For so long, in seconds.
        confirm_s: u16,
        /// Whether it may be older than what runs.
        downgrade: Downgrade,
    },
    /// Keep the firmware that is on trial.
    ConfirmFirmware,
    /// Return to the firmware before.
    EndFirmware,
    /// Keep the settings of the edge node of this length in `StoreHandle::image`.
    Edge {
        /// Their length in bytes.
        len: usize,
        /// Whether they say that something is told.
        tells: bool,
        /// Whether the board is to restart with them.
        restart: bool,
    },
}

/// Why nothing was done.
#[derive(Debug, Clone, Copy)]
pub enum Failed {
    /// It is refused.
    Refused(Refused),
    /// It is about the firmware, and refused.
    Firmware(update::UpdateError),
    /// The store cannot be written.
    Store(KeepError),
}

/// What readers see of the firmware.
#[derive(Debug, Clone, Copy)]
pub struct FirmwareView {
    /// The board's name.
    pub board: BoardName,
    /// The slot that the program runs in.
    pub slot: Option<Slot>,
    /// Which build runs.
    pub build: Option<Build>,
    /// Why it takes no update.
    pub cannot: Option<&'static str>,
    /// The public key of the loader.
    pub key: Option<[u8; 32]>,
    /// The marks of the store.
    pub marks: SlotMarks,
    /// When the trial of what runs is over, and what it waits for.
    pub trial: Option<(Instant, WaitsFor)>,
    /// What the other slot holds, whole.
    pub other: Option<Header>,
    /// What is being received, or was.
    pub incoming: Option<Incoming>,
}

/// Length of a text that says why a configuration does not run.
pub const MAX_FAILURE: usize = 160;
/// Bytes of an image that are read at once: a multiple of a flash word.
pub const PART: usize = 512;

/// Shared by the store task and its clients.
pub struct StoreHandle {
    pub(super) revisions: RefCell<Option<Revisions>>,
    /// The configuration that runs.
    pub(super) running: Cell<Option<u32>>,
    pub(super) failure: RefCell<String<MAX_FAILURE>>,
    /// A change holds the lock: changes are made one after the other.
    pub(super) is_taken: Cell<bool>,
    pub(super) image: RefCell<&'static mut [u8; MAX_IMAGE]>,
    pub(super) requests: Signal<NoopRawMutex, StoreRequest>,
    pub(super) done: Signal<NoopRawMutex, Result<u32, Failed>>,
    pub(super) part_requests: Signal<NoopRawMutex, (u32, usize)>,
    pub(super) part: RefCell<[u8; PART]>,
    pub(super) part_len: Signal<NoopRawMutex, Option<usize>>,
    /// The number of a session that begins, and whether it is kept.
    pub(super) session: Signal<NoopRawMutex, u8>,
    pub(super) session_kept: Signal<NoopRawMutex, bool>,
    pub(super) readers: Mutex<NoopRawMutex, ()>,
    pub(super) firmware: Cell<Option<FirmwareView>>,
    /// A request was admitted since the start.
    pub(super) was_reached: Cell<bool>,
}

impl StoreHandle {
    /// Without a store task yet. `image` is the buffer for an image on its way to the store.
    pub fn new(image: &'static mut [u8; MAX_IMAGE]) -> Self {
        Self {
            revisions: RefCell::new(None),
            running: Cell::new(None),
            failure: RefCell::new(String::new()),
            is_taken: Cell::new(false),
            image: RefCell::new(image),
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

    /// Passes the revisions to `look`; `None` if the board keeps nothing, or does not know yet what it keeps.
    pub fn look<R>(&self, look: impl FnOnce(&Revisions) -> R) -> Option<R> {
        self.revisions.borrow().as_ref().map(look)
    }

    /// Number of the configuration that runs; `None` if it is not one of the store.
    pub fn running(&self) -> Option<u32> {
        self.running.get()
    }

    /// What is known of the firmware; `None` while the store is being read.
    pub fn firmware(&self) -> Option<FirmwareView> {
        self.firmware.get()
    }

    /// Notes that an admitted request has reached this board.
    pub fn note_reached(&self) {
        self.was_reached.set(true);
    }

    /// Passes to `look` why the newest configuration that did not run did not; empty if all ran.
    pub fn failure<R>(&self, look: impl FnOnce(&str) -> R) -> R {
        look(&self.failure.borrow())
    }

    /// Notes why a configuration did not run.
    pub fn failed(&self, why: &impl core::fmt::Display) {
        let mut failure = self.failure.borrow_mut();
        failure.clear();
        // What there is no room for is cut.
        let _ = core::fmt::Write::write_fmt(&mut Cut(&mut failure), format_args!("{why}"));
    }

    /// Takes the lock for a change; `None` if another change holds it.
    pub fn take(&self) -> Option<StoreLock<'_>> {
        (!self.is_taken.replace(true)).then_some(StoreLock { handle: self, is_asked: false })
    }

    /// Keeps the number of a session of the edge node, which alone calls this. Returns whether it is kept. Waits while
    /// the store is being written.
    pub async fn keep_session(&self, bd_seq: u8) -> bool {
        self.session_kept.reset();
        self.session.signal(bd_seq);
        self.session_kept.wait().await
    }

    /// Copies the image of a configuration from `offset` on, a multiple of [`PART`], and returns the number of bytes:
    /// at most [`PART`], fewer at its end. `None` if it is not kept. Waits while the store is being written.
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

/// The right to make a change.
pub struct StoreLock<'a> {
    handle: &'a StoreHandle,
    /// From then on the store task releases the lock.
    is_asked: bool,
}

impl StoreLock<'_> {
    /// Writes to the buffer of the image.
    pub fn fill(&mut self, offset: usize, bytes: &[u8]) {
        let mut image = self.handle.image.borrow_mut();
        for (place, byte) in image.iter_mut().skip(offset).zip(bytes) {
            *place = *byte;
        }
    }

    /// Passes the first bytes of the image to `look`.
    pub fn look<R>(&self, len: usize, look: impl FnOnce(&[u8]) -> R) -> R {
        look(self.handle.image.borrow().get(..len).unwrap_or(&[]))
    }

    /// Asks for a change and waits until it is made, or refused. Returns the number of the revision.
    ///
    /// # Errors
    /// Why nothing was changed.
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

/// A text that is cut where it is full.
struct Cut<'a>(&'a mut String<MAX_FAILURE>);

impl core::fmt::Write for Cut<'_> {
    fn write_str(&mut self, text: &str) -> core::fmt::Result {
        for letter in text.chars() {
            self.0.push(letter).map_err(|_| core::fmt::Error)?;
        }
        Ok(())
    }
}
