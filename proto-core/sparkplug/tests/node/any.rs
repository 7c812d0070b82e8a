//! Any order of inputs: whatever happens, what is sent are whole packets, sequence numbers follow each other and
//! nothing is told of who was not born.

use proptest::prelude::*;
use recipe_sparkplug::node::Input;
use recipe_sparkplug::value::Value;

use crate::kit::{Did, Plant, Rig, settings};

#[derive(Debug, Clone)]
enum Step {
    Wait(u64),
    Set(usize, u8),
    Unknown(usize),
    Alive(u32),
    Opened,
    Closed,
    Accept,
    Subscribed,
    Pong,
    Rebirth,
    Garbage(Vec<u8>),
    Drain,
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        3 => (1_u64..5_000).prop_map(Step::Wait),
        6 => (0_usize..6, any::<u8>()).prop_map(|(place, value)| Step::Set(place, value)),
        1 => (0_usize..6).prop_map(Step::Unknown),
        2 => (0_u32..4).prop_map(Step::Alive),
        4 => Just(Step::Opened),
        1 => Just(Step::Closed),
        4 => Just(Step::Accept),
        4 => Just(Step::Subscribed),
        2 => Just(Step::Pong),
        2 => Just(Step::Rebirth),
        1 => prop::collection::vec(any::<u8>(), 0..40).prop_map(Step::Garbage),
        8 => Just(Step::Drain),
    ];
    prop::collection::vec(step, 1..300)
}

/// What a reader knows of the present session.
#[derive(Default)]
struct Known {
    seq: Option<u64>,
    born: Vec<String>,
}

impl Known {
    fn look(&mut self, did: &Did) {
        let message = match did {
            Did::Connect(_) => return *self = Self::default(),
            Did::Publish(message) => message,
            _ => return,
        };
        let parts: Vec<_> = message.topic.split('/').collect();
        assert_eq!((parts[0], parts[1], parts[3]), ("spBv1.0", "hall", "press"));
        let device = parts.get(4).map_or(String::new(), |device| (*device).to_owned());
        let seq = message.payload.seq;
        match parts[2] {
            "NBIRTH" => {
                assert_eq!(seq, Some(0));
                self.born = vec![String::new()];
            }
            "NDEATH" => return,
            verb => {
                assert!(self.born.contains(&String::new()), "{verb} without a birth");
                assert_eq!(seq, self.seq.map(|last| (last + 1) % 256));
                match verb {
                    "DBIRTH" => {
                        assert!(!self.born.contains(&device), "born twice");
                        self.born.push(device);
                    }
                    "DDEATH" => {
                        assert!(self.born.contains(&device), "dead without a birth");
                        self.born.retain(|other| *other != device);
                    }
                    "NDATA" | "DDATA" => {
                        assert!(self.born.contains(&device), "data without a birth");
                        assert!(!message.payload.metrics.is_empty());
                    }
                    other => panic!("{other}"),
                }
            }
        }
        self.seq = seq;
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_order_of_inputs_is_told_rightly(steps in steps(), buffer in 768_usize..1_200) {
        let mut rig = Rig::new(settings(), Plant { more: 20, ..Plant::default() });
        rig.buffer = buffer;
        let mut known = Known::default();
        for step in steps {
            match step {
                Step::Wait(ms) => rig.wait_ms(ms),
                Step::Set(place, value) => {
                    let value = match rig.values[place.min(1)] {
                        _ if place == 1 => Value::UInt32(value.into()),
                        _ if place == 0 => Value::Float(value.into()),
                        _ => Value::Double(value.into()),
                    };
                    rig.set(place, value);
                }
                Step::Unknown(place) => rig.set(place, None),
                Step::Alive(alive) => {
                    rig.alive = alive;
                    rig.sample();
                }
                Step::Opened => rig.handle(Input::Opened),
                Step::Closed => {
                    rig.drain();
                    rig.handle(Input::Closed);
                }
                Step::Accept => rig.receive(&[0x20, 2, 0, 0]),
                Step::Subscribed => rig.receive(&[0x90, 3, 0, 1, 1]),
                Step::Pong => rig.receive(&[0xD0, 0]),
                Step::Rebirth => rig.command("spBv1.0/hall/NCMD/press", &[("Node Control/Rebirth", true)]),
                Step::Garbage(bytes) => rig.receive(&bytes),
                Step::Drain => {}
            }
            for did in rig.drain() {
                known.look(&did);
            }
        }
    }
}
