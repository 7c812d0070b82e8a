//! Every sequence of requests, results and power cuts up to a length, and long ones by chance: what runs in
//! the end was confirmed, and is what runs after a restart.

use proptest::prelude::*;
use proto_core::time::{Duration, Instant};
use recipe_api::revisions::{
    Ended, Etag, MAX_REVISIONS, Refused, Result, Revision, RevisionOutput, Revisions, Stored,
};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Event {
    Put,
    PutOnOld,
    Apply,
    ApplyOldest,
    Confirm,
    RollBack,
    EndsByItself,
    Wait(u64),
    /// The next output fails, or the one after it.
    Fail(usize),
    /// The power goes before the next output is carried out, or now if there is none.
    Cut,
}

const EVENTS: [Event; 12] = [
    Event::Put,
    Event::PutOnOld,
    Event::Apply,
    Event::ApplyOldest,
    Event::Confirm,
    Event::RollBack,
    Event::EndsByItself,
    Event::Wait(2),
    Event::Wait(100),
    Event::Fail(1),
    Event::Fail(2),
    Event::Cut,
];
const TRIAL: Duration = Duration::from_secs(60);

/// A driver with a store and something that runs.
struct World {
    now: Instant,
    machine: Revisions,
    store: Stored,
    runs: Option<u32>,
    /// So many outputs until one fails; 0: none does.
    fails: usize,
    /// The power goes at the next output.
    is_cut: bool,
    /// Numbers that a person has confirmed; the first one counts as such.
    confirmed: Vec<u32>,
    /// That is being confirmed.
    asked: Option<u32>,
}

impl World {
    fn new() -> Self {
        let first = Revision { number: 1, digest: 11 };
        let store = Stored { kept: [first].into_iter().collect(), live: 1, previous: None };
        let machine = Revisions::new(store.clone()).unwrap();
        Self {
            now: Instant::ZERO,
            machine,
            store,
            runs: Some(1),
            fails: 0,
            is_cut: false,
            confirmed: vec![1],
            asked: None,
        }
    }

    fn has(&self, number: u32) -> bool {
        self.store.kept.iter().any(|kept| kept.number == number)
    }

    fn play(&mut self, event: Event) {
        match event {
            Event::Put | Event::PutOnOld => {
                let base = self.machine.base().unwrap();
                let old = Revision { digest: base.digest + 1, ..base };
                let put = self.machine.put(if event == Event::Put { base } else { old }, base.digest + 10);
                if event == Event::PutOnOld {
                    assert!(put.is_err());
                }
                if let Ok(number) = put {
                    assert!(number > self.store.kept.iter().map(|kept| kept.number).max().unwrap());
                }
            }
            Event::Apply => drop(self.machine.apply(None, TRIAL)),
            Event::ApplyOldest => {
                let oldest = self.machine.kept()[0].number;
                let _ = self.machine.apply(Some(oldest), TRIAL);
            }
            Event::Confirm => self.asked = self.machine.confirm(self.now).ok(),
            Event::RollBack => drop(self.machine.roll_back()),
            Event::EndsByItself => {
                if self.machine.trial().is_some() {
                    self.runs = None;
                    self.machine.handle(self.now, Result::Ended);
                }
            }
            Event::Wait(seconds) => self.now += Duration::from_secs(seconds),
            Event::Fail(nth) => self.fails = nth,
            Event::Cut => self.is_cut = true,
        }
        self.drain();
        if event == Event::Cut && core::mem::take(&mut self.is_cut) {
            self.restart();
        }
        self.check();
    }

    fn drain(&mut self) {
        for _ in 0..20 {
            let output = self.machine.poll_output(self.now);
            if let RevisionOutput::Sleep { until } = output {
                assert!(until > self.now);
                return;
            }
            if core::mem::take(&mut self.is_cut) {
                return self.restart();
            }
            let is_done = self.fails != 1;
            self.fails = self.fails.saturating_sub(1);
            let result = match output {
                RevisionOutput::Store { revision, forget } => {
                    if is_done {
                        assert_ne!(forget, Some(self.store.live), "the live one is forgotten");
                        self.store.kept.retain(|kept| Some(kept.number) != forget);
                        self.store.kept.push(revision).expect("at most eight are kept");
                    }
                    Result::Stored(is_done)
                }
                RevisionOutput::Run { number } => {
                    assert!(self.has(number), "{number} is not kept");
                    self.runs = is_done.then_some(number);
                    Result::Started(is_done)
                }
                RevisionOutput::Mark { live, previous } => {
                    assert_eq!(self.runs, Some(live), "what does not run is marked");
                    if is_done {
                        if self.asked == Some(live) {
                            self.confirmed.push(live);
                        }
                        (self.store.live, self.store.previous) = (live, Some(previous));
                    }
                    Result::Marked(is_done)
                }
                RevisionOutput::Sleep { .. } => unreachable!(),
            };
            self.machine.handle(self.now, result);
        }
        panic!("it does not come to rest");
    }

    fn restart(&mut self) {
        self.machine = Revisions::new(self.store.clone()).expect("the store holds the live one");
        self.runs = Some(self.store.live);
        self.fails = 0;
    }

    fn check(&self) {
        assert!(self.has(self.store.live));
        assert!(self.confirmed.contains(&self.store.live), "{} was never confirmed", self.store.live);
        assert_eq!(self.machine.live(), self.store.live);
        assert_eq!(self.machine.running(), self.runs);
        assert_eq!(self.machine.kept(), &self.store.kept[..]);
        if self.machine.trial().is_none()
            && let Some(number) = self.runs
        {
            assert_eq!(number, self.store.live, "what runs is not what runs after a restart");
        }
        assert!(self.machine.waiting().is_none_or(|number| self.has(number)));
        assert!(self.machine.previous().is_none_or(|number| self.has(number) && number != self.store.live));
    }

    /// Nobody asks for anything any more, and nothing fails.
    fn settle(&mut self) {
        self.fails = 0;
        for _ in 0..3 {
            self.play(Event::Wait(3_600));
        }
        assert_eq!(self.runs, Some(self.store.live));
        assert_eq!(self.machine.trial(), None);
    }
}

fn every_sequence(left: usize, world: &World, count: &mut u64) {
    *count += 1;
    let clone = || World {
        machine: world.machine.clone(),
        store: world.store.clone(),
        confirmed: world.confirmed.clone(),
        ..*world
    };
    clone().settle();
    if left == 0 {
        return;
    }
    for event in EVENTS {
        let mut next = clone();
        next.play(event);
        every_sequence(left - 1, &next, count);
    }
}

#[test]
fn every_sequence_of_five_events_ends_with_something_confirmed() {
    let mut count = 0;
    every_sequence(5, &World::new(), &mut count);
    assert_eq!(count, (0..=5).map(|length| 12_u64.pow(length)).sum());
}

proptest! {
    #[test]
    fn so_do_long_ones(events in prop::collection::vec(prop::sample::select(&EVENTS[..]), 0..80)) {
        let mut world = World::new();
        for event in events {
            world.play(event);
        }
        world.settle();
    }
}

#[test]
fn a_trial_that_nobody_confirms_is_taken_back_in_time() {
    let mut world = World::new();
    world.play(Event::Put);
    assert_eq!((world.machine.waiting(), world.runs), (Some(2), Some(1)));
    world.play(Event::Apply);
    assert_eq!(world.machine.trial(), Some((2, Instant::ZERO + TRIAL)));
    assert_eq!((world.runs, world.store.live), (Some(2), 1));
    world.play(Event::Wait(59));
    assert_eq!(world.runs, Some(2));
    world.play(Event::Wait(1));
    assert_eq!((world.runs, world.machine.last()), (Some(1), Some((2, Ended::NotConfirmed))));
    // It is still there, and can be applied by its number.
    assert_eq!(world.machine.apply(None, TRIAL), Err(Refused::NothingWaits));
    assert_eq!(world.machine.apply(Some(2), TRIAL), Ok(2));
    world.drain();
    world.play(Event::Confirm);
    assert_eq!((world.store.live, world.store.previous), (2, Some(1)));
    assert_eq!(world.machine.roll_back(), Ok(1));
    world.drain();
    assert_eq!((world.runs, world.store.live, world.store.previous), (Some(1), 1, Some(2)));
}

#[test]
fn two_people_do_not_overwrite_each_other() {
    let mut world = World::new();
    let base = world.machine.base().unwrap();
    assert_eq!(world.machine.put(base, 22), Ok(2));
    assert_eq!(world.machine.put(base, 33), Err(Refused::Busy));
    world.drain();
    assert_eq!(world.machine.put(base, 33), Err(Refused::Changed(Revision { number: 2, digest: 22 })));
    assert_eq!(world.machine.put(world.machine.base().unwrap(), 33), Ok(3));
}

#[test]
fn the_last_eight_are_kept_and_among_them_those_that_are_needed() {
    let mut world = World::new();
    for _ in 0..20 {
        world.play(Event::Put);
    }
    let numbers: Vec<u32> = world.store.kept.iter().map(|kept| kept.number).collect();
    assert_eq!(numbers, [1, 15, 16, 17, 18, 19, 20, 21]);
    assert_eq!(numbers.len(), MAX_REVISIONS);
}

#[test]
fn what_does_not_start_is_taken_back_and_what_was_live_is_tried_again() {
    let mut world = World::new();
    world.play(Event::Put);
    world.machine.apply(None, TRIAL).unwrap();
    world.fails = 1;
    world.drain();
    assert_eq!((world.runs, world.machine.last()), (Some(1), Some((2, Ended::Failed))));
    // Neither does the live one, for a while.
    world.machine.apply(Some(2), TRIAL).unwrap();
    let mut failures = 0;
    for second in 0..60_u64 {
        world.now = Instant::ZERO + Duration::from_secs(second);
        while let output @ RevisionOutput::Run { .. } = world.machine.poll_output(world.now) {
            failures += 1;
            assert!(failures == 1 || output == RevisionOutput::Run { number: 1 });
            world.machine.handle(world.now, Result::Started(false));
        }
        assert_eq!(world.machine.put(world.machine.base().unwrap(), 0), Err(Refused::Busy));
    }
    // On trial, at once, then after 1, 2, 4, 8, 10, 10, 10 and 10 seconds.
    assert_eq!(failures, 10);
    world.now += Duration::from_secs(10);
    world.drain();
    assert_eq!(world.runs, Some(1));
}

#[test]
fn a_store_without_its_live_revision_is_refused() {
    let kept = [Revision { number: 3, digest: 0 }, Revision { number: 4, digest: 0 }];
    let of = |kept: &[Revision], live| {
        Revisions::new(Stored { kept: kept.iter().copied().collect(), live, previous: Some(9) })
    };
    assert!(of(&kept, 2).is_none());
    assert!(of(&[kept[1], kept[0]], 3).is_none());
    let machine = of(&kept, 3).unwrap();
    assert_eq!((machine.live(), machine.previous(), machine.waiting()), (3, None, None));
    assert_eq!(machine.clone().roll_back(), Err(Refused::NoPrevious));
    assert_eq!(machine.clone().apply(Some(9), TRIAL), Err(Refused::Unknown));
    assert_eq!(machine.clone().apply(Some(3), TRIAL), Err(Refused::Runs));
    assert_eq!(machine.clone().apply(Some(4), Duration::from_secs(0)), Err(Refused::Trial));
    assert_eq!(machine.clone().confirm(Instant::ZERO), Err(Refused::NotOnTrial));
}

#[test]
fn an_etag_has_one_text() {
    let revision = Revision { number: 12, digest: 0xBAD_CAFE };
    assert_eq!(Etag(revision).to_string(), "\"12-0badcafe\"");
    assert_eq!(Etag::parse("\"12-0badcafe\""), Some(revision));
    for wrong in
        ["12-0badcafe", "\"12-badcafe\"", "\"12-0BADCAFE\"", "\"+12-0badcafe\"", "\"012-0badcafe\"", "*", ""]
    {
        assert_eq!(Etag::parse(wrong), None, "{wrong}");
    }
}
