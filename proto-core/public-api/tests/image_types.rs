//! The types that a configuration image is made of, as they were when its version was made. `GOLDEN=write` writes what
//! is missing.

use std::path::Path;

use proto_core::config::image::VERSION;
use proto_core::config::{
    BoardAddress, Bus, CommandWhen, Echo, FieldSpec, GatewayConfig, InputBinding, InputRule, LinkSource,
    OnStale, OutputBinding, Outside, Parity, Parts, PortValue, SendOn, Transaction,
};
use proto_core::device::{Algorithm, Boundary, ByteOrder, Counts, Escape, Kind, Overflow, TextWidth, Width};
use proto_core::modbus::rtu::Operation;
use proto_core::recipe::model::Mode;
use proto_core::sysvar::SysVar;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::{Scalar, ScalarType};
use serde_reflection::{Samples, Tracer, TracerConfig};

/// Every type, field and variant that an image of the newest version can have, in their order. A change
/// here takes a new version, even if all kept images can still be read: older firmware would take the new
/// image for a damaged one.
#[test]
fn serialized_types_are_those_of_the_version() {
    let mut tracer = Tracer::new(TracerConfig::default());
    let samples = Samples::new();
    macro_rules! trace {
        ($($kind:ty),* $(,)?) => { $(tracer.trace_type::<$kind>(&samples).unwrap();)* };
    }
    // Every enum for itself, or the tracer sees only some of its variants; it names those that are missing.
    trace!(
        BoardAddress,
        Bus,
        CanId,
        CommandWhen,
        Echo,
        FieldSpec,
        InputBinding,
        InputRule,
        LinkSource,
        Mode,
        OnStale,
        OutputBinding,
        Outside,
        Parity,
        Parts,
        PortValue,
        Scalar,
        ScalarType,
        SendOn,
        Algorithm,
        ByteOrder,
        Kind,
        Overflow,
        Width,
        Boundary,
        Escape,
        Counts,
        TextWidth,
        Operation,
        Transaction,
        GatewayConfig,
    );
    let mut said = String::new();
    for (name, format) in tracer.registry().unwrap() {
        said += &format!("{name}: {format:#?}\n");
    }
    // A variable is its place in the table.
    for var in SysVar::all() {
        said += &format!("variable {}: {var}\n", var.ordinal());
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../tests/golden/v{VERSION}/types.txt"));
    if !path.exists() && std::env::var_os("GOLDEN").is_some_and(|value| value == "write") {
        std::fs::write(&path, &said).unwrap();
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let line = kept.lines().zip(said.lines()).position(|(kept, said)| kept != said);
    assert!(kept == said, "types.txt differs from line {:?}; it is now:\n{said}", line.map(|line| line + 1));
}
