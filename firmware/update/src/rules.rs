//! Rules for updates, checked before anything is erased, and for configurations stored during a trial.

use core::fmt;

use recipe_store::{Slot, SlotMarks};

use crate::SlotFlash;
use crate::check::{BadImage, fits};
use crate::header::{BoardName, Formats, Header, Version};

/// The firmware that receives an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RunningFirmware {
    /// Board that it runs on.
    pub board: BoardName,
    /// The slot it runs in.
    pub slot: Slot,
    /// Version of the running firmware.
    pub version: Version,
    /// The oldest and the newest version of the configuration images that may have to run after the update: the live
    /// one, the previous one, and the one on trial. `None` if there is none.
    pub kept: Option<(u32, u32)>,
}

/// Whether an older firmware is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Downgrade {
    /// Refuse it.
    Refused,
    /// Accept it, because it was requested explicitly.
    Allowed,
}

/// Why an update may not be installed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum UpdateRefused {
    /// It cannot run in the free slot of this board.
    Bad(BadImage),
    /// It is older than the running firmware.
    Older {
        /// Version of the update.
        offered: Version,
        /// Version of the running firmware.
        running: Version,
    },
    /// It cannot read the configurations of this board.
    Format {
        /// Version of a stored configuration.
        kept: u32,
        /// Versions that the update reads.
        reads: Formats,
    },
    /// It cannot read the store of this board.
    Store {
        /// The version that it reads.
        offered: u32,
    },
    /// A firmware is on trial: the other slot is needed to fall back.
    OnTrial,
    /// The running slot is not marked as the good one. There is no loader, or something went wrong.
    NotGood,
}

impl fmt::Display for UpdateRefused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bad(bad) => bad.fmt(f),
            Self::Older { offered, running } => {
                write!(
                    f,
                    "the firmware {offered} is older than the one that runs, {running}; a downgrade has to be asked for"
                )
            }
            Self::Format { kept, reads: Formats { oldest, newest, .. } } => write!(
                f,
                "a configuration of this board has version {kept}; the firmware reads {oldest} to {newest}"
            ),
            Self::Store { offered } => write!(
                f,
                "the firmware keeps a store of version {offered}; the one of this board has version {}",
                recipe_store::VERSION
            ),
            Self::OnTrial => f.write_str("a firmware is on trial; confirm it or take it back first"),
            Self::NotGood => f.write_str("the running firmware is not marked as the good one"),
        }
    }
}

impl core::error::Error for UpdateRefused {}

impl RunningFirmware {
    /// Checks that an update may be written to the free slot.
    pub fn accepts(
        &self,
        header: &Header,
        flash: &impl SlotFlash,
        marks: SlotMarks,
        downgrade: Downgrade,
    ) -> Result<(), UpdateRefused> {
        if marks.trial.is_some() {
            return Err(UpdateRefused::OnTrial);
        }
        if marks.good != Some(self.slot) {
            return Err(UpdateRefused::NotGood);
        }
        fits(header, flash, self.slot.other(), &self.board).map_err(UpdateRefused::Bad)?;
        let (offered, running) = (header.version(), self.version);
        if offered < running && downgrade == Downgrade::Refused {
            return Err(UpdateRefused::Older { offered, running });
        }
        // Also checked for a requested downgrade: without a configuration the buses would be silent.
        let reads = header.parts().formats;
        if let Some((oldest, newest)) = self.kept {
            for kept in [oldest, newest] {
                if !reads.reads(kept) {
                    return Err(UpdateRefused::Format { kept, reads });
                }
            }
        }
        let offered = header.parts().store;
        if offered != recipe_store::VERSION {
            return Err(UpdateRefused::Store { offered });
        }
        Ok(())
    }
}

/// Whether a configuration image of this version may be stored. During a trial the previous firmware must be able to
/// read it too, or falling back would leave the board without its configuration.
pub fn may_keep(version: u32, running: &Formats, before: Option<&Formats>, marks: SlotMarks) -> bool {
    let is_read_before = before.is_none_or(|before| before.reads(version));
    running.reads(version) && (marks.trial.is_none() || is_read_before)
}
