//! A request with the arguments of its operation: those of the head, and those of the body.

use core::net::Ipv4Addr;

use proto_core::engine::PortId;
use proto_core::time::Duration as Span;
use recipe_api::arguments::{ArgumentValue, each};
use recipe_api::key::{KEY_LEN, Key, from_hex};
use recipe_api::request::{HttpHead, Method};
use recipe_api::response::StatusCode;
use recipe_api::revisions::{Etag, Revision};
use recipe_api::route::ApiOperation;

use crate::tasks::store::StoreLock;

/// A request after its head was parsed and its client admitted.
pub(super) struct ConsoleRequest<'a> {
    pub(super) head: HeadArguments,
    pub(super) operation: ApiOperation,
    pub(super) arguments: Arguments,
    /// Length of the body in the image buffer of the store handle, and the lock on it.
    pub(super) image: Option<(usize, StoreLock<'a>)>,
    pub(super) peer: Ipv4Addr,
}

/// The arguments in the head of a request. They are all parsed at once, so that the buffer with the head is free for
/// the reply.
#[derive(Debug, Clone, Copy)]
pub(super) struct HeadArguments {
    pub(super) method: Method,
    /// `revision`, `lines` or `offset`; an operation has at most one of them. `Some(None)`: not a number.
    pub(super) number: Option<Option<u32>>,
    /// `downgrade` or `restart`; `Some(false)`: not `yes`.
    pub(super) yes: Option<bool>,
    pub(super) frames: bool,
    /// The port of the frames; `Some(None)`: there is no such port.
    pub(super) port: Option<Option<PortId>>,
    /// `If-Match`; `Some(None)`: not one ETag.
    pub(super) if_match: Option<Option<Revision>>,
    /// `If-None-Match`, if it is the ETag of a revision.
    pub(super) if_none_match: Option<Revision>,
    /// Status of the page, which depends on `If-None-Match`.
    pub(super) page: StatusCode,
}

impl HeadArguments {
    /// `find` returns the port of a name.
    pub(super) fn of(
        head: &HttpHead<'_>,
        page: StatusCode,
        find: impl FnOnce(&str) -> Option<PortId>,
    ) -> Self {
        let first = |names: &[&str]| names.iter().find_map(|name| head.query(name));
        Self {
            method: head.method,
            number: first(&["revision", "lines", "offset"]).map(|text| text.parse().ok()),
            yes: first(&["downgrade", "restart"]).map(|text| text == "yes"),
            frames: head.query("frames") == Some("1"),
            port: head.query("port").map(find),
            if_match: head.if_match.map(Etag::parse),
            if_none_match: head.if_none_match.and_then(Etag::parse),
            page,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Arguments {
    /// The operation takes no arguments.
    None,
    Apply {
        number: Option<u32>,
        trial: Span,
    },
    /// The key of `claim`.
    Key([u8; KEY_LEN]),
    /// Duration of the trial of `update/try`, in seconds.
    Try(u16),
    /// Duration of `identify`, in seconds.
    Seconds(u32),
    /// Invalid; the text says what is allowed.
    Wrong(&'static str),
}

impl Arguments {
    #[inline(never)]
    pub(super) fn parse(operation: ApiOperation, body: &[u8]) -> Self {
        match operation {
            ApiOperation::Apply => apply(body),
            ApiOperation::Claim => claim(body),
            ApiOperation::Identify => identify(body),
            ApiOperation::TryUpdate => try_update(body),
            _ if each(body, |_, _| false) => Self::None,
            _ => Self::Wrong("this operation takes no arguments"),
        }
    }
}

fn apply(body: &[u8]) -> Arguments {
    let (mut number, mut trial) = (None, None);
    let is_read = each(body, |name, value| match (name, value) {
        ("confirm_s", ArgumentValue::Thousandths(millis)) => {
            trial.replace(Span::from_millis(millis)).is_none()
        }
        ("revision", value) => {
            let is_new = number.is_none();
            number = value.whole();
            is_new && number.is_some()
        }
        _ => false,
    });
    match is_read {
        true => Arguments::Apply { number, trial: trial.unwrap_or(DEFAULT_TRIAL) },
        false => Arguments::Wrong("apply takes an object with the numbers confirm_s and revision"),
    }
}

fn claim(body: &[u8]) -> Arguments {
    let mut key = None;
    let is_read = each(body, |name, value| match (name, value) {
        ("key", ArgumentValue::Text(text)) if Key::parse(text).is_some() => {
            key.replace(from_hex::<KEY_LEN>(text)).is_none()
        }
        _ => false,
    });
    match key.flatten().filter(|_| is_read) {
        Some(key) => Arguments::Key(key),
        None => {
            Arguments::Wrong("key must be 32 hexadecimal digits that are not all equal: {\"key\": \"...\"}")
        }
    }
}

fn identify(body: &[u8]) -> Arguments {
    let mut seconds = None;
    let is_read = each(body, |name, value| {
        let is_new = seconds.is_none();
        seconds = value.whole().filter(|seconds| (1..=MAX_SECONDS).contains(seconds));
        name == "s" && is_new && seconds.is_some()
    });
    match is_read {
        true => Arguments::Seconds(seconds.unwrap_or(DEFAULT_SECONDS)),
        false => Arguments::Wrong("s is out of range; allowed: 1..=600"),
    }
}

fn try_update(body: &[u8]) -> Arguments {
    let mut seconds = None;
    let is_read = each(body, |name, value| {
        let is_new = seconds.is_none();
        seconds = value.whole().filter(|seconds| FIRMWARE_TRIAL.contains(seconds));
        name == "confirm_s" && is_new && seconds.is_some()
    });
    match is_read {
        true => {
            Arguments::Try(seconds.and_then(|seconds| seconds.try_into().ok()).unwrap_or(DEFAULT_FIRMWARE_S))
        }
        false => Arguments::Wrong("confirm_s is out of range; allowed: 60..=3600"),
    }
}

const FIRMWARE_TRIAL: core::ops::RangeInclusive<u32> = 60..=3600;
const DEFAULT_FIRMWARE_S: u16 = 300;
const DEFAULT_TRIAL: Span = Span::from_secs(60);
const DEFAULT_SECONDS: u32 = 10;
const MAX_SECONDS: u32 = 600;

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(operation: ApiOperation, body: &str) -> Arguments {
        Arguments::parse(operation, body.as_bytes())
    }

    #[test]
    fn each_operation_has_its_own() {
        let default = Arguments::Apply { number: None, trial: Span::from_secs(60) };
        assert_eq!(parse(ApiOperation::Apply, ""), default);
        assert_eq!(parse(ApiOperation::Apply, "{}"), default);
        let both = Arguments::Apply { number: Some(3), trial: Span::from_millis(1_500) };
        assert_eq!(parse(ApiOperation::Apply, "{\"confirm_s\": 1.5, \"revision\": 3}"), both);
        assert_eq!(parse(ApiOperation::Confirm, "{}"), Arguments::None);
        assert_eq!(parse(ApiOperation::Identify, ""), Arguments::Seconds(10));
        assert_eq!(parse(ApiOperation::Identify, "{\"s\":600}"), Arguments::Seconds(600));
        assert_eq!(parse(ApiOperation::TryUpdate, ""), Arguments::Try(300));
        assert_eq!(parse(ApiOperation::TryUpdate, "{\"confirm_s\":60}"), Arguments::Try(60));
        let key = parse(ApiOperation::Claim, "{\"key\": \"000102030405060708090a0b0c0d0eFF\"}");
        let bytes = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 255];
        assert_eq!(key, Arguments::Key(bytes));
    }

    #[test]
    fn what_is_unknown_or_comes_twice_is_refused() {
        for (operation, body) in [
            (ApiOperation::Apply, "{\"confirm\":1}"),
            (ApiOperation::Apply, "{\"confirm_s\":1,\"confirm_s\":2}"),
            (ApiOperation::Apply, "{\"revision\":1.5}"),
            (ApiOperation::Confirm, "{\"a\":1}"),
            (ApiOperation::Rollback, "x"),
            (ApiOperation::Identify, "{\"s\":0}"),
            (ApiOperation::Identify, "{\"s\":601}"),
            (ApiOperation::Identify, "{\"t\":1}"),
            (ApiOperation::TryUpdate, "{\"confirm_s\":59}"),
            (ApiOperation::TryUpdate, "{\"s\":60}"),
            (ApiOperation::Claim, ""),
            (ApiOperation::Claim, "{\"key\":\"00\"}"),
            (ApiOperation::Claim, "{\"key\":\"00000000000000000000000000000000\"}"),
        ] {
            assert!(matches!(parse(operation, body), Arguments::Wrong(_)), "{operation:?} {body}");
        }
    }
}
