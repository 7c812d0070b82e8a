//! An RS-485 port's task: one task for a port, which drives the line, sends, waits for the last stop
//! bit, releases the line and reads again.
//!
//! Its device buffers what arrives while the task is elsewhere, and its `read` loses nothing when it is
//! dropped before it is done.

use core::pin::pin;

use embassy_futures::select::{Either3, select3};
use embassy_futures::yield_now;
use embassy_time::{Duration, Instant, Timer, with_timeout};
use embedded_io_async::{Read, Write};
use proto_core::engine::{Input, PortId};
use proto_core::time::Instant as CoreInstant;

use crate::fmt::Text;
use crate::gateway::Gateway;
use crate::warn;
use crate::watchdog::Pulse;

/// A half-duplex line (D20).
pub trait Line: Read + Write {
    /// Raises or releases driver-enable; nothing where the hardware does it, or where there is none.
    fn drive(&mut self, direction: LineDirection) {
        let _ = direction;
    }

    /// When the bytes of the newest read arrived, where the device knows.
    fn arrival(&self) -> Option<Arrival> {
        None
    }

    /// What the device could not take.
    fn errors(&self) -> LineErrors {
        LineErrors::NONE
    }
}

/// What a line's device could not take since it was started. Counters wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LineErrors {
    /// Characters left out for their parity.
    pub parity: u32,
    /// Characters left out for a stop bit that was none.
    pub framing: u32,
    /// Times that the receive FIFO was full, with one character or more lost.
    pub overruns: u32,
    /// Characters lost because nobody read.
    pub unread: u32,
}

impl LineErrors {
    pub(crate) const NONE: Self = Self { parity: 0, framing: 0, overruns: 0, unread: 0 };
}

/// When bytes arrived that were read later.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    /// The first of them.
    pub first: Instant,
    /// The last of them.
    pub last: Instant,
}

/// Who drives the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineDirection {
    /// The devices.
    Receive,
    /// We.
    Send,
}

/// Drives the port for ever.
pub async fn run(gateway: &Gateway, pulse: &Pulse, port: PortId, mut line: impl Line, baud: u32) -> ! {
    let Some(control) = gateway.port(port) else { core::future::pending().await };
    let mut chunk = [0; 256];
    let mut is_failing = false;
    let mut errors = Told { errors: LineErrors::NONE, look: Instant::MIN };
    loop {
        gateway.input(Input::PortUp { port });
        let failed = loop {
            let next = select3(line.read(&mut chunk), control.next_bytes(), Timer::at(errors.look));
            let next = pulse.idle(pin!(next)).await;
            let frame = match next {
                Either3::First(Ok(len)) => {
                    tell(gateway, port, chunk.get(..len).unwrap_or(&[]), line.arrival());
                    if Instant::now() >= errors.look {
                        errors.tell(port, line.errors());
                    }
                    // A line that is never silent does not keep the other tasks from running.
                    yield_now().await;
                    // A line that never falls silent does not keep us from sending.
                    match control.take_bytes() {
                        Some(frame) => frame,
                        None => continue,
                    }
                }
                Either3::First(Err(error)) => break embedded_io_async::Error::kind(&error),
                Either3::Second(frame) => frame,
                Either3::Third(()) => {
                    // At the wrong speed nothing else is ever heard of a line.
                    errors.tell(port, line.errors());
                    continue;
                }
            };
            line.drive(LineDirection::Send);
            let sent = with_timeout(patience(frame.len(), baud), async {
                line.write_all(&frame).await?;
                line.flush().await
            });
            // A long frame on a slow line takes seconds.
            let sent = pulse.idle(pin!(sent)).await;
            line.drive(LineDirection::Receive);
            match sent {
                Ok(Ok(())) => {
                    is_failing = false;
                    gateway.input(Input::PortSent { port });
                }
                Ok(Err(error)) => break embedded_io_async::Error::kind(&error),
                Err(_) => break embedded_io_async::ErrorKind::TimedOut,
            }
        };
        // Said once, however often it fails in a row.
        if !is_failing {
            warn!("port {}: {}", port.0, Text(&failed));
        }
        is_failing = true;
        gateway.input(Input::PortDown { port });
        control.clear();
        Timer::after(RETRY).await;
    }
}

/// Hands bytes to the engine. Silence on the line is judged by when they arrived, not by when this task
/// had the time to look.
fn tell(gateway: &Gateway, port: PortId, bytes: &[u8], arrival: Option<Arrival>) {
    let input = |at: Instant, bytes| {
        gateway.input_at(CoreInstant::from_micros(at.as_micros()), Input::PortBytes { port, bytes });
    };
    // Saturating: a driver's clock that is ahead of ours is no reason to panic.
    let waited = |first| Instant::now().saturating_duration_since(first);
    match (arrival, bytes.split_first_chunk::<1>()) {
        (Some(Arrival { first, last }), Some((head, rest))) if waited(first) > PROMPT => {
            input(first, head);
            input(last, rest);
        }
        _ => gateway.input(Input::PortBytes { port, bytes }),
    }
}

/// The errors that were told of, and when they are looked at again.
struct Told {
    errors: LineErrors,
    look: Instant,
}

impl Told {
    fn tell(&mut self, port: PortId, errors: LineErrors) {
        self.look = Instant::now() + ERROR_PERIOD;
        if errors == self.errors {
            return;
        }
        self.errors = errors;
        let LineErrors { parity, framing, overruns, unread } = errors;
        warn!(
            "port {}: characters left out for parity {}, framing {}; overruns {}, unread {}",
            port.0, parity, framing, overruns, unread
        );
    }
}

/// Twice what the bytes take on the line (12 bits a byte at most), and a little.
fn patience(bytes: usize, baud: u32) -> Duration {
    let bits = (bytes as u64).saturating_mul(24_000_000);
    Duration::from_micros(bits / u64::from(baud.max(1))) + Duration::from_millis(20)
}

/// Bytes that were read within this time have just arrived: a fraction of any silence that matters.
const PROMPT: Duration = Duration::from_micros(100);
const ERROR_PERIOD: Duration = Duration::from_secs(1);
/// After a failed device.
const RETRY: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests;
