//! The gateway engine, as large as the firmware's, and the periods it is made of.

use core::hint::black_box;

use firmware::tasks::gateway::SizedEngine as Engine;
use proto_core::config::GatewayConfig;
use proto_core::engine::{Engine as AnyEngine, Input, LinkId, MAX_TAPPED, OUTPUT_BUFFER, PortId};
use proto_core::histogram::Histogram;
use proto_core::image::Image;
use proto_core::schedule::Grid;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use static_cell::ConstStaticCell;

use crate::any;

/// The engine, all zeros: it must be placed in .bss, which `.ci/run` checks.
static ENGINE: ConstStaticCell<Engine> = ConstStaticCell::new(Engine::idle());

/// An engine with a tap and few exchanges.
type EngineWithTap = AnyEngine<2, 1, 32, 2048, 4>;
/// An engine without exchanges.
type PlainEngine = AnyEngine<2, 1, 32, 0, 0>;

pub(crate) fn all() {
    static CONFIG: GatewayConfig = GatewayConfig::empty();
    let Some(gateway) = ENGINE.try_take() else { return };
    let mut out = [0; OUTPUT_BUFFER];
    engine_configure(black_box(&mut *gateway), black_box(&CONFIG));
    engine_new(black_box(&CONFIG));
    engine_handle(black_box(&mut *gateway), any(Instant::ZERO), any(Input::Tick));
    engine_poll_output(black_box(&mut *gateway), any(Instant::ZERO), black_box(&mut out));
    engine_questions(black_box(&*gateway));
    engine_status(black_box(&*gateway), any(Instant::ZERO));
    engine_tap();
    engine_plain();
    process_image(black_box(gateway.image()));
    grid();
}

#[inline(never)]
fn engine_configure(gateway: &mut Engine, config: &GatewayConfig) {
    let _ = black_box(gateway.configure(config));
}

#[inline(never)]
fn engine_new(config: &GatewayConfig) {
    if let Ok(gateway) = Engine::new(config) {
        black_box(&gateway);
    }
}

#[inline(never)]
fn engine_handle(gateway: &mut Engine, now: Instant, input: Input<'_>) {
    gateway.handle(now, input);
}

#[inline(never)]
fn engine_poll_output(gateway: &mut Engine, now: Instant, out: &mut [u8; OUTPUT_BUFFER]) {
    black_box(gateway.poll_output(now, out));
}

#[inline(never)]
fn engine_questions(gateway: &Engine) {
    let port = any(PortId(0));
    black_box((gateway.deadline(), gateway.port_counters(port), gateway.reply_code(port), gateway.image()));
    black_box((gateway.port_state(port), gateway.latency()));
    black_box((gateway.sleeps(), gateway.is_frame(any(LinkId::RECIPE_UDP), any(&[0; 8][..]))));
    gateway.field_ports().for_each(|port| _ = black_box(port));
    for link in gateway.links() {
        black_box((link, link.kind.name(), link.state.name(), link.id.port()));
    }
}

#[inline(never)]
fn engine_status(gateway: &Engine, now: Instant) {
    let status = gateway.status(now);
    black_box((status.at(), status.health(), status.controller(), status.sleeps()));
    status.variables().for_each(|known| _ = black_box(known));
    status.links().for_each(|link| _ = black_box(link));
    for port in status.ports() {
        black_box((port, port.state.name(), port.reply.name()));
        for peer in port.peers() {
            black_box((peer, peer.presence.name()));
        }
        if let Some(rejection) = port.last_rejection {
            black_box((rejection.bytes(), rejection.why.text()));
        }
    }
    let mut histogram = status.latency().arrived;
    histogram.merge(&status.latency().lateness);
    black_box((histogram.percentile(any(500)), histogram.sum(), histogram.max(), histogram.buckets()));
    black_box(Histogram::bucket_end(any(3)));
}

#[inline(never)]
fn engine_tap() {
    static TAPPED: ConstStaticCell<EngineWithTap> = ConstStaticCell::new(EngineWithTap::idle());
    let Some(gateway) = TAPPED.try_take() else { return };
    static CONFIG: GatewayConfig = GatewayConfig::empty();
    let gateway = black_box(gateway);
    let _ = black_box(gateway.configure(black_box(&CONFIG)));
    gateway.tap().listen(any(true));
    gateway.handle(any(Instant::ZERO), any(Input::Tick));
    black_box(gateway.poll_output(any(Instant::ZERO), &mut [0; OUTPUT_BUFFER]));
    black_box((gateway.tap().is_listening(), gateway.tap().next(&mut [0; MAX_TAPPED])));
}

#[inline(never)]
fn engine_plain() {
    static PLAIN: ConstStaticCell<PlainEngine> = ConstStaticCell::new(PlainEngine::idle());
    static CONFIG: GatewayConfig = GatewayConfig::empty();
    let Some(gateway) = PLAIN.try_take() else { return };
    let gateway = black_box(gateway);
    let _ = black_box(gateway.configure(black_box(&CONFIG)));
    gateway.handle(any(Instant::ZERO), any(Input::Tick));
    black_box(gateway.poll_output(any(Instant::ZERO), &mut [0; OUTPUT_BUFFER]));
}

#[inline(never)]
fn process_image(image: &Image) {
    let Some(var) = any(SysVar::from_ordinal(any(3))) else { return };
    black_box((image.bytes(), image.value(var), image.is_known(var)));
    black_box((image.age(var, any(Instant::ZERO)), var.shown_by()));
}

#[inline(never)]
fn grid() {
    let mut grid = Grid::starting_at(any(Instant::ZERO), any(Duration::ZERO));
    black_box(black_box(&mut grid).due(any(Instant::NEVER)));
    let time = any(Instant::ZERO) + any(Duration::MAX);
    black_box((time - any(Duration::MAX), time.saturating_since(any(time)), any(Duration::MAX).as_millis()));
}
