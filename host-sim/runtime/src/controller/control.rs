//! The control socket (docs/control.md section 1): JSON lines, and what each asks for.
//!
//! Requests of a client are executed in order. While a client does not read its answers, its requests are not read. A
//! client that follows events and does not read them loses those that the controller no longer keeps.

use std::cell::{Cell, RefCell};
use std::io;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use proto_core::time::Instant;
use serde::Serialize;
use serde_json::Value;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;
use tokio::task::spawn_local;
use tracing::{debug, warn};

use super::ControllerRuntime;
use recipe_controller::ControllerEvent;
use recipe_controller::operations::{Operation, check_kinds};
use recipe_io::fairness::yield_fairly;
use recipe_io::tcp_options;
use recipe_io::timer;

#[derive(Debug, Default)]
pub(super) struct ControlClient {
    /// Lines that wait for the client.
    out: RefCell<Vec<u8>>,
    /// Since when the system has accepted none of these bytes.
    blocked_since: Cell<Option<Instant>>,
    /// The events that the client follows.
    follows: RefCell<Option<Follow>>,
    /// The client makes no more requests.
    has_ended: Cell<bool>,
    wake: Notify,
    /// Wakes the client's reading half after a write.
    written: Notify,
}

#[derive(Debug)]
struct Follow {
    /// Empty: all kinds.
    kinds: Vec<String>,
    next: u64,
}

#[derive(Serialize)]
struct ControlReply {
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<Value>,
    ok: bool,
    time_s: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    result: Option<Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
enum Notice<'a> {
    Event(&'a ControllerEvent),
    Lost(u64),
}

impl ControlClient {
    pub(super) fn blocked_since(&self) -> Option<Instant> {
        self.blocked_since.get()
    }

    /// Wakes the task that writes the events that the client follows.
    pub(super) fn notify(&self) {
        if self.follows.borrow().is_some() {
            self.wake.notify_one();
        }
    }

    fn push(&self, line: &impl Serialize) {
        let mut out = self.out.borrow_mut();
        // Cannot fail: the value came from JSON and is written to memory.
        let _ = serde_json::to_writer(&mut *out, line);
        out.push(b'\n');
        if self.blocked_since.get().is_none() {
            self.blocked_since.set(Some(timer::now()));
        }
        self.wake.notify_one();
    }
}

impl ControllerRuntime {
    pub(super) async fn serve_control(self: Rc<Self>, listener: TcpListener) {
        loop {
            let failed = |error: &io::Error| {
                self.count(|counters| counters.accept_failures += 1);
                if let Some(more) = self.log_limit.allow(timer::now()) {
                    warn!(%error, more, "cannot accept a client of the control socket");
                }
            };
            let (stream, peer) = tcp_options::accept(&listener, failed).await;
            self.note_activity();
            debug!(%peer, "control client connected");
            Rc::clone(&self).welcome(stream);
            yield_fairly().await;
        }
    }

    fn welcome(self: Rc<Self>, stream: TcpStream) {
        let client = Rc::new(ControlClient::default());
        if self.control_clients.borrow().len() < MAX_CLIENTS {
            self.control_clients.borrow_mut().push(Rc::clone(&client));
        } else if self.refused_control_clients.get() < MAX_CLIENTS {
            client.push(&self.answer(None, Err(format!("there are {MAX_CLIENTS} clients already"))));
            client.has_ended.set(true);
            self.refused_control_clients.set(self.refused_control_clients.get() + 1);
        } else {
            return;
        }
        let is_refused = client.has_ended.get();
        spawn_local(async move {
            let ended = self.read_lines(stream, &client).await;
            debug!(?ended, "control client disconnected");
            self.control_clients.borrow_mut().retain(|other| !Rc::ptr_eq(other, &client));
            if is_refused {
                self.refused_control_clients.set(self.refused_control_clients.get() - 1);
            }
        });
    }

    async fn read_lines(&self, stream: TcpStream, client: &ControlClient) -> io::Result<()> {
        tcp_options::enable_keepalive(&stream);
        let (read, mut write) = stream.into_split();
        let mut read = BufReader::new(read);
        let reading = async {
            if !client.has_ended.get() {
                self.execute_lines(client, &mut read).await?;
            }
            client.has_ended.set(true);
            client.wake.notify_one();
            if client.follows.borrow().is_some() {
                return std::future::pending().await;
            }
            tokio::time::sleep(LINGER).await;
            io::Result::Err(io::ErrorKind::TimedOut.into())
        };
        tokio::select! {
            ended = self.write(client, &write) => ended?,
            ended = reading => ended?,
        }
        // Closing with unread requests would reset the connection, and drop answers that wait at the client.
        write.shutdown().await?;
        let all_read = async { while read.read(&mut [0; 4_096]).await.is_ok_and(|count| count > 0) {} };
        let _ = tokio::time::timeout(LINGER, all_read).await;
        Ok(())
    }

    async fn execute_lines(
        &self,
        client: &ControlClient,
        read: &mut BufReader<OwnedReadHalf>,
    ) -> io::Result<()> {
        let mut line = Vec::new();
        loop {
            while client.out.borrow().len() > MAX_UNREAD {
                client.written.notified().await;
            }
            let request = match next_line(read, &mut line).await? {
                ControlLine::End => return Ok(()),
                ControlLine::TooLong => Err(format!("the line is longer than {MAX_LINE} bytes")),
                ControlLine::Whole => match serde_json::from_slice(&line) {
                    Ok(Value::Object(request)) => Ok(request),
                    Ok(_) => Err("not a JSON object".to_owned()),
                    Err(error) => Err(format!("not a JSON object: {error}")),
                },
            };
            self.note_activity();
            let mut request = match request {
                Ok(request) => request,
                Err(error) => {
                    client.follows.take();
                    client.push(&self.answer(None, Err(format!("{error}; the connection is closed"))));
                    return Ok(());
                }
            };
            let id = request.remove("id");
            let done = match Operation::from_json(request) {
                Ok(operation) => self.perform(client, operation).await,
                Err(error) => Err(error.to_string()),
            };
            // Events that occurred before go first.
            self.push_events(client);
            client.push(&self.answer(id, done));
            self.note_activity();
            yield_fairly().await;
        }
    }

    async fn perform(&self, client: &ControlClient, operation: Operation) -> Result<Value, String> {
        match operation {
            Operation::Follow { kinds } => {
                check_kinds(&kinds).map_err(|error| error.to_string())?;
                let next = self.controller.borrow().newest_event() + 1;
                *client.follows.borrow_mut() = Some(Follow { kinds, next });
                Ok(Value::Null)
            }
            Operation::Advance { seconds } => self.advance_clock(seconds).await.map(|()| Value::Null),
            Operation::Wait { until, timeout_s } => {
                self.wait_for(until, timeout_s).await.map(|()| Value::Null)
            }
            other => self.operate(&other),
        }
    }

    fn answer(&self, id: Option<Value>, done: Result<Value, String>) -> ControlReply {
        let time_s = self.controller.borrow().time_s(self.clock.now());
        let (ok, result, error) = match done {
            Ok(result) => (true, Some(result), None),
            Err(error) => (false, None, Some(error)),
        };
        ControlReply { id, ok, time_s, result, error }
    }

    /// Adds the events that a client follows to its waiting bytes, while there is room.
    fn push_events(&self, client: &ControlClient) {
        let mut follows = client.follows.borrow_mut();
        let Some(follow) = follows.as_mut() else { return };
        let controller = self.controller.borrow();
        let dropped = controller.dropped_events();
        if dropped >= follow.next {
            let kept = controller.events_since(follow.next).take_while(|event| event.number <= dropped);
            client.push(&Notice::Lost(dropped + 1 - follow.next - kept.count() as u64));
        }
        for event in controller.events_since(follow.next) {
            if client.out.borrow().len() > MAX_UNREAD {
                return;
            }
            follow.next = event.number + 1;
            if follow.kinds.is_empty() || follow.kinds.iter().any(|kind| kind == event.what.kind()) {
                client.push(&Notice::Event(event));
            }
        }
    }

    /// Writes the client's waiting bytes until the client has ended and none wait.
    async fn write(&self, client: &ControlClient, write: &OwnedWriteHalf) -> io::Result<()> {
        loop {
            self.push_events(client);
            if client.out.borrow().is_empty() {
                client.blocked_since.set(None);
                if client.has_ended.get() && client.follows.borrow().is_none() {
                    return Ok(());
                }
                client.wake.notified().await;
                continue;
            }
            write.writable().await?;
            let mut out = client.out.borrow_mut();
            match write.try_write(&out) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(count) => {
                    drop(out.drain(..count));
                    if out.is_empty() {
                        // Releases the memory that a long answer needed.
                        *out = Vec::new();
                    }
                    client.blocked_since.set(Some(timer::now()));
                    client.written.notify_one();
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error),
            }
        }
    }
}

enum ControlLine {
    Whole,
    TooLong,
    End,
}

/// Reads a line without its end. The last line needs no end.
async fn next_line(read: &mut BufReader<OwnedReadHalf>, line: &mut Vec<u8>) -> io::Result<ControlLine> {
    line.clear();
    loop {
        let chunk = read.fill_buf().await?;
        let end = chunk.iter().position(|&byte| byte == b'\n');
        let count = end.unwrap_or(chunk.len());
        if line.len() + count > MAX_LINE {
            return Ok(ControlLine::TooLong);
        }
        if count == 0 && end.is_none() {
            return Ok(if line.is_empty() { ControlLine::End } else { ControlLine::Whole });
        }
        line.extend_from_slice(chunk.get(..count).unwrap_or(chunk));
        read.consume(count + usize::from(end.is_some()));
        if end.is_some() {
            return Ok(ControlLine::Whole);
        }
    }
}

/// Maximum number of clients, and of refused clients that are told so.
pub(super) const MAX_CLIENTS: usize = 16;
/// Maximum length of a request, in bytes.
pub(super) const MAX_LINE: usize = 1 << 20;
/// With more bytes waiting, a client is not read, and no events are added for it.
const MAX_UNREAD: usize = 256 << 10;
/// How long a client that makes no more requests may take to read its answers, and then to close.
const LINGER: StdDuration = StdDuration::from_secs(2);
