//! NUCLEOs, on their modelled chips in real time (docs/chip.md section 5).

use std::path::{Path, PathBuf};

use recipe_ctl::Slot;
use recipe_test_kit::{Process, chip};
use serde_json::Value;

use super::releases::Built;
use super::{Slotted, gets_another_firmware};
use crate::board::{Board, Surroundings};
use crate::nucleo::{control, emulate};
use crate::target::Target;

/// On RS-485 A its panel.
struct Nucleo {
    around: Surroundings,
    /// What a probe has written into slot A.
    slot_a: PathBuf,
    chip: Option<Process>,
}

impl Nucleo {
    fn control(&self) -> PathBuf {
        control(&self.around)
    }
}

impl Board for Nucleo {
    fn around(&self) -> &Surroundings {
        &self.around
    }

    fn around_mut(&mut self) -> &mut Surroundings {
        &mut self.around
    }

    fn start(&mut self, file: &Path) {
        let mut more = vec!["--load".into(), format!("0x08020000={}", self.slot_a.display()).into()];
        for slot in [Slot::A, Slot::B] {
            more.extend(["--knows".into(), Self::BUILT.program(slot).into()]);
        }
        self.chip = Some(emulate(&self.around, &Surroundings::named("CHIP_LOADER"), file, &more));
    }

    fn press(&self) {
        chip::command(&self.control(), "press 200");
    }

    fn kill(&mut self) {
        chip::command(&self.control(), "power");
    }

    fn short_trial_s(&self) -> u32 {
        60
    }
}

impl Slotted for Nucleo {
    const BUILT: Built = Built {
        board: "nucleo-h743zi",
        images: [(Slot::A, 0x0802_0400), (Slot::B, 0x0810_0400)],
        variables: "CHIP",
    };

    fn new(slot_a: &Path) -> Self {
        Self { around: Surroundings::new(), slot_a: slot_a.to_owned(), chip: None }
    }

    fn restarts(&self) -> u64 {
        let figures: Value = serde_json::from_str(&chip::request(&self.control(), "figures")).unwrap();
        figures["restarts"].as_u64().unwrap()
    }
}

impl Drop for Nucleo {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let log = self.chip.as_ref().map_or_else(String::new, |chip| chip.lines().join("\n"));
            eprintln!("the log of a board:\n{log}");
        }
        self.pull();
    }
}

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A, CHIP_SLOT_B and qemu-system-arm"]
fn a_plant_of_nucleos_gets_another_firmware() {
    gets_another_firmware::<Nucleo>();
}
