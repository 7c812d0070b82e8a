//! Data by exception, and what is kept while nobody listens.

use recipe_sparkplug::node::Input;
use recipe_sparkplug::value::Value;

use crate::kit::{Did, Plant, Rig, UTC, seqs, settings, topics};

#[test]
fn only_what_has_changed_is_told() {
    let mut rig = Rig::online();
    rig.sample();
    assert_eq!(rig.drain(), []);
    rig.wait_ms(100);
    rig.set(4, Value::Float(2.5));
    let data = rig.messages();
    assert_eq!(topics(&data), ["spBv1.0/hall/DDATA/press/right"]);
    assert_eq!(data[0].values(), ["#5=2.5"]);
    let told = &data[0].payload.metrics[0];
    assert_eq!((told.timestamp, told.data_type, &told.name), (Some(UTC + 100), None, &None));
    assert_eq!((data[0].qos, data[0].is_retained, data[0].payload.timestamp), (0, false, Some(UTC + 100)));
    assert_eq!(seqs(&data), [3]);
}

#[test]
fn changes_of_one_owner_are_one_message() {
    let mut rig = Rig::online();
    rig.values[0] = Some(Value::Float(30.0));
    rig.values[2] = Some(Value::Float(9.0));
    rig.values[3] = Some(Value::Word("silent"));
    rig.sample();
    let data = rig.messages();
    assert_eq!(topics(&data), ["spBv1.0/hall/NDATA/press", "spBv1.0/hall/DDATA/press/left"]);
    assert_eq!(
        (data[0].values(), data[1].values()),
        (vec!["#1=30".to_owned()], vec!["#3=9".into(), "#4=silent".into()])
    );
    assert_eq!(seqs(&data), [3, 4]);
}

#[test]
fn sequence_numbers_wrap_behind_255() {
    let mut rig = Rig::online();
    let mut expected = 3;
    for nth in 0_u16..600 {
        rig.set(2, Value::Float(f32::from(nth) + 10.0));
        assert_eq!(seqs(&rig.messages()), [expected]);
        expected = (expected + 1) % 256;
    }
}

#[test]
fn a_dead_band_counts_from_what_was_told() {
    let mut rig = Rig::online();
    let mut told = Vec::new();
    for tenths in 200_u16..=215 {
        rig.set(0, Value::Float(f32::from(tenths) / 10.0));
        told.extend(rig.messages().iter().flat_map(|message| message.values()));
    }
    assert_eq!(told, ["#1=20.6", "#1=21.2"]);
}

#[test]
fn a_rate_is_kept_and_the_last_value_is_told() {
    let mut rig = Rig::online();
    rig.wait_ms(1_000);
    let mut told = Vec::new();
    for count in 1..=35 {
        rig.set(1, Value::UInt32(count));
        told.extend(rig.messages().iter().flat_map(|message| message.values()));
        rig.wait_ms(100);
    }
    assert_eq!(told, ["#2=2", "#2=12", "#2=22", "#2=32"]);
    rig.wait_ms(1_000);
    rig.sample();
    assert_eq!(rig.messages()[0].values(), ["#2=35"]);
}

#[test]
fn unknown_values_are_null_and_never_invented() {
    let mut rig = Rig::online();
    rig.set(0, None);
    let told = &rig.messages()[0].payload.metrics[0];
    assert!(told.is_null && told.value.is_none());
    rig.set(0, Value::Float(f32::NAN));
    assert_eq!(rig.drain(), []);
    rig.set(0, Value::Float(20.0));
    assert_eq!(rig.messages()[0].values(), ["#1=20"]);
    // A value of another type is none.
    rig.set(0, Value::Boolean(true));
    assert_eq!(rig.messages()[0].values(), ["#1=null"]);
    // Of a sample that is too short the rest is unknown.
    rig.handle(Input::Sample { values: &[], alive: 0b11 });
    let values: Vec<_> = rig.messages().iter().flat_map(|message| message.values()).collect();
    assert_eq!(values, ["#3=null", "#4=null", "#5=null", "#6=null"]);
}

#[test]
fn a_sample_in_parts_is_told_when_it_is_whole() {
    let mut rig = Rig::online();
    rig.wait_ms(10);
    rig.values[0] = Some(Value::Float(1.0));
    rig.values[1] = Some(Value::Float(f32::NAN));
    let values = rig.values.clone();
    for (part, values) in values.chunks(2).enumerate() {
        rig.handle(Input::Values { first: 2 * part, values });
        assert_eq!(rig.drain(), []);
    }
    rig.handle(Input::Sampled { alive: rig.alive });
    let in_parts = rig.messages();
    let mut other = Rig::online();
    other.wait_ms(10);
    other.values = values;
    other.sample();
    assert_eq!(in_parts.iter().flat_map(|message| message.values()).collect::<Vec<_>>(), ["#1=1"]);
    assert_eq!(in_parts, other.messages());
}

#[test]
fn more_than_a_buffer_is_more_messages() {
    let mut rig = Rig::new(settings(), Plant { more: 150, ..Plant::default() });
    rig.buffer = 800;
    rig.connect();
    rig.subscribed();
    rig.wait_ms(10);
    rig.values.iter_mut().skip(2).take(150).for_each(|value| *value = Some(Value::Double(0.5)));
    rig.sample();
    let data = rig.messages();
    assert!(data.len() > 3);
    let told: Vec<_> = data.iter().flat_map(|message| &message.payload.metrics).collect();
    assert!(told.iter().map(|told| told.alias.unwrap()).eq(3..153));
    assert!(told.iter().all(|told| told.value.as_deref() == Some("0.5")));
}

#[test]
fn what_changes_while_nobody_listens_is_told_later() {
    let mut rig = Rig::online();
    rig.wait_ms(100);
    rig.handle(Input::Closed);
    for nth in 1_u8..=3 {
        rig.wait_ms(100);
        rig.set(2, Value::Float(f32::from(nth) * 10.0));
    }
    rig.drain();
    rig.connect();
    let mut messages = rig.subscribed();
    assert_eq!(messages[1].values(), ["force=30", "state=working"]);
    let past = messages.split_off(3);
    assert_eq!(topics(&past), ["spBv1.0/hall/DDATA/press/left"]);
    assert_eq!(past[0].values(), ["#3=10 then", "#3=20 then", "#3=30 then"]);
    let times = past[0].payload.metrics.iter().map(|told| told.timestamp.unwrap() - UTC);
    assert_eq!(times.collect::<Vec<_>>(), [200, 300, 400]);
    assert_eq!(seqs(&past), [3]);
    let counters = rig.node.counters();
    assert_eq!((counters.historical, counters.kept, counters.lost), (3, 0, 0));
}

#[test]
fn what_is_kept_is_bounded_and_the_oldest_goes() {
    let mut rig = Rig::online();
    rig.handle(Input::Closed);
    for nth in 1_u8..=20 {
        rig.wait_ms(10);
        rig.set(2, Value::Float(f32::from(nth) * 10.0));
    }
    assert_eq!((rig.node.counters().kept, rig.node.counters().lost), (16, 4));
    rig.drain();
    rig.connect();
    let past = rig.subscribed().split_off(3);
    assert_eq!(past[0].values().first().map(String::as_str), Some("#3=50 then"));
}

#[test]
fn the_past_of_a_dead_device_waits_for_its_birth() {
    let mut rig = Rig::online();
    rig.handle(Input::Closed);
    rig.wait_ms(10);
    rig.set(2, Value::Float(7.0));
    rig.set(0, Value::Float(70.0));
    rig.alive = 0b10;
    rig.sample();
    rig.drain();
    rig.connect();
    let messages = rig.subscribed();
    let expected =
        ["spBv1.0/hall/NBIRTH/press", "spBv1.0/hall/DBIRTH/press/right", "spBv1.0/hall/NDATA/press"];
    assert_eq!(topics(&messages), expected);
    assert_eq!(messages[2].values(), ["#1=70 then"]);
    rig.wait_ms(2_000);
    rig.alive = 0b11;
    rig.sample();
    let messages = rig.messages();
    assert_eq!(topics(&messages), ["spBv1.0/hall/DBIRTH/press/left", "spBv1.0/hall/DDATA/press/left"]);
    assert_eq!(messages[1].values(), ["#3=7 then"]);
}

#[test]
fn what_was_not_sent_before_the_connection_broke_is_kept() {
    let mut rig = Rig::online();
    rig.set(2, Value::Float(7.0));
    rig.handle(Input::Closed);
    rig.sample();
    assert_eq!(rig.drain(), Vec::<Did>::new());
    assert_eq!(rig.node.counters().kept, 1);
}

#[test]
fn what_a_dead_device_has_is_not_kept() {
    let mut rig = Rig::online();
    rig.handle(Input::Closed);
    rig.alive = 0b10;
    rig.sample();
    rig.set(2, Value::Float(7.0));
    assert_eq!(rig.node.counters().kept, 0);
    rig.set(4, Value::Float(7.0));
    assert_eq!(rig.node.counters().kept, 1);
}
