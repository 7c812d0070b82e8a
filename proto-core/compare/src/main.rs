//! proto-core beside libraries that a user would take instead, on the same work in one run, counted in
//! instructions by valgrind:
//!
//! ```text
//! cargo run --release --manifest-path proto-core/compare/Cargo.toml -- instructions
//! ```
//!
//! `CANTOOLS=PROGRAM` names cantools, if it is not in `PATH`; `cc` builds what it writes. Each must find all frames, and the same newest values. It fails when proto-core takes more than half of what another library
//! takes. The table is in docs/performance.md.

mod can;
mod cantools;
#[path = "../../benches/instructions/mod.rs"]
mod instructions;
mod modbus;
mod stream;
#[path = "../../benches/workload/mod.rs"]
#[allow(dead_code, reason = "the benchmarks use the rest")]
mod workload;

use std::hint::black_box;
use std::process::ExitCode;

use instructions::{Beside, Limit, Work};
use workload::FRAMES;

fn main() -> ExitCode {
    let work = |name, run| Work { name, limit: None, run };
    let works = [
        work("stream: proto-core", |n| repeat(n, workload::Stream::frames(), workload::Stream::decode)),
        work("stream: one struct, by hand", |n| {
            repeat(n, workload::Stream::frames(), workload::Stream::decode_bare)
        }),
        work("stream: nom 8.0.0", |n| repeat(n, stream::Line::new(), |line| line.decode(stream::nom))),
        work("stream: binrw 0.15.2", |n| repeat(n, stream::Line::new(), |line| line.decode(stream::binrw))),
        work("stream: deku 0.20.3", |n| repeat(n, stream::Line::new(), |line| line.decode(stream::deku))),
        work("CAN: proto-core", |n| repeat(n, workload::Can::new(), workload::Can::decode)),
        work("CAN: one match, by hand", |n| repeat(n, workload::Can::new(), workload::Can::decode_bare)),
        work("CAN: dbc-rs 0.7.1", |n| repeat(n, can::Dbc::new(), can::Dbc::decode)),
        work("CAN: C by cantools 45.1.0", cantools::run),
        work("read 118 words: proto-core", |n| modbus::ProtoCore::default().repeat(n, modbus::What::Words)),
        work("read 118 words: modbus-core 0.2.0", |n| {
            modbus::ModbusCore::default().repeat(n, modbus::What::Words);
        }),
        work("read 118 words: rmodbus 0.13.0", |n| modbus::Rmodbus::default().repeat(n, modbus::What::Words)),
        work("write 16 coils: proto-core", |n| modbus::ProtoCore::default().repeat(n, modbus::What::Coils)),
        work("write 16 coils: modbus-core 0.2.0", |n| {
            modbus::ModbusCore::default().repeat(n, modbus::What::Coils);
        }),
        work("write 16 coils: rmodbus 0.13.0", |n| modbus::Rmodbus::default().repeat(n, modbus::What::Coils)),
    ];
    let beside = [
        ("stream: proto-core", "stream: nom 8.0.0"),
        ("stream: proto-core", "stream: binrw 0.15.2"),
        ("stream: proto-core", "stream: deku 0.20.3"),
        ("CAN: proto-core", "CAN: dbc-rs 0.7.1"),
        ("read 118 words: proto-core", "read 118 words: modbus-core 0.2.0"),
        ("read 118 words: proto-core", "read 118 words: rmodbus 0.13.0"),
        ("write 16 coils: proto-core", "write 16 coils: modbus-core 0.2.0"),
        ("write 16 coils: proto-core", "write 16 coils: rmodbus 0.13.0"),
    ];
    if std::env::args().nth(1).as_deref() == Some("instructions")
        && let Err(text) = cantools::build()
    {
        eprintln!("{text}");
        return ExitCode::FAILURE;
    }
    let beside = beside.map(|(name, bare)| Beside { name, bare, limit: Limit::Times(0.5) });
    instructions::main_beside(&works, &beside).unwrap_or_else(|| {
        eprintln!("say `instructions`, or `run NAME COUNT` to look at one with another tool:");
        works.iter().for_each(|work| eprintln!("  {}", work.name));
        ExitCode::from(2)
    })
}

/// Does a work for `frames` frames.
fn repeat<T>(frames: u64, mut work: T, pass: fn(&mut T) -> usize) {
    for _ in 0..frames / FRAMES as u64 {
        assert_eq!(black_box(pass(&mut work)), FRAMES);
    }
}
