//! A store on the model, what it has to hold, and changes of it.

use std::collections::BTreeMap;
use std::fmt;

use embassy_futures::block_on;
use recipe_store::{Geometry, Marks, Store, Trial, TrialEnd};

use crate::model::{Nor, Torn};

/// A change of the store.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Change {
    Keep { number: u32, image: Vec<u8> },
    Mark(Marks),
    Counter(u8, u64),
    BirthSequence(u8),
    Key([u8; 16]),
    Edge(Vec<u8>),
}

/// Everything a store holds.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct StoreContents {
    images: BTreeMap<u32, (u32, Vec<u8>)>,
    marks: Marks,
    counters: [u64; 3],
    edge: Vec<u8>,
    birth: Option<u8>,
    key: Option<[u8; 16]>,
}

#[derive(Debug, Default, Clone)]
pub(crate) struct Totals {
    pub(crate) cuts: u32,
    pub(crate) second_cuts: u32,
    pub(crate) erase_cuts: u32,
    pub(crate) refused: u32,
    pub(crate) new: u32,
}

impl fmt::Display for Totals {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cuts, second_cuts, erase_cuts, refused, new } = self;
        write!(
            f,
            "{cuts} cuts ({erase_cuts} of changes with an erase), then {new} times the new one; {second_cuts} second \
             cuts; {refused} writes to words that only looked blank"
        )
    }
}

#[derive(Debug, Clone)]
pub(crate) struct StoreBench {
    pub(crate) flash: Nor,
    pub(crate) store: Store,
    pub(crate) expected: StoreContents,
}

/// Contents of an image that tell every byte's place and the image's number.
pub(crate) fn image(number: u32, len: usize) -> Vec<u8> {
    (0..len as u32)
        .map(|at| (number.wrapping_mul(2_654_435_761).wrapping_add(at.wrapping_mul(40_503)) >> 13) as u8)
        .collect()
}

/// The changes in the life of a board: images of these lengths are kept, tried, confirmed or taken back.
pub(crate) fn life(changes: usize, lens: &[usize]) -> Vec<Change> {
    let (mut all, mut live, mut previous) = (vec![Change::Key([7; 16])], None, None);
    let mut last = None;
    let mut lens = lens.iter().cycle();
    for number in 1.. {
        let len = *lens.next().expect("it is a cycle");
        all.push(Change::Keep { number, image: image(number, len) });
        let trial =
            |attempts| Marks { live, previous, trial: Some(Trial { number, attempts, confirm_s: 60 }), last };
        all.extend([Change::Mark(trial(2)), Change::Mark(trial(1))]);
        if number % 3 == 0 {
            last = Some((number, TrialEnd::TakenBack));
            all.push(Change::Mark(Marks { live, previous, trial: None, last }));
        } else {
            (live, previous, last) = (Some(number), live, Some((number, TrialEnd::Confirmed)));
            all.push(Change::Mark(Marks { live, previous, trial: None, last }));
        }
        all.extend([Change::BirthSequence(number as u8), Change::Counter(number as u8 % 3, number.into())]);
        if number % 4 == 1 {
            all.push(Change::Edge(image(!number, number as usize * 7 % 150)));
        }
        if all.len() >= changes {
            all.truncate(changes);
            return all;
        }
    }
    unreachable!()
}

impl Change {
    pub(crate) fn attempt(&self, store: &mut Store, flash: &mut Nor) -> bool {
        let done = match self {
            Self::Keep { number, image } => {
                block_on(store.keep(*number, !number, image, None).expect("it is allowed").execute(flash))
            }
            Self::Mark(marks) => block_on(store.mark(*marks).expect("all are kept").execute(flash)),
            Self::Counter(number, value) => {
                block_on(store.set_counter(*number, *value).expect("there is room").execute(flash))
            }
            Self::BirthSequence(value) => {
                block_on(store.set_birth_sequence(*value).expect("there is room").execute(flash))
            }
            Self::Edge(settings) => block_on(store.set_edge(settings).expect("there is room").execute(flash)),
            Self::Key(key) => block_on(store.set_access_key(key).expect("there is room").execute(flash)),
        };
        done.is_ok()
    }
}

impl StoreContents {
    /// What the store says that it holds.
    pub(crate) fn read(store: &Store, flash: &Nor) -> Self {
        let mut buf = vec![0; recipe_store::MAX_DATA];
        let images = store.revisions().into_iter().map(|kept| {
            let image = store.image(flash, kept.number, &mut buf).expect("it is kept").to_vec();
            (kept.number, (kept.digest, image))
        });
        let images = images.collect();
        Self {
            images,
            marks: store.marks(),
            counters: std::array::from_fn(|number| store.counter(number as u8)),
            edge: store.get(flash, recipe_store::RecordKey::Edge, &mut buf).unwrap_or_default().to_vec(),
            birth: store.birth_sequence(),
            key: store.access_key(flash),
        }
    }

    /// After a change, with what the store has forgotten for it.
    pub(crate) fn after(&self, change: &Change) -> Self {
        let mut new = self.clone();
        match change {
            Change::Keep { number, image } => {
                if new.images.len() == 8 && !new.images.contains_key(number) {
                    let needed = new.marks.numbers();
                    let oldest = new.images.keys().copied().find(|number| !needed.contains(&Some(*number)));
                    new.images.remove(&oldest.expect("four are needed"));
                }
                new.images.insert(*number, (!number, image.clone()));
            }
            Change::Mark(marks) => new.marks = *marks,
            Change::Counter(number, value) => new.counters[usize::from(*number)] = *value,
            Change::BirthSequence(value) => new.birth = Some(*value),
            Change::Key(key) => new.key = Some(*key),
            Change::Edge(settings) => new.edge.clone_from(settings),
        }
        new
    }
}

impl StoreBench {
    pub(crate) fn new(geometry: Geometry, torn: Torn) -> Self {
        let flash = Nor::new(geometry, torn);
        let store = Store::mount(&flash).expect("an empty one");
        Self { flash, store, expected: StoreContents::default() }
    }

    #[track_caller]
    pub(crate) fn restart(&mut self) {
        self.flash.power();
        self.store = Store::mount(&self.flash).expect("it always starts");
    }

    pub(crate) fn attempt(&mut self, change: &Change) -> bool {
        change.attempt(&mut self.store, &mut self.flash)
    }

    #[track_caller]
    pub(crate) fn check(&self) {
        assert_eq!(StoreContents::read(&self.store, &self.flash), self.expected);
    }

    /// With power: it has to succeed, now and after a restart.
    #[track_caller]
    pub(crate) fn execute(&mut self, change: &Change) {
        assert!(self.attempt(change), "{change:?}");
        self.expected = self.expected.after(change);
        self.check();
        let again = Store::mount(&self.flash).expect("it always starts");
        assert_eq!(StoreContents::read(&again, &self.flash), self.expected);
    }

    /// After a cut: the old or the new, whole, and the images that are marked are kept. Whether it is the new.
    #[track_caller]
    pub(crate) fn start_after_cut(&mut self, change: &Change) -> bool {
        self.restart();
        let new = self.expected.after(change);
        let found = StoreContents::read(&self.store, &self.flash);
        let is_new = found == new;
        if is_new {
            self.expected = new;
        }
        assert_eq!(found, self.expected, "neither old nor new");
        let candidates = self.store.at_start().candidates;
        assert_eq!(candidates.is_empty(), self.expected.marks == Marks::default());
        is_new
    }

    /// Cuts the power in each operation of a change, and in one of the next change after the restart. `restarts`:
    /// nothing was written since the last start.
    #[track_caller]
    pub(crate) fn cut_everywhere(
        &self,
        change: &Change,
        next: Option<&Change>,
        seed: u64,
        restarts: bool,
        totals: &mut Totals,
    ) {
        let mut whole = self.clone();
        assert!(whole.attempt(change));
        let has_erase = whole.flash.erases > self.flash.erases;
        let steps = whole.flash.operations() - self.flash.operations();
        for cut in 0..steps {
            let mut dead = self.clone();
            dead.flash.cut_after(cut, seed << 32 | u64::from(cut) << 8 | 0x55);
            dead.attempt(change);
            assert!(dead.flash.is_off());
            totals.cuts += 1;
            totals.erase_cuts += u32::from(has_erase);
            totals.new += u32::from(dead.start_after_cut(change));
            // Once more, in the same change or in the next one, early or late.
            for (second, turn) in [(0, 0), (1, 1), (cut * 7 % (steps + 3), 0), (cut * 5 % (steps + 3), 1)] {
                let mut twice = dead.clone();
                let change = next.filter(|_| turn == 1).unwrap_or(change);
                if !twice.is_possible(change) {
                    continue;
                }
                twice.flash.cut_after(second, u64::from(cut) << 16 | u64::from(second) << 3 | 5);
                let is_done = twice.attempt(change);
                if twice.flash.is_off() {
                    totals.second_cuts += 1;
                    twice.start_after_cut(change);
                } else {
                    // It was over before.
                    assert!(is_done);
                    twice.flash.power();
                    twice.expected = twice.expected.after(change);
                }
                if twice.is_possible(change) {
                    twice.execute(change);
                }
                totals.refused += twice.flash.refused;
            }
            if dead.is_possible(change) {
                dead.execute(change);
                // The word at which the one cut was is left out, unless the start before left it out too.
                assert!(restarts || dead.flash.refused == 0, "{change:?}, cut {cut}");
            }
            totals.refused += dead.flash.refused;
        }
    }

    /// Whether the store may accept it: what is kept already under this number, and in use, is not replaced, and
    /// only what is kept is marked.
    pub(crate) fn is_possible(&self, change: &Change) -> bool {
        match change {
            Change::Keep { number, .. } => !self.expected.marks.numbers().contains(&Some(*number)),
            Change::Mark(marks) => {
                marks.numbers().into_iter().flatten().all(|number| self.expected.images.contains_key(&number))
            }
            _ => true,
        }
    }
}
