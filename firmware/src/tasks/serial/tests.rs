//! Lines whose bytes wait in the device, because the processor is busy or was stopped.

use core::cell::{Cell, RefCell};
use core::convert::Infallible;
use core::future::{Future, pending, poll_fn};
use core::task::{Context, Waker};
use std::boxed::Box;
use std::collections::VecDeque;
use std::rc::Rc;
use std::vec::Vec;

use embedded_io_async::{ErrorType, Read, Write};
use proto_core::config::{GatewayConfig, InputField, OutputField, Port, Recipe, SendOn};
use proto_core::engine::PortCounters;
use proto_core::time::Duration as CoreDuration;
use proto_core::wire::scalar::ScalarType;

use super::*;
use crate::tasks::test_clock::{TestClock, advance};
use crate::tasks::test_executor::{Executor, WakeOrder};
use crate::tasks::watchdog::{TaskName, TaskWatch};

const FRAME: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];
const PORT: PortId = PortId(0);
const IDLE_GAP: Duration = Duration::from_millis(100);
const TIMEOUT: Duration = Duration::from_millis(200);
const BAUD: u32 = 115_200;

/// State of a device.
#[derive(Default)]
struct ScriptedDevice {
    received: VecDeque<u8>,
    /// Sent bytes do not leave.
    is_stuck: bool,
    /// Number of bytes read before each frame was begun.
    read_before: Vec<usize>,
    read: usize,
    reader: Option<Waker>,
    writer: Option<Waker>,
}

struct Script(Rc<RefCell<ScriptedDevice>>);

impl ErrorType for Script {
    type Error = Infallible;
}

impl Read for Script {
    async fn read(&mut self, buf: &mut [u8]) -> Result<usize, Infallible> {
        poll_fn(|cx| {
            let mut device = self.0.borrow_mut();
            let len = device.received.len().min(buf.len());
            if len == 0 {
                device.reader = Some(cx.waker().clone());
                return Poll::Pending;
            }
            device.read += len;
            buf.iter_mut().zip(device.received.drain(..len)).for_each(|(place, byte)| *place = byte);
            Poll::Ready(Ok(len))
        })
        .await
    }
}

impl Write for Script {
    async fn write(&mut self, buf: &[u8]) -> Result<usize, Infallible> {
        let mut device = self.0.borrow_mut();
        let read = device.read;
        device.read_before.push(read);
        Ok(buf.len())
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        poll_fn(|cx| {
            let mut device = self.0.borrow_mut();
            if device.is_stuck {
                device.writer = Some(cx.waker().clone());
                return Poll::Pending;
            }
            Poll::Ready(Ok(()))
        })
        .await
    }
}

impl Line for Script {}

/// One RS-485 port, whose frames are answered when `send` says so.
fn config(send: SendOn) -> GatewayConfig {
    GatewayConfig::builder()
        .controller("10.0.0.1")
        .recipe(
            Recipe::user("a")
                .stream_input(&FRAME[..2], &FRAME[3..], &[InputField::unused(ScalarType::Byte)])
                .stream_output(&FRAME[..2], &FRAME[3..], &[OutputField::constant(ScalarType::Byte, 7.0)])
                .send(send),
        )
        .port(
            Port::rs485("a", "a")
                .baud(BAUD)
                .idle_gap(CoreDuration::from_micros(IDLE_GAP.as_micros()))
                .turnaround(CoreDuration::ZERO)
                .cycle(CoreDuration::from_millis(400))
                .timeout(CoreDuration::from_micros(TIMEOUT.as_micros()))
                .stale_after(CoreDuration::from_secs(1)),
        )
        .build()
        .unwrap()
}

/// The port, its task and the engine's.
struct SerialBench {
    gateway: &'static Gateway,
    device: Rc<RefCell<ScriptedDevice>>,
    executor: Executor<'static>,
    _clock: TestClock,
}

impl SerialBench {
    fn new(order: WakeOrder, send: SendOn, baud: u32) -> Self {
        let device = Rc::new(RefCell::new(ScriptedDevice::default()));
        Self::with_line(order, send, baud, Script(Rc::clone(&device)), device)
    }

    fn with_line(
        order: WakeOrder,
        send: SendOn,
        baud: u32,
        line: impl Line + 'static,
        device: Rc<RefCell<ScriptedDevice>>,
    ) -> Self {
        let clock = TestClock::take();
        let gateway = Box::leak(Box::new(Gateway::idle()));
        gateway.configure(&config(send)).unwrap();
        let gateway: &'static Gateway = gateway;
        let watch: &'static TaskWatch<2> = Box::leak(Box::new(TaskWatch::new()));
        let pulses = [TaskName::Engine, TaskName::Serial(PORT)].map(|name| watch.register(name).unwrap());
        let mut executor = Executor::new(order);
        executor.spawn(gateway.keep_time(pulses[0]));
        executor.spawn(run(gateway, pulses[1], PORT, line, baud));
        // The engine treats instant 0 as absent.
        advance(Duration::from_millis(1));
        Self { gateway, device, executor, _clock: clock }
    }

    /// Bytes arrive, but the task is not polled yet.
    fn arrive(&self, bytes: impl IntoIterator<Item = u8>) {
        let mut device = self.device.borrow_mut();
        device.received.extend(bytes);
        device.reader.take().inspect(Waker::wake_by_ref);
    }

    /// Whether sent bytes leave.
    fn stick(&self, is_stuck: bool) {
        let mut device = self.device.borrow_mut();
        device.is_stuck = is_stuck;
        device.writer.take().inspect(Waker::wake_by_ref);
    }

    /// Runs until the next frame is sent.
    fn wait_until_it_sends(&mut self) {
        let before = self.device.borrow().read_before.len();
        for _ in 0..500 {
            if self.device.borrow().read_before.len() > before {
                return;
            }
            self.wait(Duration::from_millis(1));
        }
        panic!("it sends nothing");
    }

    fn wait(&mut self, time: Duration) {
        advance(time);
        self.executor.settle();
    }

    fn counters(&self) -> PortCounters {
        self.gateway.report(|status| *status.ports().next().unwrap().counters)
    }
}

#[test]
fn bytes_that_wait_for_a_busy_processor_do_not_make_a_silence() {
    for order in WakeOrder::ALL {
        let mut bench = SerialBench::new(order, SendOn::Period, BAUD);
        bench.arrive(FRAME[..3].iter().copied());
        bench.wait(Duration::from_millis(1));
        bench.arrive(FRAME[3..].iter().copied());
        bench.wait(IDLE_GAP * 2);
        let counters = bench.counters();
        assert_eq!((counters.frames_in, counters.discarded_bytes, counters.resync_bytes), (1, 0, 0));
        // A real silence is noticed.
        bench.arrive(FRAME[..3].iter().copied());
        bench.wait(Duration::from_millis(1));
        bench.wait(IDLE_GAP * 2);
        assert_eq!(bench.counters().discarded_bytes, 3);
    }
}

#[test]
fn all_that_waits_in_a_device_is_heard_before_a_frame_is_overdue() {
    for order in WakeOrder::ALL {
        let mut bench = SerialBench::new(order, SendOn::Period, BAUD);
        bench.arrive(FRAME);
        bench.wait(Duration::from_millis(1));
        assert_eq!(bench.counters().frames_in, 1);
        // More than one read.
        bench.arrive([0; 1_000].into_iter().chain(FRAME));
        bench.wait(TIMEOUT * 2);
        let counters = bench.counters();
        assert_eq!((counters.frames_in, counters.resync_bytes, counters.timeouts), (2, 1_000, 0));
        bench.wait(TIMEOUT * 2);
        assert_eq!(bench.counters().timeouts, 1);
    }
}

#[test]
fn what_a_device_has_woken_nobody_for_is_heard_before_a_frame_is_overdue() {
    for order in WakeOrder::ALL {
        let mut bench = SerialBench::new(order, SendOn::Period, BAUD);
        for round in 1..5 {
            // As long as less than a quarter of its FIFO is full.
            bench.device.borrow_mut().received.extend(FRAME);
            bench.wait(TIMEOUT * 2);
            let counters = bench.counters();
            assert_eq!((counters.frames_in, counters.timeouts), (round, 0));
        }
    }
}

#[test]
fn what_waits_is_heard_before_anything_is_sent() {
    for order in WakeOrder::ALL {
        let mut bench = SerialBench::new(order, SendOn::Frame, BAUD);
        bench.wait(Duration::from_millis(1));
        // An answer is due after the first of them.
        bench.arrive(FRAME.into_iter().chain([0; 1_000]).chain(FRAME));
        bench.wait(Duration::from_millis(1));
        assert_eq!(bench.counters().frames_in, 2);
        assert_eq!(bench.device.borrow().read_before.first(), Some(&(1_000 + 2 * FRAME.len())));
    }
}

#[test]
fn what_waited_while_the_processor_was_stopped_is_not_heard_of_only_when_a_frame_has_left() {
    for order in WakeOrder::ALL {
        // At this baud rate a frame takes seconds.
        let mut bench = SerialBench::new(order, SendOn::Period, 10);
        bench.stick(true);
        bench.wait_until_it_sends();
        // The processor is stopped while the device goes on receiving.
        bench.arrive(FRAME);
        bench.wait(Duration::from_secs(2));
        let counters = bench.counters();
        let slept = (counters.bytes_in, counters.discarded_bytes, counters.asleep, counters.frames_in);
        assert_eq!(slept, (5, 5, 1, 0));
        assert!(bench.device.borrow().is_stuck && counters.downs == 0, "it still sends");
        // Later bytes are read when the frame has left.
        bench.wait(Duration::from_millis(60));
        bench.arrive(FRAME);
        bench.stick(false);
        bench.wait(Duration::from_millis(1));
        assert_eq!(bench.counters().frames_in, 1);
    }
}

#[test]
fn a_line_that_takes_nothing_is_given_up_and_heard_all_the_same() {
    for order in WakeOrder::ALL {
        let mut bench = SerialBench::new(order, SendOn::Period, BAUD);
        bench.stick(true);
        bench.wait_until_it_sends();
        bench.wait(Duration::from_millis(10));
        bench.arrive(FRAME);
        bench.wait(Duration::from_millis(20));
        assert_eq!((bench.counters().downs, bench.counters().frames_in), (1, 1));
        bench.arrive(FRAME);
        bench.wait(Duration::from_millis(1));
        assert_eq!(bench.counters().frames_in, 2);
    }
}

/// A line that never falls silent.
struct Flood<'a>(&'a Cell<u32>);

impl ErrorType for Flood<'_> {
    type Error = Infallible;
}

impl Read for Flood<'_> {
    async fn read(&mut self, buf: &mut [u8]) -> Result<usize, Infallible> {
        if self.0.get() == 0 {
            return pending().await;
        }
        self.0.set(self.0.get() - 1);
        buf.fill(0xA5);
        Ok(buf.len())
    }
}

impl Write for Flood<'_> {
    async fn write(&mut self, buf: &[u8]) -> Result<usize, Infallible> {
        Ok(buf.len())
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

impl Line for Flood<'_> {}

/// A device whose bytes are followed by a flood.
struct FloodAndScript(Script, Rc<Cell<u32>>);

impl ErrorType for FloodAndScript {
    type Error = Infallible;
}

impl Read for FloodAndScript {
    async fn read(&mut self, buf: &mut [u8]) -> Result<usize, Infallible> {
        if self.1.get() > 0 { Flood(&self.1).read(buf).await } else { self.0.read(buf).await }
    }
}

impl Write for FloodAndScript {
    async fn write(&mut self, buf: &[u8]) -> Result<usize, Infallible> {
        self.0.write(buf).await
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        self.0.flush().await
    }
}

impl Line for FloodAndScript {}

#[test]
fn a_line_that_never_falls_silent_keeps_neither_the_time_nor_what_is_to_be_sent() {
    for order in WakeOrder::ALL {
        let reads = Rc::new(Cell::new(0));
        let device = Rc::new(RefCell::new(ScriptedDevice::default()));
        let line = FloodAndScript(Script(Rc::clone(&device)), Rc::clone(&reads));
        let mut bench = SerialBench::with_line(order, SendOn::Period, BAUD, line, device);
        bench.arrive(FRAME);
        bench.wait(Duration::from_millis(1));
        assert_eq!(bench.counters().frames_in, 1);
        reads.set(u32::MAX);
        bench.arrive([0]);
        advance(Duration::from_millis(400));
        let rounds = (0..99).take_while(|_| bench.counters().timeouts == 0 && bench.executor.round()).count();
        assert!((3..=25).contains(&rounds), "a tick in {rounds} rounds");
        let sends =
            |bench: &mut SerialBench| bench.device.borrow().read_before.is_empty() && bench.executor.round();
        let rounds = (0..99).take_while(|_| sends(&mut bench)).count();
        assert!(rounds <= 15, "sent after {rounds} rounds");
        assert!(reads.get() > 0);
    }
}

#[test]
fn a_line_that_never_falls_silent_does_not_starve_the_other_tasks() {
    let _clock = TestClock::take();
    let mut gateway = Box::new(Gateway::idle());
    gateway.configure(&config(SendOn::Period)).unwrap();
    let watch = TaskWatch::<1>::new();
    let pulse = watch.register(TaskName::Serial(PortId(0))).unwrap();
    let reads = Cell::new(100);
    let mut task = pin!(run(&gateway, pulse, PortId(0), Flood(&reads), 115_200));
    let mut cx = Context::from_waker(Waker::noop());
    for turn in 1..=50 {
        assert!(task.as_mut().poll(&mut cx).is_pending());
        assert_eq!(reads.get(), 100 - turn, "one read in a turn");
    }
}

/// A line on which only errors are received.
struct Wrong<'a>(&'a Cell<u32>);

impl ErrorType for Wrong<'_> {
    type Error = Infallible;
}

impl Read for Wrong<'_> {
    async fn read(&mut self, _: &mut [u8]) -> Result<usize, Infallible> {
        pending().await
    }
}

impl Write for Wrong<'_> {
    async fn write(&mut self, buf: &[u8]) -> Result<usize, Infallible> {
        Ok(buf.len())
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

impl Line for Wrong<'_> {
    fn errors(&self) -> LineErrors {
        self.0.set(self.0.get() + 1);
        LineErrors { framing: 1_000 * self.0.get(), ..LineErrors::NONE }
    }
}

#[test]
fn errors_are_looked_at_once_a_second_on_a_line_where_nothing_else_is_heard() {
    let _clock = TestClock::take();
    let mut gateway = Box::new(Gateway::idle());
    gateway.configure(&config(SendOn::Period)).unwrap();
    let watch = TaskWatch::<1>::new();
    let pulse = watch.register(TaskName::Serial(PortId(0))).unwrap();
    let looks = Cell::new(0);
    let mut task = pin!(run(&gateway, pulse, PortId(0), Wrong(&looks), 115_200));
    let mut cx = Context::from_waker(Waker::noop());
    for second in 1..=5 {
        for _ in 0..10 {
            assert!(task.as_mut().poll(&mut cx).is_pending());
            advance(Duration::from_millis(100));
        }
        assert_eq!(looks.get(), second);
    }
}
