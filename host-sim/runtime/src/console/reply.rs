//! Responses: a status, a body and fields, and their bytes.

use std::rc::Rc;
use std::time::Duration;

use recipe_api::guard::Refusal;
use recipe_api::response::{ContentType, Length, Page, Response, StatusCode};
use serde_json::{Value, json};

#[derive(Debug)]
pub(super) struct HttpReply {
    pub(super) status: StatusCode,
    pub(super) kind: ContentType,
    pub(super) body: ReplyBody,
    pub(super) fields: Vec<(&'static str, String)>,
}

#[derive(Debug)]
pub(super) enum ReplyBody {
    Text(Rc<str>),
    /// Part of the program.
    Bytes(&'static [u8]),
    /// Made for this request.
    Made(Vec<u8>),
}

impl ReplyBody {
    pub(super) fn as_bytes(&self) -> &[u8] {
        match self {
            Self::Text(text) => text.as_bytes(),
            Self::Bytes(bytes) => bytes,
            Self::Made(bytes) => bytes,
        }
    }
}

impl<T: Into<Rc<str>>> From<T> for ReplyBody {
    fn from(text: T) -> Self {
        Self::Text(text.into())
    }
}

impl HttpReply {
    pub(super) fn new(status: StatusCode, kind: ContentType, body: impl Into<ReplyBody>) -> Self {
        Self { status, kind, body: body.into(), fields: Vec::new() }
    }

    /// A document that already exists.
    pub(super) fn text(kind: ContentType, body: Rc<str>) -> Self {
        Self::new(StatusCode::OK, kind, body)
    }

    pub(super) fn page(if_none_match: Option<&str>) -> Self {
        let status = PAGE.status(if_none_match);
        let bytes = if status == StatusCode::OK { PAGE.bytes } else { &[] };
        Self { body: ReplyBody::Bytes(bytes), ..Self::new(status, ContentType::Page, "") }
    }

    pub(super) fn image(bytes: Vec<u8>) -> Self {
        Self { body: ReplyBody::Made(bytes), ..Self::new(StatusCode::OK, ContentType::Image, "") }
    }

    pub(super) fn json(status: StatusCode, value: &Value) -> Self {
        Self::new(status, ContentType::Json, value.to_string())
    }

    /// An object with `error`.
    pub(super) fn error(status: StatusCode, text: &str) -> Self {
        Self::json(status, &json!({ "error": text }))
    }

    pub(super) fn with(mut self, name: &'static str, value: impl ToString) -> Self {
        self.fields.push((name, value.to_string()));
        self
    }
}

impl From<Refusal> for HttpReply {
    fn from(refusal: Refusal) -> Self {
        let reply = Self::error(refusal.status, refusal.text);
        let reply = match refusal.allow {
            Some(allow) => reply.with("Allow", allow),
            None => reply,
        };
        match refusal.retry_after_s {
            Some(seconds) => reply.with("Retry-After", seconds),
            None => reply,
        }
    }
}

pub(super) fn bytes_of(reply: &HttpReply) -> Vec<u8> {
    let body = reply.body.as_bytes();
    let mut bytes = head_of(reply, Length::Bytes(body.len() as u64)).into_bytes();
    bytes.extend_from_slice(body);
    bytes
}

pub(super) fn head_of(reply: &HttpReply, length: Length) -> String {
    let fields: Vec<(&str, &dyn std::fmt::Display)> =
        reply.fields.iter().map(|(name, value)| (*name, value as &dyn std::fmt::Display)).collect();
    let mut text = String::new();
    // Writing to a `String` cannot fail.
    let _ = match reply.kind {
        ContentType::Page => PAGE.write_head(reply.status, &mut text),
        kind => Response::new(reply.status, kind, length).with(&fields).write(&mut text),
    };
    text
}

/// The page for people.
const PAGE: Page =
    Page { bytes: &recipe_console::PAGE, policy: recipe_console::POLICY, etag: recipe_console::ETAG };
/// How long a request may take to arrive, and a response to be read.
pub(super) const MAX_TIME: Duration = Duration::from_secs(5);
