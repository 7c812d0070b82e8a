//! A cell at work: both field buses, the controller, the watchdog, for a while.

use chip::device::{MICRO, MILLI, SECOND};
use chip::models::can_bus::Frame;
use chip::models::line::Format;

use crate::boot::CELL;
use crate::serial::{ready, word};

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn every_frame_of_both_buses_is_answered_and_arrives() {
    const FORMAT: Format = Format { baud: 115_200, odd_parity: None, stop_bits: 1 };
    const ROUNDS: u8 = 250;
    let mut bench = ready(CELL);
    for round in 1..=ROUNDS {
        let now = bench.now();
        bench.chip.devices().first.line.send(now, &[255, 255, round, 0, 7, 238, 238], FORMAT);
        bench.chip.devices().can.bus.send(now + 500 * MICRO, Frame::standard(1, &[round]));
        bench.run(20 * MILLI);
        assert_eq!(
            (word(&bench, "WordInputReg[1]"), word(&bench, "WordInputReg[4]")),
            (round.into(), round.into())
        );
    }
    let devices = bench.chip.devices();
    let line = &devices.first.line;
    assert_eq!(line.sent.len(), 7 * usize::from(ROUNDS));
    assert_eq!(line.driver.len(), 2 * usize::from(ROUNDS));
    assert!(line.sent.iter().all(|sent| sent.is_driven));
    let bus = &devices.can.bus;
    assert_eq!((bus.sent.len(), bus.heard, bus.broken_off), (ROUNDS.into(), ROUNDS.into(), 0));
    assert_eq!(devices.ethernet.dropped, 0);
    assert!(bench.chip.resets.is_empty() && bench.chip.faults.is_empty());
    assert!(bench.now() > 5 * SECOND);
    println!("{} instructions, {} interrupts", bench.chip.instructions(), bench.chip.interrupts());
}
