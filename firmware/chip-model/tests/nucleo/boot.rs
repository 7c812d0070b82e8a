//! From power-on to operation, also with each external part missing.

use recipe_chip_model::CONFIG;
use recipe_chip_model::device::{MILLI, SECOND};
use recipe_chip_model::models::gpio::Mode;

use crate::Bench;

/// One RS-485 line and CAN, a fixed address.
pub(crate) const CELL: &str = r#"
[controller]
address = "192.168.12.10"
[network]
address = "192.168.12.20/24"
[[recipe]]
name = "three-bytes"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [
    { name = "input1", type = "byte", to = "WordInputReg[1]" },
    { name = "input2", type = "byte", to = "WordInputReg[2]" },
    { name = "input3", type = "byte", to = "WordInputReg[3]" },
]
[recipe.output]
head = [255, 255]
tail = [254, 254]
send = "frame"
fields = [
    { name = "output1", type = "byte", value = 125 },
    { name = "output2", type = "byte", value = 126 },
    { name = "output3", type = "byte", value = 127 },
]
[[recipe]]
name = "can"
kind = "can"
mode = "user"
[[recipe.input.frame]]
id = 1
fields = [ { name = "cin", type = "byte", to = "WordInputReg[4]" } ]
[recipe.output]
send = "frame"
[[recipe.output.frame]]
id = 2
fields = [ { name = "cout", type = "byte", value = 77 } ]
[[port]]
name = "rs485-1"
bus = "rs485"
baud = 115200
recipe = "three-bytes"
[[port]]
name = "can-1"
bus = "can"
bitrate = 500000
recipe = "can"
"#;

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn it_boots_and_reaches_the_controller() {
    let mut bench = Bench::new(CELL).with_robot();
    bench.until_log("info: started", 10 * MILLI);
    bench.until_log("field ports", 10 * MILLI);
    let at = bench.until_log("address 192.168.12.20/24", 2 * SECOND);
    assert!(at > bench.chip.devices().ethernet.phy.negotiation, "logged before it can be reached");
    bench.until("a Modbus connection", 5 * SECOND, |bench| {
        bench.robot.as_ref().is_some_and(|robot| robot.counters().modbus.open == 1)
    });
    let clocks = bench.chip.devices().rcc.clocks();
    assert_eq!(
        (clocks.core, clocks.hclk, clocks.usart, clocks.fdcan),
        (400_000_000, 200_000_000, 100_000_000, 80_000_000)
    );
    assert!(!bench.has_logged("no 8 MHz clock"), "it runs on the external clock");
    // The MAC is set to 100 Mbit/s full duplex, so the PHY must advertise nothing else.
    assert_eq!(bench.chip.devices().ethernet.phy.advertised(), 0x0101);
    // The link's LED is on, the fault's is off.
    assert_eq!(bench.chip.devices().gpio[4].output(1), Some(true));
    assert_eq!(bench.chip.devices().gpio[1].output(14), Some(false));
    assert!(bench.chip.resets.is_empty() && bench.chip.faults.is_empty());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn only_a_chip_of_the_old_revision_reads_its_ram_one_by_one() {
    for (identity, mode) in [(0x1003_6450, 1), (0x2003_6450, 0)] {
        let mut bench = Bench::blank();
        bench.chip.devices().dbgmcu.put(0, identity);
        bench.until_log("info: started", 10 * MILLI);
        assert_eq!(bench.chip.devices().axi.get(0x108), mode, "{identity:08X}");
    }
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn two_runs_are_the_same() {
    let run = || {
        let mut bench = Bench::new(CELL).with_robot();
        bench.run(SECOND);
        (bench.chip.instructions(), bench.chip.interrupts(), bench.chip.waits, bench.chip.log.clone())
    };
    assert_eq!(run(), run());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn without_a_configuration_the_buses_stay_silent() {
    let mut bench = Bench::blank();
    bench.until_log("nothing runs: not a configuration image", SECOND);
    bench.run(12 * SECOND);
    assert_eq!(bench.times_logged("nothing runs"), 2, "the reason is logged every ten seconds");
    // Fast blinking: five a second.
    let changes = &bench.chip.devices().gpio[1].changes;
    let status =
        changes.iter().filter(|(at, pin, _)| *pin == 0 && *at > 2 * SECOND && *at <= 12 * SECOND).count();
    assert!((98..=102).contains(&status), "{status} changes in 10 s");
    assert!(bench.chip.devices().usart2.line.driver.is_empty() && bench.chip.resets.is_empty());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_torn_word_of_flash_is_told_with_its_address() {
    let mut bench = Bench::new(CELL);
    bench.chip.tear(CONFIG + 0x40).expect("the library does it");
    bench.until_log("flash at 081C0040 cannot be read", SECOND);
    bench.run(5 * SECOND);
    assert!(bench.chip.faults.is_empty() && bench.chip.resets.is_empty());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn without_the_external_clock_it_runs_on_its_own() {
    let mut bench = Bench::new(CELL).with_robot();
    bench.chip.devices().rcc.has_external = false;
    bench.until_log("no 8 MHz clock from the debugger", 100 * MILLI);
    bench.until("a Modbus connection", 5 * SECOND, |bench| {
        bench.robot.as_ref().is_some_and(|robot| robot.counters().modbus.open == 1)
    });
    assert_eq!(bench.chip.devices().rcc.clocks().core, 400_000_000);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn without_the_phy_the_field_buses_run() {
    let mut bench = Bench::new(CELL);
    bench.chip.devices().ethernet.phy.is_present = false;
    bench.until_log("no controller: no Ethernet: the PHY's identifier reads FFFF", SECOND);
    bench.run(5 * SECOND);
    assert!(bench.chip.resets.is_empty());
    assert!(bench.chip.devices().watchdog.feeds.len() >= 4);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_phy_that_answers_late_is_waited_for() {
    let mut bench = Bench::new(CELL).with_robot();
    bench.chip.devices().ethernet.phy.answers_from = 100 * MILLI;
    bench.until_log("address 192.168.12.20/24", 2 * SECOND);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn without_the_phys_clock_the_field_buses_run() {
    let mut bench = Bench::new(CELL);
    bench.chip.devices().ethernet.phy.has_clock = false;
    bench.until_log("no controller: no Ethernet: no 50 MHz clock from the PHY", SECOND);
    bench.run(5 * SECOND);
    assert!(bench.chip.resets.is_empty());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn without_a_cable_it_waits_and_takes_it_when_it_comes() {
    let mut bench = Bench::new(CELL).with_robot();
    bench.chip.devices().ethernet.phy.has_cable = false;
    bench.run(2 * SECOND);
    assert_eq!(bench.chip.devices().gpio[4].output(1), Some(false));
    assert!(bench.robot.as_ref().is_some_and(|robot| robot.frames.is_empty()));
    bench.chip.devices().ethernet.phy.has_cable = true;
    bench.until("a Modbus connection", 5 * SECOND, |bench| {
        bench.robot.as_ref().is_some_and(|robot| robot.counters().modbus.open == 1)
    });
    assert_eq!(bench.chip.devices().gpio[4].output(1), Some(true));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn the_phys_clock_stays_connected() {
    let mut bench = Bench::new(CELL);
    bench.run(100 * MILLI);
    let modes = bench.chip.devices().gpio[0].modes.iter().filter(|(_, pin, _)| *pin == 1);
    let modes: Vec<Mode> = modes.map(|(_, _, mode)| *mode).collect();
    assert_eq!(modes, [Mode::Function(11)], "PA1 in its order");
}
