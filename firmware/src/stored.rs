//! The configuration that runs after a start, from the store (docs/store.md).
//!
//! In: the store's flash, and the image that a probe or a file left outside the store. Out: the images to be
//! tried, in their order. What is written on the way is finished before anything runs, so a start that is cut
//! short is repeated, and changes nothing twice.

use core::fmt;

use embassy_time::Duration;
use heapless::Vec;
use proto_core::config::image;
use recipe_sparkplug::document::{Document, DocumentError};
use recipe_store::{
    Adoption, Ended, Flash, Found, KeepError, MAX_REVISIONS, Marks, MountError, Newest, PutError, Revision,
    Role, Side, SlotMarks, Store, Trial, WORD, newest,
};

/// Flash that hands out the bytes of a record.
pub trait StoreFlash: Flash {
    /// The data of a record; `None` if they are no longer there.
    fn bytes(&mut self, found: Found) -> Option<&[u8]>;
}

/// The places that a board has for its store.
#[derive(Debug)]
pub struct Places<F> {
    /// The first place.
    pub first: F,
    /// The second one, if the board has slots for its firmware.
    pub second: Option<F>,
    /// The one in the bank that the program does not run from.
    pub own: Side,
}

impl<F> Places<F> {
    /// The only place of a board without slots.
    pub fn one(first: F) -> Self {
        Self { first, second: None, own: Side::First }
    }
}

/// A store and its flash.
#[derive(Debug)]
pub struct StoredConfig<F> {
    store: Store,
    /// Where it is.
    flash: F,
    /// The place for it, if it is in the wrong one.
    to: Option<F>,
}

/// Why a configuration of the store is run, for the log.
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

/// How a trial ended, for the log.
#[derive(Debug, Clone, Copy)]
pub struct EndedName(pub Ended);

impl fmt::Display for EndedName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.0 {
            Ended::Confirmed => "it was confirmed",
            Ended::NotConfirmed => "nobody confirmed it in time",
            Ended::TakenBack => "somebody took it back",
            Ended::Failed => "it could not run, or none of its starts lasted",
        })
    }
}

impl<F: StoreFlash> StoredConfig<F> {
    /// Reads the flash.
    ///
    /// # Errors
    /// There can be no store in it.
    pub fn open(places: Places<F>) -> Result<Self, MountError> {
        let Places { first, second, own } = places;
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

    /// Whether it is in the bank that the program runs from: while a sector of it is erased the program would stand
    /// still.
    pub fn is_to_be_moved(&self) -> bool {
        self.to.is_some()
    }

    /// Moves it into its own place, once.
    ///
    /// # Errors
    /// It stays where it was.
    pub async fn move_home(&mut self) -> Result<(), PutError> {
        let Some(mut to) = self.to.take() else { return Ok(()) };
        self.store = self.store.relocate().execute(&self.flash, &mut to).await?;
        self.flash = to;
        Ok(())
    }

    /// Which slots of the firmware are good and on trial.
    pub fn slots(&self) -> SlotMarks {
        self.store.slots()
    }

    /// Marks slots of the firmware.
    ///
    /// # Errors
    /// The marks cannot be written; those before count.
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

    /// What is kept.
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// Makes an image from outside the store the live one, once. Returns whether it did.
    ///
    /// # Errors
    /// It cannot be written; what was live before still is.
    pub async fn adopt(&mut self, digest: u32, image: &[u8]) -> Result<bool, KeepError> {
        let mut is_new = false;
        // An image, its mark, a note: each once. Before that, room for the image.
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

    /// The configurations to be tried, in this order. A start of the one on trial is counted before it runs: what
    /// crashes has no endless trials. If it cannot be counted, it is not tried.
    ///
    /// # Errors
    /// It could not be counted. The others are in `candidates` all the same.
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
    /// It cannot be written; the next start runs what is live.
    pub async fn begin_trial(&mut self, number: u32, confirm_s: u16) -> Result<(), KeepError> {
        let trial = Some(Trial { number, attempts: STARTS, confirm_s });
        self.mark(Marks { trial, ..self.store.marks() }).await
    }

    /// Ends the trial: the next start runs the live one.
    ///
    /// # Errors
    /// It cannot be written. The starts of a trial are counted, so it ends nevertheless.
    pub async fn end_trial(&mut self, ended: Ended) -> Result<(), KeepError> {
        let marks = self.store.marks();
        let last = marks.trial.map(|trial| (trial.number, ended)).or(marks.last);
        self.mark(Marks { trial: None, last, ..marks }).await
    }

    /// Makes a configuration the live one, and another the one before it. A trial ends with that.
    ///
    /// # Errors
    /// It cannot be written; what was live before still is.
    pub async fn make_live(&mut self, live: u32, previous: Option<u32>) -> Result<(), KeepError> {
        let marks = self.store.marks();
        let last = marks.trial.map(|trial| (trial.number, Ended::Confirmed)).or(marks.last);
        self.mark(Marks { live: Some(live), previous, trial: None, last }).await
    }

    /// Keeps a configuration, in the place of `forget` or in a free one. If there is no room beside the others, the
    /// oldest ones that no mark names are forgotten.
    ///
    /// # Errors
    /// It cannot be written.
    pub async fn keep(
        &mut self,
        number: u32,
        digest: u32,
        image: &[u8],
        forget: Option<u32>,
    ) -> Result<(), KeepError> {
        let marks = self.store.marks();
        // The mark names its place, where another one will be.
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

    /// Forgets a configuration, if the store is full: this one, or the oldest that may be.
    async fn make_room(&mut self, why: KeepError, forget: Option<u32>) -> Result<(), KeepError> {
        if !matches!(why, KeepError::Put(PutError::Full { .. })) {
            return Err(why);
        }
        let put = self.store.forget(forget)?.ok_or(why)?;
        Ok(put.execute(&mut self.flash).await?)
    }

    /// The key of the API.
    pub fn access_key(&self) -> Option<[u8; 16]> {
        self.store.access_key(&self.flash)
    }

    /// Keeps the key of the API.
    ///
    /// # Errors
    /// It cannot be written.
    pub async fn set_access_key(&mut self, key: &[u8; 16]) -> Result<(), KeepError> {
        Ok(self.store.set_access_key(key)?.execute(&mut self.flash).await?)
    }

    /// Reads the settings of the edge node into `document`. Returns whether it tells; `None` if there are none.
    pub fn edge(&mut self, document: &mut Document) -> Option<Result<bool, DocumentError>> {
        let bytes = self.flash.bytes(self.store.edge()?)?;
        Some(document.decode(bytes))
    }

    /// Keeps the settings of the edge node. If there is no room, the oldest configurations that no mark names are
    /// forgotten.
    ///
    /// # Errors
    /// They cannot be written; those before are kept.
    pub async fn set_edge(&mut self, settings: &[u8]) -> Result<(), KeepError> {
        for _ in 0..MAX_REVISIONS {
            match self.store.set_edge(settings) {
                Ok(put) => return Ok(put.execute(&mut self.flash).await?),
                Err(full) => self.make_room(full.into(), None).await?,
            }
        }
        Ok(self.store.set_edge(settings)?.execute(&mut self.flash).await?)
    }

    /// Keeps the number of the edge node's session.
    ///
    /// # Errors
    /// It cannot be written.
    pub async fn set_session(&mut self, bd_seq: u8) -> Result<(), KeepError> {
        Ok(self.store.set_birth_sequence(bd_seq)?.execute(&mut self.flash).await?)
    }

    async fn mark(&mut self, marks: Marks) -> Result<(), KeepError> {
        Ok(self.store.mark(marks)?.execute(&mut self.flash).await?)
    }

    /// Bytes of an image from `offset` on, which is a multiple of [`WORD`]: as many as there are and as `out` has
    /// room for. `None` if the configuration is not kept.
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

/// Starts that a trial has: one, and two more after power cuts.
const STARTS: u8 = 3;

/// How long a trial lasts.
pub fn trial_time(role: Role) -> Option<Duration> {
    match role {
        Role::Trial { confirm_s } => Some(Duration::from_secs(confirm_s.into())),
        Role::Live | Role::Previous => None,
    }
}

#[cfg(test)]
mod tests;
