//! Several answers of a device's own: pending, done, refused with a code; on lines and on CAN.

use proto_core::engine::Input;
use proto_core::recipe::model::Mode;

use super::*;

/// What the device says: `S` and a status.
const DONE: u8 = 0;
const PENDING: u8 = 1;

fn frame(cell: &mut Cell, id: Option<u16>, head: &[u8], fields: Vec<FieldSpec>) -> Option<u8> {
    frame_of(cell, id, head, &[], fields)
}

/// `G` starts it, `Q` asks for a value, `H` stops it. Each answer to `G` is `S` and a status, which is the code of a
/// refusal; a pending one has the progress behind it.
struct Device {
    line: Line,
    /// What comes after a `G`: how much later, and which status.
    says: Vec<(u64, u8)>,
    starts: usize,
    stops: Vec<Instant>,
    polls: usize,
}

const CODE: &str = "WordInputReg[4]";
const PROGRESS: &str = "WordInputReg[5]";

impl Device {
    fn new(change: impl FnOnce(&mut Exchange)) -> Self {
        let mut cell = Cell::new();
        let go = frame(&mut cell, None, b"G", vec![fixed(7)]);
        let pad = || FieldSpec::Padding { len: 1, fill: 0 };
        let done = frame(&mut cell, None, b"S", vec![fixed(DONE.into()), pad()]);
        let pending = frame(&mut cell, None, b"S", vec![fixed(PENDING.into()), byte_to(PROGRESS)]);
        let refusal = frame(&mut cell, None, b"S", vec![byte_to(CODE), pad()]);
        let ask = frame(&mut cell, None, b"Q", vec![fixed(7)]);
        let value = frame(&mut cell, None, b"V", vec![byte_to("WordInputReg[1]")]);
        let halt = frame(&mut cell, None, b"H", vec![fixed(7)]);
        let halted = frame(&mut cell, None, b"T", vec![fixed(0)]);
        let talk = |request, reply| Transaction::Frames { request, reply, refusal: None };
        let mut start =
            Exchange::new(1, Transaction::Frames { request: go, reply: done, refusal }, rising(0));
        start.pending = pending;
        start.late = Some(Duration::ZERO);
        start.outcome = OutcomeTo { to: Some(var("WordInputReg[2]")), ..OutcomeTo::NONE };
        change(&mut start);
        let poll = never_late(Exchange::new(2, talk(ask, value), Triggers::every(MS(50))));
        let mut stop = never_late(Exchange::new(1, talk(halt, halted), rising(1)));
        stop.stop = true;
        let port = talking(&mut cell, &[start, poll, stop]);
        cell.last_port().timeout = MS(1_000);
        let mut device =
            Self { line: Line::new(&cell, port), says: vec![], starts: 0, stops: vec![], polls: 0 };
        device.run(500);
        device
    }

    fn run(&mut self, millis: u64) {
        for _ in 0..millis {
            let mut said = Vec::new();
            let says = &self.says;
            let asked = self.line.run(MS(1), |request| match request[0] {
                b'G' => {
                    said.clone_from(says);
                    None
                }
                b'Q' => Some((MS(2), b"V\x09".to_vec())),
                _ => Some((MS(2), b"T\x00".to_vec())),
            });
            for (nth, (delay, status)) in said.into_iter().enumerate() {
                self.line.comes(MS(delay), &status_of(status, nth as u8));
            }
            for (at, request) in asked {
                match request[0] {
                    b'G' => self.starts += 1,
                    b'H' => self.stops.push(at),
                    _ => self.polls += 1,
                }
            }
        }
    }

    /// The bit rises, and the device says this.
    fn start(&mut self, says: &[(u64, u8)]) {
        self.says = says.to_vec();
        self.line.bit(0, false);
        self.run(50);
        self.line.bit(0, true);
        // Up to the request.
        let before = self.starts;
        for _ in 0..60 {
            if self.starts == before {
                self.run(1);
            }
        }
        assert_eq!(self.starts, before + 1);
    }

    fn outcome(&self) -> u16 {
        self.line.shown("WordInputReg[2]")
    }
}

fn status_of(status: u8, progress: u8) -> Vec<u8> {
    vec![b'S', status, progress]
}

#[test]
fn a_pending_answer_is_waited_for_and_confirms_nothing() {
    let mut device = Device::new(|_| ());
    device.start(&[(80, PENDING), (160, PENDING), (240, PENDING), (320, DONE)]);
    let polls = device.polls;
    for millis in [90, 80, 80] {
        device.run(millis);
        assert_eq!((device.outcome(), device.polls), (1, polls), "the line waits");
    }
    assert_eq!(device.line.shown(PROGRESS), 2);
    device.run(120);
    assert_eq!((device.outcome(), device.starts), (2, 1));
    assert!(device.polls > polls);
    let counters = device.line.peer(1).counters;
    assert_eq!((counters.replies, counters.timeouts, counters.refused), (1, 0, 0));
}

#[test]
fn a_refusal_tells_its_code() {
    let mut device = Device::new(|_| ());
    device.start(&[(30, PENDING), (60, 7)]);
    device.run(100);
    assert_eq!((device.outcome(), device.line.shown(CODE)), (3, 7));
    device.start(&[(30, 9)]);
    device.run(100);
    assert_eq!((device.outcome(), device.line.shown(CODE)), (3, 9));
    device.start(&[(30, DONE)]);
    device.run(2_000);
    assert_eq!((device.outcome(), device.line.shown(CODE)), (2, 9), "that of the newest refusal");
    let counters = device.line.peer(1).counters;
    assert_eq!((counters.refused, counters.replies, counters.events.refused), (2, 1, 2));
}

#[test]
fn a_device_that_says_nothing_behind_a_pending_answer_may_have_done_it() {
    // Repetitions are for requests that may not have arrived.
    let mut device = Device::new(|start| (start.retries, start.event_retries) = (3, 3));
    device.start(&[(50, PENDING)]);
    device.run(145);
    assert_eq!(device.outcome(), 1);
    device.run(10);
    assert_eq!(device.outcome(), 5);
    device.run(3_000);
    assert_eq!(device.starts, 1);
    let peer = device.line.peer(1);
    assert_eq!((peer.counters.timeouts, peer.counters.replies, peer.presence.name()), (1, 0, "up"));
}

/// The only exchange of a device: asked each 50 ms, with an answer that is pending.
fn alone() -> Line {
    let mut cell = Cell::new();
    let request = frame(&mut cell, None, b"G", vec![fixed(7)]);
    let reply = frame(&mut cell, None, b"S", vec![fixed(0)]);
    let pending = frame(&mut cell, None, b"S", vec![fixed(1)]);
    let talk = Transaction::Frames { request, reply, refusal: None };
    let exchange = Exchange { pending, ..Exchange::new(1, talk, Triggers::every(MS(50))) };
    let port = talking(&mut cell, &[never_late(exchange)]);
    Line::new(&cell, port)
}

#[test]
fn a_pending_answer_shows_that_the_device_is_there() {
    let mut line = alone();
    line.run(MS(3_000), |_| None);
    assert_eq!(line.peer(1).presence.name(), "down");
    let mut asked = 0;
    while asked == 0 {
        asked = line.run(MS(1), |_| Some((MS(1), b"S\x01".to_vec()))).len();
    }
    line.run(MS(5), |_| None);
    assert_eq!(line.peer(1).presence.name(), "up", "while its answer is awaited");
    // Nor is the silence behind it an absence.
    for _ in 0..20_000 {
        line.run(MS(1), |_| Some((MS(1), b"S\x01".to_vec())));
        assert_eq!(line.peer(1).presence.name(), "up");
    }
    assert!(line.peer(1).counters.timeouts > 3);
}

#[test]
fn a_device_that_is_pending_for_ever_does_not_hold_the_line() {
    let mut device = Device::new(|_| ());
    let says: Vec<_> = (1..100).map(|nth| (nth * 40, PENDING)).collect();
    device.start(&says);
    let polls = device.polls;
    device.run(1_590);
    assert_eq!((device.outcome(), device.polls), (1, polls));
    device.run(30);
    assert_eq!(device.outcome(), 5, "16 timeouts");
    device.run(500);
    assert!(device.polls >= polls + 9, "{} polls", device.polls - polls);
    assert_eq!(device.line.peer(1).presence.name(), "up");
}

#[test]
fn a_state_that_stays_pending_is_written_again_later() {
    let mut device = Device::new(|start| {
        start.when = Triggers { change: true, ..Triggers::NEVER };
        start.outcome = OutcomeTo::NONE;
        start.retries = 3;
    });
    device.says = vec![(20, PENDING)];
    device.starts = 0;
    device.run(5_000);
    // Behind 2, 4, 8, 16 timeouts and more.
    assert!((2..=6).contains(&device.starts), "{} times", device.starts);
    assert_eq!(device.line.peer(1).counters.retries, 0, "never at once");
    device.says = vec![(20, DONE)];
    device.run(5_000);
    let before = device.starts;
    device.run(10_000);
    assert_eq!(device.starts, before, "it is done");
}

/// Nothing more comes from the device: the stop goes at once.
#[test]
fn a_stop_ends_the_wait_behind_a_pending_answer_at_once() {
    let mut device = Device::new(|start| start.timeout = MS(2_000));
    device.start(&[(20, PENDING)]);
    device.run(100);
    device.line.bit(1, true);
    let wanted = device.line.rig.now;
    device.run(50);
    let waited = device.stops.first().map(|at| at.saturating_since(wanted)).unwrap();
    assert!(waited <= MS(10), "{waited}");
    assert_eq!(device.outcome(), 5);
}

#[test]
fn a_stop_does_not_wait_for_what_is_pending() {
    for millis in [20, 150] {
        let mut device = Device::new(|_| ());
        let says: Vec<_> = (1..40).map(|nth| (nth * 40, PENDING)).collect();
        device.start(&says);
        device.run(millis);
        device.line.bit(1, true);
        let wanted = device.line.rig.now;
        device.run(120);
        let waited = device.stops.first().map(|at| at.saturating_since(wanted)).unwrap();
        // Before a pending answer it is an ordinary request, which has its timeout; the next one ends it.
        assert!(waited <= MS(45), "{waited} behind {millis} ms");
        assert_eq!(device.outcome(), 5);
    }
}

/// What is pending yields to a stop that is repeated, too.
#[test]
fn a_stop_that_is_not_confirmed_yet_has_its_turns() {
    let mut cell = Cell::new();
    let talk = |request, reply| Transaction::Frames { request, reply, refusal: None };
    let (go, done) =
        (frame(&mut cell, None, b"G", vec![fixed(7)]), frame(&mut cell, None, b"S", vec![fixed(0)]));
    let pending = frame(&mut cell, None, b"S", vec![fixed(1)]);
    let (halt, halted) =
        (frame(&mut cell, None, b"H", vec![fixed(7)]), frame(&mut cell, None, b"T", vec![fixed(0)]));
    let start = Exchange { pending, ..never_late(Exchange::new(1, talk(go, done), Triggers::every(MS(50)))) };
    let mut stop = never_late(Exchange::new(2, talk(halt, halted), rising(1)));
    stop.stop = true;
    let port = talking(&mut cell, &[start, stop]);
    let mut line = Line::new(&cell, port);
    line.bit(1, true);
    let mut stops = Vec::new();
    for _ in 0..1_000 {
        let asked = line.run(MS(1), |_| None);
        for (at, request) in asked {
            if request[0] == b'G' {
                (1..50).for_each(|nth| line.comes(MS(nth * 30), b"S\x01"));
            } else {
                stops.push(at);
            }
        }
    }
    let longest = stops.windows(2).map(|pair| pair[1].saturating_since(pair[0])).max().unwrap();
    assert!(stops.len() >= 4 && longest < MS(250), "{} stops, {longest}", stops.len());
}

#[test]
fn a_late_pending_answer_is_no_reply() {
    let mut device = Device::new(|start| start.late = Some(MS(1_000)));
    device.run(1_000);
    device.start(&[]);
    device.run(110);
    assert_eq!(device.outcome(), 5);
    device.line.comes(MS(1), &status_of(PENDING, 1));
    device.line.comes(MS(300), &status_of(DONE, 0));
    device.says = vec![(10, DONE)];
    device.line.bit(0, false);
    device.run(20);
    device.line.bit(0, true);
    device.run(200);
    assert_eq!(device.starts, 1, "its reply is still awaited");
    assert_eq!(device.line.shown(PROGRESS), 0, "nothing of it is taken");
    device.run(300);
    let counters = device.line.peer(1).counters;
    assert_eq!((device.starts, device.outcome(), counters.late_replies), (2, 2, 2));
}

/// Late by this much it is still waited for: from the pending answer on, not from the request.
#[test]
fn a_reply_may_be_late_behind_a_pending_answer() {
    let mut device = Device::new(|start| start.late = Some(MS(500)));
    device.run(500);
    let says: Vec<_> = (1..=10).map(|nth| (nth * 90, PENDING)).chain([(1_300, DONE)]).collect();
    device.start(&says);
    device.run(1_010);
    assert_eq!(device.outcome(), 5);
    device.says = vec![(80, 9)];
    device.line.bit(0, false);
    device.run(20);
    device.line.bit(0, true);
    device.run(500);
    // The late reply is not that to the second request.
    assert_eq!((device.starts, device.outcome(), device.line.shown(CODE)), (2, 3, 9));
    assert_eq!(device.line.peer(1).counters.late_replies, 1);
}

/// Two exchanges of one device, each with its reply and its pending answer: the first each 10 s, the second when bit 0
/// rises. A third one shows that the device is there.
fn two(first: [&[u8]; 2], second: [Option<&[u8]>; 2]) -> Line {
    let mut cell = Cell::new();
    let mut exchange = |request: &[u8], answers: [Option<&[u8]>; 2], when| {
        let request = frame(&mut cell, None, request, vec![fixed(7)]);
        let [reply, pending] =
            answers.map(|head| head.and_then(|head| frame(&mut cell, None, head, vec![fixed(0)])));
        let talk = Transaction::Frames { request, reply, refusal: None };
        Exchange { late: Some(MS(1_000)), retries: 0, pending, ..Exchange::new(1, talk, when) }
    };
    let first = exchange(b"A", first.map(Some), Triggers::every(MS(10_000)));
    let mut second = exchange(b"C", second, rising(0));
    (second.outcome.to, second.trigger) = (Some(var("WordInputReg[2]")), Some(MS(3_000)));
    let poll = exchange(b"Q", [Some(b"V"), None], Triggers::every(MS(50)));
    let port = talking(&mut cell, &[first, second, poll]);
    let mut line = Line::new(&cell, port);
    // Behind the start, in which any reply may be late. The first is asked and not answered.
    let asked = line.run(MS(1_150), polls);
    assert!(asked.iter().any(|(_, request)| request[0] == b'A'));
    line.bit(0, true);
    line
}

fn polls(request: &[u8]) -> Option<(Duration, Vec<u8>)> {
    (request[0] == b'Q').then(|| (MS(2), b"V\0".to_vec()))
}

/// Two of a device with the same pending answer: one that may be the other's is nobody's.
#[test]
fn a_pending_answer_that_may_be_anothers_extends_nothing() {
    let mut line = two([b"B", b"P"], [Some(b"D"), Some(b"P")]);
    let mut asked = 0;
    for _ in 0..300 {
        let second = line.run(MS(1), polls).iter().any(|(_, request)| request[0] == b'C');
        if second {
            asked += 1;
            line.comes(MS(60), b"P\0");
            line.comes(MS(120), b"D\0");
        }
    }
    assert_eq!((asked, line.shown("WordInputReg[2]")), (1, 5), "its own timeout counts");
}

/// A late pending answer has the bytes of the other exchange's reply: they wait for each other.
#[test]
fn a_reply_that_looks_like_anothers_pending_answer_is_not_asked_for_meanwhile() {
    let mut line = two([b"B", b"D"], [Some(b"D"), None]);
    let asked = line.run(MS(500), polls);
    assert!(asked.iter().all(|(_, request)| request[0] != b'C'), "{asked:?}");
    line.comes(MS(1), b"D\0");
    line.run(MS(100), polls);
    assert_eq!(line.shown("WordInputReg[2]"), 1, "a pending answer that came late did nothing");
    let answers =
        |request: &[u8]| if request[0] == b'C' { Some((MS(5), b"D\0".to_vec())) } else { polls(request) };
    line.run(MS(1_000), answers);
    assert_eq!(line.shown("WordInputReg[2]"), 2);
}

/// The same frame with a status in it, on CAN: pending, done, and refused with a code.
#[test]
fn answers_with_one_id_on_can() {
    let mut cell = Cell::new();
    let request = frame(&mut cell, Some(0x101), &[], vec![fixed(1)]);
    let reply = frame(&mut cell, Some(0x201), &[], vec![fixed(9), fixed(0)]);
    let pending = frame(&mut cell, Some(0x201), &[], vec![fixed(9), fixed(1)]);
    let refusal = frame(&mut cell, Some(0x201), &[], vec![fixed(9), byte_to(CODE)]);
    let talk = Transaction::Frames { request, reply, refusal };
    let mut exchange = Exchange { pending, ..never_late(Exchange::new(1, talk, rising(0))) };
    exchange.outcome.to = Some(var("WordInputReg[2]"));
    let parts = Parts::Can { input: Default::default(), output: Default::default() };
    let recipe = cell.recipe(Mode::User, parts);
    cell.0.exchanges.push(exchange).unwrap();
    cell.last_recipe().exchanges = Span { start: 0, len: 1 };
    let port = cell.can_port(recipe);
    for (last, outcome) in [(0, 2), (7, 3)] {
        let mut line = Line::new(&cell, port);
        line.rig.run(MS(200));
        line.bit(0, true);
        line.rig.run(MS(60));
        assert_eq!(line.rig.can_sent_to(port).len(), 1);
        for _ in 0..5 {
            line.rig.can(port, 0x201, &[9, 1]);
            line.rig.run(MS(90));
            assert_eq!(line.shown("WordInputReg[2]"), 1);
        }
        line.rig.can(port, 0x201, &[9, last]);
        line.rig.input(Input::Tick);
        line.rig.run(MS(50));
        assert_eq!((line.shown("WordInputReg[2]"), line.shown(CODE)), (outcome, last.into()));
    }
}
