//! Faults of a bus and of an interface, by the kernel itself where it can make them.

use std::time::Duration;

use serde_json::Value;

use super::BINARY;
use super::adapter::Adapter;
use super::{Needs, Test};
use recipe_test_kit::can::{Candump, Vcan, cansend, tool};
use recipe_test_kit::{HostSim, example, until};
use rustix::process::Signal;

pub(crate) fn trials(interface: &str) -> Vec<Test> {
    let on = |name, needs, test: fn(&str)| -> Test {
        let interface = interface.to_owned();
        (name, needs, Box::new(move || test(&interface)))
    };
    let own = |name, needs, test: fn()| -> Test { (name, needs, Box::new(test)) };
    vec![
        own("bus_off_stops_the_cycle_and_nothing_old_is_sent_after_it", Needs::Slcan, bus_off),
        on("error_frames_become_the_ports_state", Needs::Nothing, error_frames),
        own("an_interface_goes_down_and_comes_back", Needs::Root, down_and_up),
        own("an_interface_is_deleted_and_made_again", Needs::Root, deleted),
        own("no_room_in_the_interfaces_queue", Needs::Root, no_room),
        own("fd_frames_are_counted_and_ignored", Needs::Root, fd_frames),
        on("what_the_kernel_dropped_is_counted", Needs::Nothing, overrun),
        on("what_waited_while_the_gateway_was_stopped_is_discarded", Needs::Nothing, stopped),
        on("what_is_no_can_interface_is_refused_at_once", Needs::Nothing, no_interface),
    ]
}

/// The gateway of the hand's example, which sends one frame each 20 ms.
fn hand(interface: &str) -> (HostSim, HostSim) {
    let robot = BINARY.controller(&example("can-hand-controller.toml"), &[]);
    let bind = format!("--bind=hand=socketcan:{interface}");
    let gateway = BINARY.gateway(&example("can-hand.toml"), &robot, &[&bind]);
    (robot, gateway)
}

/// A controller that sends three frames each 4 ms.
fn system(interface: &str) -> HostSim {
    let bind = format!("--bind=can=socketcan:{interface}");
    BINARY.controller(&example("can-system-controller.toml"), &[&bind])
}

fn bus_off() {
    let adapter = Adapter::new("hsslc0");
    let (robot, gateway) = hand(adapter.interface);
    let open = "t5016000000000000\r";
    let closed = "t5016C8C8C8C8C8C8\r";
    until("the open hand", || adapter.received().contains(open).then_some(()));
    adapter.send("t50240001F401");
    gateway.stats("a frame in", |stats| stats["ports"]["hand"]["frames_in"] == 1);
    let reported =
        |state: &str| gateway.stats(state, |stats| stats["ports"]["hand"]["device"]["bus"] == state);
    reported("active");
    adapter.send("sw100010");
    reported("warning");
    adapter.send("sp130010");
    reported("passive");
    adapter.forget();
    until("frames while passive", || adapter.received().contains(open).then_some(()));

    adapter.send("sb000256");
    reported("bus-off");
    let stats = gateway.fresh();
    assert_eq!(stats["ports"]["hand"]["bus_offs"], 1, "{stats}");
    until("a warning", || gateway.log("bus-off: nothing is sent").pop());
    let sent = stats["ports"]["hand"]["frames_out"].as_u64();
    adapter.forget();
    // The adapter reports it, but the driver was not restarted.
    adapter.send("sa000000");
    robot.command("run(grip.jspf)", "run start");
    robot.stats("the grip", |stats| stats["registers"]["WordOutputReg[6]"].as_f64() == Some(200.0));
    let links = |stats: &serde_json::Value| {
        let received = |name: &str| stats["links"][name]["received"].as_u64().unwrap_or(0);
        received("state") + received("modbus")
    };
    let before = links(&gateway.fresh());
    let stats = gateway.stats("five more looks at the controller", |stats| links(stats) > before + 5);
    assert_eq!(stats["ports"]["hand"]["frames_out"].as_u64(), sent, "nothing is sent: {stats}");
    assert_eq!(stats["ports"]["hand"]["device"]["bus"], "bus-off", "{stats}");
    assert_eq!(adapter.received(), "", "nothing reaches the adapter");

    // This driver is restarted by taking the interface down and up; others have `restart-ms`.
    tool("ip link set hsslc0 down");
    tool("ip link set hsslc0 up");
    until("the closed hand", || adapter.received().contains(closed).then_some(()));
    assert!(!adapter.received().contains(open), "old: {}", adapter.received());
    let stats = reported("active");
    assert_eq!(stats["ports"]["hand"]["bus_offs"], 1, "{stats}");
    assert_eq!(stats["ports"]["hand"]["device"]["ups"], 2, "{stats}");
    gateway.end();
    robot.end();
}

fn error_frames(interface: &str) {
    let (robot, gateway) = hand(interface);
    let dump = Candump::start(interface);
    dump.wait_for("501#000000000000");
    let reported =
        |state: &str| gateway.stats(state, |stats| stats["ports"]["hand"]["device"]["bus"] == state);
    // CAN_ERR_CRTL with the counters: warning, passive, active again.
    for (frame, state) in [
        ("20000204#0008000000006000", "warning"),
        ("20000204#0030000000008080", "passive"),
        ("20000204#0040000000000000", "active"),
    ] {
        cansend(interface, frame);
        reported(state);
    }
    // CAN_ERR_BUSOFF. This interface is not really off: the next check of its carrier shows that.
    cansend(interface, "20000040#0000000000000000");
    let stats = gateway.stats("bus-off", |stats| stats["ports"]["hand"]["bus_offs"] == 1);
    assert_eq!(stats["ports"]["hand"]["device"]["restarts"], 0, "{stats}");
    reported("active");
    // CAN_ERR_BUSOFF, and CAN_ERR_RESTARTED at once.
    cansend(interface, "20000040#0000000000000000");
    cansend(interface, "20000100#0000000000000000");
    let stats = gateway.stats("restarted", |stats| stats["ports"]["hand"]["device"]["restarts"] == 1);
    assert_eq!(stats["ports"]["hand"]["bus_offs"], 2, "{stats}");
    reported("active");
    // CAN_ERR_ACK: counted, no state.
    cansend(interface, "20000020#0000000000000000");
    let stats = gateway.stats("seven", |stats| stats["ports"]["hand"]["device"]["error_frames"] == 7);
    assert_eq!(stats["ports"]["hand"]["device"]["bus"], "active", "{stats}");
    let sent = stats["ports"]["hand"]["frames_out"].as_u64();
    gateway.stats("it sends again", |stats| stats["ports"]["hand"]["frames_out"].as_u64() > sent);
    gateway.end();
    robot.end();
}

/// Checks that frames pass in both directions, and how often the port came up.
#[track_caller]
fn works(interface: &str, robot: &HostSim, value: u8, ups: u64) {
    let dump = Candump::start(interface);
    dump.wait_for("002#EF54EF3EA7E7D13E");
    cansend(interface, &format!("001#{value:02X}"));
    let stats = robot.stats("DO1..8", |stats| {
        stats["registers"]["DigitalOutputCommand[1]"].as_f64() == Some(f64::from(value))
    });
    assert_eq!(stats["ports"]["can"]["device"]["ups"], ups, "{stats}");
}

fn down_and_up() {
    let bus = Vcan::new("hsdown0");
    tool("ip link set hsdown0 down");
    // An interface that is down is no error: it may come up later.
    let robot = system(bus.0);
    assert_eq!(robot.fresh()["ports"]["can"]["device"]["ups"], 0);
    for (value, ups) in [(1, 1), (2, 2), (3, 3)] {
        tool("ip link set hsdown0 up");
        robot.stats("up", |stats| stats["ports"]["can"]["device"]["ups"] == ups);
        works(bus.0, &robot, value, ups);
        tool("ip link set hsdown0 down");
        let sent = robot.fresh()["ports"]["can"]["device"]["frames_out"].clone();
        assert_eq!(
            robot.fresh()["ports"]["can"]["device"]["frames_out"],
            sent,
            "nothing is sent while it is down"
        );
    }
    robot.end();
}

fn deleted() {
    let bus = Vcan::new("hsdel0");
    let (robot, gateway) = {
        let robot =
            BINARY.controller(&example("can-system-controller.toml"), &["--bind=can=slcan-tcp:127.0.0.1:0"]);
        let gateway = BINARY.gateway(&example("can-system.toml"), &robot, &["--bind=can-1=socketcan:hsdel0"]);
        (robot, gateway)
    };
    for round in 1..=2 {
        cansend(bus.0, &format!("001#{round:02X}"));
        robot.stats("DO1..8", |stats| {
            stats["registers"]["DigitalOutputCommand[1]"].as_f64() == Some(f64::from(round))
        });
        tool("ip link del hsdel0");
        gateway.stats("down", |stats| stats["ports"]["can-1"]["downs"] == round);
        tool("ip link add hsdel0 type vcan");
        tool("ip link set hsdel0 up");
        gateway.stats("up", |stats| stats["ports"]["can-1"]["device"]["ups"] == round + 1);
        Candump::start(bus.0).wait_for("002#EF54EF3EA7E7D13E");
    }
    gateway.end();
    robot.end();
}

fn no_room() {
    let bus = Vcan::new("hstbf0");
    // A third of the bit rate that the cycle of three frames needs, and a queue of ten.
    tool("tc qdisc add dev hstbf0 root tbf rate 32kbit burst 64b limit 160");
    let dump = Candump::start(bus.0);
    let robot = system(bus.0);
    let stats = robot.stats("refusals", |stats| {
        stats["ports"]["can"]["device"]["refusals"].as_u64() > Some(100)
            && stats["ports"]["can"]["skipped_cycles"].as_u64() > Some(20)
    });
    assert_eq!(stats["ports"]["can"]["device"]["dropped"], 0, "{stats}");
    let frames = until("frames", || Some(dump.frames()).filter(|frames| frames.len() > 200));
    let ids: Vec<u8> = frames.iter().map(|frame| frame.as_bytes()[2]).collect();
    for pair in ids.windows(2) {
        assert!(matches!(pair, b"23" | b"34" | b"42"), "out of order: {}", String::from_utf8_lossy(&ids));
    }
    // A queue of one: frames that wait too long are given up, and the program keeps running.
    tool("tc qdisc change dev hstbf0 root tbf rate 80bit burst 64b limit 160");
    robot.stats("given up", |stats| stats["ports"]["can"]["device"]["dropped"].as_u64() > Some(3));
    tool("tc qdisc del dev hstbf0 root");
    let sent = robot.fresh()["ports"]["can"]["device"]["frames_out"].as_u64().unwrap();
    robot.stats("all is well again", |stats| {
        stats["ports"]["can"]["device"]["frames_out"].as_u64() > Some(sent + 300)
    });
    works(bus.0, &robot, 9, 1);
    robot.end();
}

fn fd_frames() {
    let bus = Vcan::new("hsfd0");
    tool("ip link set hsfd0 down");
    tool("ip link set hsfd0 mtu 72");
    tool("ip link set hsfd0 up");
    let robot = system(bus.0);
    let dump = Candump::start(bus.0);
    dump.wait_for("002#EF54EF3EA7E7D13E");
    cansend(bus.0, "001##101");
    cansend(bus.0, "001##1000102030405060708090A0B");
    robot.stats("two", |stats| stats["ports"]["can"]["device"]["fd_frames"] == 2);
    works(bus.0, &robot, 5, 1);
    let stats = robot.fresh();
    assert_eq!(stats["ports"]["can"]["frames_in"], 1, "{stats}");
    robot.end();
}

fn overrun(interface: &str) {
    let robot = BINARY.controller(&example("can-hand-controller.toml"), &[]);
    let bind = format!("--bind=can-1=socketcan:{interface}");
    let gateway = BINARY.gateway(&example("can-user.toml"), &robot, &[&bind]);
    gateway.signal(Signal::STOP);
    const SENT: u64 = 6_000;
    tool(&format!("cangen {interface} -g 0 -I 001 -L 3 -D 010203 -n {SENT}"));
    gateway.signal(Signal::CONT);
    let stats = gateway.stats("all accounted for", |stats| {
        let device = &stats["ports"]["can-1"]["device"];
        device["frames_in"]
            .as_u64()
            .zip(device["overruns"].as_u64())
            .is_some_and(|(read, lost)| read + lost == SENT)
    });
    let port = &stats["ports"]["can-1"];
    assert!(port["device"]["overruns"].as_u64() > Some(0), "{port}");
    assert!(port["device"]["frames_in"].as_u64() > Some(100), "{port}");
    // Accepted, or rejected if the stall was so long that it counts as sleep.
    let count = |name: &str| port[name].as_u64().unwrap();
    assert_eq!(count("frames_in") + not_believed(port), port["device"]["frames_in"], "{port}");
    goes_on(interface, &gateway, &robot);
    gateway.end();
    robot.end();
}

fn stopped(interface: &str) {
    let robot = BINARY.controller(&example("can-hand-controller.toml"), &[]);
    let bind = format!("--bind=can-1=socketcan:{interface}");
    let gateway = BINARY.gateway(&example("can-user.toml"), &robot, &[&bind]);
    gateway.signal(Signal::STOP);
    const WAITING: u64 = 50;
    tool(&format!("cangen {interface} -g 1 -I 001 -L 3 -D 010203 -n {WAITING}"));
    std::thread::sleep(STOPPED);
    gateway.signal(Signal::CONT);
    let all = |stats: &Value| stats["sleeps"] == 1 && not_believed(&stats["ports"]["can-1"]) == WAITING;
    let stats = gateway.stats("awake", all);
    assert_eq!(stats["ports"]["can-1"]["frames_in"], 0, "{stats}");
    goes_on(interface, &gateway, &robot);
    let register = robot.fresh()["registers"]["WordInputReg[1]"].as_f64();
    assert_eq!(register, Some(4.0));
    gateway.end();
    robot.end();
}

/// Frames that waited while the gateway slept: discarded by the engine, or dropped if they were read too late for that.
fn not_believed(port: &Value) -> u64 {
    port["asleep"].as_u64().unwrap() + port["device"]["dropped"].as_u64().unwrap()
}

/// Checks that it works as before, once its links are up.
fn goes_on(interface: &str, gateway: &HostSim, robot: &HostSim) {
    let links_up =
        |stats: &Value| stats["links"].as_object().unwrap().values().all(|link| link["state"] == "up");
    gateway.stats("links up", links_up);
    let dump = Candump::start(interface);
    cansend(interface, "001#040506");
    dump.wait_for("002#7D7D7D");
    robot.stats("the newest", |stats| stats["registers"]["WordInputReg[1]"].as_f64() == Some(4.0));
}

/// Longer than a stall that does not count as sleep.
const STOPPED: Duration = Duration::from_secs(1);

fn no_interface(_: &str) {
    for (interface, message) in [("hsnone0", "no such CAN interface"), ("lo", "no such CAN interface")] {
        let mut command = BINARY.command();
        command.args(["controller", "-c"]).arg(example("can-system-controller.toml"));
        let output = command.arg(format!("--bind=can=socketcan:{interface}")).output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{errors}");
        assert!(errors.contains(message) && errors.contains("docs/socketcan.md"), "{errors}");
    }
}
