//! The ring between the gateway's thread and those who watch.

use std::time::{Duration as StdDuration, SystemTime};

use proto_core::engine::TapRecord;
use recipe_capture::{Epoch, Interest, Next};

use super::*;

const FRAMES: Interest = Interest { frames: true, passes: false };
const PASSES: Interest = Interest { frames: false, passes: true };

fn cell() -> Cell {
    let epoch = Epoch { at: Instant::from_micros(0), wall: SystemTime::UNIX_EPOCH };
    Cell { ports: Vec::new(), links: Vec::new(), decoder: Arc::default(), epoch }
}

fn begin(watch: &Watch) -> Tapping {
    let image = watch.wanted().passes.then_some(&[1, 2, 3][..]);
    Tapping::begin(watch, cell(), Instant::from_micros(0), image).unwrap()
}

fn record(at: u64, verdict: TapVerdict, can_id: Option<CanId>, bytes: &[u8]) -> TapRecord<'_> {
    let at = Instant::from_micros(at);
    let place = TapPlace::Port(PortId(3));
    TapRecord { at, place, direction: TapDirection::Out, verdict, can_id, len: bytes.len(), bytes, lost: 0 }
}

fn all(subscription: &recipe_capture::Subscription) -> Vec<(Record, u64)> {
    let mut records = Vec::new();
    while let Next::Record(arrived) = subscription.next(StdDuration::from_secs(20)) {
        records.push(((*arrived.record).clone(), arrived.missed));
    }
    records
}

#[test]
fn frames_come_out_as_they_went_in() {
    let watch = Watch::new();
    let subscription = watch.subscribe(FRAMES, 1_000);
    let mut tapping = begin(&watch);
    let verdicts = Rejection::ALL.map(TapVerdict::Rejected);
    let verdicts: Vec<_> = verdicts.into_iter().chain([TapVerdict::Taken, TapVerdict::Link]).collect();
    let ids = [None, Some(CanId::Standard(0x7FF)), Some(CanId::Extended(0x1FFF_FFFF))];
    for (nth, &verdict) in verdicts.iter().enumerate() {
        tapping.frame(&record(nth as u64, verdict, ids[nth % 3], &[7; 5]));
        tapping.push(FRAME);
    }
    drop(tapping);
    watch.close();
    let seen = all(&subscription);
    assert!(matches!(&seen[0].0.what, What::Began(_)));
    for (nth, &verdict) in verdicts.iter().enumerate() {
        let (record, missed) = &seen[nth + 1];
        let What::Frame(frame) = &record.what else { panic!("{record:?}") };
        assert_eq!((record.at.as_micros(), record.lost, *missed), (nth as u64, 0, 0));
        assert_eq!((frame.verdict, frame.can_id, frame.len), (verdict, ids[nth % 3], 5));
        assert_eq!((frame.place, frame.direction), (TapPlace::Port(PortId(3)), TapDirection::Out));
        assert_eq!(&*frame.bytes, [7; 5]);
    }
    assert_eq!(seen.len(), verdicts.len() + 1);
}

#[test]
fn what_finds_no_room_is_lost_at_once_and_counted() {
    let watch = Watch::new();
    let subscription = watch.subscribe(FRAMES, 1 << 20);
    let mut tapping = begin(&watch);
    // More than the ring has room for, faster than anybody reads.
    const COUNT: u64 = 60_000;
    let started = std::time::Instant::now();
    for nth in 0..COUNT {
        tapping.frame(&record(nth, TapVerdict::Taken, None, &[9; 1_000]));
        tapping.push(FRAME);
    }
    let took = started.elapsed();
    let lost = tapping.lost[0];
    drop(tapping);
    watch.close();
    let (mut seen, mut lost_before) = (0, 0);
    for (record, missed) in all(&subscription).iter().skip(1) {
        lost_before += u64::from(record.lost);
        assert_eq!(
            (record.at.as_micros(), *missed),
            (seen + lost_before, 0),
            "in order, the lost ones counted"
        );
        seen += 1;
    }
    assert_eq!(seen + lost_before + u64::from(lost), COUNT);
    assert!(took < StdDuration::from_secs(10), "{took:?}: it waited");
}

#[test]
fn passes_begin_with_the_start_of_the_engine() {
    let watch = Watch::new();
    let subscription = watch.subscribe(PASSES, 10);
    let mut tapping = begin(&watch);
    tapping.head(PASS, Instant::from_micros(5));
    tapping.entry(&Entry::Input { at: Instant::from_micros(5), input: Input::Tick });
    tapping.entry(&Entry::Output(Output::Sleep { until: Instant::NEVER }));
    tapping.push(PASS);
    drop(tapping);
    watch.close();
    let seen = all(&subscription);
    let passes = seen.iter().filter_map(|(record, _)| match &record.what {
        What::Pass(bytes) => Some(bytes),
        _ => None,
    });
    let passes: Vec<_> = passes.collect();
    assert!(matches!(Entry::parse(passes[0]), Some((Entry::Start { image: &[1, 2, 3] }, []))));
    let (first, rest) = Entry::parse(passes[1]).unwrap();
    assert!(matches!(first, Entry::Input { input: Input::Tick, .. }));
    assert!(matches!(Entry::parse(rest), Some((Entry::Output(Output::Sleep { .. }), []))));
}

#[test]
fn who_comes_too_late_gets_no_passes() {
    let watch = Watch::new();
    let mut tapping = begin(&watch);
    let subscription = watch.subscribe(PASSES, 10);
    tapping.output(Output::Sleep { until: Instant::NEVER });
    assert!(!tapping.records_passes);
    drop(tapping);
    watch.close();
    assert!(all(&subscription).iter().all(|(record, _)| !matches!(record.what, What::Pass(_))));
}
