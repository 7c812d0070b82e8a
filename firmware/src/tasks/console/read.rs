//! Operations that read.

use core::fmt::{self, Write};

use embassy_futures::yield_now;
use embassy_time::Instant;
use proto_core::engine::FieldBus;
use recipe_api::claim::Claim;
use recipe_api::documents::Document;
use recipe_api::json;
use recipe_api::key::SCHEME;
use recipe_api::metrics::Families;
use recipe_api::nonces::MAX_AGE;
use recipe_api::response::{ContentType, Length, Page, StatusCode};
use recipe_api::revisions::{Etag, Revision, Revisions};
use recipe_api::route::ApiOperation;
use serde::Serialize;

use super::answer::{Reply, RequestOutcome, Responder, SendError, TextBuffer, busy, nothing_kept};
use super::arguments::ConsoleRequest;
use super::documents::DocumentSource;
use super::{Console, MAX_ANSWER, MAX_TIME};
use crate::clock::now;
use crate::journal;
use crate::platform::Ports;
use crate::tasks::store::{NOTHING, PART, StoreHandle};

impl Console {
    pub(super) async fn execute<'a>(
        &'a self,
        responder: &mut Responder<'_, '_>,
        request: ConsoleRequest<'a>,
    ) -> Result<RequestOutcome, SendError> {
        let reply = match request.operation {
            ApiOperation::Info => self.info(responder.buf),
            ApiOperation::Nonce => self.nonce(responder.buf),
            ApiOperation::Revisions => self.revisions(responder.buf, StatusCode::OK, None),
            ApiOperation::Edge => self.edge(responder.buf, StatusCode::OK),
            ApiOperation::Update => self.firmware(responder.buf, StatusCode::OK),
            ApiOperation::Status => {
                return self.document(responder, DocumentSource::of(Document::Status)).await;
            }
            ApiOperation::Values => {
                return self.document(responder, DocumentSource::of(Document::Values)).await;
            }
            ApiOperation::Metrics => {
                return self.document(responder, DocumentSource::Metrics(Families::new())).await;
            }
            ApiOperation::Stream => return self.stream(responder, &request).await,
            ApiOperation::Log => return log(responder, &request).await,
            ApiOperation::Page => return page(responder, &request).await,
            ApiOperation::Config => return self.config(responder, &request).await,
            _ => self.change(responder.buf, request).await,
        };
        Ok(RequestOutcome::Reply(reply))
    }

    fn nonce(&self, buf: &mut [u8]) -> Reply {
        let nonce = self.guard.borrow_mut().nonce(now());
        let age = MAX_AGE.as_millis() / 1_000;
        Reply::new(buf, StatusCode::OK, ContentType::Json, |out| {
            write!(out, "{{\"max_age_s\":{age},\"nonce\":\"{nonce}\",\"scheme\":\"{SCHEME}\"}}")
        })
    }

    #[inline(never)]
    fn info(&self, buf: &mut [u8]) -> Reply {
        Reply::new(buf, StatusCode::OK, ContentType::Json, |out| {
            let name = &self.name;
            let version = env!("CARGO_PKG_VERSION");
            write!(out, "{{\"role\":\"board\",\"name\":\"{name}\",\"version\":\"{version}\",\"api\":\"v1\"")?;
            let uptime = Instant::now().as_secs();
            let mut claim = self.claim.get();
            claim.poll(now());
            let is_claimed = claim == Claim::Claimed;
            write!(out, ",\"uptime_s\":{uptime},\"claimed\":{is_claimed},\"can_be_changed\":{is_claimed}")?;
            if let Claim::Open { until } = claim {
                write!(out, ",\"claim_left_s\":{}", until.saturating_since(now()).as_millis() / 1_000)?;
            }
            if let Some(running) = self.store.and_then(StoreHandle::running) {
                write!(out, ",\"revision\":{running}")?;
            }
            let Ports { lines, buses } = self.ports;
            write!(out, ",\"has\":{{\"rs485\":{lines},\"can\":{buses}}},\"places\":{{\"ports\":{{")?;
            self.gateway.report(|status| {
                status.ports().enumerate().try_for_each(|(nth, port)| {
                    out.write_str(if nth == 0 { "" } else { "," })?;
                    json::write_text(out, port.name)?;
                    out.write_str(match port.bus {
                        FieldBus::Rs485 => ":\"rs485\"",
                        FieldBus::ModbusTcp => ":\"modbus-tcp\"",
                        _ => ":\"can\"",
                    })
                })
            })?;
            let (connections, streams) = (self.connections.get(), self.streams.get());
            write!(
                out,
                "}}}},\"console\":{{\"connections\":{connections},\"streams\":{streams},\"requests\":"
            )?;
            write_json(out, self.guard.borrow().counters())?;
            out.write_str(",\"counters\":")?;
            write_json(out, &self.counters.get())?;
            out.write_str("}}")
        })
    }

    /// The revisions and their state; `changed` is the subject of a change.
    #[inline(never)]
    pub(super) fn revisions(&self, buf: &mut [u8], status: StatusCode, changed: Option<u32>) -> Reply {
        let Some(store) = self.store else { return nothing_kept(buf) };
        let reply = store.look(|revisions| {
            let etag = changed.and_then(|number| revisions.revision(number));
            let write = |out: &mut TextBuffer<'_>| write_revisions(out, store, revisions, changed);
            Reply::new(buf, status, ContentType::Json, write).about(etag)
        });
        // The store is being read, or an image is being adopted.
        reply.unwrap_or_else(|| busy(buf))
    }

    /// The image of the running configuration or of the requested revision.
    async fn config(
        &self,
        responder: &mut Responder<'_, '_>,
        request: &ConsoleRequest<'_>,
    ) -> Result<RequestOutcome, SendError> {
        let (store, revision) = match self.requested_revision(responder.buf, request) {
            Ok(found) => found,
            Err(reply) => return Ok(RequestOutcome::Reply(reply)),
        };
        if !responder.begin(ContentType::Image, Length::Chunked, Some(revision)).await? {
            return Ok(RequestOutcome::Sent);
        }
        let mut offset = 0;
        loop {
            let len = store.part(revision.number, offset, responder.buf).await.ok_or(SendError::Gone)?;
            responder.chunk(len, Instant::now() + MAX_TIME).await?;
            offset = offset.saturating_add(PART);
            if len < PART {
                responder.last_chunk().await?;
                return Ok(RequestOutcome::Sent);
            }
            yield_now().await;
        }
    }

    fn requested_revision(
        &self,
        buf: &mut [u8],
        request: &ConsoleRequest<'_>,
    ) -> Result<(&'static StoreHandle, Revision), Reply> {
        let Some(store) = self.store else { return Err(nothing_kept(buf)) };
        let number = match request.head.number {
            None => store.running(),
            Some(Some(number)) => Some(number),
            Some(None) => {
                return Err(Reply::error(buf, StatusCode::BAD_REQUEST, "revision must be a number"));
            }
        };
        let revision = number.and_then(|number| store.look(|revisions| revisions.revision(number)).flatten());
        let Some(revision) = revision.filter(|revision| *revision != NOTHING) else {
            return Err(Reply::error(buf, StatusCode::NOT_FOUND, "there is no such revision"));
        };
        if request.head.if_none_match == Some(revision) {
            let unchanged = Reply::new(buf, StatusCode::NOT_MODIFIED, ContentType::Image, |_| Ok(()));
            return Err(unchanged.about(Some(revision)));
        }
        Ok((store, revision))
    }
}

async fn log(
    responder: &mut Responder<'_, '_>,
    request: &ConsoleRequest<'_>,
) -> Result<RequestOutcome, SendError> {
    let lines = match request.head.number {
        None => MAX_LINES,
        Some(Some(lines @ 1..=MAX_LINES)) => lines,
        Some(_) => {
            let text = "lines is out of range; allowed: 1..=256";
            return Ok(RequestOutcome::Reply(Reply::error(responder.buf, StatusCode::BAD_REQUEST, text)));
        }
    };
    if !responder.begin(ContentType::Text, Length::Chunked, None).await? {
        return Ok(RequestOutcome::Sent);
    }
    let mut place = journal::last(lines as usize);
    // Lines added meanwhile are not sent.
    for _ in 0..journal::CAPACITY.div_ceil(LOG_PIECE) {
        let (len, behind) = journal::read(place, responder.buf.get_mut(..LOG_PIECE).unwrap_or(&mut []));
        if len == 0 {
            break;
        }
        place = behind;
        responder.chunk(len, Instant::now() + MAX_TIME).await?;
        yield_now().await;
    }
    responder.last_chunk().await?;
    Ok(RequestOutcome::Sent)
}

/// Sends the web page, unless the client has it cached.
async fn page(
    responder: &mut Responder<'_, '_>,
    request: &ConsoleRequest<'_>,
) -> Result<RequestOutcome, SendError> {
    let status = request.head.page;
    let mut buf = TextBuffer::new(responder.buf);
    PAGE.write_head(status, &mut buf).map_err(|_| SendError::TooLong)?;
    let (head, until) = (buf.len, Instant::now() + MAX_ANSWER);
    responder.send_part(0, head, until.min(Instant::now() + MAX_TIME)).await?;
    if responder.is_head || status != StatusCode::OK {
        return Ok(RequestOutcome::Sent);
    }
    for piece in PAGE.bytes.chunks(PAGE_PIECE) {
        responder.send(piece, until.min(Instant::now() + MAX_TIME)).await?;
        yield_now().await;
    }
    Ok(RequestOutcome::Sent)
}

fn write_revisions(
    out: &mut TextBuffer<'_>,
    store: &StoreHandle,
    revisions: &Revisions,
    changed: Option<u32>,
) -> fmt::Result {
    out.write_str("{\"kept\":[")?;
    let stored = revisions.kept().iter().filter(|revision| **revision != NOTHING);
    for (nth, revision) in stored.enumerate() {
        let comma = if nth == 0 { "" } else { "," };
        write!(out, "{comma}{{\"revision\":{},\"etag\":", revision.number)?;
        json::write_text(out, Etag(*revision))?;
        out.write_char('}')?;
    }
    out.write_char(']')?;
    let real = |number: Option<u32>| number.filter(|number| *number != NOTHING.number);
    let numbers = [
        ("running", store.running()),
        ("live", real(Some(revisions.live()))),
        ("previous", real(revisions.previous())),
        ("waiting", revisions.waiting()),
        ("revision", changed),
    ];
    for (name, number) in numbers {
        if let Some(number) = number {
            write!(out, ",\"{name}\":{number}")?;
        }
    }
    if let Some((number, until)) = revisions.trial() {
        let left = until.saturating_since(now()).as_millis();
        write!(out, ",\"trial\":{{\"revision\":{number},\"left_s\":{}.{:03}}}", left / 1_000, left % 1_000)?;
    }
    if let Some(base) = revisions.base() {
        out.write_str(",\"base\":")?;
        json::write_text(out, Etag(base))?;
    }
    if let Some((number, ended)) = revisions.last() {
        write!(out, ",\"last\":{{\"revision\":{number},\"ended\":\"{}\"}}", ended.name())?;
    }
    store.failure(|failure| {
        if failure.is_empty() {
            return Ok(());
        }
        out.write_str(",\"failure\":")?;
        json::write_text(out, failure)
    })?;
    out.write_char('}')
}

fn write_json(out: &mut TextBuffer<'_>, value: &impl Serialize) -> fmt::Result {
    json::write(out, value).map_err(|_| fmt::Error)
}

pub(super) const PAGE: Page =
    Page { bytes: &recipe_console::PAGE, policy: recipe_console::POLICY, etag: recipe_console::ETAG };
/// Bytes of the web page per write.
const PAGE_PIECE: usize = 1024;
const MAX_LINES: u32 = 256;
const LOG_PIECE: usize = 1024;
