//! The firmware of this board: what is received into the free slot, and the one on trial (docs/update.md).
//!
//! In: pieces of a firmware, marks, how well the cell does. Out: what is written into the free slot, why something is
//! refused, and when a trial is confirmed. What may be taken is decided in `recipe-update`; who may ask, by the console.

use core::fmt;

use embassy_futures::yield_now;
use embassy_time::{Duration, Instant};
use proto_core::config::image;
use recipe_store::SlotMarks;
use recipe_update::{
    BoardName, Downgrade, Foreign, Formats, Gap, HEADER, Header, HeaderError, PublicKey, Receive,
    ReceiveError, ReceiveStep, Running, Slot, SlotFlash, Version, header_of,
};

/// What a board says of its slots.
#[derive(Debug)]
pub struct Site<S> {
    /// The board's name, as updates have it.
    pub board: &'static str,
    /// The slot that the program runs in, and what belongs to it; or why it takes no update.
    pub slots: Result<Slots<S>, &'static str>,
}

/// The slots of a board with a loader.
#[derive(Debug)]
pub struct Slots<S> {
    /// The slot that the program runs in.
    pub running: Slot,
    /// The public key of the loader.
    pub key: [u8; 32],
    /// The flash of that slot: only read.
    pub own: S,
    /// The flash of the other slot.
    pub free: S,
}

/// Why a request about the firmware is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpdateError {
    /// This firmware takes no update.
    Cannot(&'static str),
    /// What was sent is no header.
    Header(HeaderError),
    /// The header has to come alone.
    Alone,
    /// It may not be taken.
    Rule(recipe_update::Refused),
    /// The piece is not the next one.
    Gap {
        /// Where the next one begins, counted from the beginning of the header.
        expected: u32,
    },
    /// No header was sent.
    NoHeader,
    /// The slot is being erased, or its contents are being checked.
    Busy,
    /// It could not be received.
    Failed(ReceiveError),
    /// Nothing is ready to be tried.
    NotReady,
    /// Nothing is on trial.
    NotOnTrial,
    /// It was signed with another key.
    Foreign,
    /// A configuration is on trial, or is being stored.
    Unsettled,
    /// The firmware before the one on trial would not read this configuration.
    Format(u32),
}

impl UpdateError {
    /// Whether what was sent is wrong, and not only the moment.
    pub fn is_wrong(&self) -> bool {
        match self {
            Self::Rule(recipe_update::Refused::OnTrial | recipe_update::Refused::NotGood) => false,
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

/// How far a firmware has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpdateStage {
    /// The slot is being erased.
    Erasing,
    /// The next piece is awaited.
    Receiving,
    /// The hash is being computed.
    Checking,
    /// It is whole.
    Ready,
    /// It is not, and why.
    Failed(ReceiveError),
}

/// What is being received, or was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Incoming {
    /// What it is.
    pub header: Header,
    /// How far it has come.
    pub stage: UpdateStage,
    /// Where the next piece begins, counted from the beginning of the header.
    pub received: u32,
}

/// The update of this board.
#[derive(Debug)]
pub struct Updates<S> {
    board: BoardName,
    slots: Result<Slots<S>, &'static str>,
    receive: Option<Receive>,
    incoming: Option<Incoming>,
    /// What the other slot holds, whole.
    other: Option<Header>,
    build: Option<Build>,
}

impl<S: SlotFlash> Updates<S> {
    /// Nothing is being received; the other slot is looked at. `None` if the board's name is none.
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

    /// Why this firmware takes no update.
    pub fn cannot(&self) -> Option<&'static str> {
        self.slots.as_ref().err().copied()
    }

    /// Which build runs; `None` if its slot has no header.
    pub fn build(&self) -> Option<Build> {
        self.build
    }

    /// What is being received, or was.
    pub fn incoming(&self) -> Option<Incoming> {
        self.incoming
    }

    /// What the other slot holds, whole.
    pub fn other(&self) -> Option<&Header> {
        self.other.as_ref()
    }

    fn rule(&self, kept: Option<(u32, u32)>) -> Result<Running, UpdateError> {
        let slot = self.slots.as_ref().map_err(|why| UpdateError::Cannot(why))?.running;
        Ok(Running { board: self.board, slot, version: VERSION, kept })
    }

    /// Takes a piece. With `offset` 0 it is the header; that of what is being received, or is whole in its slot, changes
    /// nothing.
    ///
    /// # Errors
    /// Why it is not taken.
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
        running: &Running,
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
                // A short one is checked at once.
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

    /// Erases a sector, or looks at some KiB of what was received.
    pub async fn work(&mut self) {
        let (Ok(slots), Some(receive), Some(incoming)) =
            (&mut self.slots, &mut self.receive, &mut self.incoming)
        else {
            return;
        };
        // What the slot held is gone from here on.
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
    ///
    /// # Errors
    /// There is none, or it may not be taken.
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

    /// Checks a signature: some million instructions in one stretch, so nothing may wait for the board.
    ///
    /// # Errors
    /// It was made with another key than the loader's.
    #[inline(never)]
    pub fn verify(&self, header: &Header) -> Result<(), UpdateError> {
        let slots = self.slots.as_ref().map_err(|why| UpdateError::Cannot(why))?;
        let key = PublicKey::parse(&slots.key).ok_or(UpdateError::Foreign)?;
        header.verify(&key).map_err(|_| UpdateError::Foreign)
    }

    /// Whether a configuration of this version may be kept.
    ///
    /// # Errors
    /// The last failure, if there is no session.
    pub fn may_keep(&self, version: u32, marks: SlotMarks) -> Result<(), UpdateError> {
        let before = self.other.map(|header| header.parts().formats);
        match recipe_update::may_keep(version, &FORMATS, before.as_ref(), marks) {
            true => Ok(()),
            false => Err(UpdateError::Format(version)),
        }
    }
}

/// The first bytes of the SHA-512 of an image. They tell builds of one version apart.
pub type Build = [u8; 8];

/// The build that this header is of.
pub fn build_of(header: &Header) -> Build {
    header.hash().first_chunk().copied().unwrap_or_default()
}

/// Length of header and image.
pub fn whole_length(header: &Header) -> u32 {
    header.length().saturating_add(HEADER as u32)
}

/// How much of a cell works: so many links to the controller, and so many field ports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Works {
    /// Links that are up.
    pub links: u8,
    /// Ports that work.
    pub ports: u8,
}

impl Works {
    /// As the mark of a trial keeps it: at most 15 of each.
    pub fn code(self) -> u8 {
        self.links.min(15) << 4 | self.ports.min(15)
    }

    /// Of such a mark.
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
    /// A request that was admitted: a board that nobody can reach cannot be updated again.
    Request,
    /// That all of it lasts.
    Time,
}

impl WaitsFor {
    /// As documents have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Controller => "controller",
            Self::Ports => "ports",
            Self::Request => "request",
            Self::Time => "time",
        }
    }
}

/// A firmware on trial: it confirms itself once the cell does as well as before.
#[derive(Debug, Clone, Copy)]
pub struct FirmwareTrial {
    until: Instant,
    before: Works,
    well_since: Option<Instant>,
}

/// What comes of a look at a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The trial goes on.
    Waits(WaitsFor),
    /// It is to be confirmed.
    Confirmed,
    /// Its time is over.
    Over,
}

impl FirmwareTrial {
    /// From now on, for this long.
    pub fn new(now: Instant, confirm_s: u16, before: Works) -> Self {
        Self { until: now + Duration::from_secs(confirm_s.into()), before, well_since: None }
    }

    /// When its time is over.
    pub fn until(&self) -> Instant {
        self.until
    }

    /// Looks at it; called again within a second.
    pub fn look(&mut self, now: Instant, works: Works, is_reached: bool) -> Verdict {
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
            _ if is_well => Verdict::Confirmed,
            _ if now >= self.until => Verdict::Over,
            Some(missing) => Verdict::Waits(missing),
            None => Verdict::Waits(WaitsFor::Time),
        }
    }
}

/// The version of this firmware.
pub const VERSION: Version = Version::new(
    number(env!("CARGO_PKG_VERSION_MAJOR")),
    number(env!("CARGO_PKG_VERSION_MINOR")),
    number(env!("CARGO_PKG_VERSION_PATCH")),
);

/// A number of the package's version. Checked when it is compiled.
const fn number(digits: &str) -> u16 {
    match u16::from_str_radix(digits, 10) {
        Ok(number) => number,
        Err(_) => panic!("a version of a firmware has three numbers of 16 bits"),
    }
}

/// The configurations that it reads and writes.
pub const FORMATS: Formats =
    Formats { oldest: image::OLDEST_VERSION, newest: image::VERSION, written: image::VERSION };
/// How long all has to be well until a trial is confirmed.
pub const LASTS: Duration = Duration::from_secs(10);
/// Words that are written until others run, where writing does not wait.
const WORDS: u32 = 16;

#[cfg(test)]
mod tests;
