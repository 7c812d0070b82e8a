//! The task with a scripted controller, in virtual time.

use core::future::Future;
use core::pin::Pin;
use core::task::{Context, Poll};
use std::boxed::Box;
use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};
use std::vec::Vec;

use core::cell::RefCell;
use proto_core::config::{CanFields, GatewayConfig, InputField, OutputField, Port, Recipe};
use proto_core::engine::PortCounters;
use proto_core::wire::scalar::ScalarType;

use super::*;
use crate::tasks::test_clock::{TestClock, advance};
use crate::tasks::watchdog::{TaskName, TaskWatch};

const PORT: PortId = PortId(0);
const BITRATE: u32 = 500_000;
/// The cycle time is 4 ms.
const CYCLE: u64 = 4;
/// More frames than are received in 102 turns.
const FLOOD: u32 = 10_000;

/// State of the scripted controller.
#[derive(Default)]
struct Controller {
    arriving: VecDeque<CanEvent<CanFrame>>,
    /// Number of frames that can be received without a wait.
    flood: u32,
    /// Queued frames leave at once.
    is_acknowledged: bool,
    is_off: bool,
    /// Its transmit queue is full.
    is_full: bool,
    bitrate: u32,
    waiting: Vec<CanFrame>,
    sent: Vec<CanFrame>,
    filters: Option<Vec<CanId>>,
    recoveries: Vec<u64>,
    counters: CanCounters,
    waker: Option<Waker>,
}

impl Controller {
    fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }

    fn bring(&mut self, event: CanEvent<CanFrame>) {
        self.arriving.push_back(event);
        self.wake();
    }

    fn go_off(&mut self) {
        self.is_off = true;
        self.waiting.clear();
        self.bring(CanEvent::Bus(BusState::BusOff));
    }

    fn come_back(&mut self) {
        self.is_off = false;
        self.bring(CanEvent::Bus(BusState::Active));
    }
}

struct Fake(Rc<RefCell<Controller>>);

impl CanPort for Fake {
    type Frame = CanFrame;

    async fn receive(&mut self) -> CanEvent<CanFrame> {
        core::future::poll_fn(|cx| {
            let mut controller = self.0.borrow_mut();
            if controller.flood > 0 {
                controller.flood -= 1;
                return Poll::Ready(CanEvent::Frame(input_frame()));
            }
            if let Some(event) = controller.arriving.pop_front() {
                return Poll::Ready(event);
            }
            if controller.is_acknowledged && !controller.waiting.is_empty() {
                let leaving = core::mem::take(&mut controller.waiting);
                controller.sent.extend(leaving);
                return Poll::Ready(CanEvent::Sent);
            }
            controller.waker = Some(cx.waker().clone());
            Poll::Pending
        })
        .await
    }

    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusOff> {
        core::future::poll_fn(|_| if self.0.borrow().is_full { Poll::Pending } else { Poll::Ready(()) })
            .await;
        let mut controller = self.0.borrow_mut();
        if controller.is_off {
            return Err(BusOff);
        }
        controller.waiting.push(*frame);
        controller.wake();
        Ok(())
    }

    fn recover(&mut self) {
        let mut controller = self.0.borrow_mut();
        controller.waiting.clear();
        controller.recoveries.push(Instant::now().as_millis());
    }

    fn set_filters(&mut self, ids: &[CanId]) {
        self.0.borrow_mut().filters = Some(ids.to_vec());
    }

    fn counters(&self) -> CanCounters {
        self.0.borrow().counters
    }

    fn bitrate(&self) -> u32 {
        self.0.borrow().bitrate
    }
}

struct Woken(AtomicBool);

impl Wake for Woken {
    fn wake(self: Arc<Self>) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// A future that is polled only when it was woken, like a task.
struct RunningPort {
    future: Pin<Box<dyn Future<Output = ()>>>,
    woken: Arc<Woken>,
    polls: usize,
}

impl RunningPort {
    fn new(future: impl Future<Output = ()> + 'static) -> Self {
        Self { future: Box::pin(future), woken: Arc::new(Woken(AtomicBool::new(true))), polls: 0 }
    }

    fn poll(&mut self) -> bool {
        if !self.woken.0.swap(false, Ordering::Relaxed) {
            return false;
        }
        self.polls += 1;
        let waker = Waker::from(Arc::clone(&self.woken));
        assert!(self.future.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
        true
    }
}

/// A gateway with one CAN port, its task and the engine's, on a clock of its own.
struct Cell {
    gateway: &'static Gateway,
    controller: Rc<RefCell<Controller>>,
    engine: RunningPort,
    task: RunningPort,
    _clock: TestClock,
}

impl Cell {
    fn new() -> Self {
        let clock = TestClock::take();
        let gateway = Box::leak(Box::new(Gateway::idle()));
        gateway.configure(&config()).unwrap();
        let gateway: &'static Gateway = gateway;
        let watch: &'static TaskWatch<2> = Box::leak(Box::new(TaskWatch::new()));
        let pulses = [TaskName::Engine, TaskName::Can(PORT)].map(|name| watch.register(name).unwrap());
        let controller = Rc::new(RefCell::new(Controller {
            is_acknowledged: true,
            bitrate: BITRATE,
            ..Controller::default()
        }));
        let fake = Fake(Rc::clone(&controller));
        let mut cell = Self {
            gateway,
            controller,
            engine: RunningPort::new(async move { gateway.keep_time(pulses[0]).await }),
            task: RunningPort::new(async move { run(gateway, pulses[1], PORT, fake).await }),
            _clock: clock,
        };
        cell.settle();
        cell
    }

    /// Runs until no task is woken.
    fn settle(&mut self) {
        let rounds = (0..1_000).take_while(|_| self.engine.poll() | self.task.poll()).count();
        assert!(rounds < 1_000, "a task wakes itself for ever");
    }

    fn millis(&mut self, millis: u64) {
        for _ in 0..millis {
            advance(Duration::from_millis(1));
            self.settle();
        }
    }

    fn controller(&mut self, change: impl FnOnce(&mut Controller)) {
        change(&mut self.controller.borrow_mut());
        self.settle();
    }

    fn counters(&self) -> PortCounters {
        self.gateway.report(|status| *status.ports().next().unwrap().counters)
    }

    fn sent(&self) -> usize {
        self.controller.borrow().sent.len()
    }

    fn recoveries(&self) -> Vec<u64> {
        self.controller.borrow().recoveries.clone()
    }
}

/// Receives ids 1 and 0x12345, sends ids 2 and 3 each cycle.
fn config() -> GatewayConfig {
    let (input, output) =
        ([InputField::unused(ScalarType::Byte)], [OutputField::constant(ScalarType::Byte, 7.0)]);
    GatewayConfig::builder()
        .controller("10.0.0.1")
        .recipe(
            Recipe::user("hand")
                .can_input(&[CanFields::standard(1, &input), CanFields::extended(0x12345, &input)])
                .can_output(&[CanFields::standard(2, &output), CanFields::standard(3, &output)]),
        )
        .port(Port::can("can", "hand").bitrate(BITRATE).cycle(proto_core::time::Duration::from_millis(CYCLE)))
        .build()
        .unwrap()
}

fn input_frame() -> CanFrame {
    CanFrame::new(CanId::Standard(1), &[5]).unwrap()
}

#[test]
fn filters_are_the_ids_that_the_recipe_takes() {
    let cell = Cell::new();
    let wanted = [CanId::Standard(1), CanId::Extended(0x12345)];
    assert_eq!(cell.controller.borrow().filters.as_deref(), Some(&wanted[..]));
}

#[test]
fn each_cycle_leaves_whole_and_in_order() {
    let mut cell = Cell::new();
    cell.millis(10 * CYCLE);
    let ids: Vec<_> = cell.controller.borrow().sent.iter().map(CanFrame::id).collect();
    assert!(ids.len() >= 18, "{} frames in 10 cycles", ids.len());
    let cycle = [CanId::Standard(2), CanId::Standard(3)];
    assert!(ids.chunks(2).all(|ids| ids == cycle), "{ids:?}");
    assert_eq!(cell.counters().frames_out as usize, ids.len());
}

#[test]
fn what_arrives_is_taken_and_a_remote_frame_is_told_from_data() {
    let mut cell = Cell::new();
    cell.controller(|can| {
        can.bring(CanEvent::Frame(input_frame()));
        can.bring(CanEvent::Frame(CanFrame::remote(CanId::Standard(1), 1).unwrap()));
    });
    let counters = cell.counters();
    assert_eq!((counters.frames_in, counters.rejected_remote), (1, 1));
}

#[test]
fn bus_off_is_told_and_waited_out_and_nothing_is_sent_until_the_controller_is_back() {
    let mut cell = Cell::new();
    cell.millis(2 * CYCLE);
    let before = cell.sent();
    cell.controller(Controller::go_off);
    assert_eq!(cell.counters().bus_offs, 1);
    let off_at = Instant::now().as_millis();
    cell.millis(99);
    assert!(cell.recoveries().is_empty());
    cell.millis(1);
    assert_eq!(cell.recoveries(), [off_at + 100]);
    // During the recovery of 129 times 11 bits.
    cell.millis(3);
    assert_eq!(cell.sent(), before);
    cell.controller(Controller::come_back);
    cell.millis(2 * CYCLE);
    assert!(cell.sent() > before);
    assert_eq!(cell.counters().bus_offs, 1);
}

#[test]
fn bus_off_found_when_sending_is_the_same_bus_off() {
    let mut cell = Cell::new();
    cell.controller(|can| can.is_off = true);
    cell.millis(2 * CYCLE);
    assert_eq!(cell.counters().bus_offs, 1);
    cell.millis(100);
    assert_eq!(cell.recoveries().len(), 1);
}

#[test]
fn each_bus_off_is_waited_out_twice_as_long_until_the_bus_was_well() {
    let mut cell = Cell::new();
    for wait in [100, 200, 400, 800, 1_600, 3_200, 5_000, 5_000] {
        cell.controller(Controller::go_off);
        let (tries, off_at) = (cell.recoveries().len(), Instant::now().as_millis());
        cell.millis(wait);
        assert_eq!(cell.recoveries()[tries..], [off_at + wait], "after {wait} ms");
        cell.controller(Controller::come_back);
        cell.millis(4_999);
    }
    cell.millis(1);
    cell.controller(Controller::go_off);
    let (tries, off_at) = (cell.recoveries().len(), Instant::now().as_millis());
    cell.millis(200);
    assert_eq!(cell.recoveries()[tries..], [off_at + 100]);
}

#[test]
fn a_controller_that_does_not_come_back_is_tried_again() {
    let mut cell = Cell::new();
    cell.controller(Controller::go_off);
    cell.millis(3_150);
    assert_eq!(cell.recoveries(), [100, 1_100, 2_100, 3_100]);
    assert_eq!(cell.counters().bus_offs, 1);
    cell.controller(Controller::come_back);
    let before = cell.sent();
    cell.millis(2 * CYCLE);
    assert!(cell.sent() > before);
}

#[test]
fn what_nobody_acknowledges_is_given_up_and_never_sent_late() {
    let mut cell = Cell::new();
    cell.controller(|can| can.is_acknowledged = false);
    cell.millis(240);
    assert_eq!(cell.counters().downs, 0);
    assert!(cell.counters().skipped_cycles > 50);
    cell.millis(20);
    assert_eq!((cell.counters().downs, cell.counters().bus_offs), (1, 0));
    // Receiving goes on meanwhile.
    cell.controller(|can| can.bring(CanEvent::Frame(input_frame())));
    assert_eq!(cell.counters().frames_in, 1);
    // Waiting frames were dropped: the frames of one cycle leave, then those of each cycle.
    cell.controller(|can| can.is_acknowledged = true);
    let before = cell.sent();
    cell.millis(5 * CYCLE);
    assert!(cell.sent() - before <= 2 * 6, "{} frames in 5 cycles", cell.sent() - before);
}

#[test]
fn error_states_are_told_and_stop_nothing() {
    let mut cell = Cell::new();
    cell.controller(|can| {
        can.bring(CanEvent::Bus(BusState::Warning));
        can.bring(CanEvent::Bus(BusState::Passive));
    });
    let before = cell.sent();
    cell.millis(2 * CYCLE);
    assert!(cell.sent() > before);
    assert_eq!(cell.counters().bus_offs, 0);
    assert!(cell.recoveries().is_empty());
}

#[test]
fn a_flood_starves_neither_the_other_tasks_nor_what_is_to_be_sent() {
    let mut cell = Cell::new();
    cell.controller.borrow_mut().flood = FLOOD;
    cell.controller.borrow_mut().wake();
    let (polls, received) = (cell.task.polls, cell.counters().frames_in);
    for _ in 0..100 {
        assert!(cell.task.poll(), "it has to come back by itself");
    }
    assert_eq!(cell.task.polls, polls + 100);
    let a_turn = (cell.counters().frames_in - received) / 100;
    assert!((1..=IN_A_ROW as u32).contains(&a_turn), "{a_turn} frames in a turn");
    let before = cell.controller.borrow().waiting.len();
    advance(Duration::from_millis(CYCLE));
    // Before a tick, other tasks get a turn.
    while cell.engine.poll() {}
    cell.task.poll();
    assert!(cell.controller.borrow().waiting.len() > before);
    assert!(cell.controller.borrow().flood > 0);
}

#[test]
fn what_waited_while_the_processor_was_stopped_is_not_heard_of_only_when_a_frame_has_left() {
    let mut cell = Cell::new();
    // A frame may take seconds.
    cell.controller(|can| (can.is_full, can.bitrate) = (true, 100));
    cell.millis(2 * CYCLE);
    cell.controller.borrow_mut().bring(CanEvent::Frame(input_frame()));
    advance(Duration::from_secs(2));
    cell.settle();
    let counters = cell.counters();
    assert_eq!((counters.asleep, counters.frames_in, counters.downs), (1, 0, 1));
    cell.controller(|can| can.is_full = false);
    cell.millis(60);
    cell.controller(|can| can.bring(CanEvent::Frame(input_frame())));
    assert_eq!(cell.counters().frames_in, 1);
}
