//! Documents about the engine, sent in pieces.

use embassy_futures::yield_now;
use embassy_time::Instant;
use proto_core::engine::Health;
use recipe_api::documents::{Document, Pieces};
use recipe_api::metrics::Families;
use recipe_api::response::{ContentType, Length, StatusCode};

use super::answer::{Reply, RequestOutcome, Responder, SendError, TextBuffer};
use super::{Console, MAX_ANSWER, MAX_TIME};

#[derive(Debug, Clone)]
pub(super) enum DocumentSource {
    Pieces(Pieces),
    Metrics(Families),
}

impl DocumentSource {
    pub(super) fn of(document: Document) -> Self {
        Self::Pieces(Pieces::of(document))
    }
}

impl Console {
    pub(super) async fn document(
        &self,
        responder: &mut Responder<'_, '_>,
        mut source: DocumentSource,
    ) -> Result<RequestOutcome, SendError> {
        if self.is_idle() {
            let text = "nothing runs at the moment; try again";
            return Ok(RequestOutcome::Reply(Reply::error(responder.buf, StatusCode::UNAVAILABLE, text)));
        }
        let kind = match source {
            DocumentSource::Pieces(_) => ContentType::Json,
            DocumentSource::Metrics(_) => ContentType::Metrics,
        };
        if !responder.begin(kind, Length::Chunked, None).await? {
            return Ok(RequestOutcome::Sent);
        }
        let until = Instant::now() + MAX_ANSWER;
        while let Some(len) = self.piece(responder, &mut source)? {
            responder.chunk(len, until.min(Instant::now() + MAX_TIME)).await?;
            yield_now().await;
        }
        responder.last_chunk().await?;
        Ok(RequestOutcome::Sent)
    }

    /// Writes the next piece into the buffer; returns its length. The engine is borrowed only here.
    pub(super) fn piece(
        &self,
        responder: &mut Responder<'_, '_>,
        source: &mut DocumentSource,
    ) -> Result<Option<usize>, SendError> {
        let mut buf = TextBuffer::new(responder.buf);
        let is_more = self.gateway.report(|status| match source {
            DocumentSource::Pieces(pieces) => {
                pieces.write_next(status, &mut buf).map_err(|_| SendError::TooLong)
            }
            DocumentSource::Metrics(families) => {
                families.write_next(status, &mut buf).map_err(|_| SendError::TooLong)
            }
        })?;
        Ok(is_more.then_some(buf.len))
    }

    pub(super) fn is_idle(&self) -> bool {
        self.gateway.report(|status| status.health()) == Health::Idle
    }
}
