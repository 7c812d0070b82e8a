//! Hosts that mean no good: floods, peers that never read or never finish, garbage without end, at the
//! sockets of real processes. The other clients keep what they get; memory and descriptors stay bounded.
//!
//! Each attack is compared with the same run's own quiet time.

mod attack;
mod controller_side;
mod gateway_side;
mod limits;
mod process;
mod witness;

use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

use serde_json::Value;

use attack::Attack;
use process::{Usage, usage};
use recipe_test_kit::HostSim;
use witness::{Lap, Witnesses};

/// One attack at a time: they would be each other's disturbance.
fn alone() -> MutexGuard<'static, ()> {
    static ONE: Mutex<()> = Mutex::new(());
    // Who failed before does no harm to who is next.
    ONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// A process, those that depend on it, and what they got while nobody did them harm.
struct Scene {
    process: HostSim,
    witnesses: Witnesses,
    quiet: Lap,
    _alone: MutexGuard<'static, ()>,
}

impl Scene {
    fn new(alone: MutexGuard<'static, ()>, process: HostSim, witnesses: Witnesses) -> Self {
        // What comes first is the beginning's: connections, first answers.
        witnesses.lap(Duration::from_millis(50));
        let quiet = witnesses.lap(QUIET);
        Self { process, witnesses, quiet, _alone: alone }
    }

    /// More clients, before any attack.
    fn joined_by(&mut self, join: impl FnOnce(&mut Witnesses)) {
        join(&mut self.witnesses);
        self.quiet = self.witnesses.lap(QUIET);
    }

    /// Lets attacks go on until there was a stretch of time in which the clients got what they got before, and
    /// the attacks got no memory. Then the process is told to end, and does, while they go on. What it counted
    /// until then comes back.
    #[track_caller]
    fn survives(self, attacks: Vec<Attack>) -> Value {
        self.witnesses.lap(WARM_UP);
        let mut quiet = None;
        in_some_stretch(|| {
            let before = usage(&self.process);
            let lap = self.witnesses.lap(ATTACK);
            let after = usage(&self.process);
            let done: Vec<_> = attacks.iter().map(Attack::done).collect();
            // Seen when the test fails, or with --nocapture.
            println!("quiet  {}\nattack {lap}\n{before:?}\n{after:?}\ndone {done:?}", self.quiet);
            within_bounds(&after);
            if done.iter().any(|&done| done <= 5) {
                return Err(format!("an attack that did nothing: {done:?}"));
            }
            if after.rss_kib > before.rss_kib + MOST_GROWTH_KIB {
                return Err(format!("{before:?} grew to {after:?}"));
            }
            lap.is_like(quiet.as_ref().unwrap_or(&self.quiet)).inspect_err(|_| {
                // Perhaps the machine has more to do than before.
                attacks.iter().for_each(Attack::pause);
                quiet = Some(self.witnesses.lap(QUIET).at_least(&self.quiet));
                attacks.iter().for_each(Attack::resume);
                self.witnesses.lap(WARM_UP);
            })
        });
        let stats = self.process.fresh();
        drop(self.witnesses);
        self.process.end();
        drop(attacks);
        stats
    }
}

/// Other load of the machine comes and goes. What an attack takes it takes all the time.
#[track_caller]
fn in_some_stretch(mut look: impl FnMut() -> Result<(), String>) {
    let mut found = Ok(());
    for _ in 0..MOST_STRETCHES {
        found = look();
        if found.is_ok() {
            return;
        }
    }
    found.unwrap();
}

/// For a quiet machine: `HOST_SIM_MINUTES=10 cargo test --test hostile -- --ignored --nocapture`.
#[test]
#[ignore = "takes as many minutes as HOST_SIM_MINUTES says, 10 unless it does"]
fn everything_at_once_for_a_long_time() {
    let minutes = std::env::var("HOST_SIM_MINUTES").map_or(10, |minutes| minutes.parse().unwrap());
    let alone = alone();
    let robot = controller_side::controller(controller_side::NOBODY);
    let (gateway, _own_robot) = gateway_side::gateway(&[]);
    let mut witnesses = Witnesses::default();
    controller_side::clients(&robot, &mut witnesses);
    gateway_side::devices(&gateway, &mut witnesses);
    witnesses.lap(QUIET);
    let quiet = witnesses.lap(Duration::from_secs(5));
    println!("quiet {quiet}\n{:?}\n{:?}", usage(&robot), usage(&gateway));
    let mut attacks = controller_side::everything(&robot);
    attacks.extend(gateway_side::everything(&gateway));
    let usage = || [usage(&robot), usage(&gateway)];
    let mut first = None;
    for minute in 1..=minutes {
        let lap = witnesses.lap(Duration::from_secs(60));
        let now = usage();
        println!("minute {minute}: {lap}\n{now:?}");
        lap.is_like(&quiet).unwrap();
        for (before, now) in first.get_or_insert(now).iter().zip(&now) {
            within_bounds(now);
            assert!(now.rss_kib <= before.rss_kib + 4 * MOST_GROWTH_KIB, "{before:?} grew to {now:?}");
        }
    }
    println!(
        "{:?}\n{}\n{}",
        attacks.iter().map(Attack::done).collect::<Vec<_>>(),
        robot.fresh(),
        gateway.fresh()
    );
    drop(witnesses);
    robot.end();
    gateway.end();
    drop(alone);
}

#[track_caller]
fn within_bounds(usage: &Usage) {
    assert!(usage.rss_kib <= MOST_RSS_KIB, "{usage:?}");
    assert!(usage.descriptors <= MOST_DESCRIPTORS, "{usage:?}");
    assert!(usage.threads <= 8, "{usage:?}");
}

const QUIET: Duration = Duration::from_millis(300);
const WARM_UP: Duration = Duration::from_millis(200);
const ATTACK: Duration = Duration::from_millis(500);
/// docs/devices.md section 7.
const MOST_RSS_KIB: u64 = 64 << 10;
const MOST_DESCRIPTORS: usize = 400;
/// In a stretch: the allocator's way with the same amounts again.
const MOST_GROWTH_KIB: u64 = 512;
const MOST_STRETCHES: usize = 12;
