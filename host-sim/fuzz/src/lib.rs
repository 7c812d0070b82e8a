//! Fuzz targets of `host-sim`: configuration files of both kinds with overrides, against overrides written into the
//! file; inventories and Sparkplug files; operations and timelines of the simulated controller; recordings
//! (docs/fuzzing.md).

mod files;
mod lists;
mod operations;
mod recording;

use recipe_fuzz::harness::Target;

/// All targets.
pub const TARGETS: &[Target] = &[
    Target { name: "toml", run: files::run, seeds: files::seeds, runs: 400, longest: 5_000 },
    Target {
        name: "inventory",
        run: lists::run_inventory,
        seeds: lists::inventory_seeds,
        runs: 2_000,
        longest: 1_000,
    },
    Target {
        name: "sparkplug",
        run: lists::run_sparkplug,
        seeds: lists::sparkplug_seeds,
        runs: 2_000,
        longest: 1_000,
    },
    Target {
        name: "operations",
        run: operations::run_lines,
        seeds: operations::line_seeds,
        runs: 300,
        longest: 600,
    },
    Target {
        name: "timeline",
        run: operations::run_timeline,
        seeds: operations::timeline_seeds,
        runs: 200,
        longest: 600,
    },
    Target { name: "recording", run: recording::run, seeds: recording::seeds, runs: 300, longest: 1_000 },
];

/// The target of this name.
///
/// # Panics
/// If there is none.
pub fn target(name: &str) -> &'static Target {
    TARGETS.iter().find(|target| target.name == name).unwrap_or_else(|| panic!("there is no target {name:?}"))
}
