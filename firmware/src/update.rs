//! Firmware updates: receiving into the free slot, and trials (docs/update.md).
//!
//! In: pieces of a firmware, marks, the number of links and ports that work. Out: writes to the free slot, refusals,
//! and when a trial is confirmed. `recipe-update` decides what may be installed, the console who may ask.

use core::fmt;

use embassy_futures::yield_now;
use embassy_time::{Duration, Instant};
use proto_core::config::image;
use recipe_store::SlotMarks;
use recipe_update::{
    BoardName, Downgrade, Foreign, Formats, Gap, HEADER, Header, HeaderError, PublicKey, Receive,
    ReceiveError, ReceiveStep, RunningFirmware, Slot, SlotFlash, Version, header_of,
};

/// Slots of a board.
#[derive(Debug)]
pub struct Site<S> {
    /// Name of the board in firmware headers.
    pub board: &'static str,
    /// The slots; or why the firmware cannot be updated.
    pub slots: Result<Slots<S>, &'static str>,
}

/// The slots of a board with a loader.
#[derive(Debug)]
pub struct Slots<S> {
    /// The slot that the program runs in.
    pub running: Slot,
    /// The public key of the loader.
    pub key: [u8; 32],
    /// Flash of the running slot; only read.
    pub own: S,
    /// Flash of the other slot.
    pub free: S,
}

/// Why a request about the firmware is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpdateError {
    /// This firmware cannot be updated.
    Cannot(&'static str),
    /// Invalid header.
    Header(HeaderError),
    /// The piece at offset 0 is not exactly as long as the header.
    Alone,
    /// The firmware may not be installed.
    Rule(recipe_update::UpdateRefused),
    /// The piece is not the next one.
    Gap {
        /// Offset of the next piece from the beginning of the header, in bytes.
        expected: u32,
    },
    /// No header was sent.
    NoHeader,
    /// The slot is being erased, or its contents are being checked.
    Busy,
    /// Receiving failed.
    Failed(ReceiveError),
    /// No complete firmware is in the free slot.
    NotReady,
    /// Nothing is on trial.
    NotOnTrial,
    /// The firmware was signed with another key.
    Foreign,
    /// A configuration is on trial, or is being stored.
    Unsettled,
    /// The firmware before the one on trial cannot read configurations of this version.
    Format(u32),
}

impl UpdateError {
    /// Whether the request itself is invalid, as opposed to refused only at this time.
    pub fn is_wrong(&self) -> bool {
        match self {
            Self::Rule(recipe_update::UpdateRefused::OnTrial | recipe_update::UpdateRefused::NotGood) => {
                false
            }
            Self::Header(_) | Self::Alone | Self::Rule(_) | Self::Failed(_) | Self::Foreign => true,
            _ => false,
        }
    }
}

impl fmt::Display for UpdateError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cannot(why) => f.write_str(why),
            Self::Header(error) => error.fmt(f),
            Self::Alone => write!(f, "offset 0 is the header alone, {HEADER} bytes"),
            Self::Rule(refused) => refused.fmt(f),
            Self::Gap { expected } => Gap { expected: *expected }.fmt(f),
            Self::NoHeader => f.write_str("the header comes first, with offset 0"),
            Self::Busy => f.write_str("the slot is being erased or checked; `update` says when that is done"),
            Self::Failed(error) => error.fmt(f),
            Self::NotReady => f.write_str("no firmware was received and checked"),
            Self::NotOnTrial => f.write_str("no firmware is on trial"),
            Self::Foreign => Foreign.fmt(f),
            Self::Unsettled => f.write_str("a configuration is on trial; confirm it or roll it back first"),
            Self::Format(version) => write!(
                f,
                "a firmware is on trial, and the one before it does not read configurations of version {version}"
            ),
        }
    }
}

/// Progress of receiving a firmware.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpdateStage {
    /// The slot is being erased.
    Erasing,
    /// Waiting for the next piece.
    Receiving,
    /// The hash is being computed.
    Checking,
    /// The firmware is complete.
    Ready,
    /// Receiving failed.
    Failed(ReceiveError),
}

/// The firmware being received, or received last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Incoming {
    /// Header of the firmware.
    pub header: Header,
    /// Progress.
    pub stage: UpdateStage,
    /// Offset of the next piece from the beginning of the header, in bytes.
    pub received: u32,
}

/// State of firmware updates.
#[derive(Debug)]
pub struct Updates<S> {
    board: BoardName,
    slots: Result<Slots<S>, &'static str>,
    receive: Option<Receive>,
    incoming: Option<Incoming>,
    /// Header of the complete firmware in the other slot.
    other: Option<Header>,
    build: Option<Build>,
}

impl<S: SlotFlash> Updates<S> {
    /// Reads the headers of both slots. `None` if the name of the board is invalid.
    pub fn new(site: Site<S>) -> Option<Self> {
        let board = BoardName::parse(site.board)?;
        let slots = site.slots;
        let own = slots.as_ref().ok().and_then(|slots| header_of(&slots.own, slots.running, &board).ok());
        let build = own.as_ref().map(build_of);
        let mut updates = Self { board, slots, receive: None, incoming: None, other: None, build };
        updates.look();
        Some(updates)
    }

    fn look(&mut self) {
        self.other = match &self.slots {
            Ok(slots) => header_of(&slots.free, slots.running.other(), &self.board).ok(),
            Err(_) => None,
        };
    }

    /// The board's name.
    pub fn board(&self) -> &BoardName {
        &self.board
    }

    /// The slot that the program runs in.
    pub fn running(&self) -> Option<Slot> {
        self.slots.as_ref().ok().map(|slots| slots.running)
    }

    /// The public key of the loader.
    pub fn key(&self) -> Option<[u8; 32]> {
        self.slots.as_ref().ok().map(|slots| slots.key)
    }

    /// Why this firmware cannot be updated.
    pub fn cannot(&self) -> Option<&'static str> {
        self.slots.as_ref().err().copied()
    }

    /// Build of the running firmware; `None` if its slot has no header.
    pub fn build(&self) -> Option<Build> {
        self.build
    }

    /// The firmware being received, or received last.
    pub fn incoming(&self) -> Option<Incoming> {
        self.incoming
    }

    /// Header of the complete firmware in the other slot.
    pub fn other(&self) -> Option<&Header> {
        self.other.as_ref()
    }

    fn rule(&self, kept: Option<(u32, u32)>) -> Result<RunningFirmware, UpdateError> {
        let slot = self.slots.as_ref().map_err(|why| UpdateError::Cannot(why))?.running;
        Ok(RunningFirmware { board: self.board, slot, version: VERSION, kept })
    }

    /// Accepts a piece. The piece at `offset` 0 is the header. If it is the header of the firmware that is already
    /// being received, or is complete in its slot, nothing changes.
    pub async fn take(
        &mut self,
        offset: u32,
        bytes: &[u8],
        kept: Option<(u32, u32)>,
        marks: SlotMarks,
        downgrade: Downgrade,
    ) -> Result<(), UpdateError> {
        let running = self.rule(kept)?;
        match offset {
            0 => self.begin(bytes, &running, marks, downgrade),
            _ => self.fill(offset, bytes).await,
        }
    }

    fn begin(
        &mut self,
        bytes: &[u8],
        running: &RunningFirmware,
        marks: SlotMarks,
        downgrade: Downgrade,
    ) -> Result<(), UpdateError> {
        let slots = self.slots.as_ref().map_err(|why| UpdateError::Cannot(why))?;
        let bytes: &[u8; HEADER] = bytes.try_into().map_err(|_| UpdateError::Alone)?;
        let header = Header::parse(bytes).map_err(UpdateError::Header)?;
        let receive =
            Receive::begin(header, running, marks, downgrade, &slots.free).map_err(UpdateError::Rule)?;
        if let Some(Incoming { header: before, stage, .. }) = self.incoming
            && before == header
            && !matches!(stage, UpdateStage::Failed(_))
        {
            return Ok(());
        }
        if self.is_working() {
            return Err(UpdateError::Busy);
        }
        if self.other == Some(header) {
            let received = whole_length(&header);
            self.incoming = Some(Incoming { header, stage: UpdateStage::Ready, received });
            return Ok(());
        }
        self.receive = Some(receive);
        self.incoming = Some(Incoming { header, stage: UpdateStage::Erasing, received: HEADER as u32 });
        Ok(())
    }

    async fn fill(&mut self, offset: u32, mut bytes: &[u8]) -> Result<(), UpdateError> {
        let slots = self.slots.as_mut().map_err(|why| UpdateError::Cannot(why))?;
        let Some(incoming) = &mut self.incoming else { return Err(UpdateError::NoHeader) };
        match incoming.stage {
            UpdateStage::Receiving => {}
            UpdateStage::Erasing | UpdateStage::Checking => return Err(UpdateError::Busy),
            UpdateStage::Ready => return Err(UpdateError::Gap { expected: incoming.received }),
            UpdateStage::Failed(error) => return Err(UpdateError::Failed(error)),
        }
        let Some(receive) = &mut self.receive else { return Err(UpdateError::NoHeader) };
        if offset != incoming.received {
            return Err(UpdateError::Gap { expected: incoming.received });
        }
        for nth in 0_u32.. {
            match receive.next(&slots.free) {
                ReceiveStep::Take { offset } => {
                    let Ok(count @ 1..) = receive.take(offset, bytes) else { break };
                    bytes = bytes.get(count..).unwrap_or(&[]);
                    incoming.received = receive.taken().saturating_add(HEADER as u32);
                }
                ReceiveStep::Write(place, word) => slots.free.write(place, &word).await,
                ReceiveStep::Erase(sector) => slots.free.erase(sector).await,
                ReceiveStep::Again => {
                    incoming.stage = UpdateStage::Checking;
                    break;
                }
                // A short firmware is checked in a single step.
                ReceiveStep::End(Ok(())) => {
                    incoming.stage = UpdateStage::Ready;
                    self.receive = None;
                    self.look();
                    break;
                }
                ReceiveStep::End(Err(error)) => {
                    incoming.stage = UpdateStage::Failed(error);
                    return Err(UpdateError::Failed(error));
                }
            }
            if nth % WORDS == 0 {
                yield_now().await;
            }
        }
        Ok(())
    }

    /// Whether [`Updates::work`] has something to do.
    pub fn is_working(&self) -> bool {
        self.incoming
            .is_some_and(|incoming| matches!(incoming.stage, UpdateStage::Erasing | UpdateStage::Checking))
    }

    /// Does one step: erases a sector, or checks some KiB of the received image.
    pub async fn work(&mut self) {
        let (Ok(slots), Some(receive), Some(incoming)) =
            (&mut self.slots, &mut self.receive, &mut self.incoming)
        else {
            return;
        };
        // The slot's former contents are invalid from here on.
        self.other = None;
        match receive.next(&slots.free) {
            ReceiveStep::Erase(sector) => slots.free.erase(sector).await,
            ReceiveStep::Write(place, word) => slots.free.write(place, &word).await,
            ReceiveStep::Take { .. } => incoming.stage = UpdateStage::Receiving,
            ReceiveStep::Again => yield_now().await,
            ReceiveStep::End(Ok(())) => {
                incoming.stage = UpdateStage::Ready;
                self.receive = None;
                self.look();
            }
            ReceiveStep::End(Err(error)) => {
                incoming.stage = UpdateStage::Failed(error);
                self.receive = None;
            }
        }
    }

    /// The firmware that may be put on trial.
    pub fn ready(
        &self,
        kept: Option<(u32, u32)>,
        marks: SlotMarks,
        downgrade: Downgrade,
    ) -> Result<Header, UpdateError> {
        let running = self.rule(kept)?;
        let slots = self.slots.as_ref().map_err(|why| UpdateError::Cannot(why))?;
        let header = self.other.ok_or(UpdateError::NotReady)?;
        running.accepts(&header, &slots.free, marks, downgrade).map_err(UpdateError::Rule)?;
        Ok(header)
    }

    /// Checks a signature. Blocks all tasks for some million instructions.
    #[inline(never)]
    pub fn verify(&self, header: &Header) -> Result<(), UpdateError> {
        let slots = self.slots.as_ref().map_err(|why| UpdateError::Cannot(why))?;
        let key = PublicKey::parse(&slots.key).ok_or(UpdateError::Foreign)?;
        header.verify(&key).map_err(|_| UpdateError::Foreign)
    }

    /// Checks that a configuration of this version may be stored.
    ///
    /// # Errors
    /// The firmware to fall back to cannot read it.
    pub fn may_keep(&self, version: u32, marks: SlotMarks) -> Result<(), UpdateError> {
        let before = self.other.map(|header| header.parts().formats);
        match recipe_update::may_keep(version, &FORMATS, before.as_ref(), marks) {
            true => Ok(()),
            false => Err(UpdateError::Format(version)),
        }
    }
}

/// First bytes of the image's SHA-512; distinguishes builds of one version.
pub type Build = [u8; 8];

/// The build of a header.
pub fn build_of(header: &Header) -> Build {
    header.hash().first_chunk().copied().unwrap_or_default()
}

/// Length of header and image.
pub fn whole_length(header: &Header) -> u32 {
    header.length().saturating_add(HEADER as u32)
}

/// Number of links to the controller and of field ports that work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Works {
    /// Links that are up.
    pub links: u8,
    /// Ports that work.
    pub ports: u8,
}

impl Works {
    /// Encodes the counts for the mark of a trial, each limited to 15.
    pub fn code(self) -> u8 {
        self.links.min(15) << 4 | self.ports.min(15)
    }

    /// Decodes the counts of such a mark.
    pub fn of_code(code: u8) -> Self {
        Self { links: code >> 4, ports: code & 15 }
    }
}

/// What a firmware on trial waits for until it confirms itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WaitsFor {
    /// As many links to the controller as before.
    Controller,
    /// As many working ports as before.
    Ports,
    /// An admitted request: an unreachable board could not be updated again.
    Request,
    /// All conditions to hold for [`LASTS`].
    Time,
}

impl WaitsFor {
    /// Name in JSON documents.
    pub fn name(self) -> &'static str {
        match self {
            Self::Controller => "controller",
            Self::Ports => "ports",
            Self::Request => "request",
            Self::Time => "time",
        }
    }
}

/// Trial of a firmware, which confirms itself once as many links and ports work as before.
#[derive(Debug, Clone, Copy)]
pub struct FirmwareTrial {
    until: Instant,
    before: Works,
    well_since: Option<Instant>,
}

/// Result of checking a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrialVerdict {
    /// The trial goes on.
    Waits(WaitsFor),
    /// All conditions have held long enough: confirm.
    Confirmed,
    /// The trial has expired.
    Over,
}

impl FirmwareTrial {
    /// Starts a trial of `confirm_s` seconds.
    pub fn new(now: Instant, confirm_s: u16, before: Works) -> Self {
        Self { until: now + Duration::from_secs(confirm_s.into()), before, well_since: None }
    }

    /// When the trial expires.
    pub fn until(&self) -> Instant {
        self.until
    }

    /// Checks the trial; to be called at least once a second.
    pub fn look(&mut self, now: Instant, works: Works, is_reached: bool) -> TrialVerdict {
        let missing = if works.links < self.before.links {
            Some(WaitsFor::Controller)
        } else if works.ports < self.before.ports {
            Some(WaitsFor::Ports)
        } else if !is_reached {
            Some(WaitsFor::Request)
        } else {
            None
        };
        if missing.is_some() {
            self.well_since = None;
        }
        let is_well = missing.is_none() && now - *self.well_since.get_or_insert(now) >= LASTS;
        match missing {
            _ if is_well => TrialVerdict::Confirmed,
            _ if now >= self.until => TrialVerdict::Over,
            Some(missing) => TrialVerdict::Waits(missing),
            None => TrialVerdict::Waits(WaitsFor::Time),
        }
    }
}

/// The version of this firmware.
pub const VERSION: Version = Version::new(
    number(env!("CARGO_PKG_VERSION_MAJOR")),
    number(env!("CARGO_PKG_VERSION_MINOR")),
    number(env!("CARGO_PKG_VERSION_PATCH")),
);

/// Parses a part of the package's version, at compile time.
const fn number(digits: &str) -> u16 {
    match u16::from_str_radix(digits, 10) {
        Ok(number) => number,
        Err(_) => panic!("a version of a firmware has three numbers of 16 bits"),
    }
}

/// Configuration versions that this firmware reads and writes.
pub const FORMATS: Formats =
    Formats { oldest: image::OLDEST_VERSION, newest: image::VERSION, written: image::VERSION };
/// How long all conditions must hold before a trial is confirmed.
pub const LASTS: Duration = Duration::from_secs(10);
/// Number of words written before yielding. Without it, flash whose writes complete at once would never yield.
const WORDS: u32 = 16;

#[cfg(test)]
mod tests;
