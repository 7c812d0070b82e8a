//! A port or link that had nothing to send is looked at again when it is due, whichever input comes first.

mod rig;

use proto_core::config::{Bus, CommandWhen, InputBinding, OutputBinding, Parts, SendOn};
use proto_core::engine::{LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::recipe::model::Mode;
use proto_core::time::Duration;
use proto_core::wire::scalar::ScalarType;
use rig::*;

#[test]
fn a_port_sends_when_its_line_becomes_free_without_another_input() {
    let mut cell = Cell::new();
    let request = cell.fields([user_in(ScalarType::Byte, InputBinding::Unused)]);
    let input = cell.part(&[255, 255], &[238, 238], request);
    let answer = cell.fields([user_out(ScalarType::Byte, OutputBinding::Counter)]);
    let output = cell.part(&[1], &[2], answer);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output });
    cell.last_recipe().send = SendOn::Frame;
    let port = cell.rs485(recipe);
    if let Bus::Rs485(line) = &mut cell.last_port().bus {
        line.turnaround = MS(2);
    }
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[255, 255, 7, 238, 238]);
    assert!(rig.sent_to(port).is_empty(), "the line is not free yet");
    assert!(rig.wake > rig.now);
    let mut buf = [0; OUTPUT_BUFFER];
    let output = rig.engine.poll_output(rig.wake, &mut buf);
    assert!(matches!(output, Output::PortSend { port: answers, .. } if answers == port), "{output:?}");
}

#[test]
fn a_stop_is_sent_beside_one_that_had_no_reply_for_a_second() {
    const STOP: u8 = 3;
    let mut cell = Cell::new();
    let table = cell.commands(&[(i64::from(STOP), "stop")]);
    let mut button_box = || -> PortId {
        let when = CommandWhen::Change;
        let fields = cell.fields([user_in(ScalarType::Byte, InputBinding::Commands { table, when })]);
        let input = cell.part(&[255, 255], &[238, 238], fields);
        let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
        let port = cell.rs485(recipe);
        cell.last_port().timeout = MS(60_000);
        port
    };
    let (buttons, other) = (button_box(), button_box());
    let mut rig = cell.rig();
    rig.run(MS(10));
    let press = |rig: &mut Rig, value| rig.bytes(buttons, &[255, 255, value, 238, 238]);
    press(&mut rig, 0);
    press(&mut rig, STOP);
    assert_eq!(rig.sent_on(LinkId::URGENT), [b"stop"]);
    press(&mut rig, 0);
    press(&mut rig, STOP);
    // Half a head: when it is discarded, the engine recomputes its deadlines.
    rig.bytes(other, &[255]);
    rig.run(MS(999));
    assert!(rig.sent_on(LinkId::COMMAND).is_empty(), "the first one may still be answered");
    rig.now += MS(1);
    rig.bytes(other, &[0]);
    rig.run(Duration::ZERO);
    assert_eq!(
        rig.sent_on(LinkId::COMMAND),
        [b"stop"],
        "at the next call, although that was for another port"
    );
}
