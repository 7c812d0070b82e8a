//! Changes what the board keeps: configurations, their marks, and the key.
//!
//! In: what a client of the console asks for, and the end of a trial. Out: what is written to the store, a view for
//! readers, and that the board is to be restarted. What happens when is decided in `recipe_remote::revisions`.
//! Another configuration is only run by a restart: the start has the memory for it, and counts what it tries.

mod firmware;

use core::cell::{Cell, RefCell};
use core::pin::pin;

use embassy_futures::select::{Either4, select4};
use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::mutex::Mutex;
use embassy_sync::signal::Signal;
use embassy_time::{Duration, Instant, Timer};
use heapless::{String, Vec};
use proto_core::config::image::MAX_IMAGE;
use proto_core::time::Duration as Span;
use recipe_remote::revisions::{Ended, Output, Refused, Result as Done, Revision, Revisions, Stored};
use recipe_store::{KeepError, SlotMarks, Store};
use recipe_update::{BoardName, Downgrade, Header, Slot, SlotFlash};

use firmware::Judged;

use super::gateway::Gateway;
use super::watchdog::Pulse;
use crate::clock::now;
use crate::fmt::Text;
use crate::kept::{Kept, StoreFlash};
use crate::update::{self, Build, Incoming, Updates, WaitsFor, Works};
use crate::{error, info, warn};

/// What a client asks for.
#[derive(Debug, Clone)]
pub enum Ask {
    /// Keep the image of this length in `Desk::image`, which was made from a revision.
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
    /// Take the piece of a firmware of this length in `Desk::image`.
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
    /// Keep the settings of the edge node of this length in `Desk::image`.
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
    Firmware(update::Refused),
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

/// Between the keeper and those who ask.
pub struct Desk {
    revisions: RefCell<Option<Revisions>>,
    /// The configuration that runs.
    running: Cell<Option<u32>>,
    failure: RefCell<String<MAX_FAILURE>>,
    /// Somebody has the desk: changes are made one after the other.
    is_taken: Cell<bool>,
    image: RefCell<&'static mut [u8; MAX_IMAGE]>,
    asked: Signal<NoopRawMutex, Ask>,
    done: Signal<NoopRawMutex, Result<u32, Failed>>,
    wanted: Signal<NoopRawMutex, (u32, usize)>,
    part: RefCell<[u8; PART]>,
    part_len: Signal<NoopRawMutex, Option<usize>>,
    /// The number of a session that begins, and whether it is kept.
    session: Signal<NoopRawMutex, u8>,
    session_kept: Signal<NoopRawMutex, bool>,
    readers: Mutex<NoopRawMutex, ()>,
    firmware: Cell<Option<FirmwareView>>,
    /// A request was admitted since the start.
    was_asked: Cell<bool>,
}

impl Desk {
    /// A desk at which nobody works yet. The room is for an image on its way to the store.
    pub fn new(image: &'static mut [u8; MAX_IMAGE]) -> Self {
        Self {
            revisions: RefCell::new(None),
            running: Cell::new(None),
            failure: RefCell::new(String::new()),
            is_taken: Cell::new(false),
            image: RefCell::new(image),
            asked: Signal::new(),
            done: Signal::new(),
            wanted: Signal::new(),
            part: RefCell::new([0; PART]),
            part_len: Signal::new(),
            session: Signal::new(),
            session_kept: Signal::new(),
            readers: Mutex::new(()),
            firmware: Cell::new(None),
            was_asked: Cell::new(false),
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

    /// Notes that somebody reaches this board, and may change it.
    pub fn was_asked(&self) {
        self.was_asked.set(true);
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

    /// Takes the desk for a change; `None` if somebody else has it.
    pub fn take(&self) -> Option<Turn<'_>> {
        (!self.is_taken.replace(true)).then_some(Turn { desk: self, is_asked: false })
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
        let _turn = self.readers.lock().await;
        self.part_len.reset();
        self.wanted.signal((number, offset));
        let len = self.part_len.wait().await?;
        let part = self.part.borrow();
        into.iter_mut().zip(part.iter().take(len)).for_each(|(place, byte)| *place = *byte);
        Some(len)
    }
}

/// The right to make a change.
pub struct Turn<'a> {
    desk: &'a Desk,
    /// From then on the keeper gives the desk free.
    is_asked: bool,
}

impl Turn<'_> {
    /// Writes to the room for an image.
    pub fn fill(&mut self, offset: usize, bytes: &[u8]) {
        let mut image = self.desk.image.borrow_mut();
        for (place, byte) in image.iter_mut().skip(offset).zip(bytes) {
            *place = *byte;
        }
    }

    /// Passes the first bytes of the image to `look`.
    pub fn look<R>(&self, len: usize, look: impl FnOnce(&[u8]) -> R) -> R {
        look(self.desk.image.borrow().get(..len).unwrap_or(&[]))
    }

    /// Asks for a change and waits until it is made, or refused. Returns the number of the revision.
    ///
    /// # Errors
    /// Why nothing was changed.
    pub async fn ask(mut self, what: Ask) -> Result<u32, Failed> {
        self.desk.done.reset();
        self.is_asked = true;
        self.desk.asked.signal(what);
        self.desk.done.wait().await
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        if !self.is_asked {
            self.desk.is_taken.set(false);
        }
    }
}

/// What the start leaves to the keeper.
#[derive(Debug, Default)]
pub struct Work<'d> {
    /// This image came from outside the store, with this digest: it becomes the live one.
    pub adopt: Option<(u32, &'d [u8])>,
    /// What runs is on trial for this long.
    pub trial: Option<Duration>,
    /// Number of the configuration that runs.
    pub running: Option<u32>,
    /// The one on trial cannot run.
    pub trial_failed: bool,
}

/// Works for the desk until the board has to be restarted; then the safe values are out.
pub async fn run<F: StoreFlash, S: SlotFlash>(
    gateway: &Gateway,
    pulse: &Pulse,
    desk: &Desk,
    kept: &mut Kept<F>,
    updates: &mut Updates<S>,
    work: Work<'_>,
) {
    let mut running = work.running;
    if kept.is_to_be_moved() {
        info!("the store is moved out of the bank that the program runs from");
        let moved = pulse.idle(pin!(kept.move_home())).await;
        if let Err(error) = moved {
            error!("the store stays where it is: {}", Text(&error));
        }
    }
    if let Some((digest, image)) = work.adopt {
        let adopted = pulse.idle(pin!(kept.adopt(digest, image))).await;
        match adopted {
            Ok(_) => {
                info!("the store has taken over the configuration");
                running = kept.store().marks().live;
            }
            Err(error) => error!("the store: {}", Text(&error)),
        }
    }
    if work.trial_failed {
        let ended = pulse.idle(pin!(kept.end_trial(recipe_store::Ended::Failed))).await;
        if let Err(error) = ended {
            error!("the store: {}", Text(&error));
        }
    }
    let mut revisions = revisions_of(kept.store());
    if let (Some(revisions), Some(time), Some(number)) = (&mut revisions, work.trial, running) {
        revisions.resume_trial(number, now() + Span::from_micros(time.as_micros()));
    }
    let Some(revisions) = revisions else {
        error!("the store: its marks make no sense");
        pulse.idle(pin!(core::future::pending::<()>())).await;
        return;
    };
    desk.running.set(running);
    desk.revisions.replace(Some(revisions));
    let marks = kept.slots();
    let trial = marks.trial.filter(|trial| updates.running() == Some(trial.slot));
    let trial = trial.map(|trial| {
        warn!("this firmware is on trial for {} s", trial.confirm_s);
        update::Trial::new(Instant::now(), trial.confirm_s, Works::of_code(trial.before))
    });
    Keeper { desk, kept, updates, trial, trial_s: None }.work(gateway, pulse).await;
}

struct Keeper<'a, F, S> {
    desk: &'a Desk,
    kept: &'a mut Kept<F>,
    updates: &'a mut Updates<S>,
    /// The firmware that runs is on trial.
    trial: Option<update::Trial>,
    /// How long the trial that is asked for is, in seconds.
    trial_s: Option<u16>,
}

/// What comes of outputs.
enum Next {
    Sleep { until: proto_core::time::Instant },
    Restart,
}

impl<F: StoreFlash, S: SlotFlash> Keeper<'_, F, S> {
    async fn work(&mut self, gateway: &Gateway, pulse: &Pulse) {
        loop {
            let drained = pulse.idle(pin!(self.drain(0, &mut None))).await;
            let mut until = match drained {
                Next::Restart => return self.end(gateway, pulse).await,
                Next::Sleep { until } => Instant::from_micros(until.as_micros()),
            };
            let judged = pulse.idle(pin!(self.judge(gateway))).await;
            let waits_for = match judged {
                Judged::Restart => return self.end(gateway, pulse).await,
                Judged::OnTrial(waits_for) => {
                    until = until.min(Instant::now() + LOOK);
                    Some(waits_for)
                }
                Judged::Settled => None,
            };
            if self.updates.is_working() {
                // One step, and then whoever asks.
                pulse.idle(pin!(self.updates.work())).await;
                until = Instant::now();
            }
            self.show(waits_for);
            let desk = self.desk;
            let next = select4(desk.asked.wait(), desk.wanted.wait(), desk.session.wait(), Timer::at(until));
            let next = pulse.idle(pin!(next)).await;
            match next {
                Either4::First(ask) => {
                    let (result, is_restart) = pulse.idle(pin!(self.carry_out(gateway, ask))).await;
                    self.show(waits_for);
                    desk.done.signal(result);
                    if is_restart {
                        // Nobody gets the desk any more.
                        return self.end(gateway, pulse).await;
                    }
                    desk.is_taken.set(false);
                }
                Either4::Second((number, offset)) => {
                    let mut part = desk.part.borrow_mut();
                    let len = self.kept.image_part(number, offset, &mut part[..]).map(<[u8]>::len);
                    desk.part_len.signal(len);
                }
                Either4::Third(bd_seq) => {
                    let kept = pulse.idle(pin!(self.kept.set_session(bd_seq))).await;
                    desk.session_kept.signal(kept.is_ok());
                }
                Either4::Fourth(()) => {}
            }
        }
    }

    /// Brings the safe values out. The answer to who asked leaves meanwhile.
    async fn end(&self, gateway: &Gateway, pulse: &Pulse) {
        pulse.idle(pin!(Timer::after(LAST_WORDS))).await;
        if !pulse.idle(pin!(gateway.make_safe(MAX_SAFE))).await {
            warn!("the controller does not show all safe values; restarting all the same");
        }
        info!("restarting");
        pulse.idle(pin!(Timer::after(LAST_WORDS))).await;
    }

    /// Returns the result, and whether the board has to be restarted.
    async fn carry_out(&mut self, gateway: &Gateway, ask: Ask) -> (Result<u32, Failed>, bool) {
        if let Some(done) = self.of_firmware(gateway, &ask).await {
            return done;
        }
        if let Ask::Edge { len, restart, .. } = ask {
            return self.keep_edge(len, restart).await;
        }
        let mut image_len = 0;
        let decided = {
            let mut revisions = self.desk.revisions.borrow_mut();
            let Some(revisions) = revisions.as_mut() else {
                return (Err(Failed::Refused(Refused::Busy)), false);
            };
            match ask {
                Ask::Claim(_)
                | Ask::Piece { .. }
                | Ask::TryFirmware { .. }
                | Ask::ConfirmFirmware
                | Ask::EndFirmware
                | Ask::Edge { .. } => Ok(0),
                Ask::Put { base, digest, len } => {
                    image_len = len;
                    revisions.put(base, digest)
                }
                Ask::Apply { number, trial } => {
                    let seconds = trial.as_millis().div_ceil(1_000);
                    self.trial_s = Some(u16::try_from(seconds).unwrap_or(u16::MAX));
                    revisions.apply(number, trial)
                }
                Ask::Confirm => revisions.confirm(now()),
                Ask::RollBack => revisions.roll_back(),
            }
        };
        if let Ask::Claim(key) = ask {
            let taken = self.kept.set_access_key(&key).await;
            return (taken.map(|()| 0).map_err(Failed::Store), false);
        }
        let number = match decided {
            Ok(number) => number,
            Err(refused) => {
                self.trial_s = None;
                return (Err(Failed::Refused(refused)), false);
            }
        };
        let mut failed = None;
        let next = self.drain(image_len, &mut failed).await;
        let result = failed.map_or(Ok(number), |why| Err(Failed::Store(why)));
        (result, matches!(next, Next::Restart))
    }

    /// Keeps settings of the edge node. A trial is not cut short for a restart.
    #[allow(clippy::await_holding_refcell_ref, reason = "who has the desk waits for the keeper")]
    async fn keep_edge(&mut self, len: usize, restart: bool) -> (Result<u32, Failed>, bool) {
        let is_on_trial = self.desk.look(|revisions| revisions.trial().is_some()) == Some(true);
        if restart && (is_on_trial || self.trial.is_some()) {
            return (Err(Failed::Refused(Refused::OnTrial)), false);
        }
        let image = self.desk.image.borrow();
        let kept = self.kept.set_edge(image.get(..len).unwrap_or(&[])).await;
        let is_restart = restart && kept.is_ok();
        (kept.map(|()| 0).map_err(Failed::Store), is_restart)
    }

    /// What the revisions ask for.
    fn next_output(&self) -> Output {
        let mut revisions = self.desk.revisions.borrow_mut();
        // They are there as long as the keeper works.
        let Some(revisions) = revisions.as_mut() else {
            return Output::Sleep { until: proto_core::time::Instant::NEVER };
        };
        let before = revisions.last();
        let output = revisions.poll_output(now());
        if revisions.last() != before
            && let Some((_, Ended::NotConfirmed)) = revisions.last()
        {
            warn!("the configuration was not confirmed in time: back to the live one");
        }
        output
    }

    /// Does what the revisions ask for, and notes what failed.
    #[allow(clippy::await_holding_refcell_ref, reason = "who has the desk waits for the keeper")]
    async fn drain(&mut self, image_len: usize, failed: &mut Option<KeepError>) -> Next {
        loop {
            let output = self.next_output();
            let (written, result) = match output {
                Output::Sleep { until } => return Next::Sleep { until },
                Output::Store { revision: Revision { number, digest }, forget } => {
                    let image = self.desk.image.borrow();
                    let image = image.get(..image_len).unwrap_or(&[]);
                    let written = self.kept.keep(number, digest, image, forget).await;
                    // Room for it was made of others.
                    if let Some(revisions) = self.desk.revisions.borrow_mut().as_mut() {
                        revisions.keep_only(|number| {
                            number == NOTHING.number || self.kept.store().revision(number).is_some()
                        });
                    }
                    let is_done = written.is_ok();
                    (written, Done::Stored(is_done))
                }
                Output::Mark { live, previous } => {
                    let written =
                        self.kept.make_live(live, (previous != NOTHING.number).then_some(previous)).await;
                    let is_done = written.is_ok();
                    (written, Done::Marked(is_done))
                }
                // What was begun was not, and what ran still runs.
                Output::Run { number } if self.is_running(number) => (Ok(()), Done::Started(true)),
                Output::Run { number } => {
                    let (live, ended) = self.live_and_ended();
                    let written = match self.trial_s.take() {
                        Some(confirm_s) => self.kept.begin_trial(number, confirm_s).await,
                        None if number == live => {
                            // The starts of a trial are counted, so it ends also if this cannot be written.
                            if let Err(error) = self.kept.end_trial(ended).await {
                                error!("the store: {}", Text(&error));
                            }
                            return Next::Restart;
                        }
                        None => self.kept.make_live(number, Some(live)).await,
                    };
                    if written.is_ok() {
                        return Next::Restart;
                    }
                    (written, Done::Started(false))
                }
            };
            if let Err(error) = written {
                error!("the store: {}", Text(&error));
                failed.get_or_insert(error);
            }
            if let Some(revisions) = self.desk.revisions.borrow_mut().as_mut() {
                revisions.handle(now(), result);
            }
        }
    }

    fn is_running(&self, number: u32) -> bool {
        self.desk.running.get().unwrap_or(NOTHING.number) == number
    }

    /// The live one, and how the newest trial ended.
    fn live_and_ended(&self) -> (u32, recipe_store::Ended) {
        let revisions = self.desk.revisions.borrow();
        let revisions = revisions.as_ref();
        let ended = match revisions.and_then(Revisions::last) {
            Some((_, Ended::NotConfirmed)) => recipe_store::Ended::NotConfirmed,
            Some((_, Ended::TakenBack)) => recipe_store::Ended::TakenBack,
            _ => recipe_store::Ended::Failed,
        };
        (revisions.map_or(NOTHING.number, Revisions::live), ended)
    }
}

/// What a store holds; before anything was confirmed, [`NOTHING`] is the live one.
fn revisions_of(store: &Store) -> Option<Revisions> {
    let marks = store.marks();
    let mut stored = Stored { kept: Vec::new(), live: NOTHING.number, previous: marks.previous };
    let all = store.revisions();
    match marks.live {
        Some(live) => stored.live = live,
        None => stored.kept.push(NOTHING).ok()?,
    }
    // Beside it there is room for one less; the oldest is left out.
    let left_out = all.len().saturating_sub(stored.kept.capacity().saturating_sub(stored.kept.len()));
    for kept in all.iter().skip(left_out) {
        stored.kept.push(Revision { number: kept.number, digest: kept.digest }).ok()?;
    }
    let mut revisions = Revisions::new(stored)?;
    revisions.resume_last(marks.last.map(|(number, ended)| {
        let ended = match ended {
            recipe_store::Ended::Confirmed => Ended::Confirmed,
            recipe_store::Ended::NotConfirmed => Ended::NotConfirmed,
            recipe_store::Ended::TakenBack => Ended::TakenBack,
            recipe_store::Ended::Failed => Ended::Failed,
        };
        (number, ended)
    }));
    Some(revisions)
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

/// Stands for no configuration, where a live one is asked for: what is made for an empty board is based on it.
pub const NOTHING: Revision = Revision { number: 0, digest: 0 };
/// How often the trial of a firmware is looked at.
const LOOK: Duration = Duration::from_secs(1);
/// For an answer, and for the log.
const LAST_WORDS: Duration = Duration::from_millis(200);
/// How long safe values may take: so long they are repeated where nothing shows them (proto-core/docs/engine.md section 6).
const MAX_SAFE: Duration = Duration::from_secs(1);
