//! host-sim beside what a user would take instead, in one run on one machine:
//!
//! ```text
//! cargo build --release -p host-sim
//! cargo run --release --manifest-path host-sim/compare/Cargo.toml -- servers     # the controller's Modbus server, and others
//! cargo run --release --manifest-path host-sim/compare/Cargo.toml -- relay       # the gateway, and a relay in C
//! cargo run --release --manifest-path host-sim/compare/Cargo.toml -- cells       # how many cells of 4 ms one machine carries
//! ```
//!
//! Rounds of both sides take turns, so that other load of the machine affects both: quote ratios. The figures are in
//! docs/performance.md.

mod cell_files;
mod cells;
mod figures;
mod modbus_peer;
mod programs;
mod relay;
mod servers;

use std::net::SocketAddr;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// host-sim beside what a user would take instead, in one run on one machine
#[derive(Debug, Parser)]
struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Modbus TCP servers: requests a second and processor time of each
    Servers {
        /// Rounds of 120 ms for each server
        #[arg(long, default_value_t = 25)]
        rounds: usize,
        /// Who asks has one processor, and the servers another one
        #[arg(long)]
        apart: bool,
    },
    /// From the last byte on a pseudoterminal to the Modbus request, of the gateway and of a relay in C
    Relay {
        /// Rounds of 200 frames for each side
        #[arg(long, default_value_t = 25)]
        rounds: usize,
    },
    /// Gateways, a process each or one for all, with a frame up and a frame down every 4 ms
    Cells {
        /// How many, one run after the other
        #[arg(default_values_t = [10, 25, 50, 100])]
        cells: Vec<usize>,
        /// Seconds of each run
        #[arg(long, default_value_t = 20)]
        seconds: u64,
        /// One process for all, on so many threads
        #[arg(long)]
        threads: Option<usize>,
    },
    /// One of the servers, as a process of its own
    #[command(hide = true)]
    Serve { kind: servers::Kind, address: SocketAddr },
}

fn main() -> ExitCode {
    match Arguments::parse().what {
        What::Servers { rounds, apart } => servers::compare(rounds.max(1), apart),
        What::Relay { rounds } => relay::compare(rounds.max(1)),
        What::Cells { cells, seconds, threads } => {
            cells.into_iter().for_each(|cells| cells::run(cells, seconds, threads));
        }
        What::Serve { kind, address } => servers::serve(kind, address),
    }
    ExitCode::SUCCESS
}
