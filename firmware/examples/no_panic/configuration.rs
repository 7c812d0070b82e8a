//! Configurations: images, checks, plans.

use core::hint::black_box;

use proto_core::config::{
    CanFramePart, GatewayConfig, Span, can_frame_time, check_bitrate, check_cycle, image,
};
use proto_core::engine::Plan;
use proto_core::sysvar::{Direction, SysVar, VarRange};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::dialect::{Dialect, Motion};
use proto_core::wire::scalar::{Scalar, ScalarType};
use proto_core::wire::state::{OperationMode, RobotState, SafetyState};

use crate::{any, bytes, out_buf};

pub(crate) fn all() {
    let mut config = GatewayConfig::empty();
    config_image_decode(black_box(&mut config));
    config_image_decode_whole();
    config_image_encode(black_box(&config));
    config_validate(black_box(&config));
    config_questions(black_box(&config));
    plan_new(black_box(&config));
    names_and_numbers();
    dialects();
}

#[inline(never)]
fn config_image_decode(config: &mut GatewayConfig) {
    let _ = black_box(image::decode_into(bytes(), config));
    let _ = black_box(image::image_len(bytes()));
    let mut scan = black_box(image::Scan::new());
    let _ = black_box(scan.step(bytes()));
    black_box(scan.buses());
}

#[inline(never)]
fn config_image_decode_whole() {
    if let Ok(config) = image::decode(bytes()) {
        black_box(&config);
    }
}

#[inline(never)]
fn config_image_encode(config: &GatewayConfig) {
    let mut out = [0; 64];
    let _ = black_box(image::encode(config, out_buf(&mut out)));
}

#[inline(never)]
fn config_validate(config: &GatewayConfig) {
    let _ = black_box(config.validate());
}

#[inline(never)]
fn config_questions(config: &GatewayConfig) {
    for port in &config.ports {
        for part in [Direction::Input, Direction::Output] {
            black_box(config.view().budget(port, part));
        }
        black_box(port.bus.is_field());
        if let proto_core::config::Bus::Rs485(line) = &port.bus {
            let _ = black_box(line.check());
            black_box((line.bits_per_character(), line.time_on_line(any(7)), line.with_rtu_silence()));
        }
        black_box(config.view().line_share(port));
        for exchange in &config.exchanges {
            black_box(config.view().exchange_budget(port, exchange));
        }
    }
    config.view().warnings().for_each(|warning| _ = black_box(warning));
    config.view().field_ports().for_each(|port| _ = black_box(port));
    for recipe in &config.recipes {
        config.view().fields_of(recipe, any(Direction::Input)).for_each(|field| _ = black_box(field));
        black_box(config.view().is_device(recipe));
        config.view().written_by(recipe).for_each(|var| _ = black_box(var));
        config.view().bits_written_by(recipe).for_each(|bit| _ = black_box(bit));
        config.view().exchanges_of(recipe).iter().for_each(|exchange| _ = black_box(exchange));
        for port in &config.ports {
            config.view().owned_by(port, recipe).for_each(|var| _ = black_box(var));
        }
    }
    for field in &config.fields {
        black_box(field.variable());
        field.variables().for_each(|var| _ = black_box(var));
    }
    let part = any(CanFramePart { id: CanId::Standard(1), fields: Span::default() });
    black_box(part.fields.of(bytes()));
    black_box(can_frame_time(part.id, any(8), any(500_000)));
    let _ = black_box(check_bitrate(any(500_000)));
    let _ = black_box(check_cycle(any(Duration::ZERO)));
}

#[inline(never)]
fn plan_new(config: &GatewayConfig) {
    if let Ok(plan) = Plan::new(config) {
        for var in SysVar::all() {
            black_box((plan.owner(var), plan.route(var), plan.source(var)));
        }
    }
}

#[inline(never)]
fn names_and_numbers() {
    let name = any("WordInputReg[1]");
    let _ = black_box(SysVar::parse(name));
    let _ = black_box(SysVar::named(name, any(3)));
    if let Ok(range) = VarRange::parse(name) {
        range.iter().for_each(|var| _ = black_box(var));
    }
    if let Some(var) = SysVar::from_ordinal(any(7)) {
        black_box((var.group(), var.index(), var.direction(), var.ty(), var.size(), var.image_offset()));
        black_box((
            var.valid_bits(),
            var.is_bits(),
            var.unit(),
            var.stream(),
            var.modbus(),
            var.span().len(),
        ));
    }
    if let Some(ty) = ScalarType::from_name(name) {
        let _ = black_box(Scalar::from_f64(ty, any(0.5)));
        black_box(Scalar::decode(ty, bytes()));
    }
    let mut out = [0; 8];
    let value = any(Scalar::Byte(0));
    black_box((value.encode(out_buf(&mut out)), value.as_f64(), value.is_finite()));
}

#[inline(never)]
fn dialects() {
    let Some(dialect) = any(Dialect::named(any("v2.3"))) else { return };
    black_box((dialect.robot_state(any(1)), dialect.robot_code(any(RobotState::Enable))));
    black_box((dialect.safety_state(any(1)), dialect.safety_code(any(SafetyState::Run))));
    black_box(dialect.mode_to_register(any(OperationMode::Auto), any(Motion::Real)));
    black_box(dialect.mode_from_register(any(100)));
}
