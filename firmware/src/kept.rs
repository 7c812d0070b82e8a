//! The configuration that runs after a start, from the store (docs/store.md).
//!
//! In: the store's flash, and the image that a probe or a file left outside the store. Out: the images to be
//! tried, in their order. What is written on the way is finished before anything runs, so a start that is cut
//! short is repeated, and changes nothing twice.

use core::fmt;

use embassy_time::Duration;
use heapless::Vec;
use recipe_store::{Adoption, Flash, Found, KeepError, Marks, MountError, Revision, Role, Store};

/// Flash that hands out the bytes of a record.
pub trait StoreFlash: Flash {
    /// The data of a record; `None` if they are no longer there.
    fn bytes(&mut self, found: Found) -> Option<&[u8]>;
}

/// A store and its flash.
#[derive(Debug)]
pub struct Kept<F> {
    store: Store,
    flash: F,
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

impl<F: StoreFlash> Kept<F> {
    /// Reads the flash.
    ///
    /// # Errors
    /// There can be no store in it.
    pub fn open(flash: F) -> Result<Self, MountError> {
        Ok(Self { store: Store::mount(&flash)?, flash })
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
        // An image, its mark, a note: each once.
        for _ in 0..4 {
            match self.store.adopt(digest, image)? {
                Adoption::Write(put) => put.carry_out(&mut self.flash).await?,
                Adoption::Done => break,
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

    /// Ends the trial: the next start runs the live one.
    ///
    /// # Errors
    /// It cannot be written. The starts of a trial are counted, so it ends nevertheless.
    pub async fn end_trial(&mut self) -> Result<(), KeepError> {
        self.mark(Marks { trial: None, ..self.store.marks() }).await
    }

    async fn mark(&mut self, marks: Marks) -> Result<(), KeepError> {
        Ok(self.store.mark(marks)?.carry_out(&mut self.flash).await?)
    }

    /// The image of a configuration.
    pub fn image(&mut self, revision: Revision) -> Option<&[u8]> {
        self.flash.bytes(self.store.find(revision.key())?)
    }
}

/// How long a trial lasts.
pub fn trial_time(role: Role) -> Option<Duration> {
    match role {
        Role::Trial { confirm_s } => Some(Duration::from_secs(confirm_s.into())),
        Role::Live | Role::Previous => None,
    }
}

#[cfg(test)]
mod tests;
