//! Hostile hosts: floods, peers that never read or never finish, endless garbage, at the sockets of real
//! processes. Other clients are still served; memory and descriptors stay bounded.
//!
//! Each attack is compared with a quiet time of the same run.

mod attack;
mod clients;
mod controller_side;
mod gateway_side;
mod limits;
mod process;

use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

use attack::Attack;
use clients::{Clients, Service};
use process::{Usage, usage};
use recipe_test_kit::HostSim;

/// Attacks are run one at a time: they would disturb each other.
fn alone() -> MutexGuard<'static, ()> {
    static ONE: Mutex<()> = Mutex::new(());
    // A test that failed does not affect the next one.
    ONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// A process, its clients, and how they are served without an attack.
struct Scene {
    process: HostSim,
    clients: Clients,
    quiet: Service,
    _alone: MutexGuard<'static, ()>,
}

impl Scene {
    fn new(alone: MutexGuard<'static, ()>, process: HostSim, clients: Clients) -> Self {
        // Not measured: connections and first answers.
        clients.measure(Duration::from_millis(50));
        let quiet = clients.measure(QUIET);
        Self { process, clients, quiet, _alone: alone }
    }

    /// Adds clients, before any attack.
    fn joined_by(&mut self, join: impl FnOnce(&mut Clients)) {
        join(&mut self.clients);
        self.quiet = self.clients.measure(QUIET);
    }

    /// Lets attacks go on until the clients were served as before for some time while the process's memory did
    /// not grow. Then the process has to end on a signal, while the attacks go on.
    #[track_caller]
    fn survives(self, attacks: Vec<Attack>) {
        self.survives_until(attacks, |process| drop(process.fresh()));
    }

    /// The same, with something to wait for under attack, before the signal.
    #[track_caller]
    fn survives_until(self, attacks: Vec<Attack>, awaited: impl FnOnce(&HostSim)) {
        self.clients.measure(WARM_UP);
        let mut quiet = None;
        in_one_of_several_tries(|| {
            let before = usage(&self.process);
            let measure = self.clients.measure(ATTACK);
            let after = usage(&self.process);
            let done: Vec<_> = attacks.iter().map(Attack::done).collect();
            // Shown if the test fails, or with --nocapture.
            println!("quiet  {}\nattack {measure}\n{before:?}\n{after:?}\ndone {done:?}", self.quiet);
            within_bounds(&after);
            if done.iter().any(|&done| done <= 5) {
                return Err(format!("an attack that did nothing: {done:?}"));
            }
            if after.rss_kib > before.rss_kib + MAX_GROWTH_KIB {
                return Err(format!("{before:?} grew to {after:?}"));
            }
            measure.is_like(quiet.as_ref().unwrap_or(&self.quiet)).inspect_err(|_| {
                // The machine may be busier than before: measure a quiet time again.
                attacks.iter().for_each(Attack::pause);
                quiet = Some(self.clients.measure(QUIET).at_least(&self.quiet));
                attacks.iter().for_each(Attack::resume);
                self.clients.measure(WARM_UP);
            })
        });
        awaited(&self.process);
        drop(self.clients);
        self.process.end();
        drop(attacks);
    }
}

/// Tries several times, since other load of the machine comes and goes, while an attack's effect stays.
#[track_caller]
fn in_one_of_several_tries(mut attempt: impl FnMut() -> Result<(), String>) {
    let mut found = Ok(());
    for _ in 0..MAX_TRIES {
        found = attempt();
        if found.is_ok() {
            return;
        }
    }
    found.unwrap();
}

/// Run it on an idle machine: `HOST_SIM_MINUTES=10 cargo test --test hostile -- --ignored --nocapture`.
#[test]
#[ignore = "takes HOST_SIM_MINUTES minutes, by default 10"]
fn everything_at_once_for_a_long_time() {
    let minutes = std::env::var("HOST_SIM_MINUTES").map_or(10, |minutes| minutes.parse().unwrap());
    let alone = alone();
    let robot = controller_side::controller(controller_side::NOBODY);
    let (gateway, _own_robot) = gateway_side::gateway(&[]);
    let mut clients = Clients::default();
    controller_side::attach(&robot, &mut clients);
    gateway_side::devices(&gateway, &mut clients);
    clients.measure(QUIET);
    let quiet = clients.measure(Duration::from_secs(5));
    println!("quiet {quiet}\n{:?}\n{:?}", usage(&robot), usage(&gateway));
    let mut attacks = controller_side::everything(&robot);
    attacks.extend(gateway_side::everything(&gateway));
    let usage = || [usage(&robot), usage(&gateway)];
    let mut first = None;
    for minute in 1..=minutes {
        let measure = clients.measure(Duration::from_secs(60));
        let now = usage();
        println!("minute {minute}: {measure}\n{now:?}");
        measure.is_like(&quiet).unwrap();
        for (before, now) in first.get_or_insert(now).iter().zip(&now) {
            within_bounds(now);
            assert!(now.rss_kib <= before.rss_kib + 4 * MAX_GROWTH_KIB, "{before:?} grew to {now:?}");
        }
    }
    println!(
        "{:?}\n{}\n{}",
        attacks.iter().map(Attack::done).collect::<Vec<_>>(),
        robot.fresh(),
        gateway.fresh()
    );
    drop(clients);
    robot.end();
    gateway.end();
    drop(alone);
}

#[track_caller]
fn within_bounds(usage: &Usage) {
    assert!(usage.rss_kib <= MAX_RSS_KIB, "{usage:?}");
    assert!(usage.descriptors <= MAX_DESCRIPTORS, "{usage:?}");
    assert!(usage.threads <= 8, "{usage:?}");
}

const QUIET: Duration = Duration::from_millis(300);
const WARM_UP: Duration = Duration::from_millis(200);
const ATTACK: Duration = Duration::from_millis(500);
/// docs/devices.md section 7.
const MAX_RSS_KIB: u64 = 64 << 10;
const MAX_DESCRIPTORS: usize = 400;
/// Growth during one measurement that may come from the allocator.
const MAX_GROWTH_KIB: u64 = 512;
const MAX_TRIES: usize = 12;
