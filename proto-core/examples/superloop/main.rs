//! A whole gateway in a superloop: no std, no executor, no allocator, everything in statics. A device on
//! an RS-485 line switches an output of the controller and then falls silent. The same source runs on a
//! host (`cargo run -p proto-core --example superloop`) and on a Cortex-M7 (`.ci/run superloop`); both print
//! superloop.out. A driver's duties are in docs/driver.md.
#![cfg_attr(target_os = "none", no_std, no_main)]

mod board;
mod configuration;
mod controller;
mod events;
mod machine;

use proto_core::engine::{Engine, Input, OUTPUT_BUFFER, Output};
use proto_core::time::Instant;
use static_cell::ConstStaticCell;

use board::ModelBoard;
use configuration::CellConfig;
use events::{PORT, SOURCES};
use machine::say;

/// One field port, one recipe link, one user-defined field in each direction.
type CellEngine = Engine<1, 1, 1, 0, 0>;

fn superloop() {
    static GATEWAY: ConstStaticCell<CellEngine> = ConstStaticCell::new(CellEngine::idle());
    let gateway = GATEWAY.take();
    if let Err(reason) = configure(gateway) {
        say!("nothing runs: {reason}");
        return;
    }
    let mut board = ModelBoard::new();
    let mut until = pass(gateway, &mut board, Input::PortUp { port: PORT });
    while board.now() < Instant::from_millis(60) {
        // What has arrived, each source once, so that none keeps the time from passing.
        for source in SOURCES {
            if let Some(event) = board.receive(source) {
                event.show(board.now());
                until = pass(gateway, &mut board, event.input());
            }
        }
        if board.now() >= until {
            until = pass(gateway, &mut board, Input::Tick);
        }
        board.sleep(until);
    }
    let counters = gateway.port_counters(PORT).map(|port| (port.frames_in, port.frames_out));
    say!("frames in and out: {counters:?}");
}

/// One change, then everything that follows from it; returns when the engine is to be called again.
fn pass(gateway: &mut CellEngine, board: &mut ModelBoard, input: Input<'_>) -> Instant {
    let mut out = [0; OUTPUT_BUFFER];
    gateway.handle(board.now(), input);
    loop {
        match gateway.poll_output(board.now(), &mut out) {
            Output::PortSend { bytes, .. } => board.port_send(bytes),
            Output::LinkOpen { link, .. } => board.link_open(link),
            Output::LinkSend { link, bytes } => board.link_send(link, bytes),
            Output::LinkClose { .. } => board.link_close(),
            Output::Sleep { until } => return until,
            _ => {} // no CAN bus here
        }
    }
}

#[cfg(not(target_os = "none"))]
fn main() {
    superloop();
}

/// Not inlined: what it needs of the stack is free again when the loop begins.
#[inline(never)]
fn configure(gateway: &mut CellEngine) -> Result<(), &'static str> {
    static CONFIG: ConstStaticCell<CellConfig> = ConstStaticCell::new(CellConfig::empty());
    let config = CONFIG.take();
    configuration::write(config).map_err(|_| "the configuration is wrong")?;
    gateway.configure(&*config).map_err(|_| "the configuration is refused")
}
