//! The task of an RS-485 port: it drives the line, sends, waits for the last stop bit, releases the line and
//! reads again.
//!
//! The device buffers input meanwhile, and its `read` and `write` are cancel-safe. Data in the device is reported
//! at once, and before anything is sent, because the engine judges lateness by the time of the report.

use core::pin::pin;
use core::task::Poll;

use embassy_futures::select::{Either, Either3, select, select3};
use embassy_futures::{poll_once, yield_now};
use embassy_time::{Duration, Instant, Timer, with_timeout};
use embedded_io_async::{Error, ErrorKind};
use proto_core::engine::{Input, PortId};

use super::control::PortControl;
use super::gateway::Gateway;
use super::watchdog::Pulse;
use crate::drivers::line::{Line, LineDirection, LineErrors};
use crate::fmt::DisplayText;
use crate::warn;

/// Runs the port forever.
pub async fn run(gateway: &Gateway, pulse: &Pulse, port: PortId, line: impl Line, baud: u32) -> ! {
    let Some(control) = gateway.port(port) else { core::future::pending().await };
    let mut task = SerialTask { gateway, port, control, line, chunk: [0; CHUNK] };
    let mut is_failing = false;
    let mut errors = LoggedErrors { errors: LineErrors::NONE, next_check: Instant::MIN };
    loop {
        gateway.input(Input::PortUp { port });
        let mut full_chunks = 0_usize;
        let failed = loop {
            let SerialTask { line, chunk, .. } = &mut task;
            let next = select3(line.read(chunk), control.bytes_wait(), Timer::at(errors.next_check));
            let next = pulse.idle(pin!(next)).await;
            let may_send = match next {
                Either3::First(Ok(len)) => {
                    task.report(len);
                    if Instant::now() >= errors.next_check {
                        errors.log(port, task.line.errors());
                    }
                    // Unread data is reported before anything is sent, up to a limit for a line that is never
                    // silent.
                    full_chunks = if len < CHUNK { 0 } else { full_chunks.saturating_add(1) };
                    let may_send = full_chunks == 0 || full_chunks >= FULL_CHUNKS;
                    if full_chunks > 0 {
                        gateway.more_waits();
                    }
                    // Let other tasks run even if the line is never silent.
                    yield_now().await;
                    may_send
                }
                Either3::First(Err(error)) => break error.kind(),
                Either3::Second(()) => true,
                Either3::Third(()) => {
                    // At a wrong baud rate errors are all that a line receives.
                    errors.log(port, task.line.errors());
                    continue;
                }
            };
            // The future holds only this copy of the frame, and no await except that of sending holds it.
            let Some(frame) = control.take_bytes_if(may_send) else { continue };
            full_chunks = 0;
            task.line.drive(LineDirection::Send);
            let sent = with_timeout(send_timeout(frame.len(), baud), task.send(&frame));
            // A long frame on a slow line takes seconds.
            let sent = pulse.idle(pin!(sent)).await;
            task.line.drive(LineDirection::Receive);
            match sent {
                Ok(Ok(())) => {
                    is_failing = false;
                    gateway.input(Input::PortSent { port });
                }
                Ok(Err(error)) => break error,
                Err(_) => break ErrorKind::TimedOut,
            }
        };
        // Only the first of consecutive failures is logged.
        if !is_failing {
            warn!("port {}: {}", port.0, DisplayText(&failed));
        }
        is_failing = true;
        task.report_waiting();
        gateway.input(Input::PortDown { port });
        control.clear();
        // If the line only does not accept bytes, it is read again without a pause.
        if failed != ErrorKind::TimedOut {
            Timer::after(RETRY).await;
        }
    }
}

struct SerialTask<'a, L> {
    gateway: &'a Gateway,
    port: PortId,
    control: &'a PortControl,
    line: L,
    chunk: [u8; CHUNK],
}

impl<L: Line> SerialTask<'_, L> {
    /// Reports the first `len` bytes of the chunk to the engine.
    fn report(&self, len: usize) {
        let bytes = self.chunk.get(..len).unwrap_or(&[]);
        self.gateway.input(Input::PortBytes { port: self.port, bytes });
    }

    fn report_waiting(&mut self) {
        for _ in 0..FULL_CHUNKS {
            match poll_once(self.line.read(&mut self.chunk)) {
                Poll::Ready(Ok(len @ 1..)) => self.report(len),
                _ => return,
            }
        }
    }

    /// Sends a frame and waits for the end of its last stop bit. If the gateway sleeps meanwhile, data in the device is
    /// old and must be reported even before the frame has left.
    async fn send(&mut self, frame: &[u8]) -> Result<(), ErrorKind> {
        self.control.clear_sleep();
        let mut rest = frame;
        while !rest.is_empty() {
            match select(self.line.write(rest), self.control.wait_for_sleep()).await {
                Either::First(Ok(len @ 1..)) => rest = rest.get(len..).unwrap_or(&[]),
                Either::First(Ok(0)) => return Err(ErrorKind::WriteZero),
                Either::First(Err(error)) => return Err(error.kind()),
                Either::Second(()) => self.report_waiting(),
            }
        }
        loop {
            match select(self.line.flush(), self.control.wait_for_sleep()).await {
                Either::First(flushed) => return flushed.map_err(|error| error.kind()),
                Either::Second(()) => self.report_waiting(),
            }
        }
    }
}

/// The errors logged last, and the time of the next check.
struct LoggedErrors {
    errors: LineErrors,
    next_check: Instant,
}

impl LoggedErrors {
    fn log(&mut self, port: PortId, errors: LineErrors) {
        self.next_check = Instant::now() + ERROR_PERIOD;
        if errors == self.errors {
            return;
        }
        self.errors = errors;
        let LineErrors { parity, framing, overruns, unread } = errors;
        warn!(
            "port {}: characters discarded: parity {}, framing {}; overruns {}, unread {}",
            port.0, parity, framing, overruns, unread
        );
    }
}

/// Time limit for sending: twice the duration of the bytes on the line (at most 12 bits each), plus a margin.
fn send_timeout(bytes: usize, baud: u32) -> Duration {
    let bits = (bytes as u64).saturating_mul(24_000_000);
    Duration::from_micros(bits / u64::from(baud.max(1))) + Duration::from_millis(20)
}

/// Bytes per read.
const CHUNK: usize = 256;
/// Number of full chunks in a row after which a frame may be sent: more than any device can buffer.
const FULL_CHUNKS: usize = 9;
const ERROR_PERIOD: Duration = Duration::from_secs(1);
/// Pause after a failure of the device.
const RETRY: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests;
