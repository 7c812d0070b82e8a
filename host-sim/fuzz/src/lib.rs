//! Fuzz target of `host-sim`: configuration files of both kinds with overrides, against overrides
//! written into the file (docs/fuzzing.md).

mod files;

use proto_core_fuzz::harness::Target;

/// All targets.
pub const TARGETS: &[Target] =
    &[Target { name: "toml", run: files::run, seeds: files::seeds, runs: 400, longest: 5_000 }];

/// The target of this name.
///
/// # Panics
/// If there is none.
pub fn target(name: &str) -> &'static Target {
    TARGETS.iter().find(|target| target.name == name).unwrap_or_else(|| panic!("there is no target {name:?}"))
}
