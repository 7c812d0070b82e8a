//! A device whose frames have a checksum: nothing of a damaged frame reaches the robot.

use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::Link;
use super::examples::ROBOT;

pub(crate) fn all() -> Vec<Scenario> {
    vec![Scenario::new("a_grippers_reply_with_a_wrong_crc", gripper)]
}

/// What the gateway asks for: position 220, speed 255, force 150.
const REQUEST: [u8; 19] = [
    0x09, 0x17, 0x07, 0xD0, 0x00, 0x03, 0x03, 0xE8, 0x00, 0x03, 0x06, 0x09, 0x00, 0x00, 0xDC, 0xFF, 0x96,
    0xD7, 0xDA,
];
/// The gripper holds nothing at position 208, with 300 mA.
const REPLY: [u8; 11] = [0x09, 0x17, 0x06, 0xF9, 0x00, 0x00, 0xDC, 0xD0, 0x1E, 0x4E, 0x11];
const POSITION: usize = 7;

fn gripper(case: &Case) {
    let wanted = [("WordOutputReg[1]", 220), ("WordOutputReg[2]", 255), ("WordOutputReg[3]", 150)];
    let plan = wanted
        .iter()
        .fold(case.robot(ROBOT), |plan, (name, value)| plan.set(&format!("initial.{name}"), value));
    let robot = plan.start();
    let mut gateway = case.cell("gripper.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let mut device = gateway.line("gripper");
    // Each byte of the position that one bit changed, before a good reply has come.
    for bit in 0..8 {
        device.until(&REQUEST);
        device.forget();
        let mut wrong = REPLY;
        wrong[POSITION] ^= 1 << bit;
        device.send(&wrong);
    }
    let status = gateway.until_bytes_in("gripper", 8 * REPLY.len() as u64);
    assert_eq!(status.frames_in, 0, "{status:?}");
    assert_eq!(robot.variable("WordInputReg[4]"), 0.0, "a damaged position reached the robot");
    // One that comes late is not taken, and values end with their time: the device answers until all are there.
    let values = [
        ("WordInputReg[1]", 3.0),
        ("WordInputReg[2]", 3.0),
        ("WordInputReg[3]", 0.0),
        ("WordInputReg[4]", 208.0),
        ("WordInputReg[5]", 300.0),
    ];
    let mut good = 0;
    until("a good reply in time", || {
        device.forget();
        device.until(&REQUEST);
        device.send(&REPLY);
        good += 1;
        values.iter().all(|(name, value)| robot.variable(name) == *value).then_some(())
    });
    let taken = gateway.until_bytes_in("gripper", (8 + good) * REPLY.len() as u64).frames_in;
    assert!((1..=good).contains(&taken), "{taken} of {good}");
    // Another one keeps what was there.
    device.forget();
    device.until(&REQUEST);
    let mut wrong = REPLY;
    wrong[POSITION] = 66;
    device.send(&wrong);
    let status = gateway.until_bytes_in("gripper", (9 + good) * REPLY.len() as u64);
    assert_eq!(status.frames_in, taken, "{status:?}");
    assert_eq!(robot.variable("WordInputReg[4]"), 208.0);
    device.forget();
    device.until(&REQUEST);
}
