//! A client of one gateway.
//!
//! In: requests of docs/api.md. Out: answers, or a failure in words. Signs everything that needs the key: all requests
//! over a network, and changes on this machine. The key itself is never sent, not even on localhost, where the API
//! would accept it: a forwarded port leads to another machine.

use std::cell::RefCell;
use std::io::ErrorKind;
use std::net::SocketAddr;
use std::time::Duration;

use recipe_api::key::{BodyHash, Hex, Key, SCHEME, Signed};
use serde_json::Value;

use crate::address::Address;
use crate::failure::Failure;
use crate::http::{HttpExchange, HttpReply, HttpRequest, NoReply, ServerEvent, Stream, words};
use crate::shown;
use crate::stop::Stop;

/// The beginning of every path.
const API: &str = "/api/v1/";

/// A client of a gateway, for one thread at a time.
#[derive(Debug, Clone)]
pub struct Client {
    address: Address,
    places: Vec<SocketAddr>,
    host: Option<Address>,
    key: Option<Key>,
    timeout: Duration,
    stop: Stop,
    /// From the last answer; valid for one request.
    nonce: RefCell<Option<String>>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum RequestBody<'a> {
    None,
    Json(&'a Value),
    Toml(&'a str),
    Image(&'a [u8]),
}

impl RequestBody<'_> {
    fn bytes(&self) -> Vec<u8> {
        match self {
            Self::None => Vec::new(),
            Self::Json(value) => value.to_string().into_bytes(),
            Self::Toml(text) => text.as_bytes().to_vec(),
            Self::Image(bytes) => bytes.to_vec(),
        }
    }

    fn kind(&self) -> Option<&'static str> {
        match self {
            Self::None => None,
            Self::Json(_) => Some("application/json"),
            Self::Toml(_) => Some("application/toml"),
            Self::Image(_) => Some("application/octet-stream"),
        }
    }
}

/// A request of the API.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Call<'a> {
    pub(crate) method: &'static str,
    /// The path after [`API`], with its query.
    pub(crate) path: &'a str,
    pub(crate) body: RequestBody<'a>,
    pub(crate) if_match: Option<&'a str>,
    /// Additional timeout for a request that replaces the gateway.
    pub(crate) more_time: Duration,
}

impl<'a> Call<'a> {
    pub(crate) const fn get(path: &'a str) -> Self {
        Self { method: "GET", path, body: RequestBody::None, if_match: None, more_time: Duration::ZERO }
    }

    pub(crate) const fn post(path: &'a str, body: &'a Value) -> Self {
        Self { method: "POST", body: RequestBody::Json(body), ..Self::get(path) }
    }
}

impl Client {
    /// A client of the gateway at this address. A request and its answer take at most `timeout`.
    ///
    /// # Errors
    /// If the host name cannot be resolved.
    pub fn new(address: Address, key: Option<Key>, timeout: Duration, stop: Stop) -> Result<Self, Failure> {
        let places = address.resolve().map_err(|error| Failure::Refused(format!("{address}: {error}")))?;
        Ok(Self { address, places, host: None, key, timeout, stop, nonce: RefCell::new(None) })
    }

    /// Sets the address that the gateway knows itself by, if it differs from the one that leads to it, such as a
    /// forwarded port.
    #[must_use]
    pub fn known_as(self, host: Option<Address>) -> Self {
        Self { host, ..self }
    }

    pub(crate) fn until(&self, stop: Stop) -> Self {
        Self { stop, nonce: RefCell::new(None), ..self.clone() }
    }

    pub(crate) fn with_key(&self, key: Key) -> Self {
        Self { key: Some(key), ..self.until(self.stop.clone()) }
    }

    /// The gateway's address as given.
    pub fn address(&self) -> &Address {
        &self.address
    }

    pub(crate) fn stop(&self) -> &Stop {
        &self.stop
    }

    /// A failure at this gateway, in words.
    pub(crate) fn refused(&self, why: impl std::fmt::Display) -> Failure {
        Failure::Refused(format!("{}: {}", self.address, shown::line(&why.to_string())))
    }

    pub(crate) fn json(&self, path: &str) -> Result<Value, Failure> {
        self.ask(&Call::get(path))
    }

    /// An optional document: `None` if there is no such path.
    pub(crate) fn json_if_there(&self, path: &str) -> Result<Option<Value>, Failure> {
        let reply = self.call(&Call::get(path))?;
        match reply.status() {
            404 => Ok(None),
            200..=299 => self.document(&reply).map(Some),
            _ => Err(self.refusal(&reply)),
        }
    }

    pub(crate) fn get(&self, path: &str) -> Result<HttpReply, Failure> {
        let reply = self.call(&Call::get(path))?;
        self.accepted(reply)
    }

    /// Returns the reply unless it is an error.
    pub(crate) fn accepted(&self, reply: HttpReply) -> Result<HttpReply, Failure> {
        match reply.status() {
            200..=299 => Ok(reply),
            _ => Err(self.refusal(&reply)),
        }
    }

    /// Makes a request and returns the document of its answer.
    pub(crate) fn ask(&self, call: &Call<'_>) -> Result<Value, Failure> {
        self.document(&self.accepted(self.call(call)?)?)
    }

    pub(crate) fn document(&self, reply: &HttpReply) -> Result<Value, Failure> {
        serde_json::from_slice(&reply.body)
            .map_err(|_| self.refused("the answer is no JSON; is this a gateway?"))
    }

    pub(crate) fn text(&self, reply: HttpReply) -> Result<String, Failure> {
        String::from_utf8(reply.body).map_err(|_| self.refused("the answer is no text; is this a gateway?"))
    }

    pub(crate) fn stream(&self, path: &str) -> Result<EventStream<'_>, Failure> {
        self.opened(self.open(path)?)
    }

    fn open(&self, path: &str) -> Result<HttpExchange, Failure> {
        let call = Call::get(path);
        self.asked_again(&call, || self.exchange(&call))
    }

    fn opened(&self, exchange: HttpExchange) -> Result<EventStream<'_>, Failure> {
        if !(200..=299).contains(&exchange.status()) {
            let reply = exchange.finish().map_err(|error| self.no_reply(error))?;
            return Err(self.refusal(&reply));
        }
        let stream = exchange.stream().map_err(|error| self.no_reply(error))?;
        Ok(EventStream { client: self, stream })
    }

    /// Opens an optional stream: `None` if there is no such path.
    pub(crate) fn stream_if_there(&self, path: &str) -> Result<Option<EventStream<'_>>, Failure> {
        let exchange = self.open(path)?;
        if exchange.status() == 404 {
            return Ok(None);
        }
        self.opened(exchange).map(Some)
    }

    pub(crate) fn call(&self, call: &Call<'_>) -> Result<HttpReply, Failure> {
        self.asked_again(call, || Ok(self.exchange(call)?.finish()?))
    }

    /// Retries a GET on connection reset: a board without a free connection resets a forwarded port, and a connection
    /// that it has to cut off. A change is requested only once, as it may have been executed.
    fn asked_again<T>(
        &self,
        call: &Call<'_>,
        mut ask: impl FnMut() -> Result<T, Missed>,
    ) -> Result<T, Failure> {
        let mut left = if call.method == "GET" { ATTEMPTS } else { 1 };
        loop {
            left -= 1;
            match ask() {
                Ok(done) => return Ok(done),
                Err(Missed::Answer(NoReply::Reset(_))) if left > 0 => {}
                Err(Missed::Answer(error)) => return Err(self.no_reply(error)),
                Err(Missed::For(failure)) => return Err(failure),
            }
            if self.stop.wait(AGAIN) {
                return Err(self.no_reply(NoReply::Stopped));
            }
        }
    }

    fn exchange(&self, call: &Call<'_>) -> Result<HttpExchange, Missed> {
        let nonce = self.nonce.take();
        let is_kept = nonce.is_some();
        let nonce = match nonce {
            None if self.key.is_some() && !self.is_open(call) => Some(self.take_nonce()?),
            nonce => nonce,
        };
        let exchange = self.send(call, nonce.as_deref())?;
        // The nonce was old, or the request needs the key after all. With a fresh nonce the key is wrong, and a retry
        // would count as another wrong key.
        let again = exchange.status() == 401 && self.key.is_some() && (nonce.is_none() || is_kept);
        if !again {
            self.nonce.replace(exchange.field("next-nonce").and_then(fit_nonce));
            return Ok(exchange);
        }
        drop(exchange);
        let nonce = self.take_nonce()?;
        self.send(call, Some(&nonce))
    }

    /// Whether the request needs no key: reading on this machine.
    fn is_open(&self, call: &Call<'_>) -> bool {
        call.method == "GET" && self.places.iter().copied().all(is_here)
    }

    fn take_nonce(&self) -> Result<String, Failure> {
        let call = Call::get("nonce");
        let reply = self.asked_again(&call, || Ok(self.send(&call, None)?.finish()?))?;
        let document = self.document(&self.accepted(reply)?)?;
        let nonce = document["nonce"].as_str().and_then(fit_nonce);
        nonce.ok_or_else(|| self.refused("its reply has no nonce; is this a gateway?"))
    }

    fn send(&self, call: &Call<'_>, nonce: Option<&str>) -> Result<HttpExchange, Missed> {
        let target = format!("{API}{}", call.path);
        let body = call.body.bytes();
        let mut fields = Vec::new();
        if let (Some(key), Some(nonce)) = (&self.key, nonce) {
            let mut hash = BodyHash::new();
            hash.update(&body);
            let hash = Hex(&hash.finish()).to_string();
            let mac = key.sign(&Signed { nonce, method: call.method, target: &target, body: &hash });
            let proof = format!("{SCHEME} nonce={nonce}, body={hash}, mac={}", Hex(&mac));
            fields.push(("Authorization", proof));
        }
        if let Some(kind) = call.body.kind() {
            fields.push(("Content-Type", kind.to_owned()));
        }
        if let Some(etag) = call.if_match {
            fields.push(("If-Match", etag.to_owned()));
        }
        let host = self.host.as_ref().map(Address::to_string);
        let request = HttpRequest {
            method: call.method,
            host: host.as_deref(),
            target: &target,
            fields: &fields,
            body: &body,
        };
        let timeout = self.timeout + call.more_time;
        let mut last = None;
        for attempt in 0..ATTEMPTS {
            if attempt > 0 && self.stop.wait(AGAIN) {
                return Err(NoReply::Stopped.into());
            }
            let mut may_be_full = false;
            for &place in &self.places {
                match HttpExchange::start(place, &request, timeout, &self.stop) {
                    // Nothing was sent, so another address of the name may be tried.
                    Err(NoReply::Unreached(error)) => {
                        may_be_full |= error.kind() == ErrorKind::ConnectionRefused && !is_here(place);
                        let hint = self.address.hint(place);
                        last = Some(format!("nobody is there: {place}: {}{hint}", words(&error)));
                    }
                    done => return Ok(done?),
                }
            }
            if !may_be_full {
                break;
            }
        }
        Err(self.refused(last.unwrap_or_default()).into())
    }

    fn no_reply(&self, error: NoReply) -> Failure {
        match error {
            NoReply::Unreached(error) => self.refused(words(&error)),
            NoReply::Reset(why) | NoReply::Broken(why) => self.refused(why),
            NoReply::Stopped => self.refused("ended before the answer came"),
        }
    }

    /// A refusal in words. A wrong configuration counts as a wrong file.
    pub(crate) fn refusal(&self, reply: &HttpReply) -> Failure {
        let document: Value = serde_json::from_slice(&reply.body).unwrap_or_default();
        let status = reply.status();
        let said = match document["error"].as_str() {
            Some(error) if !error.is_empty() => shown::line(error).into_owned(),
            _ => format!("it answers with status {status}; is this a gateway?"),
        };
        let more = match (status, &self.key) {
            (401, None) => "; give its key with --key FILE".to_owned(),
            (401, Some(_)) => ": that of --key is not the gateway's".to_owned(),
            (429, _) => match reply.field("retry-after").and_then(|text| text.parse::<u32>().ok()) {
                Some(seconds) => format!(" {seconds} s"),
                None => String::new(),
            },
            (421, _) => "; if a forwarded port leads there, give its own address with --host, or as `host` in the inventory"
                .to_owned(),
            (403, _) if said.contains("has no key") => {
                "; start the gateway with --console-key, or claim the board".to_owned()
            }
            _ => String::new(),
        };
        let text = format!("{}: {said}{more}", self.address);
        if status != 422 {
            return Failure::Refused(text);
        }
        let place = match (document["line"].as_u64(), document["column"].as_u64()) {
            (Some(line), Some(column)) => format!("{line}:{column}: "),
            _ => String::new(),
        };
        let key = document["key"].as_str().map(|key| format!("{}: ", shown::line(key))).unwrap_or_default();
        // Only configurations have places and keys.
        let what =
            if place.is_empty() && key.is_empty() { "it is refused" } else { "the configuration is refused" };
        Failure::Wrong(format!("{}: {what}: {place}{key}{said}", self.address))
    }
}

/// Whether the address is on this machine.
fn is_here(place: SocketAddr) -> bool {
    place.ip().to_canonical().is_loopback()
}

/// Why a request was not answered.
enum Missed {
    /// No answer, or an incomplete one.
    Answer(NoReply),
    /// A failure in words: the gateway was not reached or has refused.
    For(Failure),
}

impl From<NoReply> for Missed {
    fn from(why: NoReply) -> Self {
        Self::Answer(why)
    }
}

impl From<Failure> for Missed {
    fn from(why: Failure) -> Self {
        Self::For(why)
    }
}

/// Number of attempts. A board has four connections and refuses others while these are in use.
const ATTEMPTS: u32 = 6;
/// Pause between two attempts.
const AGAIN: Duration = Duration::from_millis(200);

#[derive(Debug)]
pub(crate) struct EventStream<'a> {
    client: &'a Client,
    stream: Stream,
}

impl EventStream<'_> {
    /// The next event; `None` once the command is to end.
    pub(crate) fn next(&mut self) -> Result<Option<ServerEvent>, Failure> {
        match self.stream.event() {
            Ok(Some(event)) => Ok(Some(event)),
            Ok(None) => Err(self.client.refused("the gateway has ended the stream")),
            Err(NoReply::Stopped) => Ok(None),
            Err(error) => Err(self.client.no_reply(error)),
        }
    }

    /// The next bytes of a stream without events; `None` once the stream or the command ends.
    pub(crate) fn bytes(&mut self) -> Result<Option<Vec<u8>>, Failure> {
        match self.stream.bytes() {
            Ok(bytes) => Ok(bytes),
            Err(NoReply::Stopped) => Ok(None),
            Err(error) => Err(self.client.no_reply(error)),
        }
    }
}

/// A nonce that is safe in a head: nothing from a server may add lines to it.
fn fit_nonce(text: &str) -> Option<String> {
    let is_fit = (16..=128).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    is_fit.then(|| text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_nonce_adds_nothing_to_a_head() {
        assert!(fit_nonce("0000000928a724da00000000c27868a9e87ad27a773140a5").is_some());
        for wrong in ["", "00", "0000000928a724da\r\nHost: x", "0000000928a724da, mac=", &"0".repeat(129)] {
            assert_eq!(fit_nonce(wrong), None, "{wrong:?}");
        }
    }
}
