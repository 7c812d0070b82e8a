//! CAN: frames, a bus without other nodes, and a short circuit.

use recipe_chip_model::device::{MICRO, MILLI, SECOND};
use recipe_chip_model::models::can_bus::{BusFault, Frame};

use crate::Bench;
use crate::boot::CELL;
use crate::serial::{ready, word};

fn send(bench: &mut Bench, frame: Frame) {
    // Its end, if it begins now.
    let at = bench.now() + 200 * MICRO;
    bench.chip.devices().can.bus.send(at, frame);
}

fn sent(bench: &mut Bench) -> usize {
    bench.chip.devices().can.bus.sent.len()
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_frame_goes_up_to_the_controller_and_is_answered() {
    let mut bench = ready(CELL);
    bench.chip.devices().can.bus.bitrate = 500_000;
    send(&mut bench, Frame::standard(1, &[42]));
    bench.until("the value at the controller", SECOND, |bench| word(bench, "WordInputReg[4]") == 42.0);
    bench.run(10 * MILLI);
    let bus = &bench.chip.devices().can.bus;
    let frames: Vec<Frame> = bus.sent.iter().map(|(_, frame)| *frame).collect();
    assert_eq!(frames, [Frame::standard(2, &[77])]);
    assert_eq!((bus.received, bus.missed, bus.attempts), (1, 0, 1));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn what_no_filter_names_is_acknowledged_and_not_looked_at() {
    let mut bench = ready(CELL);
    for id in (0..0x7FF).filter(|id| *id != 1).step_by(7) {
        send(&mut bench, Frame::standard(id, &[9]));
        send(&mut bench, Frame { is_extended: true, ..Frame::standard(id, &[9]) });
        bench.run(MILLI);
    }
    // An extended id with the same number is another id.
    send(&mut bench, Frame { is_extended: true, ..Frame::standard(1, &[9]) });
    bench.run(20 * MILLI);
    assert_eq!((word(&bench, "WordInputReg[4]"), sent(&mut bench)), (0.0, 0));
    let bus = &bench.chip.devices().can.bus;
    assert_eq!((bus.accepted, bus.missed), (0, 0));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn alone_on_the_bus_it_says_so_and_sends_again_when_somebody_comes() {
    let mut bench = ready(CELL);
    send(&mut bench, Frame::standard(1, &[1]));
    bench.chip.devices().can.bus.fault = BusFault::NoAcknowledge;
    bench.until_log("error-passive", SECOND);
    bench.until_log("frames are not acknowledged by any node; transmit errors 128", SECOND);
    assert_eq!((sent(&mut bench), bench.chip.devices().can.bus.bus_offs.len()), (0, 0));
    bench.chip.devices().can.bus.fault = BusFault::None;
    bench.run(SECOND);
    assert_eq!(sent(&mut bench), 0, "what waited is old and was dropped");
    send(&mut bench, Frame::standard(1, &[2]));
    bench.until("an answer", 100 * MILLI, |bench| sent(bench) == 1);
    assert_eq!(word(&bench, "WordInputReg[4]"), 2.0);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_short_circuit_ends_in_bus_off_and_each_pause_is_longer() {
    let mut bench = ready(CELL);
    send(&mut bench, Frame::standard(1, &[1]));
    bench.run(150 * MICRO);
    bench.chip.devices().can.bus.fault = BusFault::ShortCircuit;
    let first = bench.until_log("bus-off; restart in 100 ms", SECOND);
    bench.run(50 * MILLI);
    let offs = &bench.chip.devices().can.bus.bus_offs;
    assert_eq!(offs.len(), 1);
    assert!(first - offs[0] < 5 * MILLI, "told {} us later", (first - offs[0]) / MICRO);
    // The short circuit persists when it sends again.
    bench.until_log("error-active", SECOND);
    assert!(bench.now() - first >= 100 * MILLI);
    send(&mut bench, Frame::standard(1, &[2]));
    bench.until_log("bus-off; restart in 200 ms", SECOND);
    bench.chip.devices().can.bus.fault = BusFault::None;
    bench.until_log("error-active", SECOND);
    let before = sent(&mut bench);
    send(&mut bench, Frame::standard(1, &[3]));
    bench.until("an answer", 100 * MILLI, |bench| sent(bench) == before + 1);
    assert_eq!(word(&bench, "WordInputReg[4]"), 3.0);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_burst_as_long_as_the_fifo_is_taken_whole() {
    let mut bench = ready(CELL);
    let begin = bench.now();
    // Back-to-back frames of 1 byte.
    for number in 1..=64_u64 {
        let frame = Frame::standard(1, &[number as u8]);
        bench.chip.devices().can.bus.send(begin + number * 110 * MICRO, frame);
    }
    bench.run(50 * MILLI);
    assert_eq!(bench.chip.devices().can.bus.received, 64);
    assert_eq!((word(&bench, "WordInputReg[4]"), sent(&mut bench) > 0), (64.0, true));
    assert!(!bench.has_logged("frames were lost"));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_late_access_to_the_message_ram_is_cured_like_bus_off() {
    let mut bench = ready(CELL);
    bench.chip.devices().can.fail_message_ram();
    bench.until_log("bus-off; restart in 100 ms", SECOND);
    bench.run(SECOND);
    send(&mut bench, Frame::standard(1, &[5]));
    bench.until("an answer", 100 * MILLI, |bench| sent(bench) == 1);
}
