//! The API of a gateway: requests in any order, and replies.

use core::fmt::Write;
use core::hint::black_box;
use core::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use proto_core::config::GatewayConfig;
use proto_core::time::{Duration, Instant};
use recipe_api::arguments;
use recipe_api::attempts::Attempts;
use recipe_api::claim::Claim;
use recipe_api::documents::{Document, Pieces};
use recipe_api::guard::{Guard, Refusal, Site};
use recipe_api::key::{BodyHash, Hash, Hex, Key, Signed, from_hex};
use recipe_api::metrics::Families;
use recipe_api::nonces::Nonces;
use recipe_api::request::{HeadBuffer, HttpHead, MAX_HEAD};
use recipe_api::response::{ContentType, Length, Response, StatusCode, write_chunk};
use recipe_api::revisions::{Result as Done, Revision, Revisions, Stored};
use recipe_api::route::{self, BodyType, Served};
use recipe_api::{json, revisions};
use static_cell::ConstStaticCell;

use crate::{FailingWriter, any, bytes};

type SmallEngine = proto_core::engine::Engine<2, 1, 32, 0, 4>;

pub(crate) fn all() {
    let mut memory = [0; MAX_HEAD];
    let mut buffer = HeadBuffer::within(&mut memory);
    remote_push(black_box(&mut buffer));
    let mut guard = Guard::new(any(Some(Key::new([0; 16]))), any([0; 32]));
    let guard = black_box(&mut guard);
    if let Some(head) = remote_head(black_box(&buffer)) {
        remote_route(black_box(&head));
        remote_admit(guard, black_box(&head));
    }
    remote_nonce(guard);
    remote_key();
    remote_arguments();
    remote_claim();
    remote_revisions();
    remote_response();
    static ENGINE: ConstStaticCell<SmallEngine> = ConstStaticCell::new(SmallEngine::idle());
    static CONFIG: GatewayConfig = GatewayConfig::empty();
    let Some(gateway) = ENGINE.try_take() else { return };
    let _ = black_box(black_box(&mut *gateway).configure(black_box(&CONFIG)));
    remote_documents(black_box(gateway));
    remote_metrics(black_box(gateway));
}

/// A text unknown to the compiler.
fn text() -> &'static str {
    str::from_utf8(bytes()).unwrap_or_default()
}

fn address() -> IpAddr {
    any(any(IpAddr::V4(Ipv4Addr::LOCALHOST)).max(IpAddr::V6(Ipv6Addr::LOCALHOST)))
}

#[inline(never)]
fn remote_push(buffer: &mut HeadBuffer<&mut [u8]>) {
    black_box((buffer.push(bytes()), buffer.is_empty()));
}

#[inline(never)]
fn remote_head<'h>(buffer: &'h HeadBuffer<&mut [u8]>) -> Option<HttpHead<'h>> {
    match buffer.head() {
        Ok(head) => Some(head),
        Err(error) => {
            black_box((error, Refusal::from(error)));
            None
        }
    }
}

#[inline(never)]
fn remote_route(head: &HttpHead<'_>) {
    black_box((head.path(), head.host_name(), head.query(text()), head.method.name()));
    black_box(head.has_only(any(&[text(), text()][..])));
    for served in [Served::Gateway, Served::Controller, Served::Board] {
        let _ = black_box(route::find(head, any(served)));
    }
    black_box(any(BodyType::Json).is(text()));
}

#[inline(never)]
fn remote_admit(guard: &mut Guard, head: &HttpHead<'_>) {
    let names = [text(), text()];
    let site = Site { local: address(), peer: address(), names: any(&names[..]) };
    match guard.admit(any(Instant::ZERO), head, &site, any(Served::Gateway)) {
        Ok(admitted) => _ = black_box((admitted, admitted.is_signed(), admitted.is_body(&any([0; 32])))),
        Err(refusal) => _ = black_box((refusal, site.is_loopback())),
    }
}

#[inline(never)]
fn remote_nonce(guard: &mut Guard) {
    let now = any(Instant::ZERO);
    black_box((guard.nonce(now), guard.has_key(), *guard.counters()));
    guard.set_key(Key::parse(text()));
    let mut nonces = Nonces::new(any([0; 32]));
    black_box(nonces.give(now));
    if let Ok(fresh) = nonces.check(now, text()) {
        nonces.spend(now, fresh);
    }
    let mut attempts = Attempts::new();
    let attempts = black_box(&mut attempts);
    black_box(attempts.must_wait(now, address()));
    attempts.was_wrong(now, address());
}

#[inline(never)]
fn remote_key() {
    let Some(key) = Key::parse(text()) else { return };
    let signed = Signed { nonce: text(), method: text(), target: text(), body: text() };
    let secret: Hash = any([0; 32]);
    black_box((key.is(text(), &secret), key.verify(&signed, &key.sign(&signed))));
    black_box((from_hex::<16>(text()), from_hex::<32>(text())));
    let mut hash = BodyHash::new();
    hash.update(bytes());
    let _ = black_box(write!(FailingWriter, "{}", Hex(&hash.finish())));
}

#[inline(never)]
fn remote_arguments() {
    black_box(arguments::each(bytes(), |key, value| {
        black_box((key, value, value.whole()));
        any(true)
    }));
}

#[inline(never)]
fn remote_claim() {
    let mut claim = Claim::at_start(any(false));
    let claim = black_box(&mut claim);
    let now = any(Instant::ZERO);
    claim.pressed(now);
    let _ = black_box(claim.offered(now));
    claim.written(now, any(true));
    claim.poll(now);
    black_box(claim.deadline());
}

#[inline(never)]
fn remote_revisions() {
    let revision = any(Revision { number: 1, digest: 2 });
    let kept = (0..any(3)).map(|_| any(revision)).take(revisions::MAX_REVISIONS);
    let mut stored = Stored { kept: heapless::Vec::new(), live: any(1), previous: any(None) };
    kept.for_each(|revision| _ = stored.kept.push(revision));
    let Some(mut kept) = Revisions::new(stored) else { return };
    let kept = black_box(&mut kept);
    let now = any(Instant::ZERO);
    let _ = black_box(kept.put(revision, any(3)));
    let _ = black_box(kept.apply(any(None), any(Duration::ZERO)));
    let _ = black_box((kept.confirm(now), kept.roll_back(), kept.resume_trial(any(1), now)));
    kept.resume_last(any(kept.last()));
    for result in [Done::Stored(any(true)), Done::Started(any(true)), Done::Marked(any(true)), Done::Ended] {
        kept.handle(now, any(result));
    }
    black_box(kept.poll_output(now));
    black_box((kept.kept(), kept.live(), kept.previous(), kept.waiting(), kept.running(), kept.trial()));
    black_box((kept.last().map(|(number, ended)| (number, ended.name())), kept.base()));
    black_box(kept.revision(any(1)));
}

#[inline(never)]
fn remote_response() {
    let (status, kind) = (any(StatusCode::OK), any(ContentType::Json));
    let response = Response::new(status, kind, any(Length::Bytes(1))).with_policy(text());
    let fields: [(&str, &dyn core::fmt::Display); 1] = [(text(), &text())];
    let _ = black_box(response.with(&fields).write(&mut FailingWriter));
    let _ = black_box(write_chunk(&mut FailingWriter, text()));
    let _ = black_box(json::write_text(&mut FailingWriter, text()));
}

#[inline(never)]
fn remote_documents(gateway: &SmallEngine) {
    for document in [Document::Status, Document::Values] {
        let mut pieces = Pieces::of(any(document));
        while let Ok(true) = pieces.write_next(gateway.status(any(Instant::ZERO)), &mut FailingWriter) {}
    }
    black_box(gateway.status(any(Instant::ZERO)).health().name());
}

#[inline(never)]
fn remote_metrics(gateway: &SmallEngine) {
    let mut families = Families::new();
    while let Ok(true) = families.write_next(gateway.status(any(Instant::ZERO)), &mut FailingWriter) {}
}
