//! Server-sent events: state and values five times a second.
//!
//! A client that reads slowly gets fewer events and is told how many it lost; one that does not read is
//! dropped.

use std::io;
use std::rc::Rc;
use std::time::Duration;

use recipe_remote::response::{Kind, Length, Status};
use rustix::net::sockopt;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use super::Server;
use super::http::{MAX_TIME, Reply, head_of, text_of};

/// Serves a stream until its client leaves or does not read.
pub(super) async fn serve(server: &Rc<Server>, mut stream: TcpStream) -> io::Result<()> {
    if server.streams.get() >= MAX_STREAMS {
        let reply = Reply::error(Status::UNAVAILABLE, "too many streams; poll /api/v1/status instead");
        return stream.write_all(text_of(&reply).as_bytes()).await;
    }
    server.streams.set(server.streams.get() + 1);
    let ended = follow(server, stream).await;
    server.streams.set(server.streams.get() - 1);
    ended
}

async fn follow(server: &Rc<Server>, stream: TcpStream) -> io::Result<()> {
    // Waiting events become old: about a second of them is enough.
    let _ = sockopt::set_socket_send_buffer_size(&stream, SEND_BUFFER);
    let reply = Reply { status: Status::OK, kind: Kind::Events, body: "".into(), fields: Vec::new() };
    let (mut read, mut write) = stream.into_split();
    let send = async {
        write.write_all(head_of(&reply, Length::Endless).as_bytes()).await?;
        let mut ticks = interval(PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut before: Option<Instant> = None;
        loop {
            let tick = ticks.tick().await;
            // Ticks are whole periods apart.
            let periods =
                before.map_or(1, |before| (tick - before + PERIOD / 2).as_millis() / PERIOD.as_millis());
            before = Some(tick);
            let lost = u64::try_from(periods.saturating_sub(1)).unwrap_or(u64::MAX);
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
            timeout(MAX_TIME, write.write_all(text.as_bytes())).await.unwrap_or_else(|_| {
                server.count(|counters| counters.slow_readers += 1);
                Err(io::ErrorKind::TimedOut.into())
            })?;
        }
    };
    let gone = async {
        // It has nothing more to say; what it says all the same is not looked at.
        let mut chunk = [0; 256];
        while read.read(&mut chunk).await.is_ok_and(|count| count > 0) {}
    };
    tokio::select! {
        ended = send => ended,
        () = gone => Ok(()),
    }
}

/// Bytes that the system keeps for a client.
const SEND_BUFFER: usize = 16 << 10;
/// Maximum number of streams; the other connections are for requests.
const MAX_STREAMS: usize = 4;
/// Time between two events.
const PERIOD: Duration = Duration::from_millis(200);
