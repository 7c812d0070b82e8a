//! Endless responses: captures, and server-sent events with state and values five times a second, and with decoded
//! frames on request.
//!
//! A client that reads slowly gets fewer events, with the number of lost ones; one that does not read is disconnected.

use std::io;
use std::rc::Rc;
use std::time::Duration;

use recipe_api::request::HttpHead;
use recipe_api::response::{ContentType, Length, StatusCode};
use recipe_api::route::ApiOperation;
use recipe_capture::Watch;
use rustix::net::sockopt;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::net::tcp::OwnedWriteHalf;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use super::frames::{CaptureStream, FrameEvents};
use super::reply::{HttpReply, MAX_TIME, bytes_of, head_of};
use super::{ConsoleServer, ConsoleSource};

enum Endless {
    Events(Option<FrameEvents>),
    Capture(Box<CaptureStream>),
}

/// Serves a stream until its client leaves or does not read.
pub(super) async fn serve(
    server: &Rc<ConsoleServer>,
    mut stream: TcpStream,
    operation: ApiOperation,
    head: &HttpHead<'_>,
) -> io::Result<()> {
    let endless = if server.streams.get() >= MAX_STREAMS {
        Err(HttpReply::error(StatusCode::UNAVAILABLE, "too many streams; poll /api/v1/status instead"))
    } else {
        endless(server, operation, head)
    };
    match endless {
        Err(refused) => stream.write_all(&bytes_of(&refused)).await,
        Ok(endless) => {
            server.streams.set(server.streams.get() + 1);
            let ended = follow(server, stream, endless).await;
            server.streams.set(server.streams.get() - 1);
            ended
        }
    }
}

fn endless(
    server: &ConsoleServer,
    operation: ApiOperation,
    head: &HttpHead<'_>,
) -> Result<Endless, HttpReply> {
    let watch = || match &server.source {
        ConsoleSource::Gateway { watch, .. } => Ok::<&Watch, HttpReply>(watch),
        ConsoleSource::Controller { .. } => {
            Err(HttpReply::error(StatusCode::BAD_REQUEST, "only a gateway has frames"))
        }
    };
    if operation == ApiOperation::Capture {
        let port = server.field_port(head)?;
        return Ok(Endless::Capture(Box::new(CaptureStream::of(watch()?, port))));
    }
    match (head.query("frames"), head.query("port")) {
        (Some("1"), _) => {
            let watch = watch()?;
            Ok(Endless::Events(Some(FrameEvents::of(watch, server.field_port(head)?))))
        }
        (None | Some("0"), None) => Ok(Endless::Events(None)),
        (None | Some("0"), Some(_)) => {
            Err(HttpReply::error(StatusCode::BAD_REQUEST, "port is for frames; add frames=1"))
        }
        (Some(_), _) => Err(HttpReply::error(StatusCode::BAD_REQUEST, "frames must be 0 or 1")),
    }
}

async fn follow(server: &Rc<ConsoleServer>, stream: TcpStream, endless: Endless) -> io::Result<()> {
    let kind = match &endless {
        Endless::Events(_) => ContentType::Events,
        Endless::Capture(_) => ContentType::Capture,
    };
    // Waiting events become old: about a second of them is enough.
    let _ = sockopt::set_socket_send_buffer_size(&stream, SEND_BUFFER);
    let reply = HttpReply::new(StatusCode::OK, kind, "");
    let (mut read, mut write) = stream.into_split();
    let send = async {
        put(server, &mut write, head_of(&reply, Length::Endless).as_bytes()).await?;
        match endless {
            Endless::Events(frames) => events(server, &mut write, frames).await,
            Endless::Capture(capture) => blocks(server, &mut write, *capture).await,
        }
    };
    let gone = async {
        // Further input is ignored.
        let mut chunk = [0; 256];
        while read.read(&mut chunk).await.is_ok_and(|count| count > 0) {}
    };
    tokio::select! {
        ended = send => ended,
        () = gone => Ok(()),
    }
}

/// Events until the client does not read.
async fn events(
    server: &ConsoleServer,
    write: &mut OwnedWriteHalf,
    mut frames: Option<FrameEvents>,
) -> io::Result<()> {
    let mut ticks = interval(PERIOD);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut frame_ticks = interval(FRAME_PERIOD);
    frame_ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut before: Option<Instant> = None;
    loop {
        let text = tokio::select! {
            tick = ticks.tick() => {
                // Ticks are whole periods apart.
                let periods =
                    before.map_or(1, |before| (tick - before + PERIOD / 2).as_millis() / PERIOD.as_millis());
                before = Some(tick);
                states(server, u64::try_from(periods.saturating_sub(1)).unwrap_or(u64::MAX)).await
            }
            _ = frame_ticks.tick(), if frames.is_some() => {
                let mut text = String::new();
                if let Some((data, lost)) = frames.as_mut().and_then(FrameEvents::event) {
                    server.count(|counters| counters.lost_frames += lost);
                    text = format!("event: frames\ndata: {data}\n\n");
                }
                text
            }
        };
        put(server, write, text.as_bytes()).await?;
    }
}

/// State and values, and the number of events left out before.
async fn states(server: &ConsoleServer, lost: u64) -> String {
    let mut text = String::new();
    if lost > 0 {
        server.count(|counters| counters.lost_events += lost);
        text += &format!("event: lost\ndata: {{\"count\":{lost}}}\n\n");
    }
    match server.snapshots.newest(&server.source).await {
        Some(snapshot) => {
            text += &format!("event: status\ndata: {}\n\n", snapshot.status());
            if let Some(values) = snapshot.values() {
                text += &format!("event: values\ndata: {values}\n\n");
            }
        }
        // Nothing runs at the moment. A comment shows that the stream is still there.
        None => text += ":\n\n",
    }
    text
}

/// The blocks of a capture until the client does not read.
async fn blocks(
    server: &ConsoleServer,
    write: &mut OwnedWriteHalf,
    mut capture: CaptureStream,
) -> io::Result<()> {
    let mut ticks = interval(FRAME_PERIOD);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        ticks.tick().await;
        put(server, write, &capture.blocks()).await?;
    }
}

async fn put(server: &ConsoleServer, write: &mut OwnedWriteHalf, bytes: &[u8]) -> io::Result<()> {
    timeout(MAX_TIME, write.write_all(bytes)).await.unwrap_or_else(|_| {
        server.count(|counters| counters.slow_readers += 1);
        Err(io::ErrorKind::TimedOut.into())
    })
}

/// Bytes that the kernel buffers for a client.
const SEND_BUFFER: usize = 16 << 10;
/// Maximum number of streams; the other connections are for requests.
const MAX_STREAMS: usize = 4;
/// Time between two events.
const PERIOD: Duration = Duration::from_millis(200);
/// Time between two events with frames, and two pieces of a capture.
const FRAME_PERIOD: Duration = Duration::from_millis(50);
