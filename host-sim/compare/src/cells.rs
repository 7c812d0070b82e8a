//! Many cells on this machine, a gateway process each or one for all: a frame of a device goes up to the robot's registers every 4 ms, and
//! a frame goes down to the device every 4 ms. The devices and the robots are this program, on the same machine.

use std::fs::File;
use std::io::{Read, Write};
use std::time::{Duration, Instant};

use recipe_io::realtime::{self, Scheduling};
use recipe_test_kit::{HostSim, PATIENCE};
use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use serde_json::Value;

use crate::cell_files::{self, OUT_LEN, frame, is_connected};
use crate::figures::{processor_time, quantile};
use crate::modbus_peer::Peer;

const PERIOD: Duration = Duration::from_millis(4);
/// The cells take turns within a period: devices of different machines do not send at the same moment.
const STEPS: u32 = 8;
/// Cells whose command and state one simulated controller is.
const PER_CONTROLLER: usize = 16;

/// The device of a cell, and what was seen of it.
struct Device {
    line: File,
    value: u8,
    sent: Instant,
    arrived: bool,
    late: u64,
    heard: usize,
}

/// The gateways of all cells.
enum Gateways {
    /// A process each.
    Processes(Vec<HostSim>),
    /// One process for all.
    One(HostSim),
}

/// Runs so many cells for so long, and prints what they kept. With `threads`, one process serves all cells on so many.
pub(crate) fn run(cells: usize, seconds: u64, threads: Option<usize>) {
    let mut peer = Peer::new(cells);
    let robots: Vec<_> = (0..cells.div_ceil(PER_CONTROLLER)).map(|_| cell_files::controller()).collect();
    let folders: Vec<_> = (0..cells).map(|_| tempfile::tempdir().expect("a temporary folder")).collect();
    let of = |nth: usize| (folders[nth].path(), &robots[nth / PER_CONTROLLER], peer.address(nth));
    let gateways = match threads {
        None => Gateways::Processes(
            (0..cells)
                .map(|nth| {
                    let (folder, robot, modbus) = of(nth);
                    cell_files::gateway(folder, robot, modbus, true)
                })
                .collect(),
        ),
        Some(threads) => {
            let files = (0..cells).map(|nth| {
                let (folder, robot, modbus) = of(nth);
                cell_files::write(folder, &format!("cell{nth}"), robot, modbus, true)
            });
            Gateways::One(cell_files::gateways(&folders, &files.collect::<Vec<_>>(), threads))
        }
    };
    let began = Instant::now();
    while !gateways.cells().iter().all(is_connected) {
        assert!(began.elapsed() < 6 * PATIENCE, "not all gateways are connected");
        peer.serve(Duration::from_millis(10), |_, _| {});
    }
    let mut devices: Vec<_> =
        folders.iter().map(|folder| Device::open(&folder.path().join("line"))).collect();
    let scheduled = realtime::apply(Scheduling::FifoIfAllowed);
    // The first second is not counted: what the gateways had to send before waits in the lines.
    drive(&mut devices, &mut peer, 1);
    for device in &mut devices {
        (device.late, device.heard) = (0, 0);
    }
    let before = Counted::of(&gateways, &robots);
    let (mut samples, sent) = drive(&mut devices, &mut peer, seconds);
    let after = Counted::of(&gateways, &robots);
    if std::env::var_os("SHOW").is_some() {
        println!("{}", gateways.cells()[3]);
    }

    let wanted = cells as f64 * seconds as f64 * 250.0;
    let heard: usize = devices.iter().map(|device| device.heard / OUT_LEN).sum();
    let late: u64 = devices.iter().map(|device| device.late).sum();
    let cores = |after: Duration, before: Duration| (after - before).as_secs_f64() / seconds as f64;
    let used = cores(after.used, before.used);
    match threads {
        None => print!("{cells} cells, a process each,"),
        Some(threads) => print!("{cells} cells in one process, on {threads} threads,"),
    }
    println!(" for {seconds} s; devices and robots with {scheduled}");
    println!(
        "  frames sent by devices      {sent}, {:.1} % of 250 a second each",
        sent as f64 / wanted * 100.0
    );
    println!("  values at the registers     {}; {late} were overtaken by the next one", samples.len());
    println!(
        "  frames heard by devices     {heard}, {:.1} % of 250 a second each",
        heard as f64 / wanted * 100.0
    );
    println!("  cycles left out             {}", after.skipped - before.skipped);
    println!(
        "  processor of all gateways   {used:.2} cores, {:.2} % of one for each",
        used / cells as f64 * 100.0
    );
    println!(
        "  processor of the others     devices and registers {:.2} cores, command and state {:.2}",
        cores(after.players, before.players),
        cores(after.robots, before.robots)
    );
    let quantiles = [0.5, 0.99, 1.0].map(|share| quantile(&mut samples, share));
    println!(
        "  us from frame to register   p50 {:.0}, p99 {:.0}, most {:.0}",
        quantiles[0], quantiles[1], quantiles[2]
    );
}

impl Gateways {
    /// What each cell said last.
    fn cells(&self) -> Vec<Value> {
        match self {
            Self::Processes(gateways) => gateways.iter().map(|gateway| gateway.newest()).collect(),
            Self::One(gateway) => {
                let newest = gateway.newest();
                // Without statistics yet, one that is not connected.
                let cells = newest["cells"].as_object().map(|cells| cells.values().cloned().collect());
                cells.unwrap_or_else(|| vec![Value::Null])
            }
        }
    }

    fn processor_time(&self) -> Duration {
        match self {
            Self::Processes(gateways) => gateways.iter().map(|gateway| processor_time(gateway.pid())).sum(),
            Self::One(gateway) => processor_time(gateway.pid()),
        }
    }
}

/// The devices send and listen for so long: microseconds until each value was at the robot, and frames sent.
fn drive(devices: &mut [Device], peer: &mut Peer, seconds: u64) -> (Vec<f64>, usize) {
    let mut samples = Vec::new();
    let mut sent = 0;
    let began = Instant::now();
    let steps = u32::try_from(seconds * 250).expect("some seconds") * STEPS;
    for step in 0..steps {
        let due = began + PERIOD * step / STEPS;
        loop {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            peer.serve(left, |cell, value| devices[cell].arrives(value, &mut samples));
        }
        for device in devices.iter_mut().skip((step % STEPS) as usize).step_by(STEPS as usize) {
            device.step();
            sent += 1;
        }
    }
    (samples, sent)
}

impl Device {
    fn open(line: &std::path::Path) -> Self {
        let line = cell_files::open(line);
        let flags = fcntl_getfl(&line).unwrap();
        fcntl_setfl(&line, flags | OFlags::NONBLOCK).unwrap();
        Self { line, value: 0, sent: Instant::now(), arrived: true, late: 0, heard: 0 }
    }

    /// Takes what was sent to it, and sends the next frame.
    fn step(&mut self) {
        let mut heard = [0; 1_024];
        self.heard += self.line.read(&mut heard).unwrap_or(0);
        self.late += u64::from(!self.arrived);
        self.value = self.value.wrapping_add(1);
        self.arrived = false;
        self.sent = Instant::now();
        self.line.write_all(&frame(self.value)).expect("a line takes what nobody has read for a second");
    }

    fn arrives(&mut self, value: u16, samples: &mut Vec<f64>) {
        if value == u16::from(self.value) && !self.arrived {
            self.arrived = true;
            samples.push(self.sent.elapsed().as_nanos() as f64 / 1e3);
        }
    }
}

/// What all gateways have counted.
struct Counted {
    skipped: u64,
    used: Duration,
    /// Processor time of this program.
    players: Duration,
    /// That of the simulated controllers.
    robots: Duration,
}

impl Counted {
    fn of(gateways: &Gateways, robots: &[HostSim]) -> Self {
        let skipped = |cell: &Value| cell["ports"]["device"]["skipped_cycles"].as_u64();
        Self {
            skipped: gateways.cells().iter().map(|cell| skipped(cell).expect("statistics have it")).sum(),
            used: gateways.processor_time(),
            players: processor_time(rustix::process::getpid()),
            robots: robots.iter().map(|robot| processor_time(robot.pid())).sum(),
        }
    }
}
