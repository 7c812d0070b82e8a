//! From the last byte of a frame on a pseudoterminal to the Modbus request at the robot: the gateway, and a relay in C
//! that knows this one frame, both with SCHED_FIFO where the system allows it.

use std::fs::File;
use std::io::Write;
use std::thread::sleep;
use std::time::{Duration, Instant};

use recipe_io::realtime::{self, Scheduling};
use recipe_test_kit::{PATIENCE, Process};

use crate::cell_files::{self, frame, is_connected};
use crate::figures::{processor_time, quantile};
use crate::modbus_peer::Peer;
use crate::programs;

/// Frames of a round, and the time between two.
const FRAMES: usize = 200;
const PERIOD: Duration = Duration::from_millis(4);
const GATEWAY: usize = 0;
const RELAY: usize = 1;

/// Compares both, and prints what each takes.
pub(crate) fn compare(rounds: usize) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut peer = Peer::new(2);
    let robot = cell_files::controller();
    let gateway = cell_files::gateway(folder.path(), &robot, peer.address(GATEWAY), false);
    let began = Instant::now();
    while !is_connected(&gateway.newest()) {
        assert!(began.elapsed() < PATIENCE, "the gateway is not connected: {}", gateway.newest());
        peer.serve(Duration::from_millis(10), |_, _| {});
    }
    let link = folder.path().join("relay");
    let relay = Process::start(programs::in_c("relay", &[]).arg(&link).arg(peer.address(RELAY).to_string()));
    println!(
        "the relay says: {}; this program runs with {}",
        relay.line(),
        realtime::apply(Scheduling::FifoIfAllowed)
    );

    let mut lines = [cell_files::open(&folder.path().join("line")), cell_files::open(&link)];
    let mut samples = [Vec::new(), Vec::new()];
    let (processes, mut used) = ([gateway.pid(), relay.pid()], [Duration::ZERO; 2]);
    // The first round is not counted: links, caches and tables of the kernel are cold.
    for round in 0..=rounds {
        for side in [GATEWAY, RELAY] {
            let before = processor_time(processes[side]);
            let taken = measure(&mut lines[side], &mut peer, side);
            if round > 0 {
                samples[side].extend(taken);
                used[side] += processor_time(processes[side]) - before;
            }
        }
    }
    println!("us from the frame to the request    p50    p90    p99    of {} frames each", rounds * FRAMES);
    let [gateway, relay] =
        samples.each_mut().map(|samples| [0.5, 0.9, 0.99].map(|share| quantile(samples, share)));
    let row = |name, figures: [f64; 3]| {
        println!("  {name:<30} {:>7.1} {:>6.1} {:>6.1}", figures[0], figures[1], figures[2]);
    };
    row("gateway", gateway);
    row("relay in C", relay);
    let times = |nth: usize| gateway[nth] / relay[nth];
    println!("  {:<30} {:>7.2} {:>6.2} {:>6.2}", "gateway beside the relay", times(0), times(1), times(2));
    let [gateway, relay] = used.map(|used| used.as_nanos() as f64 / 1e3 / (rounds * FRAMES) as f64);
    println!("us of a processor for 4 ms with a frame: gateway {gateway:.1}, relay {relay:.1}");
}

/// A round: microseconds of each frame.
fn measure(line: &mut File, peer: &mut Peer, side: usize) -> Vec<f64> {
    let mut taken = Vec::with_capacity(FRAMES);
    let mut next = Instant::now();
    for nth in 0..FRAMES {
        next += PERIOD;
        sleep(next.saturating_duration_since(Instant::now()));
        let value = nth as u8;
        let began = Instant::now();
        line.write_all(&frame(value)).unwrap();
        let mut arrived = None;
        while arrived.is_none() {
            assert!(began.elapsed() < PATIENCE, "frame {nth} of side {side} never arrived");
            peer.serve(PATIENCE, |robot, written| {
                if robot == side && written == u16::from(value) {
                    arrived = Some(began.elapsed());
                }
            });
        }
        taken.push(arrived.unwrap_or_default().as_nanos() as f64 / 1e3);
        // What the machine held up is not made up for.
        next = next.max(Instant::now());
    }
    taken
}
