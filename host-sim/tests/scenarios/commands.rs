//! Commands that would start something late, a stop that must not wait, and commands for what is so already.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use recipe_test_kit::toml;
use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::{Cable, Gateway, Link, Plan};
use super::field::LineClient;
use super::network::{Filter, Network, Pass};
use super::robot::Robot;

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("a_start_while_the_cable_is_out", |case| {
            late_start(case, Duration::from_secs(4), Duration::from_secs(5));
        })
        .with_true_cable(),
        Scenario::new("a_start_while_the_cable_is_out_for_long", |case| {
            late_start(case, Duration::from_millis(7_500), WATCHED);
        })
        .with_true_cable(),
        Scenario::new("a_gateway_that_was_stopped_starts_nothing", asleep).of_sleep(),
        Scenario::new("a_stop_behind_a_start_without_a_reply", stop_behind),
        Scenario::new("commands_for_what_is_so_already", already),
    ]
}

/// A gateway for a panel: an order, which sends a command when it changes, and DO1 to DO8. DO8 is the safe
/// value.
fn panel() -> String {
    toml::panel(r#"1 = "run(endless.jspf)", 9 = "stop""#, 1_000)
}

/// A controller with a program that does not end by itself.
const ENDLESS: &str = r#"
[listen]
address = "127.0.0.1"

[robot]
power = "enabled"
mode = "remote"

[[program]]
name = "endless.jspf"
script = "loop { wait_ms(50); }"
"#;

/// The variable of DO1 to DO8.
const OUTPUTS: &str = "DigitalOutputCommand[1]";

const NOTHING: u8 = 0;
const RUN: u8 = 1;
const STOP: u8 = 9;

/// A start that was not prevented shows within this time, even on a busy machine.
const WATCHED: Duration = Duration::from_secs(3);
/// How often a panel sends its switches.
const PERIOD: Duration = Duration::from_millis(20);

fn order(order: u8, outputs: u8) -> [u8; 6] {
    [0xFF, 0xFF, order, outputs, 0xEE, 0xEE]
}

/// The panel sends this frame for some time.
fn hold(panel: &mut LineClient, frame: &[u8], time: Duration, mut meanwhile: impl FnMut()) {
    let begin = Instant::now();
    while begin.elapsed() < time {
        panel.send(frame);
        meanwhile();
        std::thread::sleep(PERIOD);
    }
}

/// Starts the program by an order while everything works. After a sleep of the gateway, which a busy machine may cause,
/// the first frame is the base again: then the order is given once more, as a person would.
#[track_caller]
fn start(panel: &mut LineClient, gateway: &mut dyn Gateway, robot: &Robot) {
    until("the program runs", || {
        // The first frame only sets the base.
        let frames = gateway.port("device").frames_in;
        until("the base is taken", || {
            panel.send(&order(NOTHING, 0));
            (gateway.port("device").frames_in > frames).then_some(())
        });
        let pressed = Instant::now();
        while pressed.elapsed() < WATCHED {
            hold(panel, &order(RUN, 0), PERIOD, || ());
            if robot.is_running() {
                return Some(());
            }
        }
        None
    });
}

/// A transport retransmits after about twice the time before. What it still holds after a cable was `out` for
/// 4 s therefore arrives within the next 5 s, before the missing reply ends the connection.
fn late_start(case: &Case, out: Duration, watched: Duration) {
    const PRESSED: Duration = Duration::from_millis(200);
    let robot = case.robot_of(ENDLESS).start();
    let mut gateway = case.gateway_of(&panel()).robot(&robot).with_cable().start();
    gateway.until_up(Link::Command, 1);
    let mut panel = gateway.line("device");
    // This also shows that the panel and the command link work.
    start(&mut panel, &mut *gateway, &robot);
    until("the program ends", || {
        panel.send(&order(STOP, 0));
        (!robot.is_running()).then_some(())
    });
    hold(&mut panel, &order(NOTHING, 0), 5 * PERIOD, || ());
    gateway.cable(Cable::Pulled);
    let begin = Instant::now();
    hold(&mut panel, &order(RUN, 0), PRESSED, || ());
    let rest = out.saturating_sub(begin.elapsed());
    hold(&mut panel, &order(NOTHING, 0), rest, || gateway.must_run());
    gateway.cable(Cable::Plugged);
    let must_rest = || assert!(!robot.is_running(), "it was started after {:?}", begin.elapsed());
    until("the command link is back", || {
        must_rest();
        panel.send(&order(NOTHING, 0));
        let status = gateway.link(Link::Command);
        (status.is_up && status.connects >= 2).then_some(())
    });
    hold(&mut panel, &order(NOTHING, 0), watched, must_rest);
    start(&mut panel, &mut *gateway, &robot);
}

fn asleep(case: &Case) {
    const STOPPED: Duration = Duration::from_secs(8);
    /// What the device sends while the gateway is stopped.
    const DO1: u8 = 1;
    const BEFORE: u8 = 2;
    let robot = case.robot_of(ENDLESS).start();
    let mut gateway = case.gateway_of(&panel()).robot(&robot).start();
    gateway.until_up(Link::Command, 1);
    gateway.until_up(Link::Modbus, 1);
    let mut panel = gateway.line("device");
    robot.until_after(OUTPUTS, f64::from(BEFORE), || panel.send(&order(NOTHING, BEFORE)));
    gateway.freeze();
    panel.send(&order(RUN, DO1));
    let begin = Instant::now();
    while begin.elapsed() < STOPPED {
        assert_eq!(robot.newest(OUTPUTS), f64::from(BEFORE), "nobody is there who could have changed it");
        std::thread::sleep(PERIOD);
    }
    gateway.thaw();
    let must_rest = || {
        assert!(!robot.is_running(), "it was started {:?} after the gateway was stopped", begin.elapsed());
        assert_ne!(robot.newest(OUTPUTS), f64::from(DO1), "DO1 was set by a frame of long ago");
    };
    until("DO8, the safe value", || {
        must_rest();
        (robot.newest(OUTPUTS) == 128.0).then_some(())
    });
    let thawed = Instant::now();
    while thawed.elapsed() < WATCHED {
        must_rest();
        std::thread::sleep(PERIOD);
    }
    gateway.until_up(Link::Command, 2);
    start(&mut panel, &mut *gateway, &robot);
    robot.until_after(OUTPUTS, f64::from(DO1), || panel.send(&order(RUN, DO1)));
}

fn stop_behind(case: &Case) {
    const HELD: Duration = Duration::from_secs(3);
    const SOON: Duration = Duration::from_millis(1_500);
    let robot = case.robot_of(ENDLESS).start();
    // A connection that has carried a start returns no more answers: one is missing for 10 s.
    let mut way = Network::default();
    let command = way.tcp_through(robot.address("command"), |_| {
        let is_mute = Arc::new(AtomicBool::new(false));
        let mutes = Arc::clone(&is_mute);
        let to_server: Box<Filter> = Box::new(move |bytes| {
            mutes.fetch_or(bytes.windows(4).any(|word| word == b"run("), Ordering::SeqCst);
            Pass::On
        });
        let to_client: Box<Filter> = Box::new(move |bytes| {
            if is_mute.load(Ordering::SeqCst) {
                bytes.clear();
            }
            Pass::On
        });
        [to_server, to_client]
    });
    let plan: Plan<'_> = case.gateway_of(&panel()).robot(&robot).server_at("command", command);
    let mut gateway = plan.start();
    gateway.until_up(Link::Command, 1);
    // Until it is there, a stop waits for one of the places of the other.
    gateway.until_up(Link::Urgent, 1);
    let mut panel = gateway.line("device");
    start(&mut panel, &mut *gateway, &robot);
    let begin = Instant::now();
    let mut stopped = None;
    hold(&mut panel, &order(STOP, 0), HELD, || {
        if !robot.is_running() {
            stopped.get_or_insert(begin.elapsed());
        }
    });
    let stopped = stopped.unwrap_or_else(|| panic!("the program still runs after {HELD:?}"));
    assert!(stopped < SOON, "it was stopped after {stopped:?}");
    assert!(!robot.is_running(), "it was started again");
    gateway.must_run();
}

/// A newer controller answers `already poweron` where nothing is left to do. That is a reply like others: the usual
/// start sequence starts the program on a robot that is on, and a repeated stop costs nothing.
fn already(case: &Case) {
    const POWERON: u8 = 1;
    const ENABLE: u8 = 2;
    const START: u8 = 3;
    const DISABLE: u8 = 8;
    /// How long a switch is pressed.
    const PRESSED: Duration = Duration::from_millis(100);
    /// A reply that is missing holds everything up for 10 s.
    const SOON: Duration = Duration::from_secs(5);
    let robot = case.robot_of(&ENDLESS.replace("[robot]", "[robot]\ndialect = \"v2.6\"")).start();
    let table = r#"1 = "poweron", 2 = "enable", 3 = "run(endless.jspf)", 8 = "disable", 9 = "stop""#;
    // What the controller answers, as it is on the wire.
    let answers = Arc::<Mutex<Vec<u8>>>::default();
    let mut way = Network::default();
    let command = way.tcp_through(robot.address("command"), {
        let answers = Arc::clone(&answers);
        move |_| {
            let answers = Arc::clone(&answers);
            let to_client: Box<Filter> = Box::new(move |bytes| {
                answers.lock().unwrap().extend_from_slice(bytes);
                Pass::On
            });
            [Box::new(|_: &mut Vec<u8>| Pass::On), to_client]
        }
    });
    let plan = case.gateway_of(&toml::panel(table, 1_000)).robot(&robot).server_at("command", command);
    let mut gateway = plan.start();
    gateway.until_up(Link::Command, 1);
    gateway.until_up(Link::Urgent, 1);
    let mut panel = gateway.line("device");
    let frames = gateway.port("device").frames_in;
    until("the base is taken", || {
        panel.send(&order(NOTHING, 0));
        (gateway.port("device").frames_in > frames).then_some(())
    });
    let begin = Instant::now();
    let until_running = |panel: &mut LineClient, begin: Instant| {
        while !robot.is_running() {
            assert!(begin.elapsed() < SOON, "the program does not run after {:?}", begin.elapsed());
            hold(panel, &order(START, 0), PERIOD, || ());
        }
    };
    for value in [POWERON, ENABLE, START] {
        hold(&mut panel, &order(value, 0), PRESSED, || ());
    }
    until_running(&mut panel, begin);
    until("the program ends", || {
        panel.send(&order(DISABLE, 0));
        (!robot.is_running()).then_some(())
    });
    let begin = Instant::now();
    for value in [NOTHING, DISABLE, NOTHING, DISABLE, NOTHING, ENABLE] {
        hold(&mut panel, &order(value, 0), PRESSED, || ());
    }
    // Enabling takes the robot 200 ms.
    hold(&mut panel, &order(NOTHING, 0), 4 * PRESSED, || ());
    until_running(&mut panel, begin);
    let links = [gateway.link(Link::Command), gateway.link(Link::Urgent)];
    assert!(links.iter().all(|link| link.is_up && link.connects == 1), "{links:?}");
    // Each once: three, three times off, and two again.
    assert_eq!((robot.count("/command/requests"), robot.count("/command/refusals")), (8, 0));
    let answers = String::from_utf8_lossy(&answers.lock().unwrap()).into_owned();
    let already =
        ["poweron", "enable", "disable"].map(|what| answers.matches(&format!("already {what}")).count());
    assert_eq!(already, [1, 1, 2], "{answers:?}");
    gateway.must_run();
}
