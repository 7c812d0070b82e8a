//! The driver with a model of the controller that checks its FIFOs and the order of accesses.

use core::cell::RefCell;
use core::task::Waker;
use std::boxed::Box;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::vec::Vec;

use super::*;

#[derive(Default)]
struct Model {
    rx_words: VecDeque<u32>,
    rx_status: VecDeque<u32>,
    tx_words: Vec<u32>,
    tx_status: u32,
    tx_room: u32,
    int_en: u32,
    irq_cfg: u32,
    mac: [u32; 12],
    mac_data: u32,
    phy: [u32; 32],
    int_sts: u32,
    phy_reads: usize,
    /// Arrives when interrupts are enabled next: between the check and the sleep.
    late: Option<Vec<u8>>,
    sent: usize,
}

impl Model {
    fn arrive(&mut self, frame: &[u8], error: u32) {
        let length = frame.len() + CRC;
        self.rx_status.push_back((length as u32) << 16 | error);
        let mut bytes = frame.to_vec();
        bytes.extend([0xC5; CRC]);
        bytes.resize(length.next_multiple_of(4), 0xA5);
        self.rx_words.extend(bytes.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word)));
    }
}

struct Registers(RefCell<Model>);

impl super::Lan9118Registers for Registers {
    fn read(&self, offset: u16) -> u32 {
        let mut model = self.0.borrow_mut();
        match offset {
            RX_DATA => model.rx_words.pop_front().expect("a word beyond the frames"),
            RX_STATUS => model.rx_status.pop_front().expect("a status beyond the frames"),
            RX_FIFO_INF => (model.rx_status.len() as u32) << 16,
            TX_STATUS => {
                model.tx_status -= 1;
                0
            }
            TX_FIFO_INF => model.tx_status << 16 | model.tx_room,
            PMT_CTRL => 1,
            BYTE_TEST => 0x8765_4321,
            MAC_DATA => model.mac_data,
            INT_STS => model.int_sts,
            HW_CFG | E2P_CMD | MAC_CMD => 0,
            other => panic!("register {other:02X} is read"),
        }
    }

    fn write(&self, offset: u16, value: u32) {
        let mut model = self.0.borrow_mut();
        match offset {
            TX_DATA => model.tx_words.push(value),
            INT_EN => {
                model.int_en = value;
                if value != 0
                    && let Some(frame) = model.late.take()
                {
                    model.arrive(&frame, 0);
                }
            }
            IRQ_CFG => model.irq_cfg = value,
            INT_STS => model.int_sts &= !value,
            MAC_DATA => model.mac_data = value,
            MAC_CMD => {
                let register = (value & 0xFF) as usize;
                if value & MAC_READ != 0 {
                    model.mac_data = model.mac[register];
                } else {
                    model.mac[register] = model.mac_data;
                    if register == MAC_MII_ACC as usize {
                        let phy = (model.mac_data >> 6 & 0x1F) as usize;
                        assert_eq!(model.mac_data & !(0x1F << 6) & !MII_WRITE, PHY_ADDRESS | MII_BUSY);
                        if model.mac_data & MII_WRITE != 0 {
                            model.phy[phy] = model.mac[MAC_MII_DATA as usize];
                        } else {
                            model.phy_reads += 1;
                            model.mac[MAC_MII_DATA as usize] = model.phy[phy];
                            if phy == PHY_INT_SOURCE as usize {
                                model.phy[phy] = 0;
                            }
                        }
                    }
                }
            }
            _ => {}
        }
    }

    fn transmitted(&self) {
        self.0.borrow_mut().sent += 1;
    }
}

fn started() -> Lan9118<Registers> {
    let mut model = Model { tx_room: BUFFER as u32, ..Model::default() };
    model.mac[MAC_ADDRL as usize] = 0x3322_1102;
    model.mac[MAC_ADDRH as usize] = 0x5544;
    let waker = Box::leak(Box::new(AtomicWaker::new()));
    Lan9118::start(Registers(RefCell::new(model)), waker).unwrap()
}

fn receive(driver: &mut Lan9118<Registers>) -> Option<Vec<u8>> {
    let mut cx = Context::from_waker(Waker::noop());
    driver.receive(&mut cx).map(|(token, _)| token.consume(|frame| frame.to_vec()))
}

fn frame(length: usize) -> Vec<u8> {
    (0..length).map(|at| at as u8).collect()
}

#[test]
fn it_starts_with_the_address_of_the_eeprom() {
    let driver = started();
    assert_eq!(driver.address(), [0x02, 0x11, 0x22, 0x33, 0x44, 0x55]);
    let model = driver.regs.0.borrow();
    assert_eq!((model.int_en, model.irq_cfg), (0, 0x2200_0111));
    assert_eq!(model.mac[MAC_CR as usize], 0x0010_000C);
    assert_eq!(model.phy[PHY_BMCR as usize], 0x1200);
}

#[test]
fn another_chip_or_none_is_refused_in_bounded_time() {
    struct Nothing(u32);
    impl super::Lan9118Registers for Nothing {
        fn read(&self, _: u16) -> u32 {
            self.0
        }
        fn write(&self, _: u16, _: u32) {}
    }
    static WAKER: AtomicWaker = AtomicWaker::new();
    let error = |value| Lan9118::start(Nothing(value), &WAKER).err();
    assert_eq!(error(0), Some(Lan9118Error::Stuck { offset: PMT_CTRL }));
    assert_eq!(error(u32::MAX), Some(Lan9118Error::NoController { found: u32::MAX }));
}

#[test]
fn frames_of_every_length_come_in_whole_and_in_order() {
    let mut driver = started();
    for length in 0..=MTU {
        driver.regs.0.borrow_mut().arrive(&frame(length), 0);
        assert_eq!(receive(&mut driver), Some(frame(length)));
    }
    for length in [60, 61, 1514] {
        driver.regs.0.borrow_mut().arrive(&frame(length), 0);
    }
    for length in [60, 61, 1514] {
        assert_eq!(receive(&mut driver), Some(frame(length)));
    }
    assert_eq!(receive(&mut driver), None);
    assert_eq!(driver.dropped(), 0);
}

#[test]
fn broken_and_oversized_frames_are_read_over() {
    let mut driver = started();
    {
        let mut model = driver.regs.0.borrow_mut();
        model.arrive(&frame(100), RX_ERROR);
        model.arrive(&frame(MTU + 1), 0);
        model.arrive(&frame(16_000), 0);
        model.arrive(&frame(64), 0);
    }
    assert_eq!(receive(&mut driver), Some(frame(64)));
    assert_eq!(driver.dropped(), 3);
    assert!(driver.regs.0.borrow().rx_words.is_empty());
}

#[test]
fn a_frame_that_comes_between_the_look_and_the_sleep_is_not_forgotten() {
    let mut driver = started();
    driver.regs.0.borrow_mut().late = Some(frame(60));
    assert_eq!(receive(&mut driver), Some(frame(60)));
    assert_eq!(receive(&mut driver), None);
    assert_eq!(driver.regs.0.borrow().int_en, INT_RX_STATUS | INT_PHY);
}

#[test]
fn the_interrupt_silences_the_controller_and_wakes_who_waits() {
    struct Count(AtomicUsize);
    impl std::task::Wake for Count {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    let mut driver = started();
    let count = Arc::new(Count(AtomicUsize::new(0)));
    let waker = Waker::from(Arc::clone(&count));
    assert!(driver.receive(&mut Context::from_waker(&waker)).is_none());
    Lan9118::interrupt(&driver.regs, driver.waker);
    assert_eq!(driver.regs.0.borrow().int_en, 0);
    assert_eq!(count.0.load(Ordering::Relaxed), 1);
}

#[test]
fn a_frame_goes_out_behind_its_two_command_words() {
    let mut driver = started();
    for length in [1, 42, 60, MTU] {
        driver.regs.0.borrow_mut().tx_words.clear();
        let token = driver.transmit(&mut Context::from_waker(Waker::noop())).unwrap();
        token.consume(length, |buf| {
            assert_eq!(buf.len(), length);
            buf.copy_from_slice(&frame(length));
        });
        let model = driver.regs.0.borrow();
        let (command, data) = model.tx_words.split_at(2);
        assert_eq!(command, [0x3000 | length as u32, length as u32]);
        let bytes: Vec<u8> = data.iter().flat_map(|word| word.to_le_bytes()).collect();
        assert_eq!(bytes.len(), length.next_multiple_of(4));
        assert_eq!(bytes[..length], frame(length));
    }
    assert_eq!(driver.regs.0.borrow().sent, 4);
}

#[test]
fn without_room_nothing_is_begun_and_statuses_are_taken_away() {
    let mut driver = started();
    let mut cx = Context::from_waker(Waker::noop());
    driver.regs.0.borrow_mut().tx_status = 3;
    assert!(driver.transmit(&mut cx).is_some());
    assert_eq!(driver.regs.0.borrow().tx_status, 0);
    {
        let mut model = driver.regs.0.borrow_mut();
        model.tx_room = BUFFER as u32 - 1;
        model.arrive(&frame(60), 0);
    }
    assert!(driver.transmit(&mut cx).is_none());
    assert!(driver.receive(&mut cx).is_none(), "there would be no room for an answer");
    driver.regs.0.borrow_mut().tx_room = BUFFER as u32;
    assert_eq!(receive(&mut driver), Some(frame(60)));
}

impl Registers {
    /// Plugs the cable or pulls it: the PHY says that something has changed.
    fn plug(&self, is_plugged: bool) {
        let mut model = self.0.borrow_mut();
        model.phy[PHY_BMSR as usize] = if is_plugged { BMSR_LINK } else { 0 };
        model.phy[PHY_INT_SOURCE as usize] = 0x10;
        model.int_sts |= INT_PHY;
    }
}

#[test]
fn the_link_follows_the_phy() {
    let mut driver = started();
    let mut cx = Context::from_waker(Waker::noop());
    assert!(matches!(driver.link_state(&mut cx), LinkState::Down));
    for _ in 0..2 {
        driver.regs.plug(true);
        assert!(matches!(driver.link_state(&mut cx), LinkState::Up));
        let acknowledged = |model: &Model| (model.int_sts, model.phy[PHY_INT_SOURCE as usize]);
        assert_eq!(acknowledged(&driver.regs.0.borrow()), (0, 0));
        assert_ne!(driver.regs.0.borrow().int_en & INT_PHY, 0);
        driver.regs.plug(false);
        assert!(matches!(driver.link_state(&mut cx), LinkState::Down));
    }
}

#[test]
fn the_phy_is_read_at_the_start_and_when_it_says_so() {
    let mut driver = started();
    driver.regs.plug(true);
    driver.regs.0.borrow_mut().int_sts = 0;
    let mut cx = Context::from_waker(Waker::noop());
    assert!(matches!(driver.link_state(&mut cx), LinkState::Up), "plugged before the start");
    let reads = driver.regs.0.borrow().phy_reads;
    for _ in 0..1000 {
        assert!(matches!(driver.link_state(&mut cx), LinkState::Up));
    }
    assert_eq!(driver.regs.0.borrow().phy_reads, reads);
}
