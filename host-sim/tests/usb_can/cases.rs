//! An adapter that works, is alone on the bus, receives noise, loses frames, is unplugged and plugged in.

use std::fmt::Write;

use super::BINARY;
use super::Case;
use super::candlelight::Bus;
use super::stand::{Adapter, Cell, bind};
use recipe_test_kit::{HostSim, example, until};

pub(crate) const CASES: &[Case] = &[
    ("the_worked_example_through_the_gateway", works),
    ("another_bit_rate_is_warned_of", another_bit_rate),
    ("nobody_acknowledges_and_then_somebody_does", nobody_acknowledges),
    ("a_cycle_longer_than_the_queue_and_nobody_acknowledges", no_buffers),
    ("error_passive_with_the_counters", error_passive),
    ("what_the_adapter_lost_is_counted", overflow),
    ("unplugged_and_plugged_in_again", unplugged),
    ("unplugged_from_the_controller", unplugged_from_the_controller),
];

/// The worked example's captured frame.
const POSE: &str = "002#EF54EF3EA7E7D13E";

/// The pose is sent in cycles of three frames, and id 1 switches DO1..8.
#[track_caller]
fn serves(adapter: &Adapter, robot: &HostSim, value: u8) {
    adapter.forget();
    let frames = adapter.sends(12);
    in_order(&frames);
    assert!(frames.iter().any(|frame| frame == POSE), "{frames:?}");
    let frame = format!("001#{value:02X}");
    adapter.hears_until(&frame, robot, "DigitalOutputCommand[1]", f64::from(value));
}

#[track_caller]
fn in_order(frames: &[String]) {
    for pair in frames.windows(2) {
        let ids = (&pair[0][..3], &pair[1][..3]);
        assert!(matches!(ids, ("002", "003") | ("003", "004") | ("004", "002")), "{frames:?}");
    }
}

fn works() {
    let adapter = Adapter::up(500_000);
    let cell = Cell::system();
    for value in [1, 0, 129] {
        serves(&adapter, &cell.robot, value);
    }
    // The newest line of statistics may be older than the last frame.
    let port = until("all frames of the adapter", || {
        let port = cell.bus("active");
        (port["device"]["frames_in"] == adapter.heard()).then_some(port)
    });
    assert_eq!(
        (&port["device"]["error_frames"], &port["device"]["refusals"]),
        (&0.into(), &0.into()),
        "{port}"
    );
    assert_eq!(cell.gateway.log("interface="), Vec::<String>::new());
    cell.end();
}

fn another_bit_rate() {
    let adapter = Adapter::up(250_000);
    let cell = Cell::system();
    let warning = until("a warning", || cell.gateway.log("different bit rates").pop());
    assert!(warning.contains("bitrate=250000 configured=500000"), "{warning}");
    serves(&adapter, &cell.robot, 1);
    cell.end();
}

fn nobody_acknowledges() {
    let adapter = Adapter::up(500_000);
    let cell = Cell::system();
    serves(&adapter, &cell.robot, 1);
    adapter.becomes(Bus::Empty);
    adapter.forget();
    let port = cell.bus("passive");
    // The transmit error counter stops here: the adapter stays on the bus, alone.
    let counters = (&port["device"]["tx_error_counter"], &port["device"]["rx_error_counter"]);
    assert_eq!(counters, (&128.into(), &0.into()), "{port}");
    until("a warning", || cell.gateway.log("error-passive").pop());
    let (sent, given) = (port["device"]["frames_out"].as_u64().unwrap(), adapter.given());
    let skipped = cell.port("skipped cycles", |port| port["skipped_cycles"].as_u64() > Some(20));
    // Three in the adapter, and a cycle that waits for them.
    assert!(skipped["device"]["frames_out"].as_u64() <= Some(sent + 6), "{skipped}");
    assert!(adapter.given() <= given + 6);
    assert_eq!((&skipped["device"]["dropped"], &skipped["downs"]), (&0.into(), &0.into()), "{skipped}");

    adapter.becomes(Bus::Sound);
    in_order(&adapter.sends(60));
    // Each frame that is sent decrements the error counter.
    let port = cell.bus("active");
    assert!(port["device"]["tx_error_counter"].as_u64() < Some(96), "{port}");
    serves(&adapter, &cell.robot, 2);
    assert_eq!(cell.fresh()["bus_offs"], 0);
    cell.end();
}

fn no_buffers() {
    const FRAMES: u64 = 30;
    let mut file = "[controller]\naddress = \"127.0.0.1\"\n\
                    [[recipe]]\nname = \"wide\"\nkind = \"can\"\nmode = \"user\"\n"
        .to_owned();
    for frame in 1..=FRAMES {
        let field = format!("{{ name = \"v{frame}\", type = \"word\", from = \"WordOutputReg[{frame}]\" }}");
        write!(file, "[[recipe.output.frame]]\nid = {}\nfields = [{field}]\n", 0x100 + frame).unwrap();
    }
    file += "[[port]]\nname = \"can\"\nbus = \"can\"\nbitrate = 500000\nrecipe = \"wide\"\ncycle_ms = 100\n";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("wide.toml");
    std::fs::write(&path, file).unwrap();

    let adapter = Adapter::up(500_000);
    adapter.becomes(Bus::Empty);
    let cell = Cell::of(&path);
    // Three in the adapter's mailboxes, ten in the driver, ten or eleven in the interface's queue. The others
    // are refused repeatedly, and then given up. On a slow machine the mailboxes take their frames late, so the
    // last of those that wait belong to the second cycle.
    let port = cell.port("given up", |port| {
        let count = |name: &str| port["device"][name].as_u64().unwrap();
        count("frames_out") >= 23 && count("dropped") > 0 && count("refusals") > 0
    });
    let taken = port["device"]["frames_out"].as_u64().unwrap();
    assert!(taken < 26, "{port}");
    cell.port("each is taken or given up", |port| {
        let count = |name: &str| port["device"][name].as_u64().unwrap();
        Some(count("frames_out") + count("dropped")) == port["frames_out"].as_u64()
    });
    cell.looks_on(|port| assert_eq!(port["device"]["frames_out"], taken, "no more wait: {port}"));
    assert_eq!((&port["downs"], &port["device"]["ups"]), (&0.into(), &1.into()), "{port}");

    adapter.becomes(Bus::Sound);
    let ids = |frames: &[String]| {
        let id = |frame: &String| u64::from_str_radix(&frame[..3], 16).unwrap() - 0x100;
        frames.iter().map(id).collect::<Vec<_>>()
    };
    let whole: Vec<u64> = (1..=FRAMES).collect();
    let sent = ids(&adapter.sends(4 * whole.len()));
    let cycles: Vec<&[u64]> = sent.chunk_by(|first, second| first < second).collect();
    for cycle in &cycles {
        // On a machine that is slow for 100 ms, the rest of a later cycle may be given up, too.
        assert_eq!(*cycle, &whole[..cycle.len()], "in order: {sent:?}");
    }
    let sums = cycles.iter().scan(0, |sum, cycle| {
        *sum += cycle.len() as u64;
        Some(*sum)
    });
    assert!(sums.into_iter().any(|sum| sum == taken), "{taken} that waited: {sent:?}");
    assert!(cycles[1..].contains(&whole.as_slice()), "a whole one, however often it was refused: {sent:?}");
    cell.end();
}

fn error_passive() {
    let adapter = Adapter::up(500_000);
    let cell = Cell::system();
    serves(&adapter, &cell.robot, 1);
    for (noise, state, counter) in [(96, "warning", 96), (32, "passive", 128)] {
        adapter.hears_noise(noise);
        let port = cell.bus(state);
        let counters = (&port["device"]["tx_error_counter"], &port["device"]["rx_error_counter"]);
        assert_eq!(counters, (&0.into(), &counter.into()), "{port}");
        adapter.forget();
        adapter.sends_a(POSE);
    }
    let warning = until("a warning", || cell.gateway.log("error-passive").pop());
    assert!(warning.contains("tx_error_counter=0 rx_error_counter=128"), "{warning}");
    // Each readable frame decrements the error counter.
    for value in 0..40 {
        adapter.receive_from_bus(&format!("001#{value:02X}"));
    }
    let port = cell.bus("active");
    assert_eq!(port["device"]["rx_error_counter"], 95, "{port}");
    serves(&adapter, &cell.robot, 2);
    cell.end();
}

fn overflow() {
    let adapter = Adapter::up(500_000);
    let cell = Cell::system();
    serves(&adapter, &cell.robot, 1);
    adapter.hears_after_a_loss("001#05");
    let port = cell.port("an overflow", |port| port["device"]["overflows"] == 1);
    assert_eq!(port["device"]["frames_in"], adapter.heard(), "{port}");
    assert_eq!(
        (&port["device"]["error_frames"], &port["device"]["overruns"]),
        (&1.into(), &0.into()),
        "{port}"
    );
    assert_eq!(port["device"]["bus"], "active", "{port}");
    serves(&adapter, &cell.robot, 6);
    cell.end();
}

fn unplugged() {
    let mut adapter = Adapter::up(1_000_000);
    let cell = Cell::hand();
    adapter.sends_a("501#000000000000");
    // Between two frames, with frames that wait, and bus-off.
    for (round, bus) in (1_u16..).zip([Bus::Sound, Bus::Empty, Bus::Shorted]) {
        cell.grips(&adapter, 500 + round);
        adapter.becomes(bus);
        cell.bus(match bus {
            Bus::Sound => "active",
            Bus::Empty => "passive",
            Bus::Shorted => "bus-off",
        });
        adapter.unplug();
        let port = cell.port("down", |port| port["downs"] == round);
        assert_eq!(port["device"]["ups"], round, "{port}");
        until("a warning", || {
            let warnings = cell.gateway.log("interface lost, will be reopened");
            (warnings.len() == usize::from(round)).then_some(())
        });
        // There is no hand.
        cell.register("WordInputReg[1]", 0.0);
        cell.robot.command("run(grip.jspf)", "run start");

        // Plugged in, but without bit rate and not up.
        adapter = Adapter::new();
        if round == 1 {
            cell.looks_on(|port| assert_eq!(port["device"]["ups"], round, "{port}"));
            assert_eq!(adapter.given(), 0);
        }
        adapter.bring_up(1_000_000);
        let port = cell.port("up", |port| port["device"]["ups"] == round + 1);
        assert_eq!(port["downs"], round, "{port}");
        let first = &adapter.sends(1)[0];
        assert_eq!(first, "501#C8C8C8C8C8C8", "what is true now, and nothing old");
        cell.bus("active");
    }
    cell.grips(&adapter, 600);
    cell.end();
}

fn unplugged_from_the_controller() {
    let mut adapter = Adapter::up(500_000);
    let file = example("can-system-controller.toml");
    let robot = BINARY.controller(&file, &[&bind("can"), "--set=port.can.cycle_ms=20"]);
    for round in 1..=2 {
        serves(&adapter, &robot, round);
        adapter.unplug();
        let sent = until("it says so", || {
            let stats = robot.fresh();
            let lost = robot.log("interface lost, will be reopened").len() == usize::from(round);
            lost.then(|| stats["ports"]["can"]["device"]["frames_out"].clone())
        });
        assert_eq!(robot.fresh()["ports"]["can"]["device"]["frames_out"], sent);
        adapter = Adapter::up(500_000);
        robot.stats("up", |stats| stats["ports"]["can"]["device"]["ups"] == round + 1);
    }
    serves(&adapter, &robot, 7);
    robot.end();
}
