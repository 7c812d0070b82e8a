//! The gateway engine, as large as the firmware's, and the supervisors and periods it is made of.

use core::hint::black_box;

use firmware::tasks::gateway::Engine;
use proto_core::config::GatewayConfig;
use proto_core::engine::{Engine as AnyEngine, Input, LinkId, MAX_TAPPED, OUTPUT_BUFFER, PortId};
use proto_core::histogram::Histogram;
use proto_core::image::{GroupId, Image, InputSet, VarSet, bind_to_variable, saturate_to_field};
use proto_core::link::{LinkTimings, Supervisor};
use proto_core::schedule::Grid;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::{Scalar, ScalarType};
use static_cell::ConstStaticCell;

use crate::any;

/// Stands in .bss: all its bytes are zero, which `.ci/run` looks at.
static ENGINE: ConstStaticCell<Engine> = ConstStaticCell::new(Engine::idle());

/// One that can be listened to.
type EngineWithTap = AnyEngine<2, 1, 32, 2048>;

pub(crate) fn all() {
    static CONFIG: GatewayConfig = GatewayConfig::empty();
    let Some(gateway) = ENGINE.try_take() else { return };
    let mut out = [0; OUTPUT_BUFFER];
    engine_configure(black_box(&mut *gateway), black_box(&CONFIG));
    engine_new(black_box(&CONFIG));
    engine_handle(black_box(&mut *gateway), any(Instant::ZERO), any(Input::Tick));
    engine_poll_output(black_box(&mut *gateway), any(Instant::ZERO), black_box(&mut out));
    engine_questions(black_box(gateway));
    engine_status(black_box(gateway), any(Instant::ZERO));
    engine_tap();
    process_image();
    supervisor();
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
    let gateway = black_box(gateway);
    gateway.tap().listen(any(true));
    gateway.handle(any(Instant::ZERO), any(Input::Tick));
    black_box(gateway.poll_output(any(Instant::ZERO), &mut [0; OUTPUT_BUFFER]));
    black_box((gateway.tap().is_listening(), gateway.tap().next(&mut [0; MAX_TAPPED])));
}

#[inline(never)]
fn process_image() {
    let mut image = Image::new();
    let image = black_box(&mut image);
    let Some(var) = any(SysVar::from_ordinal(any(3))) else { return };
    let value = any(Scalar::Byte(0));
    let _ = black_box(image.set(var, value));
    black_box((image.value(var), image.is_known(var), image.age(var, any(Instant::ZERO))));
    if let Some(group) = any::<Option<GroupId>>(image.group(var)) {
        image.assign(var, group);
        image.stamp(group, any(Instant::ZERO));
        image.forget(group);
        black_box(image.stamp_of(group));
    }
    black_box((image.receive(var, value), image.is_readable(var), image.known_since(var), var.shown_by()));
    image.all_readable(any(Some(var)).into_iter());
    let mut vars = any(VarSet::EMPTY);
    vars.insert(var);
    black_box((image.can_read(&vars), vars.contains(any(var)), vars.is_empty()));
    vars.remove(any(var));
    black_box(bind_to_variable(var, value, any(1.0), any(0.0)));
    black_box(saturate_to_field(any(ScalarType::Byte), any(1.0), any(1.0), any(0.0)));
    let mut set = any(InputSet::EMPTY);
    set.insert(var);
    set.remove(any(var));
    let other = InputSet::run(var, any(4));
    black_box((set.and(&other), set.or(&other), set.minus(&other), set.run_len(var), set.contains(var)));
    set.iter().for_each(|var| _ = black_box(var));
}

#[inline(never)]
fn supervisor() {
    let mut link = Supervisor::new(any(LinkTimings::TCP.with_silence(Duration::from_secs(2))));
    let (link, now) = (black_box(&mut link), any(Instant::ZERO));
    black_box((link.up(now), link.down(now), link.advance(now)));
    link.heard(now);
    link.give_up(now);
    link.share(now);
    link.unshare(now);
    black_box((link.take_action(), link.deadline(), link.is_up(), link.history()));
}

#[inline(never)]
fn grid() {
    let mut grid = Grid::starting_at(any(Instant::ZERO), any(Duration::ZERO));
    black_box(black_box(&mut grid).due(any(Instant::NEVER)));
    let time = any(Instant::ZERO) + any(Duration::MAX);
    black_box((time - any(Duration::MAX), time.saturating_since(any(time)), any(Duration::MAX).as_millis()));
}
