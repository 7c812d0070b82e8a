//! A cell in operation for some time: both field buses, the controller, the watchdog.

use recipe_chip_model::device::{MICRO, MILLI, Picos, SECOND};
use recipe_chip_model::models::can_bus::Frame;
use recipe_chip_model::models::line::Format;

use crate::Bench;
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
        bench.chip.devices().usart2.line.send(now, &[255, 255, round, 0, 7, 238, 238], FORMAT);
        bench.chip.devices().can.bus.send(now + 500 * MICRO, Frame::standard(1, &[round]));
        bench.run(20 * MILLI);
        assert_eq!(
            (word(&bench, "WordInputReg[1]"), word(&bench, "WordInputReg[4]")),
            (round.into(), round.into())
        );
    }
    let devices = bench.chip.devices();
    let line = &devices.usart2.line;
    assert_eq!(line.sent.len(), 7 * usize::from(ROUNDS));
    assert_eq!(line.driver.len(), 2 * usize::from(ROUNDS));
    assert!(line.sent.iter().all(|sent| sent.is_driven));
    let bus = &devices.can.bus;
    assert_eq!((bus.sent.len(), bus.received, bus.aborted), (ROUNDS.into(), ROUNDS.into(), 0));
    assert_eq!(devices.ethernet.dropped, 0);
    assert!(bench.chip.resets.is_empty() && bench.chip.faults.is_empty());
    assert!(bench.now() > 5 * SECOND);
    println!("{} instructions, {} interrupts", bench.chip.instructions(), bench.chip.interrupts());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn outputs_leave_every_four_milliseconds_on_both_buses() {
    let mut bench = ready(&CELL.replace("send = \"frame\"\n", ""));
    let begin = bench.now();
    bench.run(SECOND);
    for (what, count, worst) in off_the_grid(&mut bench, begin) {
        assert!((249..=251).contains(&count), "{what}: {count} in a second");
        // The delay that another task or an interrupt may cause.
        assert!(worst < 300 * MICRO, "{what}: off by {worst:?}");
        println!("{what}: off by {worst:?} at most");
    }
}

/// Of the frames of [`CELL`] that left since `begin`, on each bus: how many, and how much the time between two was
/// off 4 ms at most.
pub(crate) fn off_the_grid(bench: &mut Bench, begin: Picos) -> [(&'static str, usize, Picos); 2] {
    let devices = bench.chip.devices();
    let frames = devices.usart2.line.sent.chunks_exact(7).map(|frame| frame[0].start);
    let lines = frames.filter(|at| *at >= begin).collect::<Vec<_>>();
    let bus = devices.can.bus.sent.iter().map(|(at, _)| *at).filter(|at| *at >= begin).collect::<Vec<_>>();
    [("RS-485", lines), ("CAN", bus)].map(|(bus, times)| {
        let off = times.windows(2).map(|pair| (pair[1] - pair[0]).abs_diff(4 * MILLI)).max();
        (bus, times.len(), off.unwrap_or(Picos::MAX))
    })
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn forces_of_a_sensor_go_up_by_udp() {
    const FORMAT: Format = Format { baud: 460_800, odd_parity: None, stop_bits: 1 };
    let gateway = include_str!("../../../../host-sim/configs/force-sensor.toml");
    let gateway = gateway.replace("127.0.0.1", "192.168.12.10");
    let gateway = format!("{gateway}\n[network]\naddress = \"192.168.12.20/24\"\n");
    let controller = include_str!("../../../../host-sim/configs/force-sensor-controller.toml");
    let mut bench = Bench::new(&gateway).with_robot_of(controller);
    bench.until_log("address", 2 * SECOND);
    bench.run(2 * SECOND);
    for round in 1..=200_u16 {
        let now = bench.now();
        let mut frame = vec![0x48, 0xAA];
        frame.extend((1..=6_u16).flat_map(|axis| (f32::from(round) + f32::from(axis) / 10.0).to_le_bytes()));
        frame.extend([0x0D, 0x0A]);
        bench.chip.devices().usart2.line.send(now, &frame, FORMAT);
        bench.run(2 * MILLI);
    }
    assert_eq!(word(&bench, "ForceEnd[1]") as f32, 200.1);
    assert_eq!(word(&bench, "ForceEnd[6]") as f32, 200.6);
    let robot = bench.robot.as_ref().expect("there is one");
    assert_eq!(robot.counters().ports["udp2011"].frames_in, 200);
    // The device is silent from here on.
    bench.run(500 * MILLI);
    assert_eq!(word(&bench, "ForceEnd[6]"), 0.0);
    assert!(!bench.has_logged("discarded"));
}
