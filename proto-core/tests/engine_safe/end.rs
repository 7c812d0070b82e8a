//! The end of an engine that is replaced: safe values at once, and until they are known to be there.

use proto_core::engine::{Input, LinkId};

use super::ON;
use super::rig::*;

const OFF: &[u8] = &[255, 255, 0, 238, 238];

#[test]
fn at_the_end_safe_values_do_not_wait_for_the_timeout() {
    let (cell, port) = Cell::guarded();
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, ON);
    rig.run(MS(5));
    assert_eq!(rig.take_written(), [coils(192, 1)]);
    assert!(rig.engine.is_safe(), "its owner is not silent");
    // The next value waits for the answer to the one before.
    rig.modbus_answers = false;
    rig.bytes(port, OFF);
    rig.bytes(port, ON);
    rig.engine.make_safe();
    rig.input(Input::Tick);
    assert!(!rig.engine.is_safe());
    rig.modbus_answers = true;
    rig.run(MS(600));
    assert_eq!(rig.take_written().last(), Some(&coils(192, 4)));
    assert!(rig.engine.is_safe());
    rig.sent_on(LinkId::MODBUS);
    rig.run(MS(1_000));
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 0, "it is there");
}

#[test]
fn a_device_that_never_spoke_changes_nothing_at_the_end() {
    let (cell, port) = Cell::guarded();
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.engine.make_safe();
    rig.run(MS(1_000));
    assert_eq!(rig.take_written(), []);
    assert_eq!(rig.counters(port).timeouts, 0);
    // Nor does one whose safe value is there already.
    rig.bytes(port, ON);
    rig.run(MS(500));
    assert_eq!(rig.take_written(), [coils(192, 1), coils(192, 4)]);
    rig.engine.make_safe();
    rig.run(MS(1_000));
    assert_eq!(rig.take_written(), []);
}
