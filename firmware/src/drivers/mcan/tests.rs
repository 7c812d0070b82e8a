//! The driver with the model of FDCAN1 that the board's binary is tested on.

use core::pin::pin;
use core::task::Context;
use std::boxed::Box;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Wake, Waker};
use std::vec::Vec;

use recipe_chip_model::device::{Clocks, MICRO, MILLI, Picos, Pin};
use recipe_chip_model::models::can_bus::{BusFault, Frame as Wire};
use recipe_chip_model::models::fdcan::Fdcan;

use super::*;
use crate::drivers::test_chip::TestDevice;

const CLOCK: u32 = 80_000_000;
const BIT: Picos = 2 * MICRO;
/// Not 0, so that a missing offset is noticed.
const OFFSET: u16 = 0x300;

type Model = Rc<TestDevice<Fdcan>>;

impl McanBlock for Model {
    fn read(&self, offset: u8) -> u32 {
        TestDevice::read(self, offset.into())
    }

    fn write(&self, offset: u8, value: u32) {
        TestDevice::write(self, offset.into(), value);
    }

    fn ram_read(&self, word: u16) -> u32 {
        let read = self.access(|can, _| can.ram_read((OFFSET + word).into()));
        read.unwrap_or_else(|refusal| panic!("word {word} is read: {refusal}"))
    }

    fn ram_write(&self, word: u16, value: u32) {
        let written = self.access(|can, _| can.ram_write((OFFSET + word).into(), value));
        written.unwrap_or_else(|refusal| panic!("word {word} <- {value:08X}: {refusal}"));
    }
}

struct McanBench {
    model: Model,
    mcan: Mcan<Model>,
    waker: &'static AtomicWaker,
}

fn reset() -> Model {
    let clocks = Clocks { fdcan: CLOCK, ..Clocks::default() };
    TestDevice::new(Fdcan::new(), clocks, &[Pin('D', 0), Pin('D', 1)], 9)
}

/// On the bus, with filters for these ids.
fn on_the_bus(ids: &[CanId]) -> McanBench {
    let (model, waker) = (reset(), &*Box::leak(Box::new(AtomicWaker::new())));
    // The bit rate of the other nodes.
    model.with(|can| can.bus.bitrate = 500_000);
    let mut mcan = Mcan::start(Rc::clone(&model), OFFSET, waker, 500_000, CLOCK).unwrap();
    // The board bypasses the clock calibration unit.
    TestDevice::write(&model, 0x804, TestDevice::read(&model, 0x804) | 1 << 6);
    let is_on_bus = || model.with(|can| can.is_on_bus());
    assert!(!is_on_bus());
    mcan.set_filters(ids);
    assert!(is_on_bus());
    McanBench { model, mcan, waker }
}

/// A data frame of another node; the bytes after its data are not 0.
fn wire(id: CanId, data: &[u8]) -> Wire {
    let mut bytes = [0xEE; 8];
    bytes[..data.len()].copy_from_slice(data);
    let (id, is_extended) = match id {
        CanId::Standard(id) => (id.into(), false),
        CanId::Extended(id) => (id, true),
    };
    Wire { id, is_extended, is_remote: false, len: data.len() as u8, data: bytes }
}

impl McanBench {
    /// The next event, if there is one now.
    fn next(&mut self) -> Option<CanEvent<CanFrame>> {
        let mut receiving = pin!(self.mcan.receive());
        match receiving.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(event) => Some(event),
            Poll::Pending => None,
        }
    }

    /// The next event within 10 ms.
    #[track_caller]
    fn wait(&mut self) -> CanEvent<CanFrame> {
        let end = self.model.now() + 10 * MILLI;
        loop {
            if let Some(event) = self.next() {
                return event;
            }
            assert!(self.model.hop(end), "nothing happens");
        }
    }

    #[track_caller]
    fn wait_for(&mut self, state: BusState) {
        let told = self.wait();
        assert!(matches!(told, CanEvent::Bus(now) if now == state), "{told:?} and not {state:?}");
    }

    /// Advances time until a condition is true, at most 10 ms.
    #[track_caller]
    fn until(&mut self, is_so: impl Fn(&Self) -> bool) {
        let end = self.model.now() + 10 * MILLI;
        while !is_so(self) {
            assert!(self.model.hop(end), "it does not come about");
        }
    }

    #[track_caller]
    fn frame(&mut self) -> CanFrame {
        let Some(CanEvent::Frame(frame)) = self.next() else { panic!("no frame") };
        frame
    }

    /// Another node sends a frame; returns after its end.
    fn arrive(&self, frame: Wire) {
        let ended = self.model.now() + 140 * BIT;
        self.model.with(|can| can.bus.send(ended, frame));
        self.model.pass(141 * BIT);
    }

    fn data(&self, id: CanId, data: &[u8]) {
        self.arrive(wire(id, data));
    }

    /// Sets bits in the control word of a FIFO's newest element.
    fn mark(&self, fifo: usize, bits: u32) {
        let (status, _) = RX_REGISTERS[fifo];
        let status = self.get(status);
        let newest = ((status >> 8 & 0x3F) + (status & 0x7F) - 1) % 64;
        let word = element(RX_FIFOS[fifo], newest) + 1;
        self.model.ram_write(word, self.model.ram_read(word) | bits);
    }

    fn broken(&self, times: usize) {
        for _ in 0..times {
            let ended = self.model.now() + 140 * BIT;
            self.model.with(|can| can.bus.send_error_frame(ended));
            self.model.pass(141 * BIT);
        }
    }

    fn trouble(&self, trouble: BusFault) {
        self.model.with(|can| can.bus.fault = trouble);
    }

    /// A short circuit during the present frame.
    #[track_caller]
    fn bus_off(&mut self) {
        self.trouble(BusFault::ShortCircuit);
        self.until(|cell| cell.model.with(|can| !can.bus.bus_offs.is_empty()));
        self.trouble(BusFault::None);
    }

    /// The next frame leaves.
    fn transmit(&self) -> Option<Wire> {
        let sent = |can: &mut Fdcan| can.bus.sent.len();
        let (before, end) = (self.model.with(sent), self.model.now() + 5 * MILLI);
        while self.model.with(sent) == before {
            if !self.model.hop(end) {
                return None;
            }
        }
        self.model.with(|can| can.bus.sent.last().map(|(_, frame)| *frame))
    }

    /// Whether the frame was queued.
    fn send(&mut self, id: CanId, data: &[u8]) -> Poll<Result<(), BusOff>> {
        let frame = CanFrame::new(id, data).unwrap();
        let mut sending = pin!(self.mcan.send(&frame));
        sending.as_mut().poll(&mut Context::from_waker(Waker::noop()))
    }

    fn get(&self, register: u8) -> u32 {
        McanBlock::read(&self.model, register)
    }

    /// The first word of a part of the message RAM, as the driver counts it.
    fn start(&self, register: u8) -> usize {
        usize::from((self.get(register) >> 2 & 0x3FFF) as u16 - OFFSET)
    }
}

const A: CanId = CanId::Standard(1);
const B: CanId = CanId::Standard(0x7FF);
const C: CanId = CanId::Extended(1);
const D: CanId = CanId::Extended(0x1FFF_FFFF);

#[test]
fn parts_of_the_message_ram_do_not_overlap() {
    let cell = on_the_bus(&[]);
    let size = |register: u8, place: u32, mask: u32| (cell.get(register) >> place & mask) as usize;
    let mut parts = [
        (cell.start(SIDFC), size(SIDFC, 16, 0xFF)),
        (cell.start(XIDFC), 2 * size(XIDFC, 16, 0x7F)),
        (cell.start(RXF0C), 4 * size(RXF0C, 16, 0x7F)),
        (cell.start(RXF1C), 4 * size(RXF1C, 16, 0x7F)),
        (cell.start(TXBC), 4 * size(TXBC, 24, 0x3F)),
    ];
    parts.sort();
    assert!(parts.windows(2).all(|pair| pair[0].0 + pair[0].1 <= pair[1].0), "{parts:?}");
    assert_eq!(parts[4].0 + parts[4].1, usize::from(MESSAGE_RAM_WORDS));
    assert!((0..MESSAGE_RAM_WORDS).all(|word| cell.model.ram_read(word) == 0));
    // It does not write outside its part.
    let others = (0..OFFSET).chain(OFFSET + MESSAGE_RAM_WORDS..2560);
    assert!(
        cell.model
            .with(|can| others.into_iter().all(|word| can.ram_read(word.into()).unwrap() == 0xDEAD_BEEF))
    );
}

#[test]
fn frames_of_the_ids_come_whole_and_nothing_else_does() {
    let mut cell = on_the_bus(&[A, B, C, D]);
    let frames = [(A, &[1, 2, 3, 4, 5, 6, 7, 8][..]), (B, &[]), (C, &[9]), (D, &[1, 2, 3, 4, 5])];
    for (index, (id, data)) in frames.into_iter().enumerate() {
        cell.data(id, data);
        // A time stamp is none of its length.
        cell.mark(index % 2, 0x1234);
        assert_eq!(cell.frame(), CanFrame::new(id, data).unwrap());
    }
    let near = [CanId::Standard(0), CanId::Standard(2), CanId::Extended(0x7FF), CanId::Extended(2)];
    near.into_iter().for_each(|id| cell.data(id, &[1]));
    assert!(cell.next().is_none());
    // They were acknowledged nevertheless.
    assert_eq!(cell.model.with(|can| (can.bus.received, can.bus.missed, can.bus.accepted)), (8, 0, 4));
}

#[test]
fn without_an_input_part_nothing_comes() {
    let mut cell = on_the_bus(&[]);
    cell.data(A, &[1]);
    cell.data(D, &[1]);
    assert!(cell.next().is_none());
}

#[test]
fn as_many_ids_as_a_recipe_can_have_find_room_of_either_length() {
    for id in [|n| CanId::Standard(n * 3), |n| CanId::Extended(u32::from(n) * 0x10_001)] {
        let ids: Vec<_> = (0..MAX_CAN_IDS as u16).map(id).collect();
        let mut cell = on_the_bus(&ids);
        for &id in &ids {
            cell.data(id, &[7]);
            assert_eq!(cell.frame(), CanFrame::new(id, &[7]).unwrap());
        }
    }
}

#[test]
fn a_remote_frame_is_one_and_a_frame_of_can_fd_is_none() {
    let mut cell = on_the_bus(&[A, C]);
    cell.arrive(Wire { is_remote: true, len: 3, ..wire(A, &[]) });
    assert_eq!(cell.frame(), CanFrame::remote(A, 3).unwrap());
    // The controller stores no CAN FD frame while that is off, so a classic one is changed.
    cell.data(C, &[1, 2, 3, 4, 5, 6, 7, 8]);
    cell.mark(1, 9 << 16 | CONTROL_FD);
    cell.arrive(Wire { len: 15, ..wire(C, &[1, 2, 3, 4, 5, 6, 7, 8]) });
    // In a classic frame a DLC above 8 means 8.
    assert_eq!(cell.frame(), CanFrame::new(C, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap());
    assert!(cell.next().is_none());
}

#[test]
fn a_burst_is_kept_in_order_by_id_and_what_has_no_room_is_counted() {
    let mut cell = on_the_bus(&[A, B]);
    // Each id has a FIFO of 64.
    for n in 0..66 {
        cell.data(A, &[n]);
    }
    cell.data(B, &[200]);
    let mut of_a = Vec::new();
    while let Some(CanEvent::Frame(frame)) = cell.next() {
        if frame.id() == A {
            of_a.push(frame.data()[0]);
        }
    }
    assert_eq!(of_a, (0..64).collect::<Vec<_>>());
    // Consecutive losses count once.
    assert_eq!(cell.mcan.counters().lost, 1);
    // Past the wrap-around of the FIFO.
    for n in 0..100 {
        cell.data(A, &[n]);
        assert_eq!(cell.frame().data(), [n]);
    }
    assert_eq!(cell.mcan.counters().lost, 1);
}

#[test]
fn a_flooded_fifo_does_not_starve_the_other() {
    let mut cell = on_the_bus(&[A, B]);
    cell.data(A, &[0]);
    cell.data(B, &[0]);
    let ids: Vec<_> = (0..4)
        .map(|_| {
            cell.data(A, &[1]);
            cell.frame().id()
        })
        .collect();
    assert!(ids.contains(&B), "{ids:?}");
}

#[test]
fn a_cycle_leaves_in_its_order_and_its_end_is_told_once() {
    let mut cell = on_the_bus(&[]);
    for n in 0..32 {
        assert_eq!(cell.send(CanId::Standard(0x100 - n), &[n as u8, 2]), Poll::Ready(Ok(())));
    }
    assert_eq!(cell.send(A, &[]), Poll::Pending, "32 are a cycle");
    for n in 0..32_u32 {
        assert!(cell.next().is_none());
        assert_eq!(cell.transmit(), Some(Wire::standard(0x100 - n, &[n as u8, 2])));
    }
    assert!(matches!(cell.next(), Some(CanEvent::Sent)));
    assert!(cell.next().is_none());
    assert_eq!(cell.send(D, &[1, 2, 3, 4, 5, 6, 7, 8]), Poll::Ready(Ok(())));
    assert_eq!(cell.transmit(), Some(wire(D, &[1, 2, 3, 4, 5, 6, 7, 8])));
    let remote = CanFrame::remote(A, 5).unwrap();
    assert!(pin!(cell.mcan.send(&remote)).poll(&mut Context::from_waker(Waker::noop())).is_ready());
    let words = Wire { is_remote: true, len: 5, ..Wire::standard(1, &[]) };
    assert_eq!(cell.transmit(), Some(words));
    // One attempt each.
    assert_eq!(cell.model.with(|can| (can.bus.attempts, can.bus.aborted)), (34, 0));
}

#[test]
fn bus_off_is_told_and_nothing_stale_is_sent_when_it_is_over() {
    let mut cell = on_the_bus(&[A]);
    assert_eq!(cell.send(B, &[1]), Poll::Ready(Ok(())));
    cell.bus_off();
    assert!(matches!(cell.next(), Some(CanEvent::Bus(BusState::BusOff))));
    assert!(cell.next().is_none());
    assert_eq!(cell.send(B, &[2]), Poll::Ready(Err(BusOff)));
    cell.mcan.recover();
    // Not before 129 times 11 recessive bits.
    cell.model.pass(128 * 11 * BIT);
    assert!(cell.next().is_none());
    assert_eq!(cell.send(B, &[2]), Poll::Ready(Err(BusOff)));
    cell.model.pass(12 * BIT);
    assert!(matches!(cell.next(), Some(CanEvent::Bus(BusState::Active))));
    assert_eq!(cell.transmit(), None);
    // The filters are as they were.
    cell.data(B, &[1]);
    cell.data(A, &[3]);
    assert_eq!(cell.frame().data(), [3]);
    assert!(cell.next().is_none());
}

#[test]
fn bus_off_found_when_sending_is_not_told_again() {
    let mut cell = on_the_bus(&[]);
    assert_eq!(cell.send(B, &[1]), Poll::Ready(Ok(())));
    cell.bus_off();
    assert_eq!(cell.send(B, &[2]), Poll::Ready(Err(BusOff)));
    assert!(cell.next().is_none());
}

#[test]
fn error_states_are_told_as_they_change() {
    let mut cell = on_the_bus(&[]);
    assert_eq!(cell.send(A, &[1]), Poll::Ready(Ok(())));
    // Without acknowledge: 8 for each attempt, and none from 128 on.
    cell.trouble(BusFault::NoAcknowledge);
    cell.wait_for(BusState::Warning);
    assert_eq!(cell.mcan.counters().transmit_errors, 96);
    assert!(cell.next().is_none());
    cell.wait_for(BusState::Passive);
    assert!(cell.next().is_none());
    cell.model.pass(5 * MILLI);
    assert_eq!(cell.mcan.counters().transmit_errors, 128);
    assert!(cell.next().is_none());
    // With acknowledge: 1 less for each frame.
    cell.trouble(BusFault::None);
    cell.wait_for(BusState::Warning);
    assert!(matches!(cell.wait(), CanEvent::Sent));
    for errors in (95..127).rev() {
        assert_eq!(cell.send(A, &[1]), Poll::Ready(Ok(())));
        if errors == 95 {
            cell.wait_for(BusState::Active);
        }
        assert!(matches!(cell.wait(), CanEvent::Sent));
        assert_eq!(cell.mcan.counters().transmit_errors, errors);
    }
    assert!(cell.next().is_none());
}

#[test]
fn error_counters_are_those_of_the_controller() {
    let mut cell = on_the_bus(&[]);
    cell.broken(17);
    assert!(cell.next().is_none());
    assert_eq!(cell.send(A, &[1]), Poll::Ready(Ok(())));
    cell.trouble(BusFault::ShortCircuit);
    cell.until(|cell| cell.get(ECR) & 0xFF == 0xF8);
    let counters = CanCounters { transmit_errors: 0xF8, receive_errors: 17, lost: 0 };
    assert_eq!(cell.mcan.counters(), counters);
    // The receive error counter reads at most 127, beside the error-passive bit.
    let mut cell = on_the_bus(&[]);
    cell.broken(130);
    cell.wait_for(BusState::Passive);
    let counters = CanCounters { transmit_errors: 0, receive_errors: 127, lost: 0 };
    assert_eq!(cell.mcan.counters(), counters);
}

#[test]
fn a_controller_that_only_listens_after_a_late_access_is_brought_back() {
    let mut cell = on_the_bus(&[]);
    cell.model.with(|can| can.fail_message_ram());
    assert!(!cell.model.with(|can| can.is_on_bus()));
    assert!(matches!(cell.next(), Some(CanEvent::Bus(BusState::BusOff))));
    cell.mcan.recover();
    assert!(matches!(cell.next(), Some(CanEvent::Bus(BusState::Active))));
    assert!(cell.model.with(|can| can.is_on_bus()));
}

#[test]
fn the_interrupt_wakes_who_waits_and_falls_silent_whatever_happened() {
    #[derive(Default)]
    struct Wakes(AtomicUsize);
    impl Wake for Wakes {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    let mut cell = on_the_bus(&[A, B]);
    let (wakes, waker) = (Arc::new(Wakes::default()), cell.waker);
    let interrupted = |cell: &mut McanBench, happens: &dyn Fn(&McanBench)| {
        let before = wakes.0.load(Ordering::Relaxed);
        {
            let task = Waker::from(Arc::clone(&wakes));
            assert!(pin!(cell.mcan.receive()).poll(&mut Context::from_waker(&task)).is_pending());
        }
        assert!(!cell.model.interrupt_line());
        happens(cell);
        assert!(cell.model.interrupt_line());
        Mcan::interrupt(&cell.model, waker);
        assert!(!cell.model.interrupt_line(), "it would come again for ever");
        assert_eq!(wakes.0.load(Ordering::Relaxed), before + 1);
        core::iter::from_fn(|| cell.next()).last()
    };
    let comes = |cell: &McanBench| {
        let end = cell.model.now() + 10 * MILLI;
        while !cell.model.interrupt_line() && cell.model.hop(end) {}
    };
    interrupted(&mut cell, &|cell| cell.data(A, &[1]));
    interrupted(&mut cell, &|cell| cell.data(B, &[1]));
    interrupted(&mut cell, &|cell| (0..70).for_each(|_| cell.data(A, &[1])));
    assert_eq!(cell.mcan.counters().lost, 1);
    assert_eq!(cell.send(A, &[1]), Poll::Ready(Ok(())));
    let last = interrupted(&mut cell, &|cell| assert!(cell.transmit().is_some()));
    assert!(matches!(last, Some(CanEvent::Sent)));
    // Each change of the error state.
    assert_eq!(cell.send(A, &[1]), Poll::Ready(Ok(())));
    cell.trouble(BusFault::ShortCircuit);
    for state in [BusState::Warning, BusState::Passive, BusState::BusOff] {
        let last = interrupted(&mut cell, &comes);
        assert!(matches!(last, Some(CanEvent::Bus(now)) if now == state), "{last:?} and not {state:?}");
    }
    cell.trouble(BusFault::None);
    cell.mcan.recover();
    let last = interrupted(&mut cell, &comes);
    assert!(matches!(last, Some(CanEvent::Bus(BusState::Active))));
    let last = interrupted(&mut cell, &|cell| cell.model.with(|can| can.fail_message_ram()));
    assert!(matches!(last, Some(CanEvent::Bus(BusState::BusOff))));
}

#[test]
fn no_controller_or_no_clock_is_refused() {
    struct Dead;
    impl McanBlock for Dead {
        fn read(&self, _: u8) -> u32 {
            0
        }
        fn write(&self, _: u8, _: u32) {}
        fn ram_read(&self, _: u16) -> u32 {
            0
        }
        fn ram_write(&self, _: u16, _: u32) {}
    }
    static WAKER: AtomicWaker = AtomicWaker::new();
    let started = Mcan::start(Dead, 0, &WAKER, 500_000, CLOCK).map(|_| ());
    assert_eq!(started, Err(McanError::NoController { found: 0 }));
    let refused = Mcan::start(reset(), 0, &WAKER, 990_000, CLOCK).map(|_| ());
    let error = BitrateError { bitrate: 990_000, clock: CLOCK };
    assert_eq!(refused, Err(McanError::Bitrate(error)));
}
