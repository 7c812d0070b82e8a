//! Server-sent events: state and values five times a second, and frames for a client that asks for them.
//!
//! A slow client gets fewer events, with the number of those it missed. A client that does not read is disconnected.

use core::fmt::Write;

use embassy_futures::select::{Either, select};
use embassy_futures::yield_now;
use embassy_time::{Duration, Instant, Timer};
use recipe_api::documents::Document;
use recipe_api::response::{ContentType, Length, StatusCode};

use super::answer::{Reply, RequestOutcome, Responder, SendError, TextBuffer};
use super::arguments::ConsoleRequest;
use super::documents::DocumentSource;
use super::{ConnectionPermit, Console, MAX_TIME, STREAMS};

impl Console {
    /// Serves a stream until its client leaves or does not read.
    pub(super) async fn stream(
        &self,
        responder: &mut Responder<'_, '_>,
        request: &ConsoleRequest<'_>,
    ) -> Result<RequestOutcome, SendError> {
        let Some(_one) = ConnectionPermit::of(&self.streams, STREAMS) else {
            self.count(|counters| &mut counters.turned_away);
            let text = "too many streams; poll /api/v1/status instead";
            return Ok(RequestOutcome::Reply(Reply::error(responder.buf, StatusCode::UNAVAILABLE, text)));
        };
        let mut follower = None;
        if request.head.frames {
            follower = self.follow(request.head.port);
            if follower.is_none() {
                let text = "another client follows the frames; a board has room for one";
                return Ok(RequestOutcome::Reply(Reply::error(responder.buf, StatusCode::UNAVAILABLE, text)));
            }
        }
        responder.begin(ContentType::Events, Length::Endless, None).await?;
        let mut next = Instant::now();
        loop {
            if let Some(follower) = &mut follower {
                loop {
                    let mut buf = TextBuffer::new(responder.buf);
                    follower.write(&mut buf).map_err(|_| SendError::TooLong)?;
                    match buf.len {
                        0 => break,
                        len => responder.send_part(0, len, Instant::now() + MAX_TIME).await?,
                    }
                    yield_now().await;
                }
            }
            let now = Instant::now();
            if now >= next {
                let lost = now.duration_since(next).as_micros() / PERIOD.as_micros();
                next += PERIOD;
                if lost > 0 {
                    next = now + PERIOD;
                    self.lose(responder, lost).await?;
                }
                self.event(responder, "status", Document::Status).await?;
                self.event(responder, "values", Document::Values).await?;
            }
            let wake = if follower.is_some() { next.min(Instant::now() + FRAMES) } else { next };
            // Further input is ignored.
            let mut said = [0; 32];
            match select(Timer::at(wake), responder.socket.read(&mut said)).await {
                Either::First(()) | Either::Second(Ok(1..)) => {}
                Either::Second(_) => return Err(SendError::Gone),
            }
            yield_now().await;
        }
    }

    async fn event(
        &self,
        responder: &mut Responder<'_, '_>,
        name: &str,
        document: Document,
    ) -> Result<(), SendError> {
        let until = Instant::now() + MAX_TIME;
        if self.is_idle() {
            // No configuration runs. A comment keeps the stream alive.
            return responder.send(b":\n\n", until).await;
        }
        let mut source = DocumentSource::of(document);
        for text in ["event: ", name, "\ndata: "] {
            responder.send(text.as_bytes(), until).await?;
        }
        while let Some(len) = self.piece(responder, &mut source)? {
            responder.send_part(0, len, until).await?;
            yield_now().await;
        }
        responder.send(b"\n\n", until).await
    }

    async fn lose(&self, responder: &mut Responder<'_, '_>, lost: u64) -> Result<(), SendError> {
        for _ in 0..lost.min(1_000) {
            self.count(|counters| &mut counters.lost_events);
        }
        let mut text = heapless::String::<64>::new();
        write!(text, "event: lost\ndata: {{\"count\":{lost}}}\n\n").map_err(|_| SendError::TooLong)?;
        responder.send(text.as_bytes(), Instant::now() + MAX_TIME).await
    }
}

const PERIOD: Duration = Duration::from_millis(200);
/// Polling interval of the tap. At full load, its ring buffer holds the frames of little more than this time.
const FRAMES: Duration = Duration::from_millis(20);
