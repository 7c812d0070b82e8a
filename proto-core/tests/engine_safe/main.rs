//! A safe value is repeated until it is known to be there (docs/engine.md section 6).

mod end;
mod modbus;
mod output;
#[path = "../rig/mod.rs"]
mod rig;
mod stream;
mod unseen;

use proto_core::config::*;
use proto_core::engine::{LinkId, PortId};
use proto_core::recipe::model::Mode;
use proto_core::time::Instant;
use proto_core::wire::scalar::ScalarType;
use rig::*;

const UDP: LinkId = LinkId::RECIPE_UDP;
const ON: &[u8] = &[255, 255, 1, 238, 238];
const SAFE: &[u8] = &[255, 255, 4, 238, 238];

/// The timeout of all owners, in milliseconds.
const SILENT: u64 = 100;

fn float(value: f32) -> Vec<u8> {
    [&[255, 255][..], &value.to_le_bytes(), &[238, 238]].concat()
}

fn floats(a: f32, b: f32) -> Vec<u8> {
    [&[255, 255][..], &a.to_le_bytes(), &b.to_le_bytes(), &[238, 238]].concat()
}

/// A state packet with FloatInputReg[1] and [2].
fn packet(a: f32, b: f32) -> Vec<u8> {
    let mut packet = vec![0; 1468];
    packet[832..836].copy_from_slice(&a.to_le_bytes());
    packet[836..840].copy_from_slice(&b.to_le_bytes());
    packet
}

/// Milliseconds after `since` at which the frame went out.
#[track_caller]
fn times(rig: &mut Rig, link: LinkId, since: Instant, frame: &[u8]) -> Vec<u64> {
    let sent = rig.sent_after(link, since);
    sent.into_iter()
        .filter(|(_, bytes)| *bytes != [0])
        .map(|(at, bytes)| {
            assert_eq!(bytes, frame, "{at} ms after it fell silent");
            at
        })
        .collect()
}

/// Milliseconds `from` to `to`, in steps of `step`.
fn every(step: usize, from: u64, to: u64) -> Vec<u64> {
    (from..=to).step_by(step).collect()
}

/// The owner sends one frame and falls silent; returns when its safe value falls due.
fn falls_silent(rig: &mut Rig, port: PortId, frame: &[u8]) -> Instant {
    rig.run(MS(10));
    rig.bytes(port, frame);
    rig.log.clear();
    rig.take_written();
    let due = rig.now + MS(SILENT);
    rig.run(MS(SILENT - 1));
    due
}

/// DigitalOutputCommand[1] by Modbus, with all other links beside it.
fn modbus_and_others() -> (Rig, PortId) {
    let (mut cell, port) = Cell::guarded();
    let table = cell.commands(&[(1, "stop")]);
    let to = InputBinding::Commands { table, when: CommandWhen::Change };
    let fields = cell.fields([user_in(ScalarType::Byte, to)]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    cell.rs485(recipe);
    let shows = cell.stream(&[], &["RobotState[8]"]);
    cell.rs485(shows);
    let up = cell.stream(&["FloatInputReg[1]"], &["RobotState[26]"]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["FloatInputReg[1]"], &[]);
    cell.rs485(recipe);
    (cell.rig(), port)
}

/// The controller goes on sending state packets.
fn live(rig: &mut Rig, millis: u64) {
    for _ in 0..millis / 100 {
        rig.link_bytes(LinkId::STATE, &packet(0.0, 0.0));
        rig.run(MS(100));
    }
}
