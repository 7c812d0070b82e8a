//! The simulated controller's own work, without sockets: what it adds to a request beside the
//! system calls, and what a cycle costs.

use std::net::Ipv4Addr;

use proto_core::recipe::model::{Field, Mode};
use proto_core::sysvar::VarRange;
use proto_core::time::{Duration, Instant};
use recipe_config::{SimBus, SimConfig, SimField, SimParts, SimPort, SimRecipe, SimStreamPart};
use recipe_controller::{ConnId, Controller, ControllerInput, ControllerOutput};

const MODBUS: ConnId = ConnId(1);
const START: Instant = Instant::from_millis(1_000);

fn main() {
    divan::main();
}

fn fields(name: &str) -> Vec<SimField> {
    let vars = VarRange::parse(name).unwrap().iter();
    vars.map(|var| SimField { name: var.to_string(), field: Field::System(var) }).collect()
}

/// A controller with a UDP server that streams the pose and takes DO1..8, and 64 Modbus clients.
fn controller() -> Controller {
    let part = |tail: u8, name| {
        Some(SimStreamPart { head: vec![0xFF, 0xFF], tail: vec![tail, tail], fields: fields(name) })
    };
    let parts = SimParts::Stream {
        input: part(0xEE, "DigitalOutputCommand[1]"),
        output: part(0xFE, "RobotState[8..13]"),
    };
    let config = SimConfig {
        recipes: vec![SimRecipe { name: "pose".to_owned(), mode: Mode::Realtime, parts }],
        ports: vec![SimPort {
            name: "udp2011".to_owned(),
            bus: SimBus::UdpServer,
            recipe: Some(0),
            cycle: Duration::from_millis(4),
        }],
        ..SimConfig::default()
    };
    let mut controller = Controller::new(&config).unwrap();
    for conn in 1..=64 {
        controller.handle(
            START,
            ControllerInput::ModbusOpened { conn: ConnId(conn), from: Ipv4Addr::LOCALHOST.into() },
        );
    }
    drain(&mut controller, START);
    controller
}

/// Everything there is to send, and its length.
fn drain(controller: &mut Controller, now: Instant) -> usize {
    let mut sent = 0;
    loop {
        match controller.poll_output(now) {
            ControllerOutput::Send { bytes, .. } | ControllerOutput::UdpSend { bytes, .. } => {
                sent += bytes.len()
            }
            ControllerOutput::StatePacket { bytes } => sent += bytes.len(),
            ControllerOutput::Sleep { .. } => return sent,
            _ => {}
        }
    }
}

#[divan::bench]
fn modbus_read_118_registers(bencher: divan::Bencher<'_, '_>) {
    let mut controller = controller();
    let request = [0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 118];
    bencher.bench_local(|| {
        let bytes = divan::black_box(&request[..]);
        controller.handle(START, ControllerInput::ModbusBytes { conn: MODBUS, bytes });
        assert_eq!(drain(&mut controller, START), 9 + 236);
    });
}

#[divan::bench]
fn modbus_write_16_coils(bencher: divan::Bencher<'_, '_>) {
    let mut controller = controller();
    let request = [0, 1, 0, 0, 0, 9, 1, 15, 0, 192, 0, 16, 2, 0x55, 0xAA];
    bencher.bench_local(|| {
        let bytes = divan::black_box(&request[..]);
        controller.handle(START, ControllerInput::ModbusBytes { conn: MODBUS, bytes });
        assert_eq!(drain(&mut controller, START), 12);
    });
}

/// The bare limit of the two above: an answer's bytes in a buffer of their own.
#[divan::bench]
fn bare_answer_of_245_bytes(bencher: divan::Bencher<'_, '_>) {
    let answer = [0x5A_u8; 245];
    bencher.bench_local(|| divan::black_box(&answer).to_vec());
}

#[divan::bench]
fn udp_frame_in(bencher: divan::Bencher<'_, '_>) {
    let mut controller = controller();
    let peer = ([127, 0, 0, 1], 5_000).into();
    bencher.bench_local(|| {
        let bytes = divan::black_box(&[0xFF, 0xFF, 1, 0xEE, 0xEE][..]);
        controller.handle(START, ControllerInput::Udp2011 { peer, bytes });
        drain(&mut controller, START)
    });
}

#[divan::bench]
fn cycle_to_8_udp_clients(bencher: divan::Bencher<'_, '_>) {
    let mut controller = controller();
    for port in 0..8 {
        let peer = ([127, 0, 0, 1], 5_000 + port).into();
        controller.handle(START, ControllerInput::Udp2011 { peer, bytes: &[] });
    }
    let mut now = START;
    bencher.bench_local(|| {
        now += Duration::from_millis(4);
        assert_eq!(drain(&mut controller, now), 8 * 28);
    });
}

#[divan::bench]
fn state_packet(bencher: divan::Bencher<'_, '_>) {
    let controller = controller();
    bencher.bench_local(|| controller.registers().packet(None));
}
