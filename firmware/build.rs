//! Provides the board's linker script.

use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=link-slots");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("none") {
        return;
    }
    // The sources refuse two boards or none, with a better message.
    let (file, script, places) = if env::var_os("CARGO_FEATURE_BOARD_MPS2_AN500").is_some() {
        ("boards/mps2-an500/mps2-an500.x", "mps2-an500.x", &MPS2_AN500)
    } else {
        // cortex-m-rt's script, which includes memory.x.
        ("../memory.x", "link.x", &NUCLEO_H743ZI)
    };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let file = Path::new(file);
    println!("cargo::rerun-if-changed={}", file.display());
    let copy = out.join(file.file_name().expect("a file"));
    fs::copy(file, copy).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    places.place_program(&out);
    println!("cargo::rustc-link-search={}", out.display());
    println!("cargo::rustc-link-arg=-T{script}");
    if env::var_os("CARGO_FEATURE_DEFMT").is_some() {
        println!("cargo::rustc-link-arg=-Tdefmt.x");
    }
}

/// The slot to link for, a or b (docs/update.md section 2).
const SLOT: &str = "FIRMWARE_SLOT";
/// Size of a slot, and of the header before the image.
const SIZE: u32 = 640 << 10;
const HEADER: u32 = 1 << 10;

/// Addresses of programs on a board.
struct ImagePlaces {
    /// Addresses of the slots A and B. `host-sim ctl sign` compares with its own table of them.
    slots: [u32; 2],
    /// A program without a slot: its address and maximum size.
    whole: (u32, u32),
}

const NUCLEO_H743ZI: ImagePlaces =
    ImagePlaces { slots: [0x0802_0000, 0x0810_0000], whole: (0x0800_0000, 768 << 10) };
const MPS2_AN500: ImagePlaces = ImagePlaces { slots: [0x0010_0000, 0x0020_0000], whole: (0, 4 << 20) };

impl ImagePlaces {
    /// Writes program.x, which the board's script includes: for the slot of the environment, and into the folders
    /// slot-a and slot-b for each, of which link-slots makes use.
    fn place_program(&self, out: &Path) {
        println!("cargo::rerun-if-env-changed={SLOT}");
        let slot = env::var(SLOT).unwrap_or_default();
        let mut program = program(0, self.whole.0, self.whole.1);
        let mut is_known = slot.is_empty();
        for (number, (letter, start)) in (1..).zip(["a", "b"].into_iter().zip(self.slots)) {
            let in_slot = self::program(number, start + HEADER, SIZE - HEADER);
            let folder = out.join(format!("slot-{letter}"));
            fs::create_dir_all(&folder).expect("OUT_DIR can be written");
            fs::write(folder.join("program.x"), &in_slot).expect("OUT_DIR can be written");
            if slot == letter {
                program = in_slot;
                is_known = true;
            }
        }
        if !is_known {
            println!(
                "cargo::error={SLOT}={slot}: a and b are slots; without it the beginning of the flash is meant"
            );
        }
        fs::write(out.join("program.x"), program).expect("OUT_DIR can be written");
    }
}

/// Address of the program. `_slot` is 1 for slot A, 2 for slot B, 0 without a slot.
fn program(slot: u32, start: u32, length: u32) -> String {
    format!("MEMORY {{ FLASH : ORIGIN = {start:#010X}, LENGTH = {length} }}\n_slot = {slot};\n")
}
