//! A line whose bytes wait, because the processor is busy with something else.

use core::cell::Cell;
use core::convert::Infallible;
use core::future::{Future, pending};
use core::pin::pin;
use core::task::{Context, Poll, Waker};
use std::boxed::Box;
use std::collections::VecDeque;

use embassy_futures::block_on;
use embassy_futures::join::join;
use embassy_futures::select::select;
use embedded_io_async::ErrorType;
use proto_core::config::{
    Bus, Delimiter, FieldSpec, GatewayConfig, Name, OnStale, Parity, Parts, Port, Recipe, Rs485, SendOn,
    Span, StreamPart,
};
use proto_core::engine::PortCounters;
use proto_core::recipe::model::Mode;
use proto_core::sysvar::SysVar;
use proto_core::time::Duration as CoreDuration;

use super::*;
use crate::test_clock::{Clock, advance};
use crate::watchdog::{TaskName, Watch};

const FRAME: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];
const IDLE_GAP: Duration = Duration::from_millis(300);

/// What happens on the line: so long after the piece before, these bytes arrive.
struct Piece {
    after: Duration,
    bytes: &'static [u8],
}

/// A line that knows when its bytes arrived. While a piece is on its way the processor is busy: all that
/// looks at the clock next finds it late.
struct Script {
    pieces: VecDeque<Piece>,
    busy: Duration,
    begin: Option<Instant>,
    arrival: Option<Arrival>,
    tells_arrival: bool,
}

impl ErrorType for Script {
    type Error = Infallible;
}

impl Read for Script {
    async fn read(&mut self, buf: &mut [u8]) -> Result<usize, Infallible> {
        let Some(piece) = self.pieces.front() else { return pending().await };
        if let Some(begin) = self.begin {
            // Who keeps the time hears of the deadline.
            for _ in 0..3 {
                yield_once().await;
            }
            // It arrives while something else has the processor.
            let busy = self.busy.max(piece.after);
            advance(busy);
            let at = begin + piece.after;
            self.arrival = Some(Arrival { first: at, last: at });
            // Whoever else is due comes first.
            yield_once().await;
        }
        self.begin = Some(self.arrival.map_or_else(Instant::now, |arrival| arrival.last));
        let bytes = self.pieces.pop_front().map_or(&[][..], |piece| piece.bytes);
        buf[..bytes.len()].copy_from_slice(bytes);
        Ok(bytes.len())
    }
}

async fn yield_once() {
    let mut yielded = false;
    core::future::poll_fn(move |cx| {
        if core::mem::replace(&mut yielded, true) {
            return Poll::Ready(());
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    })
    .await;
}

impl Write for Script {
    async fn write(&mut self, buf: &[u8]) -> Result<usize, Infallible> {
        Ok(buf.len())
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

impl Line for Script {
    fn arrival(&self) -> Option<Arrival> {
        self.arrival.filter(|_| self.tells_arrival)
    }
}

/// One RS-485 port whose frames switch DO1.
fn config() -> GatewayConfig {
    let mut config = GatewayConfig::empty();
    config.controller.dialect = heapless::String::try_from("v2.3").unwrap();
    let controller = &mut config.controller;
    (controller.command_port, controller.state_port, controller.modbus_port) = (2000, 2001, 502);
    let var = SysVar::parse("DigitalOutputCommand[1]").unwrap();
    config.fields.push(FieldSpec::System(var)).unwrap();
    let delimiter = |bytes: &[u8]| Delimiter::from_slice(bytes).unwrap();
    let fields = Span { start: 0, len: 1 };
    let input = StreamPart { head: delimiter(&FRAME[..2]), tail: delimiter(&FRAME[3..]), fields };
    let parts = Parts::Stream { input: Some(input), output: None };
    let name = Name::try_from("a").unwrap();
    let (on_stale, send) = (OnStale::Hold, SendOn::Period);
    config.recipes.push(Recipe { name: name.clone(), mode: Mode::Realtime, parts, on_stale, send }).unwrap();
    let line = Rs485 {
        baud: 115_200,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: CoreDuration::from_micros(IDLE_GAP.as_micros()),
        turnaround: CoreDuration::ZERO,
    };
    let second = CoreDuration::from_secs(1);
    let (cycle, timeout, stale_after) = (second, second, second);
    let on_timeout = Span { start: 0, len: 0 };
    let port = Port { name, bus: Bus::Rs485(line), recipe: 0, cycle, timeout, on_timeout, stale_after };
    config.ports.push(port).unwrap();
    config
}

/// What the engine counted of a line on which this happened.
fn counted(tells_arrival: bool, pieces: impl Into<VecDeque<Piece>>) -> PortCounters {
    let _clock = Clock::take();
    let mut gateway = Box::new(Gateway::idle());
    gateway.configure(&config()).unwrap();
    let pieces = pieces.into();
    let bytes: usize = pieces.iter().map(|piece| piece.bytes.len()).sum();
    let line = Script { pieces, busy: IDLE_GAP * 3, begin: None, arrival: None, tells_arrival };
    let watch = Watch::<2>::new();
    let pulses = [TaskName::Engine, TaskName::Serial(PortId(0))].map(|name| watch.register(name).unwrap());
    let counters = || {
        let mut found = PortCounters::default();
        gateway.report(|_| {}, |_, counters| found = *counters);
        found
    };
    let all_told = core::future::poll_fn(|cx| {
        if counters().bytes_in as usize == bytes {
            return Poll::Ready(());
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    });
    let tasks = join(gateway.keep_time(pulses[0]), run(&gateway, pulses[1], PortId(0), line, 115_200));
    block_on(select(pin!(tasks), all_told));
    counters()
}

#[test]
fn bytes_that_wait_for_a_busy_processor_do_not_make_a_silence() {
    for tells_arrival in [false, true] {
        let frame = [(Duration::MIN, 0..3), (Duration::from_millis(1), 3..5)];
        let pieces = frame.map(|(after, part)| Piece { after, bytes: &FRAME[part] });
        let counters = counted(tells_arrival, pieces);
        assert_eq!((counters.frames_in, counters.discarded_bytes, counters.resync_bytes), (1, 0, 0));
    }
}

#[test]
fn a_silence_ends_a_frame_even_when_nobody_looked() {
    let frame = [(Duration::MIN, 0..3), (IDLE_GAP * 2, 3..5), (Duration::from_millis(1), 0..5)];
    let pieces = frame.map(|(after, part)| Piece { after, bytes: &FRAME[part] });
    let counters = counted(true, pieces);
    assert_eq!((counters.frames_in, counters.discarded_bytes, counters.resync_bytes), (1, 3, 2));
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

#[test]
fn a_line_that_never_falls_silent_does_not_starve_the_other_tasks() {
    let _clock = Clock::take();
    let mut gateway = Box::new(Gateway::idle());
    gateway.configure(&config()).unwrap();
    let watch = Watch::<1>::new();
    let pulse = watch.register(TaskName::Serial(PortId(0))).unwrap();
    let reads = Cell::new(100);
    let mut task = pin!(run(&gateway, pulse, PortId(0), Flood(&reads), 115_200));
    let mut cx = Context::from_waker(Waker::noop());
    for turn in 1..=50 {
        assert!(task.as_mut().poll(&mut cx).is_pending());
        assert_eq!(reads.get(), 100 - turn, "one read in a turn");
    }
}

/// A line of which nothing is heard but errors.
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
    let _clock = Clock::take();
    let mut gateway = Box::new(Gateway::idle());
    gateway.configure(&config()).unwrap();
    let watch = Watch::<1>::new();
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
