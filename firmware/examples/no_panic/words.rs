//! `Display` of errors.

use core::fmt::{Display, Write};
use core::hint::black_box;

use proto_core::command::{self, Percent, StateCodes};
use proto_core::config::{GatewayConfig, image};
use proto_core::device::{LayoutError, Unreadable};
use proto_core::engine::{BuildError, PlanError};
use proto_core::modbus::{Exception, adu, client, pdu};
use proto_core::recipe::CanReject;
use proto_core::recipe::{DatagramError, EncodeError, NoSpace, PartError, ValueError};
use proto_core::sysvar::{self, SysVar};
use proto_core::time::Duration;
use proto_core::wire::scalar::{Scalar, ScalarError, ScalarType};
use proto_core::wire::slcan::LineError;
use proto_core::wire::state::{Misaligned, StateError};

use crate::{FailingWriter, any};

#[inline(never)]
fn say(what: impl Display) {
    let _ = black_box(write!(FailingWriter, "{what}"));
}

pub(crate) fn all() {
    static CONFIG: GatewayConfig = GatewayConfig::empty();
    let config = black_box(&CONFIG);
    if let Err(error) = any(config.validate()) {
        say(config.view().describe(error));
        say(error);
        say(config.view().describe_kind(error.kind));
        say(any(BuildError::Config(error)));
        say(any(image::ImageError::Config(error)));
    }
    config.view().warnings().for_each(|warning| say(config.view().describe_warning(warning)));
    say(any(image::NoSpace { available: 0 }));
    let Ok(var) = any(SysVar::parse("DI[1]")) else { return };
    say(var);
    say(any(PlanError::NoRoute { var, port: proto_core::engine::PortId(0) }));
    say(any(sysvar::ParseError::Syntax));
    say(any(Duration::ZERO));
    say(any(ScalarType::Byte));
    say(any(Scalar::Byte(0)));
    say(any(ScalarError::OutOfRange { ty: ScalarType::Byte, value: 0.0 }));
    recipes();
    devices();
    protocols();
}

fn recipes() {
    say(any(PartError::NoFrames));
    say(any(ValueError::NotFinite { field: 0 }));
    say(any(DatagramError::Head));
    say(any(NoSpace { needed: 1, available: 0 }));
    say(any(EncodeError::Count { expected: 1, got: 0 }));
    say(any(CanReject::WrongLength { frame: 0, expected: 1, got: 0 }));
}

fn devices() {
    say(any(LayoutError::Empty));
    say(any(Unreadable::Length));
}

fn protocols() {
    say(any(StateError::WrongLength { expected: 1, actual: 0 }));
    say(any(Misaligned::Bools { wrong: 1, allowed: 0 }));
    say(any(LineError::Malformed));
    say(any(Exception::from_code(1)));
    say(any(adu::AduError::Length { received: 0 }));
    say(any(pdu::PduEncodeError::Count { count: 0, max: 0 }));
    say(any(pdu::ResponseError::Length { received: 0, expected: 1 }));
    say(any(client::Violation::Unit { expected: 0, received: 1 }));
    say(any(client::StartError::Busy));
    say(any(command::StartError::Busy));
    say(any(command::ParseError::Empty));
    say(any(command::EncodeError::NoSpeed));
    say(any(StateCodes { robot: 0, program: 0, safety: 0, mode: 0 }));
    if let Some(percent) = Percent::new(any(1.0)) {
        say(percent);
    }
}
