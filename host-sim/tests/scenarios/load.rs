//! A cell at full load: every frame that a wire delivered is accounted for, on both sides.
//!
//! `HOST_SIM_LOAD_SECONDS` is its length (default 5).

use std::time::{Duration, Instant};

use serde_json::Value;

use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::Link;
use super::robot::reserved_ports;
use super::traffic::{Bus, CAN_RATE, CELL, Generator, Panel, SENSOR_RATE, can_frame, sensor_frame};

pub(crate) fn all() -> Vec<Scenario> {
    vec![Scenario::new("a_cell_at_full_load", full_load).alone().lasting(duration())]
}

fn duration() -> Duration {
    let seconds = std::env::var("HOST_SIM_LOAD_SECONDS");
    Duration::from_secs_f64(seconds.map_or(5.0, |text| text.parse().expect("HOST_SIM_LOAD_SECONDS")))
}

fn full_load(case: &Case) {
    let ports = reserved_ports();
    let mut plan = case.gateway_of(CELL).set("controller.recipe_link.udp", ports[3]);
    plan.set_servers(ports);
    let mut gateway = plan.start();
    // The devices are connected before the first frame can be sent to them.
    let mut sensor = gateway.line("force");
    let mut panel = Panel::default();
    let mut panel_line = gateway.line("panel");
    let mut bus = Bus::default();
    let mut bus_line = gateway.can("bus").into_line();
    let robot = case.robot("force-sensor-controller.toml").on(ports).start();
    for link in [Link::Modbus, Link::Udp2011, Link::State] {
        gateway.until_up(link, 1);
    }

    let duration = duration();
    let sensor = Generator::start(SENSOR_RATE, sensor.take_writer(), sensor_frame);
    let can = Generator::start(CAN_RATE, bus_line.take_writer(), can_frame);
    let (begin, spent, figures) = (Instant::now(), gateway.processor_time(), gateway.figures());
    panel.take(&panel_line.take_all());
    bus.take(&bus_line.take_all());
    let out_before = [panel.frames, bus.frames];
    let settled = duration / 5;
    let mut memory = None;
    while begin.elapsed() < duration {
        std::thread::sleep(Duration::from_millis(20));
        panel.take(&panel_line.take_all());
        bus.take(&bus_line.take_all());
        gateway.must_run();
        if memory.is_none() && begin.elapsed() > settled {
            memory = Some(gateway.memory());
        }
    }
    let spent = gateway.processor_time() - spent;
    let elapsed = begin.elapsed();
    let figures = growth(&figures, &gateway.figures(), elapsed);
    let out = [panel.frames - out_before[0], bus.frames - out_before[1]];
    let (sensor, can) = (sensor.end(), can.end());
    let (before, after) = (memory.unwrap_or_default(), gateway.memory());

    // In: all that was sent was accepted, and the newest value has reached the controller.
    let force_port = gateway.until_bytes_in("force", sensor.bytes);
    gateway.until_frames_in("bus", can.frames.into());
    // An emulator that is seconds behind loses its connection, and what waited for that is not sent: it is too old.
    let (modbus, behind) = (gateway.link(Link::Modbus), gateway.figures()["most_behind_s"].as_f64());
    if modbus.is_up && modbus.connects == 1 || behind.is_none_or(|seconds| seconds < 1.0) {
        robot.until("WordInputReg[1]", f64::from((can.frames - 1) as u16));
        robot.until("WordInputReg[2]", f64::from(((can.frames - 1) >> 16) as u16));
    } else {
        println!(
            "the machine is too slow for real time: {behind:?} s behind, {modbus:?}; Modbus is not looked at"
        );
        gateway.until_up(Link::Modbus, 2);
    }
    robot.until("ForceEnd[1]", f64::from((sensor.frames - 1) as f32));
    let requests = robot.count("/modbus/requests");
    let datagrams = robot.count("/ports/udp2011/frames_in");
    // Out: it ends without the controller; then all that was sent was received.
    robot.end();
    gateway.until_down(Link::State);
    let heard = |gateway: &dyn super::environment::Gateway, panel: &Panel, bus: &Bus| {
        let status = ["panel", "bus"].map(|port| gateway.port(port));
        (status[0].frames_out == panel.frames && status[1].frames_out == bus.frames).then_some(status)
    };
    let [panel_port, bus_port] = until("all that was sent is heard", || {
        panel.take(&panel_line.take_all());
        bus.take(&bus_line.take_all());
        heard(&*gateway, &panel, &bus)
    });
    let seconds = elapsed.as_secs_f64();
    let rate = |count: u64| count as f64 / seconds;
    println!(
        "{}: {seconds:.1} s\n  force sensor: {} frames sent ({:.0}/s, {} late together with others), {} in\n  \
         CAN: {} frames sent ({:.0}/s, {} late together with others), {} in; {} out ({:.0}/s), {} cycles skipped\n  \
         panel: {} frames out ({:.0}/s), {} cycles skipped\n  controller: {requests} Modbus requests ({:.0}/s), \
         {datagrams} datagrams of forces ({:.0}/s)\n  processor {:.0} %, memory {before} bytes, at the end {after}{figures}",
        case.environment.name(),
        sensor.frames,
        rate(sensor.frames.into()),
        sensor.together,
        force_port.frames_in,
        can.frames,
        rate(can.frames.into()),
        can.together,
        bus_port.frames_in,
        bus_port.frames_out,
        rate(out[1]),
        bus_port.skipped_cycles,
        panel_port.frames_out,
        rate(out[0]),
        panel_port.skipped_cycles,
        rate(requests),
        rate(datagrams),
        100.0 * spent.as_secs_f64() / seconds,
    );
    assert_eq!((force_port.frames_in, force_port.skipped_bytes), (sensor.frames.into(), 0), "{force_port:?}");
    assert_eq!(bus_port.frames_in, u64::from(can.frames), "{bus_port:?}");
    assert!(panel.frames > 0 && bus.frames > 0, "{panel_port:?} {bus_port:?}");
    assert!(after <= before + MEMORY_NOISE, "memory grew from {before} to {after} bytes");
}

/// The difference of an emulator's counters, with rates per second.
fn growth(before: &Value, after: &Value, elapsed: Duration) -> String {
    let mut text = String::new();
    for (name, after) in after.as_object().into_iter().flatten() {
        let (Some(before), Some(after)) = (before[name].as_f64(), after.as_f64()) else { continue };
        let count = if name.starts_with("most") { after } else { after - before };
        text += &format!("\n  {name} {count} ({:.1}/s)", count / elapsed.as_secs_f64());
    }
    text
}

/// Memory that the allocator of a host's process may take later.
const MEMORY_NOISE: u64 = 256 << 10;
