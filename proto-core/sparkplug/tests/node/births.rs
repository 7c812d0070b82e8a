//! Births of the node and of its devices, and requests for new ones.

use recipe_sparkplug::node::{Input, MIN_BUFFER};
use recipe_sparkplug::value::Value;

use crate::kit::{Did, Message, Plant, Rig, UTC, seqs, settings, topics};

const COMMANDS: &str = "spBv1.0/hall/NCMD/press";
const REBIRTH: &str = "Node Control/Rebirth";

fn births() -> (Rig, Vec<Message>) {
    let mut rig = Rig::new(settings(), Plant::default());
    rig.values[1] = None;
    rig.sample();
    rig.connect();
    let births = rig.subscribed();
    (rig, births)
}

#[test]
fn births_come_first_in_their_order() {
    let (_, births) = births();
    let expected =
        ["spBv1.0/hall/NBIRTH/press", "spBv1.0/hall/DBIRTH/press/left", "spBv1.0/hall/DBIRTH/press/right"];
    assert_eq!(topics(&births), expected);
    assert_eq!(seqs(&births), [0, 1, 2]);
    assert!(births.iter().all(|birth| birth.qos == 0 && !birth.is_retained));
    assert!(births.iter().all(|birth| birth.payload.timestamp == Some(UTC)));
}

#[test]
fn births_have_every_metric_with_name_type_and_value() {
    let (_, births) = births();
    let expected = ["bdSeq=0", "Node Control/Rebirth=false", "Node Info/UTC=true", "oil=20", "count=null"];
    assert_eq!(births[0].values(), expected);
    assert_eq!(births[1].values(), ["force=1.5", "state=working"]);
    for told in births.iter().flat_map(|birth| &birth.payload.metrics) {
        assert!(told.name.is_some() && told.data_type.is_some() && told.timestamp.is_some(), "{told:?}");
        assert_eq!(told.is_null, told.value.is_none());
        assert!(!told.is_historical);
    }
    let types = births[0].payload.metrics.iter().map(|told| told.data_type.unwrap());
    // Int64, Boolean, Boolean, Float, UInt32.
    assert_eq!(types.collect::<Vec<_>>(), [4, 11, 11, 9, 7]);
}

#[test]
fn aliases_are_unique_in_the_node_and_not_for_what_is_written_by_name() {
    let (_, births) = births();
    let told = || births.iter().flat_map(|birth| &birth.payload.metrics);
    let mut aliases: Vec<_> = told().filter_map(|told| told.alias).collect();
    aliases.sort_unstable();
    assert_eq!(aliases, [1, 2, 3, 4, 5, 6]);
    assert_eq!(births[0].metric(REBIRTH).alias, None);
}

#[test]
fn births_tell_units_ranges_and_descriptions() {
    let (_, births) = births();
    let properties = &births[0].metric("oil").properties;
    let expected =
        [("documentation", "of the press"), ("engHigh", "150"), ("engLow", "-10"), ("engUnit", "°C")];
    assert!(properties.iter().map(|(key, value)| (&**key, &**value)).eq(expected));
}

#[test]
fn long_births_come_in_pieces_of_the_buffer() {
    for buffer in [MIN_BUFFER, 1_000, 4_096, 65_536] {
        let plant = Plant { more: 200, ..Plant::default() };
        let mut rig = Rig::new(settings(), plant);
        rig.buffer = buffer;
        rig.connect();
        let births = rig.subscribed();
        assert_eq!(births[0].payload.metrics.len(), 205);
        assert_eq!(births.len(), 3);
        let pieces = rig.pieces;
        assert!((pieces == 3) == (buffer == 65_536), "{pieces} pieces of {buffer}");
    }
}

#[test]
fn a_sample_in_the_middle_of_a_birth_changes_nothing_of_it() {
    use proto_core::time::Instant;
    use recipe_sparkplug::node::{Input, NodeOutput};
    let mut rig = Rig::new(settings(), Plant { more: 200, ..Plant::default() });
    rig.connect();
    rig.drain();
    rig.receive(&[0x90, 3, 0, 1, 1]);
    let mut bytes = Vec::new();
    let mut piece = [0; MIN_BUFFER];
    loop {
        match rig.node.poll_output(Instant::from_millis(1_000), &rig.plant, &mut piece) {
            NodeOutput::Send(sent) => bytes.extend_from_slice(sent),
            NodeOutput::Busy => {}
            _ => break,
        }
        // Unknown values are shorter, and so are dates before UTC was known.
        let utc_ms = 1 << (bytes.len() % 40);
        rig.node.handle(Instant::from_millis(1_000), Input::Time { utc_ms }, &rig.plant);
        rig.values.iter_mut().for_each(|value| *value = None);
        rig.sample();
    }
    let mut len = 0_usize;
    for (nth, byte) in bytes[1..4].iter().enumerate() {
        len |= usize::from(byte & 127) << (7 * nth);
        if byte & 128 == 0 {
            assert_eq!(bytes[1 + nth + 1 + len], 0x30, "the next packet begins where the birth ends");
            return;
        }
    }
    panic!("{:?}", &bytes[..8]);
}

#[test]
fn a_rebirth_is_all_births_with_the_same_bd_seq() {
    let mut rig = Rig::online();
    rig.wait_ms(2_000);
    rig.set(0, Value::Float(30.0));
    assert_eq!(seqs(&rig.messages()), [3]);
    // What was not told before the request is in the births, and no data comes before them.
    rig.set(0, Value::Float(40.0));
    rig.command(COMMANDS, &[(REBIRTH, true)]);
    let births = rig.messages();
    assert_eq!(births.len(), 3, "{births:?}");
    assert_eq!(seqs(&births), [0, 1, 2]);
    assert_eq!(
        births[0].values()[..4],
        ["bdSeq=0", "Node Control/Rebirth=false", "Node Info/UTC=true", "oil=40"]
    );
    assert_eq!((rig.node.counters().births, rig.node.counters().rebirths), (2, 1));
    assert_eq!(rig.drain(), []);
}

#[test]
fn many_requests_are_one_rebirth_a_second() {
    let mut rig = Rig::online();
    rig.wait_ms(1_500);
    let mut births = 0;
    for _ in 0..80 {
        rig.command(COMMANDS, &[(REBIRTH, true)]);
        births += rig.messages().len() / 3;
        rig.wait_ms(100);
    }
    assert_eq!(births, 8);
}

#[test]
fn data_waits_while_a_rebirth_waits() {
    let mut rig = Rig::online();
    rig.command(COMMANDS, &[(REBIRTH, true)]);
    rig.set(0, Value::Float(90.0));
    assert_eq!(rig.drain(), []);
    rig.now = rig.until;
    let births = rig.messages();
    assert_eq!((births.len(), births[0].metric("oil").value.as_deref()), (3, Some("90")));
}

#[test]
fn nothing_else_is_obeyed() {
    let mut rig = Rig::online();
    rig.wait_ms(2_000);
    rig.command(COMMANDS, &[(REBIRTH, false), ("oil", true), ("Node Control/Reboot", true)]);
    rig.command("spBv1.0/hall/DCMD/press/left", &[(REBIRTH, true)]);
    rig.command("spBv1.0/hall/NCMD/press2", &[(REBIRTH, true)]);
    rig.publication(COMMANDS, None, &[0x12, 0x20, 1]);
    rig.publication(COMMANDS, None, &[0xFF; 2_000]);
    assert_eq!(rig.drain(), []);
    let counters = rig.node.counters();
    assert_eq!((counters.refused, counters.unreadable, counters.rebirths), (2, 4, 0));
}

#[test]
fn devices_are_born_when_they_work_and_die_when_not() {
    let mut rig = Rig::new(settings(), Plant::default());
    rig.alive = 0b01;
    rig.sample();
    rig.connect();
    assert_eq!(topics(&rig.subscribed()).last(), Some(&"spBv1.0/hall/DBIRTH/press/left"));
    rig.wait_ms(10);
    rig.alive = 0b10;
    rig.sample();
    let changed = rig.messages();
    assert_eq!(topics(&changed), ["spBv1.0/hall/DDEATH/press/left", "spBv1.0/hall/DBIRTH/press/right"]);
    assert_eq!(seqs(&changed), [2, 3]);
    let death = &changed[0];
    assert_eq!((death.qos, death.is_retained, death.payload.timestamp), (0, false, Some(UTC + 10)));
    assert!(death.payload.metrics.is_empty());
    // A dead device says nothing.
    rig.set(2, Value::Float(9.0));
    assert_eq!(rig.drain(), []);
    rig.wait_ms(2_000);
    rig.alive = 0b11;
    rig.sample();
    let born = rig.messages();
    assert_eq!(topics(&born), ["spBv1.0/hall/DBIRTH/press/left"]);
    assert_eq!(born[0].values(), ["force=9", "state=working"]);
}

#[test]
fn a_device_that_flaps_is_born_once_a_second() {
    let mut rig = Rig::online();
    rig.wait_ms(5_000);
    let mut births = 0;
    for nth in 0..100 {
        rig.alive = if nth % 2 == 0 { 0b10 } else { 0b11 };
        rig.sample();
        births += rig.messages().iter().filter(|message| message.topic.contains("DBIRTH")).count();
        rig.wait_ms(40);
    }
    assert!((3..=5).contains(&births), "{births}");
    rig.alive = 0b11;
    rig.sample();
    rig.wait_ms(1_000);
    rig.drain();
    rig.set(2, Value::Float(8.0));
    assert_eq!(rig.messages().len(), 1, "it lives");
}

#[test]
fn what_was_told_without_utc_is_told_again() {
    let mut rig = Rig::new(settings(), Plant::default());
    rig.node = recipe_sparkplug::node::EdgeNode::new(settings(), &rig.plant, None, 1).unwrap();
    rig.sample();
    rig.connect();
    let births = rig.subscribed();
    assert_eq!(births[0].metric("Node Info/UTC").value.as_deref(), Some("false"));
    assert_eq!(births[0].payload.timestamp, Some(rig.now.as_micros() / 1_000));
    rig.wait_ms(3_000);
    rig.handle(Input::Time { utc_ms: UTC });
    let births = rig.messages();
    assert_eq!(births[0].metric("Node Info/UTC").value.as_deref(), Some("true"));
    assert_eq!((births[0].payload.timestamp, births.len()), (Some(UTC), 3));
    // A correction later is none.
    rig.wait_ms(3_000);
    rig.handle(Input::Time { utc_ms: UTC + 2_990 });
    assert_eq!(rig.drain(), Vec::<Did>::new());
}
