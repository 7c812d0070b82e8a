//! The driver against a model of the USART: its FIFOs, their thresholds, and error flags that belong to
//! the character that is read next.

use core::cell::{Cell, RefCell};
use core::future::Future;
use core::pin::pin;
use core::task::Context;
use std::boxed::Box;
use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Wake, Waker};
use std::vec::Vec;

use proto_core::time::Duration as CoreDuration;

use super::*;
use crate::test_clock::Clock;

const CLOCK: u32 = 100_000_000;
const FIFO: usize = 16;

#[derive(Default)]
struct Model {
    registers: RefCell<BTreeMap<u8, u32>>,
    /// Characters with their error flags.
    received: RefCell<VecDeque<(u8, u32)>>,
    waiting: RefCell<VecDeque<u8>>,
    /// In the shift register.
    leaving: Cell<Option<u8>>,
    line: RefCell<Vec<u8>>,
    flags: Cell<u32>,
}

impl Model {
    fn get(&self, register: u8) -> u32 {
        self.registers.borrow().get(&register).copied().unwrap_or(0)
    }

    fn raise(&self, flags: u32) {
        self.flags.set(self.flags.get() | flags);
    }

    /// A character arrives.
    fn arrive(&self, byte: u8, errors: u32) {
        if self.received.borrow().len() == FIFO {
            self.raise(OVERRUN);
        } else {
            self.received.borrow_mut().push_back((byte, errors));
        }
    }

    /// One character of silence.
    fn silence(&self) {
        self.raise(IDLE);
    }

    /// One character leaves.
    fn leave(&self) -> bool {
        let Some(byte) = self.leaving.take() else { return false };
        self.line.borrow_mut().push(byte);
        self.leaving.set(self.waiting.borrow_mut().pop_front());
        if self.leaving.get().is_none() {
            self.raise(TX_COMPLETE);
        }
        true
    }

    fn status(&self) -> u32 {
        let (received, waiting) = (self.received.borrow(), self.waiting.borrow());
        let mut status = self.flags.get();
        if let Some((_, errors)) = received.front() {
            status |= RX_NOT_EMPTY | errors;
        }
        if waiting.len() < FIFO {
            status |= TX_NOT_FULL;
        }
        status
    }

    /// Whether the interrupt line is raised.
    fn interrupts(&self) -> bool {
        let (status, cr1, cr3) = (self.status(), self.get(CR1), self.get(CR3));
        let quarter = self.received.borrow().len() >= FIFO / 4;
        let half = self.waiting.borrow().len() <= FIFO / 2;
        status & IDLE != 0 && cr1 & CR1_IDLE_IRQ != 0
            || status & TX_COMPLETE != 0 && cr1 & CR1_TX_COMPLETE_IRQ != 0
            || quarter && cr3 & CR3_RX_THRESHOLD_IRQ != 0
            || half && cr3 & CR3_TX_THRESHOLD_IRQ != 0
    }
}

impl Registers for Rc<Model> {
    fn read(&self, offset: u8) -> u32 {
        match offset {
            ISR => self.status(),
            RDR => {
                let (byte, errors) = self.received.borrow_mut().pop_front().expect("nothing to read");
                // A flag that was not cleared in time stays, and spoils the next character.
                self.raise(errors);
                u32::from(byte)
            }
            _ => self.get(offset),
        }
    }

    fn write(&self, offset: u8, value: u32) {
        match offset {
            ICR => {
                self.flags.set(self.flags.get() & !value);
                if let Some((_, errors)) = self.received.borrow_mut().front_mut() {
                    *errors &= !value;
                }
            }
            TDR => {
                assert!(self.waiting.borrow().len() < FIFO, "no room");
                self.flags.set(self.flags.get() & !TX_COMPLETE);
                self.waiting.borrow_mut().push_back(value as u8);
                if self.leaving.get().is_none() {
                    self.leaving.set(self.waiting.borrow_mut().pop_front());
                }
            }
            _ => {
                let fixed = [BRR, PRESC, CR2].contains(&offset);
                assert!(!fixed || self.get(CR1) & CR1_ENABLE == 0, "register {offset:02X} while it runs");
                self.registers.borrow_mut().insert(offset, value);
            }
        }
    }
}

#[derive(Default)]
struct Wakes(AtomicUsize);

impl Wake for Wakes {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

struct Bench {
    model: Rc<Model>,
    line: Usart<Rc<Model>>,
    wakes: Arc<Wakes>,
    _clock: Clock,
}

fn settings(baud: u32, parity: Parity, stop_bits: u8) -> Rs485 {
    Rs485 { baud, parity, stop_bits, idle_gap: CoreDuration::ZERO, turnaround: CoreDuration::ZERO }
}

impl Bench {
    fn start(line: Rs485) -> Self {
        let clock = Clock::take();
        let model = Rc::new(Model::default());
        let shared = &*Box::leak(Box::new(Shared::new()));
        let line = Usart::start(Rc::clone(&model), shared, &line, CLOCK).unwrap();
        // Nothing was sent yet: the transmission of nothing is complete.
        model.raise(TX_COMPLETE);
        Self { model, line, wakes: Arc::default(), _clock: clock }
    }

    fn new() -> Self {
        Self::start(settings(460_800, Parity::None, 1))
    }

    /// The interrupts that are due; how many.
    fn interrupts(&self) -> usize {
        let mut count = 0;
        while self.model.interrupts() {
            count += 1;
            assert!(count < 10, "the interrupt comes again for ever");
            Usart::interrupt(&self.model, self.line.shared);
        }
        count
    }

    fn arrive(&self, bytes: impl IntoIterator<Item = u8>) {
        for byte in bytes {
            self.model.arrive(byte, 0);
            self.interrupts();
        }
    }

    fn silence(&self) {
        self.model.silence();
        self.interrupts();
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
        let bench = Bench::start(line);
        let model = &bench.model;
        assert_eq!((model.get(BRR), model.get(PRESC)), (divider, prescaler), "{} baud", line.baud);
        assert_eq!(model.get(CR1) & (CR1_NINE_BITS | CR1_PARITY | CR1_ODD), cr1);
        assert_eq!(model.get(CR2), cr2);
        let on = CR1_ENABLE | CR1_TX | CR1_RX | CR1_FIFO;
        assert_eq!(model.get(CR1) & on, on);
        assert_ne!(model.get(CR3) & CR3_DRIVER_ENABLE, 0);
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
    let mut bench = Bench::new();
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
    let mut bench = Bench::new();
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
    let mut bench = Bench::new();
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
    let mut bench = Bench::start(settings(115_200, Parity::Even, 1));
    let noise = FRAMING_ERROR | PARITY_ERROR | NOISE;
    for (byte, errors) in [(1, 0), (2, PARITY_ERROR), (3, 0), (4, noise), (5, NOISE), (6, 0)] {
        bench.model.arrive(byte, errors);
    }
    bench.silence();
    // Noise in a bit whose majority was clear is none of an error.
    assert_eq!(bench.read(), [1, 3, 5, 6]);
    let errors = LineErrors { parity: 1, framing: 1, ..LineErrors::NONE };
    assert_eq!(bench.line.errors(), errors);
}

#[test]
fn garbage_without_end_does_not_stop_what_is_behind_it() {
    let mut bench = Bench::new();
    for _ in 0..1_000 {
        bench.model.arrive(0, FRAMING_ERROR);
        bench.interrupts();
    }
    bench.arrive([7, 8]);
    bench.silence();
    assert_eq!(bench.read(), [7, 8]);
    assert_eq!(bench.line.errors().framing, 1_000);
}

#[test]
fn an_overrun_is_counted_and_reception_goes_on() {
    let mut bench = Bench::new();
    // Interrupts are off for 20 characters.
    (0..20).for_each(|byte| bench.model.arrive(byte, 0));
    bench.interrupts();
    bench.arrive([100]);
    bench.silence();
    let expected: Vec<u8> = (0..16).chain([100]).collect();
    assert_eq!(bench.read(), expected);
    assert_eq!(bench.line.errors().overruns, 1);
}

#[test]
fn nobody_reads_and_the_newest_is_lost_and_counted() {
    let mut bench = Bench::new();
    bench.arrive((0..RX_RING + 12).map(|n| n as u8));
    bench.silence();
    assert_eq!(bench.line.errors().unread, 12);
    let all: Vec<u8> =
        core::iter::from_fn(|| Some(bench.read()).filter(|part| !part.is_empty())).flatten().collect();
    assert!(all.into_iter().eq((0..RX_RING).map(|n| n as u8)));
}

#[test]
fn a_frame_longer_than_everything_leaves_whole_and_without_a_gap() {
    let mut bench = Bench::new();
    let frame: Vec<u8> = (0..1_500_u32).map(|n| (n / 3) as u8).collect();
    let mut rest = &frame[..];
    while !rest.is_empty() {
        if let Some(len) = bench.write(rest) {
            rest = &rest[len..];
            continue;
        }
        let wakes = bench.wakes();
        while bench.wakes() == wakes {
            assert!(bench.model.leave(), "the line fell silent inside a frame");
            bench.interrupts();
        }
    }
    // While something waits, the next character is there when one has left.
    while !bench.is_flushed() {
        assert!(bench.model.leave(), "nobody is woken at the end");
        bench.interrupts();
    }
    assert_eq!(*bench.model.line.borrow(), frame);
}

#[test]
fn flushed_is_when_the_last_character_has_left_and_who_waits_is_woken() {
    let mut bench = Bench::new();
    // Of nothing, the end is there.
    assert!(bench.is_flushed());
    for frame in [&[1][..], &[2, 3], &[4; 17], &[5; 40]] {
        assert_eq!(bench.write(frame), Some(frame.len()));
        for left in 0..frame.len() {
            assert!(!bench.is_flushed(), "{left} of {} have left", frame.len());
            let wakes = bench.wakes();
            bench.model.leave();
            bench.interrupts();
            assert!(left + 1 < frame.len() || bench.wakes() > wakes, "nobody is woken at the end");
        }
        assert!(bench.is_flushed());
        assert!(!bench.model.leave());
    }
}

#[test]
fn what_arrives_while_sending_is_kept() {
    let mut bench = Bench::new();
    assert_eq!(bench.write(&[1; 30]), Some(30));
    for byte in 0..30 {
        bench.model.leave();
        bench.arrive([byte]);
    }
    bench.silence();
    assert_eq!(bench.read(), (0..30).collect::<Vec<u8>>());
    assert!(bench.is_flushed());
}
