//! RS-485: reception, transmission and timing, to the microsecond.

use proto_core::sysvar::SysVar;
use recipe_chip_model::device::{MICRO, MILLI, Picos, SECOND};
use recipe_chip_model::models::line::{Format, Sent};

use crate::Bench;
use crate::boot::CELL;

const FRAME: [u8; 7] = [255, 255, 1, 2, 3, 238, 238];
const ANSWER: [u8; 7] = [255, 255, 125, 126, 127, 254, 254];
const FORMAT: Format = Format { baud: 115_200, odd_parity: None, stop_bits: 1 };
/// Duration of a character of 10 bits.
const CHARACTER: Picos = 10 * SECOND / 115_200;

/// A bench with all links up.
pub(crate) fn ready(toml: &str) -> Bench {
    let mut bench = Bench::new(toml).with_robot();
    bench.until("a Modbus connection", 5 * SECOND, |bench| {
        bench.robot.as_ref().is_some_and(|robot| robot.counters().modbus.open == 1)
    });
    bench.run(100 * MILLI);
    bench
}

pub(crate) fn word(bench: &Bench, name: &str) -> f64 {
    let var: SysVar = name.parse().unwrap_or_else(|_| panic!("{name}"));
    bench.robot.as_ref().expect("there is a robot").controller().registers().var(var).as_f64()
}

fn bytes(sent: &[Sent]) -> Vec<u8> {
    sent.iter().map(|sent| sent.byte).collect()
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_frame_goes_up_to_the_controller_and_is_answered() {
    let mut bench = ready(CELL);
    let now = bench.now();
    let ended = bench.chip.devices().usart2.line.send(now, &FRAME, FORMAT);
    bench.until("the values at the controller", SECOND, |bench| word(bench, "WordInputReg[3]") == 3.0);
    assert_eq!([word(&bench, "WordInputReg[1]"), word(&bench, "WordInputReg[2]")], [1.0, 2.0]);
    assert!(bench.now() - ended < 5 * MILLI, "{} us", (bench.now() - ended) / MICRO);
    bench.run(10 * MILLI);
    let sent = bench.chip.devices().usart2.line.sent.clone();
    assert_eq!(bytes(&sent), ANSWER);
    assert!(sent.iter().all(|sent| sent.is_driven));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn the_driver_is_on_for_the_answer_and_half_a_bit_more() {
    let mut bench = ready(CELL);
    let now = bench.now();
    let ended = bench.chip.devices().usart2.line.send(now, &FRAME, FORMAT);
    bench.run(10 * MILLI);
    let line = &bench.chip.devices().usart2.line;
    let (first, last) = (line.sent[0], line.sent[6]);
    // 100 MHz divided by 868.
    assert_eq!(first.bit, 8_680_000);
    assert_eq!(line.driver, [(first.start - first.bit / 2, true), (last.end + last.bit / 2, false)]);
    assert_eq!(last.end - first.start, 7 * 10 * first.bit);
    // The line is idle one character after the middle of the last stop bit. From then on there are 100 us of
    // turnaround, and the time of the program.
    let waited = first.start - ended;
    let least = CHARACTER - first.bit / 2 + 100 * MICRO;
    assert!((least..least + 60 * MICRO).contains(&waited), "{} us", waited / MICRO);
}

/// The second line, with another baud rate and format.
const SECOND_LINE: &str = r#"
[[recipe]]
name = "other"
kind = "stream"
mode = "user"
[recipe.input]
head = [170]
tail = [85]
fields = [ { name = "a", type = "byte", to = "WordInputReg[8]" } ]
[recipe.output]
head = [171]
tail = [84]
send = "frame"
fields = [ { name = "b", type = "byte", value = 7 } ]
[[port]]
name = "rs485-2"
bus = "rs485"
baud = 9600
parity = "even"
stop_bits = 2
recipe = "other"
timeout_ms = 1000
"#;

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn characters_with_errors_are_left_out_and_counted() {
    let mut bench = ready(&format!("{CELL}{SECOND_LINE}"));
    let format = Format { baud: 9_600, odd_parity: Some(false), stop_bits: 2 };
    let wrong = Format { odd_parity: Some(true), ..format };
    let now = bench.now();
    let line = &mut bench.chip.devices().uart7.line;
    // Characters with a wrong parity among those of a frame.
    let mut at = line.send(now, &[170], format);
    at = line.send(at, &[99, 98], wrong);
    at = line.send(at, &[42, 85], format);
    bench.run(at - now + 10 * MILLI);
    assert_eq!(word(&bench, "WordInputReg[8]"), 42.0);
    let line = &bench.chip.devices().uart7.line;
    assert_eq!(bytes(&line.sent), [171, 7, 84]);
    assert!(line.sent.iter().all(|sent| sent.stop_bits == 2));
    assert_eq!(
        line.sent.iter().map(|sent| sent.parity).collect::<Vec<_>>(),
        [Some(true), Some(true), Some(true)]
    );
    bench.until_log("parity 2, framing 0; overruns 0", 3 * SECOND);
    // A missing stop bit: the line is held low.
    let now = bench.now();
    let line = &mut bench.chip.devices().uart7.line;
    at = line.put(now, SECOND / 9_600, &[false; 12]);
    at = line.send(at + MILLI, &[170, 43, 85], format);
    bench.run(at - now + 10 * MILLI);
    assert_eq!(word(&bench, "WordInputReg[8]"), 43.0);
    bench.until_log("parity 2, framing 1; overruns 0", 3 * SECOND);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_device_at_another_speed_is_noticed_and_not_believed() {
    let mut bench = ready(CELL);
    let format = Format { baud: 57_600, ..FORMAT };
    let now = bench.now();
    bench.chip.devices().usart2.line.send(now, &FRAME, format);
    bench.until_log("framing", 3 * SECOND);
    assert_eq!(word(&bench, "WordInputReg[3]"), 0.0);
    assert!(bench.chip.devices().usart2.line.sent.is_empty());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_fast_line_without_pauses_loses_nothing() {
    let mut bench = ready(&CELL.replace("baud = 115200", "baud = 460800"));
    let format = Format { baud: 460_800, ..FORMAT };
    let mut at = bench.now();
    let begin = at;
    for round in 0..200_u32 {
        let frame = [255, 255, 1, 2, (round % 200) as u8, 238, 238];
        at = bench.chip.devices().usart2.line.send(at, &frame, format);
    }
    bench.run(at - begin + 50 * MILLI);
    assert_eq!(word(&bench, "WordInputReg[3]"), 199.0);
    assert!(!bench.has_logged("characters discarded"), "{}", bench.history());
}
