//! A primary host: without it nothing is told.

use recipe_sparkplug::node::{SessionFailure, Settings};
use recipe_sparkplug::topic::Id;
use recipe_sparkplug::value::Value;

use crate::kit::{Did, Plant, Rig, settings, topics};

const STATE: &str = "spBv1.0/STATE/scada";

fn hosted() -> Settings {
    let mut settings = settings();
    settings.primary_host = Some(Id::new("scada").unwrap());
    settings
}

fn waiting() -> Rig {
    let mut rig = Rig::new(hosted(), Plant::default());
    rig.connect();
    assert!(rig.subscribed().is_empty());
    rig
}

fn state(rig: &mut Rig, topic: &str, is_online: bool, timestamp: u64) {
    let payload = format!("{{\"online\":{is_online},\"timestamp\":{timestamp}}}");
    rig.publication(topic, None, payload.as_bytes());
}

#[test]
fn its_state_is_subscribed() {
    let mut rig = Rig::new(hosted(), Plant::default());
    rig.connect();
    let expected = vec![("spBv1.0/hall/NCMD/press".into(), 1), (STATE.into(), 1)];
    assert_eq!(rig.drain(), [Did::Subscribe(expected)]);
}

#[test]
fn births_wait_until_it_is_online() {
    let mut rig = waiting();
    state(&mut rig, STATE, false, 5);
    state(&mut rig, "spBv1.0/STATE/other", true, 9);
    rig.publication(STATE, None, b"ONLINE");
    rig.command("spBv1.0/hall/NCMD/press", &[("Node Control/Rebirth", true)]);
    assert_eq!(rig.drain(), []);
    state(&mut rig, STATE, true, 6);
    assert_eq!(topics(&rig.messages())[0], "spBv1.0/hall/NBIRTH/press");
}

#[test]
fn an_older_statement_is_ignored() {
    let mut rig = waiting();
    state(&mut rig, STATE, false, 50);
    state(&mut rig, STATE, true, 49);
    assert_eq!(rig.drain(), []);
    state(&mut rig, STATE, true, 50);
    assert_eq!(rig.messages().len(), 3);
    state(&mut rig, STATE, false, 49);
    assert_eq!(rig.drain(), []);
}

#[test]
fn a_statement_may_come_before_the_subscription_is_accepted() {
    let mut rig = Rig::new(hosted(), Plant::default());
    rig.connect();
    rig.drain();
    state(&mut rig, STATE, true, 5);
    assert_eq!(rig.drain(), []);
    rig.receive(&[0x90, 4, 0, 1, 1, 1]);
    assert_eq!(rig.messages().len(), 3);
}

#[test]
fn when_it_goes_the_node_dies_and_keeps_what_changes() {
    let mut rig = waiting();
    state(&mut rig, STATE, true, 5);
    rig.messages();
    state(&mut rig, STATE, false, 5);
    let did = rig.drain();
    let [Did::Publish(death), Did::Disconnect, Did::Close] = &did[..] else { panic!("{did:?}") };
    assert_eq!((&*death.topic, death.values()), ("spBv1.0/hall/NDEATH/press", vec!["bdSeq=0".to_owned()]));
    assert_eq!(rig.node.failure(), Some(SessionFailure::HostOffline));
    rig.connect();
    assert!(rig.subscribed().is_empty());
    rig.wait_ms(10);
    rig.set(0, Value::Float(99.0));
    state(&mut rig, STATE, false, 6);
    assert_eq!(rig.drain(), []);
    state(&mut rig, STATE, true, 7);
    let messages = rig.messages();
    assert_eq!(messages[0].metric("bdSeq").value.as_deref(), Some("1"));
    assert_eq!(messages[3].values(), ["#1=99 then"]);
}
