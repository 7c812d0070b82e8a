//! The driver against a model of the controller that keeps the controller's rules: what is protected,
//! what a reset of the FIFOs takes away, which frame a filter lets pass.

use core::cell::{Cell, RefCell};
use core::pin::pin;
use core::task::Context;
use std::boxed::Box;
use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Wake, Waker};
use std::vec;
use std::vec::Vec;

use super::*;

const CLOCK: u32 = 80_000_000;
/// Another place than 0, so that a forgotten offset shows.
const OFFSET: u16 = 0x300;

/// Registers that may be written only while the configuration may be changed.
const PROTECTED: [u8; 12] = [NBTP, GFC, SIDFC, XIDFC, XIDAM, RXF0C, RXF1C, RXESC, TXBC, TXESC, TXEFC, 0x0C];

#[derive(Default)]
struct Model {
    registers: RefCell<BTreeMap<u8, u32>>,
    ram: RefCell<Vec<u32>>,
    /// Reads of CCCR until a change of INIT shows.
    delay: Cell<u32>,
    rx: RefCell<[VecDeque<u32>; 2]>,
    /// The next element of each receive FIFO.
    rx_put: Cell<[u32; 2]>,
    tx: RefCell<VecDeque<u32>>,
    tx_put: Cell<u32>,
    flags: Cell<u32>,
    state: Cell<u32>,
}

impl Model {
    fn new() -> Rc<Self> {
        let model = Self::default();
        model.registers.borrow_mut().insert(CCCR, CCCR_INIT);
        *model.ram.borrow_mut() = vec![0xDEAD_BEEF; usize::from(MESSAGE_RAM_WORDS)];
        Rc::new(model)
    }

    fn get(&self, register: u8) -> u32 {
        self.registers.borrow().get(&register).copied().unwrap_or(0)
    }

    /// The first word of a part of the message RAM, as the driver counts it.
    fn start(&self, register: u8) -> usize {
        usize::from((self.get(register) >> 2 & 0x3FFF) as u16 - OFFSET)
    }

    fn is_on_the_bus(&self) -> bool {
        self.get(CCCR) & (CCCR_INIT | CCCR_RESTRICTED) == 0
    }

    fn word(&self, index: usize) -> u32 {
        self.ram.borrow()[index]
    }

    /// Which FIFO a frame goes to.
    fn filtered(&self, id: CanId) -> Option<usize> {
        let fifo = |config: u32| match config {
            1 => Some(0),
            2 => Some(1),
            _ => None,
        };
        let (found, other) = match id {
            CanId::Standard(id) => {
                let count = self.get(SIDFC) >> 16 & 0xFF;
                let filters = (0..count as usize).map(|index| self.word(self.start(SIDFC) + index));
                let found = filters
                    .filter(|word| word >> 27 & 7 != 0)
                    .inspect(|word| assert_eq!(word >> 30, 1, "a filter of two ids"))
                    .find(|word| [word >> 16 & 0x7FF, word & 0x7FF].contains(&u32::from(id)));
                (found.map(|word| word >> 27 & 7), self.get(GFC) >> 4 & 3)
            }
            CanId::Extended(id) => {
                let count = self.get(XIDFC) >> 16 & 0x7F;
                let place = |index| self.start(XIDFC) + 2 * index;
                let filters = (0..count as usize).map(|at| (self.word(place(at)), self.word(place(at) + 1)));
                let found = filters
                    .filter(|(first, _)| first >> 29 != 0)
                    .inspect(|(_, second)| assert_eq!(second >> 30, 1, "a filter of two ids"))
                    .find(|(first, second)| [first & 0x1FFF_FFFF, second & 0x1FFF_FFFF].contains(&id));
                (found.map(|(first, _)| first >> 29), self.get(GFC) >> 2 & 3)
            }
        };
        match found {
            Some(config) => fifo(config),
            None => (other < 2).then_some(other as usize),
        }
    }

    /// A frame on the bus. Its words are as the controller writes them.
    fn arrive(&self, id: CanId, control: u32, flags: u32, data: [u32; 2]) {
        if !self.is_on_the_bus() {
            return;
        }
        let Some(fifo) = self.filtered(id) else { return };
        let register = [RXF0C, RXF1C][fifo];
        let size = self.get(register) >> 16 & 0x7F;
        if self.rx.borrow()[fifo].len() == size as usize {
            self.raise(1 << (4 * fifo + 3));
            return;
        }
        let mut put = self.rx_put.get();
        let place = self.start(register) + 4 * put[fifo] as usize;
        let head = match id {
            CanId::Standard(id) => u32::from(id) << 18,
            CanId::Extended(id) => id | 1 << 30,
        };
        let words = [head | flags, control, data[0], data[1]];
        self.ram.borrow_mut()[place..place + 4].copy_from_slice(&words);
        self.rx.borrow_mut()[fifo].push_back(put[fifo]);
        put[fifo] = (put[fifo] + 1) % size;
        self.rx_put.set(put);
        self.raise(1 << (4 * fifo));
    }

    fn data(&self, id: CanId, data: &[u8]) {
        let mut bytes = [0xEE; 8];
        bytes[..data.len()].copy_from_slice(data);
        let words = [0, 4].map(|at| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()));
        self.arrive(id, (data.len() as u32) << 16 | 0x1234, 0, words);
    }

    /// The next frame leaves; its words.
    fn transmit(&self) -> Option<[u32; 4]> {
        if !self.is_on_the_bus() {
            return None;
        }
        let index = self.tx.borrow_mut().pop_front()?;
        let place = self.start(TXBC) + 4 * index as usize;
        self.raise(1 << 9);
        self.ram.borrow()[place..place + 4].try_into().ok()
    }

    fn raise(&self, flags: u32) {
        self.flags.set(self.flags.get() | flags);
    }

    /// Whether the interrupt line is raised.
    fn interrupts(&self) -> bool {
        self.flags.get() & self.get(IE) != 0 && self.get(ILE) & 1 != 0 && self.get(ILS) == 0
    }

    fn bus_off(&self) {
        self.state.set(PSR_BUS_OFF | PSR_PASSIVE | PSR_WARNING);
        let control = self.get(CCCR);
        self.registers.borrow_mut().insert(CCCR, control | CCCR_INIT);
        self.raise(1 << 25);
    }

    /// 129 times 11 recessive bits went by.
    fn recessive_bits(&self) {
        if self.is_on_the_bus() && self.state.replace(0) & PSR_BUS_OFF != 0 {
            self.raise(1 << 25);
        }
    }
}

impl Registers for Rc<Model> {
    fn read(&self, offset: u8) -> u32 {
        match offset {
            ENDN => 0x8765_4321,
            CCCR if self.delay.get() > 0 => {
                self.delay.set(self.delay.get() - 1);
                self.get(CCCR) ^ CCCR_INIT
            }
            PSR => self.state.get(),
            IR => self.flags.get(),
            ECR => 0x0000_80F8 | 17 << 8,
            TXBRP => self.tx.borrow().iter().fold(0, |all, index| all | 1 << index),
            TXFQS => {
                let size = self.get(TXBC) >> 24 & 0x3F;
                let full = self.tx.borrow().len() == size as usize;
                self.tx_put.get() << 16 | u32::from(full) << 21
            }
            0xA4 | 0xB4 => {
                let fifo = &self.rx.borrow()[usize::from(offset == 0xB4)];
                fifo.front().map_or(0, |index| index << 8 | fifo.len() as u32)
            }
            _ => self.get(offset),
        }
    }

    fn write(&self, offset: u8, value: u32) {
        let unlocked = CCCR_INIT | CCCR_CONFIGURE;
        match offset {
            CCCR => {
                let before = self.get(CCCR);
                assert!(value & CCCR_CONFIGURE == 0 || before & CCCR_INIT != 0, "off the bus first");
                if (value ^ before) & CCCR_INIT != 0 {
                    self.delay.set(3);
                }
                if value & CCCR_CONFIGURE != 0 {
                    self.rx.borrow_mut().iter_mut().for_each(VecDeque::clear);
                    self.rx_put.set([0; 2]);
                    self.tx.borrow_mut().clear();
                    self.tx_put.set(0);
                }
                self.registers.borrow_mut().insert(CCCR, value);
            }
            IR => self.flags.set(self.flags.get() & !value),
            TXBAR => {
                assert!(self.is_on_the_bus(), "a frame for a controller that is off the bus");
                assert_eq!(value, 1 << self.tx_put.get(), "the element whose turn it is");
                self.tx.borrow_mut().push_back(self.tx_put.get());
                self.tx_put.set((self.tx_put.get() + 1) % (self.get(TXBC) >> 24 & 0x3F));
            }
            0xA8 | 0xB8 => {
                let fifo = &mut self.rx.borrow_mut()[usize::from(offset == 0xB8)];
                assert_eq!(fifo.pop_front(), Some(value), "the oldest element");
            }
            _ => {
                let locked = self.get(CCCR) & unlocked != unlocked;
                assert!(!(locked && PROTECTED.contains(&offset)), "register {offset:02X} is protected");
                self.registers.borrow_mut().insert(offset, value);
            }
        }
    }

    fn ram_read(&self, word: u16) -> u32 {
        self.word(usize::from(word))
    }

    fn ram_write(&self, word: u16, value: u32) {
        self.ram.borrow_mut()[usize::from(word)] = value;
    }
}

struct Bench {
    model: Rc<Model>,
    mcan: Mcan<Rc<Model>>,
    waker: &'static AtomicWaker,
}

/// On the bus, with filters for these ids.
fn on_the_bus(ids: &[CanId]) -> Bench {
    let (model, waker) = (Model::new(), &*Box::leak(Box::new(AtomicWaker::new())));
    let mut mcan = Mcan::start(Rc::clone(&model), OFFSET, waker, 500_000, CLOCK).unwrap();
    assert!(!model.is_on_the_bus());
    mcan.set_filters(ids);
    assert!(model.is_on_the_bus());
    Bench { model, mcan, waker }
}

impl Bench {
    /// What there is now.
    fn next(&mut self) -> Option<CanEvent<CanFrame>> {
        let mut receiving = pin!(self.mcan.receive());
        match receiving.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(event) => Some(event),
            Poll::Pending => None,
        }
    }

    #[track_caller]
    fn frame(&mut self) -> CanFrame {
        let Some(CanEvent::Frame(frame)) = self.next() else { panic!("no frame") };
        frame
    }

    /// Whether it was taken.
    fn send(&mut self, id: CanId, data: &[u8]) -> Poll<Result<(), BusOff>> {
        let frame = CanFrame::new(id, data).unwrap();
        let mut sending = pin!(self.mcan.send(&frame));
        sending.as_mut().poll(&mut Context::from_waker(Waker::noop()))
    }
}

const A: CanId = CanId::Standard(1);
const B: CanId = CanId::Standard(0x7FF);
const C: CanId = CanId::Extended(1);
const D: CanId = CanId::Extended(0x1FFF_FFFF);

#[test]
fn parts_of_the_message_ram_do_not_overlap() {
    let cell = on_the_bus(&[]);
    let size = |register: u8, place: u32, mask: u32| (cell.model.get(register) >> place & mask) as usize;
    let mut parts = [
        (cell.model.start(SIDFC), size(SIDFC, 16, 0xFF)),
        (cell.model.start(XIDFC), 2 * size(XIDFC, 16, 0x7F)),
        (cell.model.start(RXF0C), 4 * size(RXF0C, 16, 0x7F)),
        (cell.model.start(RXF1C), 4 * size(RXF1C, 16, 0x7F)),
        (cell.model.start(TXBC), 4 * size(TXBC, 24, 0x3F)),
    ];
    parts.sort();
    assert!(parts.windows(2).all(|pair| pair[0].0 + pair[0].1 <= pair[1].0), "{parts:?}");
    assert_eq!(parts[4].0 + parts[4].1, usize::from(MESSAGE_RAM_WORDS));
    assert!(cell.model.ram.borrow().iter().all(|&word| word == 0));
}

#[test]
fn frames_of_the_ids_come_whole_and_nothing_else_does() {
    let mut cell = on_the_bus(&[A, B, C, D]);
    for (id, data) in [(A, &[1, 2, 3, 4, 5, 6, 7, 8][..]), (B, &[]), (C, &[9]), (D, &[1, 2, 3, 4, 5])] {
        cell.model.data(id, data);
        assert_eq!(cell.frame(), CanFrame::new(id, data).unwrap());
    }
    let near = [CanId::Standard(0), CanId::Standard(2), CanId::Extended(0x7FF), CanId::Extended(2)];
    near.into_iter().for_each(|id| cell.model.data(id, &[1]));
    assert!(cell.next().is_none());
}

#[test]
fn without_an_input_part_nothing_comes() {
    let mut cell = on_the_bus(&[]);
    cell.model.data(A, &[1]);
    cell.model.data(D, &[1]);
    assert!(cell.next().is_none());
}

#[test]
fn as_many_ids_as_a_recipe_can_have_find_room_of_either_length() {
    for id in [|n| CanId::Standard(n * 3), |n| CanId::Extended(u32::from(n) * 0x10_001)] {
        let ids: Vec<_> = (0..MAX_CAN_IDS as u16).map(id).collect();
        let mut cell = on_the_bus(&ids);
        for &id in &ids {
            cell.model.data(id, &[7]);
            assert_eq!(cell.frame(), CanFrame::new(id, &[7]).unwrap());
        }
    }
}

#[test]
fn a_remote_frame_is_one_and_a_frame_of_can_fd_is_none() {
    let mut cell = on_the_bus(&[A, C]);
    cell.model.arrive(A, 3 << 16, HEAD_REMOTE, [0; 2]);
    assert_eq!(cell.frame(), CanFrame::remote(A, 3).unwrap());
    cell.model.arrive(C, 9 << 16 | CONTROL_FD, 0, [0; 2]);
    cell.model.arrive(C, 15 << 16, 0, [0x0403_0201, 0x0807_0605]);
    // Of a classic frame a length beyond 8 means 8.
    assert_eq!(cell.frame(), CanFrame::new(C, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap());
    assert!(cell.next().is_none());
}

#[test]
fn a_burst_is_kept_in_order_by_id_and_what_has_no_room_is_counted() {
    let mut cell = on_the_bus(&[A, B]);
    // Each id has a FIFO of 64.
    for n in 0..66 {
        cell.model.data(A, &[n]);
    }
    cell.model.data(B, &[200]);
    let mut of_a = Vec::new();
    while let Some(CanEvent::Frame(frame)) = cell.next() {
        if frame.id() == A {
            of_a.push(frame.data()[0]);
        }
    }
    assert_eq!(of_a, (0..64).collect::<Vec<_>>());
    // Losses behind one another are seen as one.
    assert_eq!(cell.mcan.counters().lost, 1);
    // Round the end of the FIFO.
    for n in 0..100 {
        cell.model.data(A, &[n]);
        assert_eq!(cell.frame().data(), [n]);
    }
    assert_eq!(cell.mcan.counters().lost, 1);
}

#[test]
fn a_flooded_fifo_does_not_starve_the_other() {
    let mut cell = on_the_bus(&[A, B]);
    cell.model.data(A, &[0]);
    cell.model.data(B, &[0]);
    let ids: Vec<_> = (0..4)
        .map(|_| {
            cell.model.data(A, &[1]);
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
        let [head, control, data, _] = cell.model.transmit().unwrap();
        assert_eq!((head, control, data), ((0x100 - n) << 18, 2 << 16, 0x0200 | n));
    }
    assert!(matches!(cell.next(), Some(CanEvent::Sent)));
    assert!(cell.next().is_none());
    assert_eq!(cell.send(D, &[1, 2, 3, 4, 5, 6, 7, 8]), Poll::Ready(Ok(())));
    let words = [0x1FFF_FFFF | HEAD_EXTENDED, 8 << 16, 0x0403_0201, 0x0807_0605];
    assert_eq!(cell.model.transmit(), Some(words));
}

#[test]
fn bus_off_is_told_and_nothing_stale_is_sent_when_it_is_over() {
    let mut cell = on_the_bus(&[A]);
    assert_eq!(cell.send(B, &[1]), Poll::Ready(Ok(())));
    cell.model.bus_off();
    assert!(matches!(cell.next(), Some(CanEvent::Bus(BusState::BusOff))));
    assert!(cell.next().is_none());
    assert_eq!(cell.send(B, &[2]), Poll::Ready(Err(BusOff)));
    cell.mcan.recover();
    // Not yet there.
    assert!(cell.next().is_none());
    assert_eq!(cell.send(B, &[2]), Poll::Ready(Err(BusOff)));
    cell.model.recessive_bits();
    assert!(matches!(cell.next(), Some(CanEvent::Bus(BusState::Active))));
    assert_eq!(cell.model.transmit(), None);
    // The filters are as they were.
    cell.model.data(B, &[1]);
    cell.model.data(A, &[3]);
    assert_eq!(cell.frame().data(), [3]);
    assert!(cell.next().is_none());
}

#[test]
fn bus_off_found_when_sending_is_not_told_again() {
    let mut cell = on_the_bus(&[]);
    cell.model.bus_off();
    assert_eq!(cell.send(B, &[2]), Poll::Ready(Err(BusOff)));
    assert!(cell.next().is_none());
}

#[test]
fn error_states_are_told_as_they_change() {
    let mut cell = on_the_bus(&[]);
    for (bits, state) in [
        (PSR_WARNING, BusState::Warning),
        (PSR_WARNING | PSR_PASSIVE, BusState::Passive),
        (0, BusState::Active),
    ] {
        cell.model.state.set(bits);
        let told = cell.next();
        assert!(matches!(told, Some(CanEvent::Bus(now)) if now == state), "{told:?}");
        assert!(cell.next().is_none());
    }
    let counters = CanCounters { transmit_errors: 0xF8, receive_errors: 17, lost: 0 };
    assert_eq!(cell.mcan.counters(), counters);
}

#[test]
fn a_controller_that_only_listens_after_a_late_access_is_brought_back() {
    let mut cell = on_the_bus(&[]);
    let control = cell.model.get(CCCR);
    cell.model.registers.borrow_mut().insert(CCCR, control | CCCR_RESTRICTED);
    assert!(matches!(cell.next(), Some(CanEvent::Bus(BusState::BusOff))));
    cell.mcan.recover();
    assert!(matches!(cell.next(), Some(CanEvent::Bus(BusState::Active))));
    assert!(cell.model.is_on_the_bus());
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
    let interrupted = |cell: &mut Bench, happens: &dyn Fn(&Model)| {
        let before = wakes.0.load(Ordering::Relaxed);
        {
            let task = Waker::from(Arc::clone(&wakes));
            assert!(pin!(cell.mcan.receive()).poll(&mut Context::from_waker(&task)).is_pending());
        }
        happens(&cell.model);
        assert!(cell.model.interrupts());
        Mcan::interrupt(&cell.model, waker);
        assert!(!cell.model.interrupts(), "it would come again for ever");
        assert_eq!(wakes.0.load(Ordering::Relaxed), before + 1);
        while cell.next().is_some() {}
    };
    interrupted(&mut cell, &|model| model.data(A, &[1]));
    interrupted(&mut cell, &|model| model.data(B, &[1]));
    interrupted(&mut cell, &|model| (0..70).for_each(|_| model.data(A, &[1])));
    assert_eq!(cell.mcan.counters().lost, 1);
    assert_eq!(cell.send(A, &[1]), Poll::Ready(Ok(())));
    interrupted(&mut cell, &|model| assert!(model.transmit().is_some()));
    interrupted(&mut cell, &Model::bus_off);
}

#[test]
fn no_controller_or_no_clock_is_refused() {
    struct Dead;
    impl Registers for Dead {
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
    assert_eq!(started, Err(StartError::NoController { found: 0 }));
    let refused = Mcan::start(Model::new(), 0, &WAKER, 990_000, CLOCK).map(|_| ());
    let error = BitrateError { bitrate: 990_000, clock: CLOCK };
    assert_eq!(refused, Err(StartError::Bitrate(error)));
}
