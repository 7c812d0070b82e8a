//! Who may do what: checks hosts, origins, types, lengths and keys, in this order, before a driver executes anything.
//!
//! In: the head of a request, the addresses of its connection, the current time. Out: the operation, or a refusal.
//! Does not know bodies: a signed request names the hash of its body, which [`Admitted::is_body`] compares.

use core::net::IpAddr;

use proto_core::time::Instant;

use crate::address;
use crate::attempts::Attempts;
use crate::key::{self, Hash, Key, SCHEME, Signed};
use crate::nonces::{NonceError, NonceText, Nonces};
use crate::request::{HeadError, HttpHead, Method, cut, trim};
use crate::response::StatusCode;
use crate::route::{self, Access, ApiOperation, BodyType, RouteError, Served};

/// Maximum length of a body in bytes.
pub const MAX_BODY: u64 = 64 << 10;
/// Maximum length of a configuration image in bytes.
pub const MAX_IMAGE: u64 = 16 << 10;
/// Maximum length of arguments for a board in bytes.
pub const MAX_ARGUMENTS: u64 = 256;

/// The key, and what has to be remembered about requests.
#[derive(Debug, Clone)]
pub struct Guard {
    key: Option<Key>,
    secret: Hash,
    nonces: Nonces,
    attempts: Attempts,
    counters: RequestCounters,
}

/// Counters of requests. They wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
#[non_exhaustive]
pub struct RequestCounters {
    /// Requests that were admitted.
    pub admitted: u32,
    /// Requests that match no endpoint in path, method, type or length.
    pub unfit: u32,
    /// Requests for another host, such as a foreign name that resolves to this address (DNS rebinding).
    pub wrong_host: u32,
    /// Requests from pages of another origin.
    pub cross_site: u32,
    /// Requests without the key they need.
    pub without_key: u32,
    /// Requests with a wrong key or signature.
    pub wrong_key: u32,
    /// Signed requests whose nonce was already used or too old.
    pub replayed: u32,
    /// Requests that were refused unchecked, after too many wrong keys.
    pub locked_out: u32,
}

/// The addresses of a connection.
#[derive(Debug, Clone, Copy)]
pub struct Site<'a> {
    /// The fields that a signature covers, with a line feed after each of the four.
    pub local: IpAddr,
    /// The address of the other end.
    pub peer: IpAddr,
    /// Names of this server, in addition to its address and `localhost`.
    pub names: &'a [&'a str],
}

impl Site<'_> {
    /// Whether both ends are on one machine.
    pub fn is_loopback(&self) -> bool {
        self.local.to_canonical().is_loopback() && self.peer.to_canonical().is_loopback()
    }

    /// Whether `name` is this server. A page of another site can make its own name resolve to our address and then read
    /// our responses (DNS rebinding), but it cannot choose the host that the browser sends.
    fn is_host(&self, name: &str) -> bool {
        let bare = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
        match address::parse(bare) {
            Some(address) => address == self.local.to_canonical(),
            None if name.eq_ignore_ascii_case("localhost") => self.is_loopback(),
            None => self.names.iter().any(|own| own.eq_ignore_ascii_case(name)),
        }
    }
}

/// A request that may be executed once its body has arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Admitted {
    /// The requested operation.
    pub operation: ApiOperation,
    /// Only the head of the response is wanted.
    pub is_head: bool,
    /// Length of the body in bytes.
    pub length: u64,
    /// The client waits for [`crate::response::CONTINUE`] before it sends the body.
    pub expects_continue: bool,
    body: Option<Hash>,
}

impl Admitted {
    /// Whether `hash` is the signed hash of the body; true if the request is not signed.
    pub fn is_body(&self, hash: &Hash) -> bool {
        // Constant time is not needed: the hash is no secret, an eavesdropper sees both.
        self.body.is_none_or(|signed| signed == *hash)
    }

    /// Whether the body has to be checked with [`Admitted::is_body`].
    pub const fn is_signed(&self) -> bool {
        self.body.is_some()
    }
}

/// Why a request is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Refusal {
    /// The status of the response.
    pub status: StatusCode,
    /// An explanation for people.
    pub text: &'static str,
    /// The value of `Allow`, for status 405.
    pub allow: Option<&'static str>,
    /// The value of `Retry-After` in seconds, for status 429.
    pub retry_after_s: Option<u64>,
}

impl Refusal {
    /// A refusal without header fields of its own.
    pub const fn new(status: StatusCode, text: &'static str) -> Self {
        Self { status, text, allow: None, retry_after_s: None }
    }
}

impl From<HeadError> for Refusal {
    fn from(error: HeadError) -> Self {
        let (status, text) = match error {
            HeadError::Incomplete => (StatusCode::TIMEOUT, "the request did not arrive in time"),
            HeadError::TooLong => {
                (StatusCode::HEAD_TOO_LARGE, "the head is too long; allowed: 2048 bytes, 32 fields")
            }
            HeadError::Malformed => (StatusCode::BAD_REQUEST, "not a request of HTTP/1.1"),
            HeadError::Version => (StatusCode::VERSION, "only HTTP/1.1 is served"),
            HeadError::NoHost => (StatusCode::BAD_REQUEST, "Host is missing"),
            HeadError::Repeated => (StatusCode::BAD_REQUEST, "a field that may come once comes twice"),
            HeadError::NoLength => {
                (StatusCode::LENGTH_REQUIRED, "a body needs a Content-Length; no encoding is taken")
            }
            HeadError::Expectation => (StatusCode::EXPECTATION_FAILED, "Expect may only be 100-continue"),
        };
        Self::new(status, text)
    }
}

impl Guard {
    /// A guard with this key. Without a key nothing can be changed, and nothing can be read over a network.
    /// `secret` is random and different after each start.
    pub fn new(key: Option<Key>, secret: Hash) -> Self {
        Self {
            key,
            secret,
            nonces: Nonces::new(secret),
            attempts: Attempts::new(),
            counters: RequestCounters::default(),
        }
    }

    /// Whether there is a key.
    pub const fn has_key(&self) -> bool {
        self.key.is_some()
    }

    /// Sets the key, for example when a board was claimed.
    pub fn set_key(&mut self, key: Option<Key>) {
        self.key = key;
    }

    /// Counters since the start.
    pub const fn counters(&self) -> &RequestCounters {
        &self.counters
    }

    /// A nonce for one signed request.
    pub fn nonce(&mut self, now: Instant) -> NonceText {
        self.nonces.give(now)
    }

    /// Admits or refuses a request.
    pub fn admit(
        &mut self,
        now: Instant,
        head: &HttpHead<'_>,
        site: &Site<'_>,
        served: Served,
    ) -> Result<Admitted, Refusal> {
        let decided = self.decide(now, head, site, served);
        let counters = &mut self.counters;
        let counter = match &decided {
            Ok(_) => &mut counters.admitted,
            Err((what, _)) => match what {
                Why::Unfit => &mut counters.unfit,
                Why::Host => &mut counters.wrong_host,
                Why::CrossSite => &mut counters.cross_site,
                Why::WithoutKey => &mut counters.without_key,
                Why::WrongKey => &mut counters.wrong_key,
                Why::Replayed => &mut counters.replayed,
                Why::LockedOut => &mut counters.locked_out,
            },
        };
        *counter = counter.wrapping_add(1);
        decided.map_err(|(_, refusal)| refusal)
    }

    fn decide(
        &mut self,
        now: Instant,
        head: &HttpHead<'_>,
        site: &Site<'_>,
        served: Served,
    ) -> Decision<Admitted> {
        if !site.is_host(head.host_name()) {
            return refuse(
                Why::Host,
                StatusCode::MISDIRECTED,
                "this server is not that host; use its address",
            );
        }
        let route = match route::find(head, served) {
            Ok(route) => route,
            Err(RouteError::NotFound) => {
                return refuse(Why::Unfit, StatusCode::NOT_FOUND, "there is no such path");
            }
            Err(RouteError::Method(allow)) => {
                let refusal = Refusal::new(StatusCode::METHOD_NOT_ALLOWED, "this path has other methods");
                return Err((Why::Unfit, Refusal { allow: Some(allow), ..refusal }));
            }
        };
        if !head.has_only(route.operation.arguments()) {
            let text = "this path has no such argument, or it comes twice";
            return refuse(Why::Unfit, StatusCode::BAD_REQUEST, text);
        }
        let is_plain_read =
            matches!(head.method, Method::Get | Method::Head) && !route.operation.is_endless();
        if !is_plain_read && is_cross_site(head) {
            let text = "only pages of this server may do that";
            return refuse(Why::CrossSite, StatusCode::FORBIDDEN, text);
        }
        let (most, text) = match (route.body, served) {
            (BodyType::None, _) => (0, "the body is too long; allowed: none with GET"),
            (BodyType::Image, _) => (MAX_IMAGE, "the body is too long; allowed: 16384 bytes"),
            (_, Served::Board) => (MAX_ARGUMENTS, "the body is too long; allowed: 256 bytes"),
            _ => (MAX_BODY, "the body is too long; allowed: 65536 bytes"),
        };
        if head.length > most {
            return refuse(Why::Unfit, StatusCode::TOO_LARGE, text);
        }
        let is_fit = match head.content_type {
            Some(content_type) => route.body == BodyType::None || route.body.is(content_type),
            // A JSON body is optional.
            None => matches!(route.body, BodyType::None | BodyType::Json) && head.length == 0,
        };
        if !is_fit {
            let text = match route.body {
                BodyType::Toml => "Content-Type must be application/toml",
                BodyType::Image => "Content-Type must be application/octet-stream",
                _ => "Content-Type must be application/json",
            };
            return refuse(Why::Unfit, StatusCode::UNSUPPORTED_TYPE, text);
        }
        let body = match route.access {
            Access::Open => None,
            // Tells a person that the board can be claimed, and how.
            Access::Read
                if served == Served::Board && self.key.is_none() && route.operation == ApiOperation::Info =>
            {
                None
            }
            Access::Read if site.is_loopback() && head.authorization.is_none() => None,
            Access::Read | Access::Write => self.authorize(now, head, site, served)?,
        };
        Ok(Admitted {
            operation: route.operation,
            is_head: head.method == Method::Head,
            length: head.length,
            expects_continue: head.expects_continue,
            body,
        })
    }

    /// Checks the key, and returns the signed hash of the body, if any.
    fn authorize(
        &mut self,
        now: Instant,
        head: &HttpHead<'_>,
        site: &Site<'_>,
        served: Served,
    ) -> Decision<Option<Hash>> {
        let peer = site.peer.to_canonical();
        let Some(key) = &self.key else {
            let text = match served {
                Served::Board => "this board has no key: press its button, then POST claim within 60 s",
                _ => "this server has no key: it can only be read, on its own machine",
            };
            return refuse(Why::WithoutKey, StatusCode::FORBIDDEN, text);
        };
        if let Some(wait) = self.attempts.must_wait(now, peer) {
            let refusal = Refusal::new(StatusCode::TOO_MANY, "too many wrong keys; wait");
            let retry_after_s = Some(wait.as_millis().div_ceil(1_000));
            return Err((Why::LockedOut, Refusal { retry_after_s, ..refusal }));
        }
        let Some(shown) = head.authorization else {
            return refuse(Why::WithoutKey, StatusCode::UNAUTHORIZED, "the key is needed");
        };
        let proof = match cut(shown, b' ') {
            // Loopback only: over a network anyone could read the key.
            Some((scheme, key)) if scheme.eq_ignore_ascii_case("Bearer") && site.is_loopback() => {
                Proof::Key(trim(key))
            }
            Some((scheme, fields)) if scheme.eq_ignore_ascii_case(SCHEME) => match Signature::parse(fields) {
                Some(signature) => Proof::Signature(signature),
                None => Proof::None,
            },
            _ => Proof::None,
        };
        let is_right = match &proof {
            Proof::None => {
                let text = match site.is_loopback() {
                    true => "Authorization must be Bearer KEY, or a signature",
                    false => "Authorization must be a signature: over a network a key is never sent",
                };
                return refuse(Why::WithoutKey, StatusCode::UNAUTHORIZED, text);
            }
            Proof::Key(shown) => key.is(shown, &self.secret),
            Proof::Signature(signature) => {
                let Signature { nonce, body, mac } = *signature;
                let (method, target) = (head.method.name(), head.target);
                key.verify(&Signed { nonce, method, target, body }, &mac)
            }
        };
        if !is_right {
            self.attempts.was_wrong(now, peer);
            return refuse(Why::WrongKey, StatusCode::UNAUTHORIZED, "wrong key");
        }
        let Proof::Signature(signature) = proof else { return Ok(None) };
        match self.nonces.check(now, signature.nonce) {
            Ok(fresh) => {
                self.nonces.spend(now, fresh);
                Ok(key::from_hex(signature.body))
            }
            Err(NonceError::Used) => {
                refuse(Why::Replayed, StatusCode::UNAUTHORIZED, "this nonce was used; take a new one")
            }
            Err(NonceError::Old | NonceError::Unknown) => refuse(
                Why::Replayed,
                StatusCode::UNAUTHORIZED,
                "this nonce is not valid any more; take a new one",
            ),
        }
    }
}

#[derive(Debug, Clone, Copy)]
enum Why {
    Unfit,
    Host,
    CrossSite,
    WithoutKey,
    WrongKey,
    Replayed,
    LockedOut,
}

type Decision<T> = Result<T, (Why, Refusal)>;

fn refuse<T>(why: Why, status: StatusCode, text: &'static str) -> Decision<T> {
    Err((why, Refusal::new(status, text)))
}

/// Whether the browser reports that the request comes from a page of another origin.
fn is_cross_site(head: &HttpHead<'_>) -> bool {
    let is_ours = |origin: &str| {
        let authority = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
        authority.is_some_and(|authority| authority.eq_ignore_ascii_case(head.host))
    };
    // Browsers send `none` if a person typed the address.
    let is_own_page = |site: &str| site == "same-origin" || site == "none";
    !head.origin.is_none_or(is_ours) || !head.fetch_site.is_none_or(is_own_page)
}

#[derive(Debug, Clone, Copy)]
enum Proof<'a> {
    None,
    Key(&'a str),
    Signature(Signature<'a>),
}

/// `nonce=..., body=..., mac=...`, in any order.
#[derive(Debug, Clone, Copy)]
struct Signature<'a> {
    nonce: &'a str,
    body: &'a str,
    mac: Hash,
}

impl<'a> Signature<'a> {
    fn parse(fields: &'a str) -> Option<Self> {
        let (mut nonce, mut body, mut mac) = (None, None, None);
        let mut rest = fields;
        while !rest.is_empty() {
            let (field, behind) = cut(rest, b',').unwrap_or((rest, ""));
            rest = behind;
            let (name, value) = cut(trim(field), b'=')?;
            let place = match name {
                "nonce" => &mut nonce,
                "body" => &mut body,
                "mac" => &mut mac,
                _ => return None,
            };
            if place.replace(value).is_some() {
                return None;
            }
        }
        let (nonce, body) = (nonce?, body?);
        // The hash is compared as bytes but signed as text, so each hash must have exactly one text.
        let is_hash =
            key::from_hex::<32>(body).is_some() && !body.bytes().any(|byte| byte.is_ascii_uppercase());
        is_hash.then_some(Self { nonce, body, mac: key::from_hex(mac?)? })
    }
}

#[cfg(test)]
#[path = "guard_tests.rs"]
mod tests;
