//! Configurations stored on the board, and which one runs after a start (docs/store.md).
//!
//! In: the store's flash, and an image from outside the store. Out: the images to try, in order. All writes are
//! complete before anything runs, and each is idempotent: an interrupted start is repeated.

use core::fmt;

use embassy_time::Duration;
use heapless::Vec;
use proto_core::config::image;
use recipe_sparkplug::document::{DocumentError, NodeDocument};
use recipe_store::{
    Adoption, Flash, FoundRecord, KeepError, MAX_REVISIONS, Marks, MountError, Newest, PutError, Revision,
    Role, Side, SlotMarks, Store, Trial, TrialEnd, WORD, newest,
};

/// Flash that can return a reference to the data of a record.
pub trait StoreFlash: Flash {
    /// The data of a record; `None` if it has been replaced.
    fn bytes(&mut self, found: FoundRecord) -> Option<&[u8]>;
}

/// The places that a board has for its store.
#[derive(Debug)]
pub struct StorePlaces<F> {
    /// The first place.
    pub first: F,
    /// The second place, if the board has slots for its firmware.
    pub second: Option<F>,
    /// The place in the bank that the program does not run from.
    pub own: Side,
}

impl<F> StorePlaces<F> {
    /// The only place of a board without slots.
    pub fn one(first: F) -> Self {
        Self { first, second: None, own: Side::First }
    }
}

/// A store and its flash.
#[derive(Debug)]
pub struct StoredConfig<F> {
    store: Store,
    flash: F,
    /// The place to move to, if the store is in the bank that the program runs from.
    to: Option<F>,
}

/// Text of a [`Role`] in the log.
#[derive(Debug, Clone, Copy)]
pub struct RoleName(pub Role);

impl fmt::Display for RoleName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Role::Live => f.write_str("the live one"),
            Role::Previous => f.write_str("the one before the live one"),
            Role::Trial { confirm_s } => write!(f, "on trial for {confirm_s} s"),
        }
    }
}

/// Text of an [`TrialEnd`] in the log.
#[derive(Debug, Clone, Copy)]
pub struct EndedName(pub TrialEnd);

impl fmt::Display for EndedName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.0 {
            TrialEnd::Confirmed => "it was confirmed",
            TrialEnd::NotConfirmed => "nobody confirmed it in time",
            TrialEnd::TakenBack => "somebody took it back",
            TrialEnd::Failed => "it could not run, or none of its starts lasted",
        })
    }
}

impl<F: StoreFlash> StoredConfig<F> {
    /// Reads the flash.
    ///
    /// # Errors
    /// The flash is unsuitable, or a newer program wrote it.
    pub fn open(places: StorePlaces<F>) -> Result<Self, MountError> {
        let StorePlaces { first, second, own } = places;
        let Some(second) = second else {
            return Ok(Self { store: Store::mount(&first)?, flash: first, to: None });
        };
        let Newest { store, side, may_move } = newest(&first, &second)?;
        let (flash, to) = match side {
            Side::First => (first, second),
            Side::Second => (second, first),
        };
        Ok(Self { store, flash, to: (may_move && side != own).then_some(to) })
    }

    /// Whether the store is in the bank that the program runs from, where erasing a sector would stall the program.
    pub fn is_to_be_moved(&self) -> bool {
        self.to.is_some()
    }

    /// Moves the store to the bank that the program does not run from; does nothing if it is there already.
    ///
    /// # Errors
    /// The move failed; the store stays where it was.
    pub async fn move_home(&mut self) -> Result<(), PutError> {
        let Some(mut to) = self.to.take() else { return Ok(()) };
        self.store = self.store.relocate().execute(&self.flash, &mut to).await?;
        self.flash = to;
        Ok(())
    }

    /// Marks of the firmware slots.
    pub fn slots(&self) -> SlotMarks {
        self.store.slots()
    }

    /// Writes the marks of the firmware slots.
    ///
    /// # Errors
    /// They cannot be written; the previous marks remain valid.
    pub async fn mark_slots(&mut self, marks: SlotMarks) -> Result<(), KeepError> {
        Ok(self.store.mark_slots(marks)?.execute(&mut self.flash).await?)
    }

    /// The oldest and the newest version of the images that may have to run after an update: the live one, the one
    /// before it, and the one on trial. `None` if there is none.
    pub fn versions(&self) -> Option<(u32, u32)> {
        let Marks { live, previous, trial, .. } = self.store.marks();
        let numbers = [live, previous, trial.map(|trial| trial.number)];
        let mut range: Option<(u32, u32)> = None;
        for number in numbers.into_iter().flatten() {
            let mut head = [0; image::HEADER];
            let Some(version) = self.image_part(number, 0, &mut head).and_then(image_version) else {
                continue;
            };
            range =
                Some(range.map_or((version, version), |(oldest, newest)| {
                    (oldest.min(version), newest.max(version))
                }));
        }
        range
    }

    /// The mounted store.
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// Adopts an image from outside the store as the live one, once. Returns whether it did.
    ///
    /// # Errors
    /// It cannot be written; the live configuration is unchanged.
    pub async fn adopt(&mut self, digest: u32, image: &[u8]) -> Result<bool, KeepError> {
        let mut is_new = false;
        // An adoption has three writes: image, marks, and a record of the adoption. Each may have to make room first.
        for _ in 0..4 + MAX_REVISIONS {
            match self.store.adopt(digest, image) {
                Ok(Adoption::Write(put)) => put.execute(&mut self.flash).await?,
                Ok(Adoption::Done) => break,
                Err(full) => {
                    self.make_room(full, None).await?;
                    continue;
                }
            }
            is_new = true;
        }
        Ok(is_new)
    }

    /// The configurations to try, in order. Each start of a configuration on trial is counted before it runs, to limit
    /// the number of crashes. If the start cannot be counted, the configuration on trial is not run.
    ///
    /// # Errors
    /// The start could not be counted. `candidates` then contains only the other configurations.
    pub async fn candidates(&mut self, candidates: &mut Vec<(Revision, Role), 3>) -> Result<(), KeepError> {
        let start = self.store.at_start();
        *candidates = start.candidates;
        let Some(marks) = start.marks else { return Ok(()) };
        let counted = self.mark(marks).await;
        if counted.is_err() {
            candidates.retain(|(_, role)| !matches!(role, Role::Trial { .. }));
        }
        counted
    }

    /// Puts a configuration on trial: the next start runs it.
    ///
    /// # Errors
    /// It cannot be written; the next start runs the live configuration.
    pub async fn begin_trial(&mut self, number: u32, confirm_s: u16) -> Result<(), KeepError> {
        let trial = Some(Trial { number, attempts: STARTS, confirm_s });
        self.mark(Marks { trial, ..self.store.marks() }).await
    }

    /// Ends the trial: the next start runs the live one.
    ///
    /// # Errors
    /// The marks cannot be written. The trial still ends, at the latest when its counted starts are used up.
    pub async fn end_trial(&mut self, ended: TrialEnd) -> Result<(), KeepError> {
        let marks = self.store.marks();
        let last = marks.trial.map(|trial| (trial.number, ended)).or(marks.last);
        self.mark(Marks { trial: None, last, ..marks }).await
    }

    /// Marks a configuration as live and another as the previous one. Confirms a trial.
    ///
    /// # Errors
    /// It cannot be written; the live configuration is unchanged.
    pub async fn make_live(&mut self, live: u32, previous: Option<u32>) -> Result<(), KeepError> {
        let marks = self.store.marks();
        let last = marks.trial.map(|trial| (trial.number, TrialEnd::Confirmed)).or(marks.last);
        self.mark(Marks { live: Some(live), previous, trial: None, last }).await
    }

    /// Stores a configuration in the place of `forget` or in a free one. If the store is full, the oldest unmarked ones
    /// are forgotten.
    pub async fn keep(
        &mut self,
        number: u32,
        digest: u32,
        image: &[u8],
        forget: Option<u32>,
    ) -> Result<(), KeepError> {
        let marks = self.store.marks();
        // This mark refers to the place of `forget`, which gets another configuration.
        if forget.is_some() && marks.last.map(|(number, _)| number) == forget {
            self.mark(Marks { last: None, ..marks }).await?;
        }
        let mut forget = forget;
        for _ in 0..MAX_REVISIONS {
            match self.store.keep(number, digest, image, forget) {
                Ok(put) => return Ok(put.execute(&mut self.flash).await?),
                Err(full) => self.make_room(full, forget.take()).await?,
            }
        }
        Ok(self.store.keep(number, digest, image, None)?.execute(&mut self.flash).await?)
    }

    /// Forgets `forget` or the oldest unmarked configuration, if `why` is that the store is full.
    async fn make_room(&mut self, why: KeepError, forget: Option<u32>) -> Result<(), KeepError> {
        if !matches!(why, KeepError::Put(PutError::Full { .. })) {
            return Err(why);
        }
        let put = self.store.forget(forget)?.ok_or(why)?;
        Ok(put.execute(&mut self.flash).await?)
    }

    /// The access key of the API.
    pub fn access_key(&self) -> Option<[u8; 16]> {
        self.store.access_key(&self.flash)
    }

    /// Stores the access key of the API.
    pub async fn set_access_key(&mut self, key: &[u8; 16]) -> Result<(), KeepError> {
        Ok(self.store.set_access_key(key)?.execute(&mut self.flash).await?)
    }

    /// Decodes the settings of the edge node into `document`. Returns whether they enable publishing; `None` if there
    /// are none.
    pub fn edge(&mut self, document: &mut NodeDocument) -> Option<Result<bool, DocumentError>> {
        let bytes = self.flash.bytes(self.store.edge()?)?;
        Some(document.decode(bytes))
    }

    /// Stores the settings of the edge node. If the store is full, the oldest unmarked configurations are forgotten.
    ///
    /// # Errors
    /// They cannot be written; the previous settings remain.
    pub async fn set_edge(&mut self, settings: &[u8]) -> Result<(), KeepError> {
        for _ in 0..MAX_REVISIONS {
            match self.store.set_edge(settings) {
                Ok(put) => return Ok(put.execute(&mut self.flash).await?),
                Err(full) => self.make_room(full.into(), None).await?,
            }
        }
        Ok(self.store.set_edge(settings)?.execute(&mut self.flash).await?)
    }

    /// Stores the bdSeq of the edge node's session.
    pub async fn set_session(&mut self, bd_seq: u8) -> Result<(), KeepError> {
        Ok(self.store.set_birth_sequence(bd_seq)?.execute(&mut self.flash).await?)
    }

    async fn mark(&mut self, marks: Marks) -> Result<(), KeepError> {
        Ok(self.store.mark(marks)?.execute(&mut self.flash).await?)
    }

    /// Reads bytes of an image from `offset` on, a multiple of [`WORD`], into `out`. `None` if there is no such
    /// configuration.
    pub fn image_part<'o>(&self, number: u32, offset: usize, out: &'o mut [u8]) -> Option<&'o [u8]> {
        let found = self.store.find(self.store.revision(number)?.key())?;
        let len = found.len.saturating_sub(offset).min(out.len());
        let out = out.get_mut(..len)?;
        let mut place = found.data;
        place.word = place.word.saturating_add(u16::try_from(offset / WORD).ok()?);
        for part in out.chunks_mut(WORD) {
            part.iter_mut().zip(self.flash.read(place)).for_each(|(byte, read)| *byte = read);
            place.word = place.word.saturating_add(1);
        }
        Some(out)
    }

    /// The image of a configuration.
    pub fn image(&mut self, revision: Revision) -> Option<&[u8]> {
        self.flash.bytes(self.store.find(revision.key())?)
    }
}

/// The version in the head of a configuration image.
pub fn image_version(head: &[u8]) -> Option<u32> {
    head.get(image::MAGIC.len()..)?.first_chunk().map(|version| u32::from_le_bytes(*version))
}

/// Number of starts that a trial has: one, and two more in case of power cuts.
const STARTS: u8 = 3;

/// Duration of the trial; `None` if the configuration is not on trial.
pub fn trial_time(role: Role) -> Option<Duration> {
    match role {
        Role::Trial { confirm_s } => Some(Duration::from_secs(confirm_s.into())),
        Role::Live | Role::Previous => None,
    }
}

#[cfg(test)]
mod tests;
