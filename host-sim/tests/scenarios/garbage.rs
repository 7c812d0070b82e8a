//! Bytes that are nobody's frames, on every way into a gateway.

use super::case::{Case, Scenario};
use super::environment::Link;
use super::examples::{DO1, DO1_OFF, DO1_ON, ROBOT};

pub(crate) fn all() -> Vec<Scenario> {
    vec![Scenario::new("garbage_on_rs485", rs485), Scenario::new("garbage_on_can", can)]
}

fn rs485(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut gateway = case.cell("rs485-system.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let mut device = gateway.line("rs485-1");
    let mut garbage: Vec<u8> = (0..=255).cycle().take(2048).collect();
    // Ends in heads, and in a frame without its end.
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
        // No lines of slcan, lines too long, and frames that the recipe does not have: another id, another
        // length, a remote frame, an extended id.
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
