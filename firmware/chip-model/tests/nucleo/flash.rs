//! Programming flash: the firmware does not do it, so a few instructions replace its `main`.

use recipe_chip_model::device::{MICRO, MILLI};

use crate::Bench;

const SECTOR: u32 = 0x081E_0000;
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
/// Words of 64 bits, programming or not.
const PROGRAMMING: u32 = 0x32;
const READING: u32 = 0x30;

/// Unlocks the second bank, sets its control register, and writes a flash word full of the second key.
fn program(bench: &mut Bench, control: u32) {
    const KEYR2: u32 = 0x5200_2104;
    let main = bench.chip.program().symbol("main").expect("the program begins") & !1;
    let start = (main + 3) & !3;
    // ldr Rt, [pc, #..] of the numbered literal (Armv7-M ARM A7.7.44).
    let mut code: Vec<u16> = Vec::new();
    let load = |code: &mut Vec<u16>, register: u16, literal: usize| {
        let pc = (2 * code.len() + 4) & !3;
        code.push(0x4800 | register << 8 | ((36 + 4 * literal - pc) / 4) as u16);
    };
    load(&mut code, 0, 0);
    load(&mut code, 1, 1);
    load(&mut code, 2, 2);
    // str r1, [r0]; str r2, [r0]
    code.extend([0x6001, 0x6002]);
    load(&mut code, 1, 3);
    // str r1, [r0, #8]
    code.push(0x6081);
    load(&mut code, 3, 4);
    // str r2, [r3, #..], eight times; b .; nop
    code.extend((0..8).map(|word| 0x601A | word << 6));
    code.extend([0xE7FE, 0xBF00]);
    let mut bytes: Vec<u8> = code.iter().flat_map(|half| half.to_le_bytes()).collect();
    assert_eq!(bytes.len(), 36);
    bytes.extend([KEYR2, KEYS[0], KEYS[1], control, SECTOR].iter().flat_map(|word| word.to_le_bytes()));
    bench.chip.patch(main, &[0x00, 0xBF]);
    bench.chip.patch(start, &bytes);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_flash_word_is_there_when_its_bank_is_no_longer_busy() {
    let mut bench = Bench::blank();
    program(&mut bench, PROGRAMMING);
    // The code before `main` takes longer the more memory it clears.
    let mut waited = 0;
    while bench.chip.engine().word(SECTOR) == u32::MAX {
        assert!(waited < 10 * MILLI, "nothing is written");
        bench.run(10 * MICRO);
        waited += 10 * MICRO;
    }
    assert_eq!(
        [0, 4, 28, 32].map(|offset| bench.chip.engine().word(SECTOR + offset)),
        [KEYS[1], KEYS[1], KEYS[1], u32::MAX]
    );
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
#[should_panic(expected = "flash is written while PG is 0")]
fn a_write_without_leave_ends_the_run() {
    let mut bench = Bench::blank();
    program(&mut bench, READING);
    bench.run(10 * MILLI);
}
