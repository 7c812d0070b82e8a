//! Fuzz targets of `proto-core`, `recipe-api`, `recipe-sparkplug`, `recipe-store` and `recipe-update`
//! (docs/fuzzing.md).
//!
//! In: bytes. They are read as a short program: a recipe, operations, received bytes and where they
//! are cut. Each target runs it on the code and on a slow, obvious reference written from `docs/wire`,
//! and panics where they differ or where a call did more work than it may. The same functions run in
//! `cargo fuzz-inputs` and, guided by coverage, under libFuzzer.

pub mod harness;
pub mod source;

mod any_config;
mod any_device;
mod any_engine;
mod any_frames;
mod can;
mod command;
mod deframer;
mod edge;
mod engine;
mod framer;
mod http_guard;
mod http_head;
mod image;
mod modbus;
mod mqtt;
mod plain_frame;
mod recipes;
mod slcan;
mod state;
mod store;
mod update;

#[path = "../../tests/engine_props/model.rs"]
mod model;
#[path = "../../tests/engine_props/play.rs"]
mod play;
#[path = "../../tests/rig/mod.rs"]
mod rig;

#[path = "../../tests/reference/mod.rs"]
mod reference;
#[path = "../../tests/reference/command.rs"]
mod reference_command;
#[path = "../../tests/reference/modbus.rs"]
mod reference_modbus;

use harness::Target;

/// All targets.
pub const TARGETS: &[Target] = &[
    Target { name: "deframer", run: deframer::run, seeds: deframer::seeds, runs: 6_000, longest: 2_000 },
    Target { name: "framer", run: framer::run, seeds: framer::seeds, runs: 6_000, longest: 1_000 },
    Target { name: "can", run: can::run, seeds: can::seeds, runs: 10_000, longest: 600 },
    Target { name: "state", run: state::run, seeds: state::seeds, runs: 1_000, longest: 6_000 },
    Target { name: "slcan", run: slcan::run, seeds: slcan::seeds, runs: 10_000, longest: 1_000 },
    Target {
        name: "modbus_server",
        run: modbus::run_server,
        seeds: modbus::server_seeds,
        runs: 8_000,
        longest: 2_000,
    },
    Target {
        name: "modbus_client",
        run: modbus::run_client,
        seeds: modbus::client_seeds,
        runs: 8_000,
        longest: 1_000,
    },
    Target {
        name: "command_server",
        run: command::run_server,
        seeds: command::server_seeds,
        runs: 8_000,
        longest: 1_000,
    },
    Target {
        name: "command_client",
        run: command::run_client,
        seeds: command::client_seeds,
        runs: 3_000,
        longest: 1_000,
    },
    Target { name: "engine", run: engine::run, seeds: engine::seeds, runs: 300, longest: 600 },
    Target {
        name: "any_engine",
        run: any_engine::run,
        seeds: any_engine::seeds,
        runs: 4_000,
        longest: 1_000,
    },
    Target { name: "http_head", run: http_head::run, seeds: http_head::seeds, runs: 8_000, longest: 600 },
    Target { name: "http_guard", run: http_guard::run, seeds: http_guard::seeds, runs: 1_500, longest: 600 },
    Target { name: "edge", run: edge::run, seeds: edge::seeds, runs: 8_000, longest: 600 },
    Target { name: "mqtt", run: mqtt::run, seeds: mqtt::seeds, runs: 8_000, longest: 600 },
    Target { name: "image", run: image::run, seeds: image::seeds, runs: 3_000, longest: 3_000 },
    Target { name: "store", run: store::run, seeds: store::seeds, runs: 3_000, longest: 2_000 },
    Target { name: "update", run: update::run, seeds: update::seeds, runs: 1_000, longest: 1_000 },
];

/// The target of this name.
///
/// # Panics
/// When there is none.
pub fn target(name: &str) -> &'static Target {
    TARGETS.iter().find(|target| target.name == name).unwrap_or_else(|| panic!("there is no target {name:?}"))
}
