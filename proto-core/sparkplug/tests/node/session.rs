//! Connections, wills, deaths.

use proto_core::time::Instant;
use recipe_sparkplug::node::{EdgeNode, Input, NodeError, SessionFailure};
use recipe_sparkplug::topic::IdError;

use crate::kit::{Did, Plant, Rig, UTC, settings, text, topics};

#[test]
fn connect_has_a_clean_session_and_the_death_as_its_will() {
    let mut settings = settings();
    settings.login = Some((text("press"), text("secret")));
    let mut rig = Rig::new(settings, Plant::default());
    let connect = rig.connect();
    assert_eq!((connect.level, connect.is_clean, connect.keep_alive_s), (4, true, 20));
    assert_eq!(connect.client, "hall/press");
    assert_eq!(connect.login, Some(("press".into(), "secret".into())));
    let will = connect.will;
    assert_eq!((&*will.topic, will.qos, will.is_retained), ("spBv1.0/hall/NDEATH/press", 1, false));
    assert_eq!((will.payload.seq, will.payload.metrics.len()), (None, 1));
    let bd_seq = will.metric("bdSeq");
    // 4: Int64.
    assert_eq!((bd_seq.value.as_deref(), bd_seq.data_type), (Some("0"), Some(4)));
}

#[test]
fn commands_are_subscribed_at_qos_1_before_the_births() {
    let mut rig = Rig::new(settings(), Plant::default());
    rig.connect();
    // Nothing but that until the server has accepted it.
    assert_eq!(rig.drain(), [Did::Subscribe(vec![("spBv1.0/hall/NCMD/press".into(), 1)])]);
    rig.sample();
    assert_eq!(rig.drain(), []);
    rig.receive(&[0x90, 3, 0, 1, 1]);
    assert_eq!(topics(&rig.messages())[0], "spBv1.0/hall/NBIRTH/press");
}

#[test]
fn bd_seq_begins_at_0_goes_up_with_each_connect_and_wraps() {
    let mut rig = Rig::new(settings(), Plant::default());
    for expected in (0..=255).chain(0..3) {
        let connect = rig.connect();
        assert_eq!(connect.will.metric("bdSeq").value, Some(expected.to_string()));
        assert_eq!(rig.subscribed()[0].metric("bdSeq").value, Some(expected.to_string()));
        rig.handle(Input::Closed);
        rig.drain();
    }
    // A connection that was never there is no session.
    rig.now = rig.until;
    assert_eq!(rig.drain(), [Did::Open]);
    rig.handle(Input::Closed);
    rig.drain();
    assert_eq!(rig.connect().will.metric("bdSeq").value.as_deref(), Some("3"));
}

#[test]
fn bd_seq_goes_on_after_a_restart() {
    let plant = Plant::default();
    let mut rig = Rig::new(settings(), plant.clone());
    rig.node = EdgeNode::new(settings(), &plant, Some(255), 1).unwrap();
    assert_eq!(rig.connect().will.metric("bdSeq").value.as_deref(), Some("0"));
    rig.node = EdgeNode::new(settings(), &plant, Some(41), 1).unwrap();
    assert_eq!(rig.connect().will.metric("bdSeq").value.as_deref(), Some("42"));
}

#[test]
fn it_dies_before_it_disconnects() {
    let mut rig = Rig::online();
    rig.wait_ms(500);
    rig.handle(Input::End);
    let did = rig.drain();
    let [Did::Publish(death), Did::Disconnect, Did::Close] = &did[..] else { panic!("{did:?}") };
    assert_eq!((&*death.topic, death.payload.seq), ("spBv1.0/hall/NDEATH/press", None));
    assert_eq!((death.values(), death.payload.timestamp), (vec!["bdSeq=0".to_owned()], Some(UTC + 500)));
    assert!(rig.node.has_ended());
    assert_eq!(rig.until, Instant::NEVER);
}

#[test]
fn it_ends_from_every_phase() {
    for phase in 0..4 {
        let mut rig = Rig::new(settings(), Plant::default());
        let did = match phase {
            0 => vec![],
            1 => {
                rig.drain();
                vec![Did::Close]
            }
            2 => {
                rig.drain();
                rig.handle(Input::Opened);
                rig.drain();
                vec![Did::Close]
            }
            _ => {
                rig.connect();
                rig.drain();
                rig.handle(Input::End);
                let did = rig.drain();
                assert!(matches!(did[..], [Did::Publish(_), Did::Disconnect, Did::Close]), "{did:?}");
                vec![]
            }
        };
        rig.handle(Input::End);
        assert_eq!(rig.drain(), did, "{phase}");
        assert!(rig.node.has_ended(), "{phase}");
    }
}

#[test]
fn a_server_that_falls_silent_is_left() {
    let mut rig = Rig::online();
    rig.wait_ms(10_000);
    assert_eq!(rig.drain(), [Did::Ping]);
    rig.receive(&[0xD0, 0]);
    rig.wait_ms(10_000);
    // Data does not take the place of a ping, which is answered.
    rig.set(0, recipe_sparkplug::value::Value::Float(90.0));
    assert!(matches!(rig.drain()[..], [Did::Ping, Did::Publish(_)]));
    rig.wait_ms(9_999);
    assert_eq!(rig.drain(), []);
    rig.wait_ms(1);
    assert_eq!(rig.drain(), [Did::Close]);
    assert_eq!(rig.node.failure(), Some(SessionFailure::Silent));
    rig.connect();
    rig.subscribed();
    assert_eq!(rig.node.failure(), None);
}

#[test]
fn each_answer_has_its_time() {
    let mut rig = Rig::new(settings(), Plant::default());
    assert_eq!(rig.drain(), [Did::Open]);
    rig.wait_ms(30_000);
    assert_eq!(rig.drain(), [Did::Close]);
    rig.now = rig.until;
    assert_eq!(rig.drain(), [Did::Open]);
    rig.handle(Input::Opened);
    rig.drain();
    rig.wait_ms(10_000);
    assert_eq!(rig.drain(), [Did::Close]);
    rig.connect();
    rig.drain();
    rig.wait_ms(9_999);
    assert_eq!(rig.drain(), []);
    rig.wait_ms(1);
    assert_eq!(rig.drain(), [Did::Ping, Did::Close]);
}

#[test]
fn what_the_server_refuses_is_told() {
    let mut rig = Rig::new(settings(), Plant::default());
    rig.drain();
    rig.handle(Input::Opened);
    rig.drain();
    rig.receive(&[0x20, 2, 0, 5]);
    assert_eq!(rig.drain(), [Did::Close]);
    assert_eq!(rig.node.failure(), Some(SessionFailure::Refused { code: 5 }));
    rig.connect();
    rig.drain();
    rig.receive(&[0x90, 3, 0, 1, 0x80]);
    assert_eq!(rig.drain(), [Did::Close]);
    assert_eq!(rig.node.failure(), Some(SessionFailure::SubscriptionRefused));
    rig.connect();
    rig.receive(b"HTTP/1.1 400 Bad Request\r\n\r\n");
    assert_eq!(rig.drain(), [Did::Close]);
    assert!(matches!(rig.node.failure(), Some(SessionFailure::Protocol(_))));
    rig.connect();
    rig.drain();
    rig.receive(&[0x20, 2, 0, 0]);
    assert_eq!(rig.drain(), [Did::Close], "accepted twice");
}

#[test]
fn pauses_grow_and_differ_between_nodes() {
    let pauses = |seed: u64| {
        let plant = Plant::default();
        let mut rig = Rig::new(settings(), plant.clone());
        rig.node = EdgeNode::new(settings(), &plant, None, seed).unwrap();
        let mut pauses = Vec::new();
        for _ in 0..9 {
            rig.now = rig.now.max(rig.until);
            assert_eq!(rig.drain(), [Did::Open]);
            rig.handle(Input::Closed);
            rig.drain();
            pauses.push(rig.until.saturating_since(rig.now).as_millis());
        }
        pauses
    };
    let all: Vec<_> = (1_u64..200).map(|seed| pauses(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15))).collect();
    for (nth, most) in
        [2_000_u64, 4_000, 8_000, 16_000, 32_000, 64_000, 64_000, 64_000, 64_000].into_iter().enumerate()
    {
        let mut these: Vec<_> = all.iter().map(|pauses| pauses[nth]).collect();
        these.sort_unstable();
        assert!(these[0] >= most / 4 && these[198] <= most, "{nth}: {these:?}");
        these.dedup();
        assert!(these.len() > 100, "{nth}: only {} different ones", these.len());
    }
}

#[test]
fn publications_at_qos_1_are_acknowledged() {
    let mut rig = Rig::online();
    rig.publication("spBv1.0/hall/NCMD/press", Some(9), &[]);
    rig.publication("something/else", Some(10), b"?");
    assert_eq!(rig.drain(), [Did::PubAck(9), Did::PubAck(10)]);
    assert_eq!(rig.node.counters().unreadable, 1);
}

#[test]
fn a_node_with_too_much_or_wrong_names_is_refused() {
    let refused = |devices: Vec<&'static str>, more| {
        let plant = Plant { devices, more };
        EdgeNode::<8, 1>::new(settings(), &plant, None, 1).map(|_| ()).unwrap_err()
    };
    assert_eq!(refused(vec!["a"], 5), NodeError::Metrics { count: 9, room: 8 });
    assert_eq!(refused(vec!["a", "b", "a"], 0), NodeError::SameDevice { nth: 2 });
    let error = IdError::Reserved { character: '/' };
    assert_eq!(refused(vec!["a", "b/c"], 0), NodeError::Device { nth: 1, error });
    assert_eq!(refused(vec!["a"; 33], 0), NodeError::Devices { count: 33 });
}

#[test]
fn passwords_are_never_printed() {
    let mut settings = settings();
    settings.login = Some((text("press"), text("secret")));
    let rig = Rig::new(settings, Plant::default());
    assert!(!format!("{:?}", rig.node).contains("secret"));
}
