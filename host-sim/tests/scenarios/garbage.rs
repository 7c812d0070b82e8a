//! Invalid bytes on every path into a gateway.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream, UdpSocket};
use std::time::Duration;

use rustix::net::{self, AddressFamily, SocketType};

use recipe_test_kit::PATIENCE;

use super::case::{Case, Scenario};
use super::environment::{Gateway, Link};
use super::examples::{DO1, DO1_OFF, DO1_ON, ROBOT, listening, pose_and_output, pose_frame};

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("garbage_on_rs485", rs485),
        Scenario::new("garbage_on_can", can),
        Scenario::new("strangers_on_a_listening_tcp_port", tcp),
        Scenario::new("strangers_on_a_listening_udp_port", udp),
        Scenario::new("listening_ports_take_the_controllers_address_only", other_addresses),
    ]
}

fn rs485(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut gateway = case.cell("rs485-system.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let mut device = gateway.line("rs485-1");
    let mut garbage: Vec<u8> = (0..=255).cycle().take(2048).collect();
    // It ends in heads, and in a partial frame.
    garbage.extend_from_slice(&[0xFF, 0xFF, 0xFF]);
    garbage.extend_from_slice(&DO1_OFF[..4]);
    for (value, frame) in [(1.0, DO1_ON), (0.0, DO1_OFF)] {
        device.send(&[&garbage[..], &frame].concat());
        robot.until(DO1, value);
    }
    let status = gateway.until_frames_in("rs485-1", 2);
    assert_eq!(status.bytes_in, 2 * (garbage.len() as u64 + 5), "{status:?}");
}

fn can(case: &Case) {
    let robot = case.robot("can-system-controller.toml").bind("can", "slcan-tcp:127.0.0.1:0").start();
    let mut gateway = case.cell("can-system.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let mut bus = gateway.can("can-1");
    for value in [1, 0] {
        // Invalid lines of slcan, lines that are too long, and frames that are not in the recipe: another id,
        // another length, a remote frame, an extended id.
        for garbage in [&[0x80, 0xFF, 0x00][..], b"\r", &[b'7'; 200], b"\r", b"t9991\rtXYZ\r", b"t0020\r"] {
            bus.send_raw(garbage);
        }
        for line in ["t7FF801020304050607FF\r", "t0012FFFF\r", "r0011\r", "T000000011FF\r"] {
            bus.send_raw(line.as_bytes());
        }
        bus.send(1, &[value]);
        robot.until(DO1, f64::from(value));
    }
    gateway.until_frames_in("can-1", 2);
    bus.forget();
    assert_eq!(bus.frame(2).len(), 8, "the cycle goes on");
}

/// It has no complete frame, and ends in a partial one.
fn no_frames() -> Vec<u8> {
    let noise = (0_u32..4_096).map(|number| (number.wrapping_mul(2_654_435_761) >> 24) as u8);
    noise.chain(pose_frame(6).into_iter().take(9)).collect()
}

/// Connects to a listening port.
#[track_caller]
fn stranger(gateway: &dyn Gateway, from: Ipv4Addr) -> TcpStream {
    let socket = net::socket(AddressFamily::INET, SocketType::STREAM, None).unwrap();
    net::bind(&socket, &SocketAddr::from((from, 0))).unwrap();
    net::connect(&socket, &gateway.listens("up")).unwrap();
    let stranger = TcpStream::from(socket);
    stranger.set_read_timeout(Some(PATIENCE)).unwrap();
    stranger
}

/// The controller's address in the gateway's configuration.
const HERE: Ipv4Addr = Ipv4Addr::LOCALHOST;
/// A process of this host can act as the controller, but only from its usual address.
const ELSEWHERE: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);

fn tcp(case: &Case) {
    let link = Link::TcpListen("up");
    let (mut gateway, plan) = listening(case, "tcp-listen");
    // A client comes first: what it sends is no frame, and nothing of it reaches the device.
    let mut device = gateway.line("rs485-1");
    let mut first = stranger(&*gateway, HERE);
    gateway.until_up(link, 1);
    first.write_all(&no_frames()).unwrap();
    // When it has left, the controller is served.
    drop(first);
    gateway.until_down(link);
    let robot = plan.start();
    gateway.until_up(link, 2);
    pose_and_output(&robot, &mut device, &pose_frame(6));
    // Another client is refused, and the controller's connection stays.
    let mut second = stranger(&*gateway, HERE);
    let _ = second.write_all(&no_frames());
    assert!(is_turned_away(&mut second), "a second client was served, or left waiting");
    pose_and_output(&robot, &mut device, &pose_frame(6));
    assert_eq!(gateway.link(link).connects, 2, "the controller's connection was disturbed");
}

/// Every client is a stranger, since the controller is configured with another address.
fn other_addresses(case: &Case) {
    for bus in ["tcp-listen", "udp-listen"] {
        let plan = case.gateway("client.toml").set("controller.address", "192.0.2.1");
        let mut gateway = plan.set("port.up.bus", bus).start();
        let mut device = gateway.line("rs485-1");
        // A valid frame: from the controller, the device would be sent its values within a cycle.
        if bus == "tcp-listen" {
            let mut stranger = stranger(&*gateway, ELSEWHERE);
            let _ = stranger.write_all(&pose_frame(6));
            assert!(is_turned_away(&mut stranger), "a stranger was served, or left waiting");
        } else {
            let stranger = UdpSocket::bind((ELSEWHERE, 0)).unwrap();
            for _ in 0..10 {
                stranger.send_to(&pose_frame(6), gateway.listens("up")).unwrap();
            }
        }
        device.is_silent(Duration::from_millis(500));
        gateway.must_run();
    }
}

/// Whether the connection was closed without data.
fn is_turned_away(stranger: &mut TcpStream) -> bool {
    match stranger.read(&mut [0]) {
        Ok(len) => len == 0,
        Err(error) => error.kind() == ErrorKind::ConnectionReset,
    }
}

fn udp(case: &Case) {
    let (mut gateway, plan) = listening(case, "udp-listen");
    let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
    let to = gateway.listens("up");
    let garbage = no_frames();
    let say = |stranger: &UdpSocket| {
        for datagram in garbage.chunks(100).chain([&garbage[..1_400], &[], &pose_frame(6)[..27]]) {
            stranger.send_to(datagram, to).unwrap();
        }
    };
    say(&stranger);
    let mut device = gateway.line("rs485-1");
    gateway.until_up(Link::UdpListen("up"), 1);
    let robot = plan.start();
    device.until(&pose_frame(6));
    for _ in 0..3 {
        say(&stranger);
        for value in [1, 0] {
            // Answers go to the newest sender, which may be the stranger: the device sends again.
            robot.until_after(DO1, f64::from(value), || device.send(&[0xFF, 0xFF, value, 0xEE, 0xEE]));
        }
    }
    device.forget();
    pose_and_output(&robot, &mut device, &pose_frame(6));
}
