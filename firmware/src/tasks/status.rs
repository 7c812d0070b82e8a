//! The log of normal operation: changes of links, and the traffic of ports.

use core::pin::pin;

use embassy_time::{Duration, Timer};
use proto_core::link::LinkState;

use super::gateway::{Gateway, MAX_FIELD_PORTS, MAX_LINKS};
use super::watchdog::Pulse;
use crate::{info, traffic, warn};

/// Logs changes of the status forever.
pub async fn run(gateway: &Gateway, pulse: &Pulse) -> ! {
    let mut links = [(0, LoggedState::Down); MAX_LINKS];
    let mut ports = [[0; 6]; MAX_FIELD_PORTS];
    let mut refused_peers = [0; MAX_LINKS];
    let mut sleeps = 0;
    loop {
        for _ in 0..4 {
            gateway.report(|status| {
                for (link, (connects, before)) in status.links().zip(&mut links) {
                    let shown = match link.state {
                        LinkState::Up { .. } => LoggedState::Up,
                        LinkState::Shared => LoggedState::Shared,
                        LinkState::Down { .. } | LinkState::Opening { .. } => LoggedState::Down,
                    };
                    let name = link.name;
                    if *connects != link.history.connects {
                        *connects = link.history.connects;
                        info!("link {}: up ({})", name, connects);
                    } else if *before == LoggedState::Up && shown == LoggedState::Down {
                        warn!("link {}: lost", name);
                    }
                    if *before != LoggedState::Shared && shown == LoggedState::Shared {
                        info!(
                            "link {}: the controller takes only one connection; the command link carries its commands",
                            name
                        );
                    }
                    *before = shown;
                }
            });
            pulse.idle(pin!(Timer::after(Duration::from_millis(250)))).await;
        }
        if sleeps != gateway.sleeps() {
            sleeps = gateway.sleeps();
            warn!("the gateway slept ({}): waiting input is discarded", sleeps);
        }
        for ((kind, now), before) in gateway.refused_peers().zip(&mut refused_peers) {
            if *before != now {
                *before = now;
                warn!("link {}: {} connections or datagrams of other hosts refused", kind.name(), now);
            }
        }
        gateway.report(|status| {
            for (port, before) in status.ports().zip(&mut ports) {
                let counters = port.counters;
                let now = [
                    counters.frames_in,
                    counters.bytes_in,
                    counters.frames_out,
                    counters.bytes_out,
                    counters.resync_bytes,
                    counters.skipped_cycles,
                ];
                if *before != now {
                    *before = now;
                    let [frames_in, bytes_in, frames_out, bytes_out, skipped, cycles] = now;
                    traffic!(
                        "port {}: in {} frames, {} bytes; out {} frames, {} bytes; {} bytes skipped, {} cycles",
                        port.name, frames_in, bytes_in, frames_out, bytes_out, skipped, cycles,
                    );
                }
            }
        });
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum LoggedState {
    Down,
    Up,
    Shared,
}
