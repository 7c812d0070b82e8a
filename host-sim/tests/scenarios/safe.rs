//! Safe values reach the controller although the path to it fails at the worst moment.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::Link;
use super::examples::{DO1, DO1_OFF, DO1_ON, ROBOT};
use super::network::{Filter, Loss, Network, Pass};
use super::robot::reserved_ports;

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("a_safe_value_whose_datagrams_are_lost", lost_datagrams),
        Scenario::new("a_safe_value_whose_connection_drops", dropped_connection),
        Scenario::new("a_safe_value_at_a_controller_that_restarts", restart),
    ]
}

/// DO1 to DO8 off.
const OFF: &str = "{ 'DigitalOutputCommand[1]' = 0 }";
/// Only DO8 on, which no controller starts with.
const MARK: &str = "{ 'DigitalOutputCommand[1]' = 0x80 }";
/// Maximum time in which a value arrives without faults: far longer than a busy machine needs, and too short
/// for other causes.
const SOON: Duration = Duration::from_secs(5);

fn lost_datagrams(case: &Case) {
    // Longer than a busy machine needs from a frame to the controller's statistics.
    const TIMEOUT_MS: u32 = 1_000;
    // Shorter than the 500 ms without data after which everything would be sent again anyway.
    const LOST: Duration = Duration::from_millis(300);
    let robot = case.robot(ROBOT).start();
    let way = Network::default();
    // The device never switches off, so the first frame that does is the timeout's.
    let loss = Loss::new(&DO1_OFF, LOST);
    let udp = way.udp_losing(robot.address("udp2011"), &loss);
    let plan = case.gateway("udp-server.toml").robot(&robot).server_at("udp2011", udp);
    let plan = plan.set("port.rs485-1.timeout_ms", TIMEOUT_MS).set("port.rs485-1.on_timeout", OFF);
    let mut gateway = plan.start();
    gateway.until_up(Link::Udp2011, 1);
    let mut device = gateway.line("rs485-1");
    robot.until_after(DO1, 1.0, || device.send(&DO1_ON));
    // The device is silent from now on.
    let begun = until("the safe value is lost", || {
        gateway.must_run();
        loss.begun()
    });
    robot.until(DO1, 0.0);
    let elapsed = begun.elapsed();
    // Otherwise the value did not come from a repetition.
    assert!(elapsed >= LOST, "the controller had it after {elapsed:?}");
    assert!(elapsed < LOST + SOON, "the controller had it only after {elapsed:?}");
}

fn dropped_connection(case: &Case) {
    // Longer than a busy machine needs from a frame to the controller's statistics.
    const TIMEOUT_MS: u32 = 1_000;
    let plan = case.gateway("client.toml").set("port.rs485-1.timeout_ms", TIMEOUT_MS);
    let mut gateway = plan.set("port.rs485-1.on_timeout", OFF).start();
    let link = Link::TcpListen("up");
    // The connection is closed when it carries the first frame that switches off: the sender's transport got
    // an acknowledgement, but the controller never receives the frame.
    let (is_armed, cuts) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU32::new(0)));
    let mut way = Network::default();
    let place = way.tcp_through(gateway.listens("up"), {
        let (is_armed, cuts) = (Arc::clone(&is_armed), Arc::clone(&cuts));
        move |_| {
            let (is_armed, cuts) = (Arc::clone(&is_armed), Arc::clone(&cuts));
            let mut end = Vec::new();
            // The controller is the client here, so this is what the gateway sends.
            let to_client: Box<Filter> = Box::new(move |bytes| {
                end.extend_from_slice(bytes);
                let switches_off = end.windows(DO1_OFF.len()).any(|frame| frame == DO1_OFF);
                end.drain(..end.len().saturating_sub(DO1_OFF.len() - 1));
                if switches_off && is_armed.swap(false, Ordering::SeqCst) {
                    cuts.fetch_add(1, Ordering::SeqCst);
                    return Pass::Cut;
                }
                Pass::On
            });
            [Box::new(|_: &mut Vec<u8>| Pass::On), to_client]
        }
    });
    // The other client has no server and keeps trying.
    let robot = case.robot("client-controller.toml").set("port.tcp1.to", place);
    let robot = robot.set("port.udp1.to", "127.0.0.1:9").start();
    gateway.until_up(link, 1);
    let mut device = gateway.line("rs485-1");
    is_armed.store(true, Ordering::SeqCst);
    robot.until_after(DO1, 1.0, || device.send(&DO1_ON));
    // The device is silent from now on.
    until("the safe frame is lost with its connection", || {
        gateway.must_run();
        (cuts.load(Ordering::SeqCst) == 1).then_some(())
    });
    gateway.until_up(link, 2);
    let up = Instant::now();
    robot.until(DO1, 0.0);
    assert!(up.elapsed() < SOON, "{:?} after the link was back", up.elapsed());
}

fn restart(case: &Case) {
    let ports = reserved_ports();
    let robot = case.robot(ROBOT).on(ports).start();
    let plan = case.gateway("rs485-system.toml").robot(&robot);
    let mut gateway = plan.set("port.rs485-1.on_timeout", MARK).start();
    gateway.until_up(Link::Modbus, 1);
    let mut device = gateway.line("rs485-1");
    device.send(&DO1_ON);
    robot.until(DO1, 128.0);
    // The write was answered long ago, and the device stays silent.
    gateway.until_frames_in("rs485-1", 1);
    robot.end();
    gateway.until_down(Link::Modbus);
    let robot = case.robot(ROBOT).on(ports).set(&format!("initial.{DO1:?}"), 3).start();
    gateway.until_up(Link::Modbus, 2);
    robot.until(DO1, 128.0);
    assert_eq!(gateway.port("rs485-1").frames_in, 1, "the device was silent");
}
