//! The driver with the model of the USARTs that the board's binary is tested on.

use core::future::Future;
use core::pin::pin;
use core::task::Context;
use std::boxed::Box;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Wake, Waker};
use std::vec;
use std::vec::Vec;

use proto_core::time::Duration as CoreDuration;
use recipe_chip_model::device::{Clocks, Picos, Pin, SECOND};
use recipe_chip_model::models::line::{Format, Line as Wires, Sent};
use recipe_chip_model::models::usart::{Pins, Usart as Chip};

use super::*;
use crate::drivers::test_chip::TestDevice;

const CLOCK: u32 = 100_000_000;

type Model = Rc<TestDevice<Chip>>;

impl UsartBlock for Model {
    fn read(&self, offset: u8) -> u32 {
        TestDevice::read(self, offset.into())
    }

    fn write(&self, offset: u8, value: u32) {
        TestDevice::write(self, offset.into(), value);
    }
}

#[derive(Default)]
struct Wakes(AtomicUsize);

impl Wake for Wakes {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

struct UsartBench {
    model: Model,
    line: Usart<Model>,
    wakes: Arc<Wakes>,
    /// The format of other devices.
    format: Format,
}

fn settings(baud: u32, parity: Parity, stop_bits: u8) -> Rs485 {
    Rs485 {
        baud,
        parity,
        stop_bits,
        idle_gap: CoreDuration::ZERO,
        turnaround: CoreDuration::ZERO,
        echo: proto_core::config::Echo::No,
    }
}

impl UsartBench {
    fn start(line: Rs485) -> Self {
        let [tx, rx, de] = [Pin('D', 5), Pin('D', 6), Pin('D', 4)];
        let clocks = Clocks { usart: CLOCK, ..Clocks::default() };
        let model = TestDevice::new(Chip::new(Pins { tx, rx, de, function: 7 }), clocks, &[tx, rx, de], 7);
        let shared = &*Box::leak(Box::new(UsartShared::new()));
        let odd_parity = match line.parity {
            Parity::None => None,
            parity => Some(parity == Parity::Odd),
        };
        let format = Format { baud: line.baud, odd_parity, stop_bits: line.stop_bits };
        let line = Usart::start(Rc::clone(&model), shared, &line, CLOCK).unwrap();
        Self { model, line, wakes: Arc::default(), format }
    }

    fn new() -> Self {
        Self::start(settings(460_800, Parity::None, 1))
    }

    fn get(&self, register: u8) -> u32 {
        UsartBlock::read(&self.model, register)
    }

    /// Direct access to the line.
    fn wires<T>(&self, f: impl FnOnce(&mut Wires) -> T) -> T {
        self.model.with(|usart| f(&mut usart.line))
    }

    /// Handles pending interrupts; returns their number.
    fn interrupts(&self) -> usize {
        let mut count = 0;
        while self.model.interrupt_line() {
            count += 1;
            assert!(count < 10, "the interrupt comes again for ever");
            Usart::interrupt(&self.model, self.line.shared);
        }
        count
    }

    /// Advances time and handles interrupts.
    #[track_caller]
    fn pass_until(&self, end: Picos) {
        while self.model.hop(end) {
            self.interrupts();
        }
        self.interrupts();
    }

    /// A sixteenth of a bit of other devices.
    fn bit(&self) -> Picos {
        SECOND / Picos::from(self.format.baud) / 16 * 16
    }

    /// Duration of a character.
    fn character(&self) -> Picos {
        Picos::from(9 + u8::from(self.format.odd_parity.is_some()) + self.format.stop_bits) * self.bit()
    }

    /// Another device sends; returns after its last stop bit.
    fn arrive(&self, bytes: impl IntoIterator<Item = u8>) {
        for byte in bytes {
            self.pass_until(self.wires(|line| line.send(self.model.now(), &[byte], self.format)));
        }
    }

    /// The same with interrupts disabled, with these errors.
    fn damaged(&self, byte: u8, errors: u32) {
        let mut bits = vec![false];
        bits.extend((0..8).map(|index| byte >> index & 1 != 0));
        let even = byte.count_ones().is_multiple_of(2);
        bits.extend(self.format.odd_parity.map(|is_odd| (even == is_odd) != (errors & PARITY_ERROR != 0)));
        bits.extend([errors & FRAMING_ERROR == 0, true]);
        let mut parts: Vec<bool> = bits.into_iter().flat_map(|bit| [bit; 16]).collect();
        if errors & NOISE != 0 {
            // In the middle of a bit, shorter than two samples.
            parts[3 * 16 + 8] ^= true;
        }
        let now = self.model.now();
        self.model.pass(self.wires(|line| line.put(now, self.bit() / 16, &parts)) - now);
    }

    /// One character of it.
    fn silence(&self) {
        self.pass_until(self.model.now() + self.character());
    }

    fn sent(&self) -> Vec<Sent> {
        self.wires(|line| line.sent.clone())
    }

    /// One character leaves, if one does within the time of three.
    fn leave(&self) -> bool {
        let (before, end) = (self.sent().len(), self.model.now() + 3 * self.character());
        loop {
            let is_over = !self.model.hop(end);
            self.interrupts();
            if self.sent().len() > before || is_over {
                return self.sent().len() > before;
            }
        }
    }

    fn poll<T>(waker: &Arc<Wakes>, future: impl Future<Output = Result<T, Infallible>>) -> Option<T> {
        let waker = Waker::from(Arc::clone(waker));
        match pin!(future).poll(&mut Context::from_waker(&waker)) {
            Poll::Ready(result) => result.ok(),
            Poll::Pending => None,
        }
    }

    fn read(&mut self) -> Vec<u8> {
        let mut buf = [0; 256];
        let len = Self::poll(&self.wakes, self.line.read(&mut buf)).unwrap_or(0);
        buf[..len].to_vec()
    }

    fn write(&mut self, bytes: &[u8]) -> Option<usize> {
        Self::poll(&self.wakes, self.line.write(bytes))
    }

    fn is_flushed(&mut self) -> bool {
        Self::poll(&self.wakes, self.line.flush()).is_some()
    }

    fn wakes(&self) -> usize {
        self.wakes.0.load(Ordering::Relaxed)
    }
}

#[test]
fn speed_parity_and_stop_bits_are_the_configurations() {
    for (line, divider, prescaler, cr1, cr2) in [
        (settings(460_800, Parity::None, 1), 217, 0, 0, 0),
        (settings(115_200, Parity::Even, 1), 868, 0, CR1_NINE_BITS | CR1_PARITY, 0),
        (settings(9_600, Parity::Odd, 2), 10_417, 0, CR1_NINE_BITS | CR1_PARITY | CR1_ODD, 2 << 12),
        (settings(1_200, Parity::None, 2), 41_667, 1, 0, 2 << 12),
        (settings(4_000_000, Parity::None, 1), 25, 0, 0, 0),
    ] {
        let mut bench = UsartBench::start(line);
        assert_eq!((bench.get(BRR), bench.get(PRESC)), (divider, prescaler), "{} baud", line.baud);
        assert_eq!(bench.get(CR1) & (CR1_NINE_BITS | CR1_PARITY | CR1_ODD), cr1);
        assert_eq!(bench.get(CR2), cr2);
        let on = CR1_ENABLE | CR1_TX | CR1_RX | CR1_FIFO;
        assert_eq!(bench.get(CR1) & on, on);
        assert_ne!(bench.get(CR3) & CR3_DRIVER_ENABLE, 0);
        // On the line: five ones in eight bits.
        assert_eq!(bench.write(&[0xA7]), Some(1));
        assert!(bench.leave());
        let [sent] = bench.sent()[..] else { panic!("one character") };
        let bit = u64::from(divider * PRESCALERS[prescaler as usize]) * SECOND / u64::from(CLOCK);
        let parity = [None, Some(true), Some(false)][line.parity as usize];
        let bits = 9 + u64::from(parity.is_some()) + u64::from(line.stop_bits);
        let (start, stop_bits) = (sent.start, line.stop_bits);
        let expected =
            Sent { byte: 0xA7, start, end: start + bits * bit, bit, parity, stop_bits, is_driven: true };
        assert_eq!(sent, expected, "{} baud", line.baud);
        assert!(!bench.leave());
        bench.arrive([0x5C, 0xA7]);
        bench.silence();
        assert_eq!(bench.read(), [0x5C, 0xA7]);
        assert_eq!(bench.line.errors(), LineErrors::NONE);
    }
}

#[test]
fn every_speed_that_a_file_can_have_is_within_two_per_cent_or_refused() {
    for baud in (1_200..=4_000_000).step_by(997) {
        match Speed::of(baud, CLOCK) {
            Ok(Speed { prescaler, divider }) => {
                let made = CLOCK / PRESCALERS[prescaler as usize] / divider;
                assert!(made.abs_diff(baud) <= baud / 100, "{baud}: {made}");
                assert!((16..=0xFFFF).contains(&divider));
            }
            Err(error) => {
                assert_eq!(error, BaudError { baud, clock: CLOCK });
                assert!(baud > 1_000_000, "{baud} should be possible");
            }
        }
    }
    assert!(Speed::of(0, CLOCK).is_err());
    assert!(Speed::of(115_200, 0).is_err());
}

#[test]
fn a_frame_of_any_length_is_there_after_one_character_of_silence() {
    let mut bench = UsartBench::new();
    for len in 1..=60 {
        assert!(bench.read().is_empty());
        let wakes = bench.wakes();
        let frame: Vec<u8> = (0..len).collect();
        bench.arrive(frame.iter().copied());
        bench.silence();
        assert!(bench.wakes() > wakes, "{len} bytes wake nobody");
        assert_eq!(bench.read(), frame);
    }
    assert_eq!(bench.line.errors(), LineErrors::NONE);
}

#[test]
fn a_line_that_never_falls_silent_wakes_its_reader_each_quarter_of_the_fifo() {
    let mut bench = UsartBench::new();
    for _ in 0..8 {
        assert!(bench.read().is_empty());
        let wakes = bench.wakes();
        bench.arrive(0..3);
        assert_eq!(bench.wakes(), wakes);
        bench.arrive([3]);
        assert!(bench.wakes() > wakes);
        assert_eq!(bench.read(), [0, 1, 2, 3]);
    }
}

#[test]
fn whoever_reads_has_what_interrupted_nobody_yet() {
    let mut bench = UsartBench::new();
    bench.arrive(0..7);
    assert_eq!(bench.read(), [0, 1, 2, 3, 4, 5, 6]);
    bench.arrive(7..9);
    assert_eq!(bench.read(), [7, 8]);
    bench.silence();
    assert!(bench.read().is_empty());
    bench.arrive(9..14);
    bench.silence();
    assert_eq!(bench.read(), [9, 10, 11, 12, 13]);
}

#[test]
fn a_character_with_an_error_is_left_out_by_itself() {
    let mut bench = UsartBench::start(settings(115_200, Parity::Even, 1));
    let noise = FRAMING_ERROR | PARITY_ERROR | NOISE;
    for (byte, errors) in [(1, 0), (2, PARITY_ERROR), (3, 0), (4, noise), (5, NOISE), (6, 0)] {
        bench.damaged(byte, errors);
    }
    bench.silence();
    // Noise that leaves a majority is no error.
    assert_eq!(bench.read(), [1, 3, 5, 6]);
    let errors = LineErrors { parity: 1, framing: 1, ..LineErrors::NONE };
    assert_eq!(bench.line.errors(), errors);
    // It was there.
    bench.damaged(7, NOISE);
    assert_ne!(bench.get(ISR) & NOISE, 0);
}

#[test]
fn garbage_without_end_does_not_stop_what_is_behind_it() {
    let mut bench = UsartBench::new();
    for _ in 0..1_000 {
        bench.damaged(0, FRAMING_ERROR);
        bench.interrupts();
    }
    bench.arrive([7, 8]);
    bench.silence();
    assert_eq!(bench.read(), [7, 8]);
    assert_eq!(bench.line.errors().framing, 1_000);
}

#[test]
fn an_overrun_is_counted_and_reception_goes_on() {
    let mut bench = UsartBench::new();
    // Interrupts are disabled for 20 characters.
    (0..20).for_each(|byte| bench.damaged(byte, 0));
    bench.interrupts();
    bench.arrive([100]);
    bench.silence();
    let expected: Vec<u8> = (0..16).chain([100]).collect();
    assert_eq!(bench.read(), expected);
    assert_eq!(bench.line.errors().overruns, 1);
}

#[test]
fn nobody_reads_and_the_newest_is_lost_and_counted() {
    let mut bench = UsartBench::new();
    bench.arrive((0..RX_RING + 12).map(|n| n as u8));
    bench.silence();
    assert_eq!(bench.line.errors().unread, 12);
    let all: Vec<u8> =
        core::iter::from_fn(|| Some(bench.read()).filter(|part| !part.is_empty())).flatten().collect();
    assert!(all.into_iter().eq((0..RX_RING).map(|n| n as u8)));
}

#[test]
fn a_frame_longer_than_everything_leaves_whole_and_without_a_gap() {
    let mut bench = UsartBench::new();
    let frame: Vec<u8> = (0..1_500_u32).map(|n| (n / 3) as u8).collect();
    let mut rest = &frame[..];
    while !rest.is_empty() {
        if let Some(len) = bench.write(rest) {
            rest = &rest[len..];
            continue;
        }
        let wakes = bench.wakes();
        while bench.wakes() == wakes {
            assert!(bench.leave(), "the line fell silent inside a frame");
        }
    }
    // Queued characters follow without a gap.
    while !bench.is_flushed() {
        assert!(bench.leave(), "nobody is woken at the end");
    }
    let sent = bench.sent();
    assert!(sent.iter().map(|sent| sent.byte).eq(frame));
    assert!(sent.iter().all(|sent| sent.is_driven));
    assert!(sent.windows(2).all(|pair| pair[0].end == pair[1].start), "a gap");
}

#[test]
fn flushed_is_when_the_last_character_has_left_and_who_waits_is_woken() {
    let mut bench = UsartBench::new();
    // Nothing to flush.
    assert!(bench.is_flushed());
    for frame in [&[1][..], &[2, 3], &[4; 17], &[5; 40]] {
        assert_eq!(bench.write(frame), Some(frame.len()));
        for left in 0..frame.len() {
            assert!(!bench.is_flushed(), "{left} of {} have left", frame.len());
            let wakes = bench.wakes();
            assert!(bench.leave());
            assert!(left + 1 < frame.len() || bench.wakes() > wakes, "nobody is woken at the end");
        }
        assert!(bench.is_flushed());
        assert!(!bench.leave());
        // Driver-enable: half a bit before and after.
        let sent = bench.sent();
        let (first, last) = (sent[sent.len() - frame.len()], sent[sent.len() - 1]);
        let edges = bench.wires(|line| line.driver[line.driver.len() - 2..].to_vec());
        let half = first.bit / 2;
        assert!(edges[0].1 && first.start == edges[0].0 + half, "{edges:?}, {first:?}");
        assert_eq!(edges[1], (last.end + half, false));
    }
}

#[test]
fn what_arrives_while_sending_is_kept() {
    let mut bench = UsartBench::new();
    bench.wires(|line| line.has_four_wires = true);
    assert_eq!(bench.write(&[1; 30]), Some(30));
    let bytes: Vec<u8> = (0..30).collect();
    let end = bench.wires(|line| line.send(bench.model.now(), &bytes, bench.format));
    bench.pass_until(end - bench.character());
    assert!(!bench.is_flushed());
    bench.pass_until(end);
    bench.silence();
    assert_eq!(bench.read(), bytes);
    assert!(bench.is_flushed());
    assert!(bench.sent().iter().map(|sent| sent.byte).eq([1; 30]));
}
