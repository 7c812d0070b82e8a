use std::vec;
use std::vec::Vec as List;

use embassy_futures::block_on;
use recipe_store::{BLANK, Geometry, Place, Put, Trial, Word};

use super::*;

/// Flash without faults.
#[derive(Debug, Clone)]
struct Plain {
    words: List<Word>,
    bytes: List<u8>,
    /// From here on nothing is written.
    is_broken: bool,
    writes: u32,
}

const WORDS: u16 = 256;

impl Plain {
    fn new() -> Self {
        Self { words: vec![BLANK; 3 * usize::from(WORDS)], bytes: List::new(), is_broken: false, writes: 0 }
    }

    fn at(place: Place) -> usize {
        usize::from(place.sector) * usize::from(WORDS) + usize::from(place.word)
    }
}

impl Flash for Plain {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: 3, words: WORDS }
    }

    fn read(&self, place: Place) -> Word {
        self.words[Self::at(place)]
    }

    async fn write(&mut self, place: Place, word: &Word) {
        self.writes += 1;
        if !self.is_broken {
            self.words[Self::at(place)] = *word;
        }
    }

    async fn erase(&mut self, sector: u8) {
        self.words[usize::from(sector) * usize::from(WORDS)..][..usize::from(WORDS)].fill(BLANK);
    }
}

impl StoreFlash for Plain {
    fn bytes(&mut self, found: Found) -> Option<&[u8]> {
        self.bytes = self.words[Self::at(found.data)..].as_flattened().get(..found.len)?.to_vec();
        Some(&self.bytes)
    }
}

impl Kept<Plain> {
    fn restart(&mut self) {
        *self = Kept::open(self.flash.clone()).unwrap();
    }

    fn write(&mut self, put: impl FnOnce(&mut Store) -> Put<'_, 'static>) {
        block_on(put(&mut self.store).carry_out(&mut self.flash)).unwrap();
    }

    /// Numbers and roles of a start.
    fn start(&mut self) -> List<(u32, Role)> {
        self.restart();
        let mut candidates = Vec::new();
        let _ = block_on(self.candidates(&mut candidates));
        candidates.iter().map(|(revision, role)| (revision.number, *role)).collect()
    }
}

fn blank() -> Kept<Plain> {
    Kept::open(Plain::new()).unwrap()
}

#[test]
fn an_image_outside_the_store_is_taken_over_once() {
    let mut kept = blank();
    assert_eq!(kept.start(), []);
    assert!(block_on(kept.adopt(1, b"first")).unwrap());
    assert_eq!(kept.start(), [(1, Role::Live)]);
    let writes = kept.flash.writes;
    assert!(!block_on(kept.adopt(1, b"first")).unwrap());
    assert_eq!(kept.flash.writes, writes, "nothing is written at the other starts");
    // Another one was put there.
    assert!(block_on(kept.adopt(2, b"second")).unwrap());
    assert_eq!(kept.start(), [(2, Role::Live), (1, Role::Previous)]);
    let (revision, _) = kept.store.at_start().candidates[0];
    assert_eq!(kept.image(revision), Some(&b"second"[..]));
    // What was changed in the store since then stays.
    kept.write(|store| store.mark(Marks { live: Some(1), previous: Some(2), trial: None }).unwrap());
    assert!(!block_on(kept.adopt(2, b"second")).unwrap());
    assert_eq!(kept.start(), [(1, Role::Live), (2, Role::Previous)]);
}

#[test]
fn a_trial_is_counted_before_it_runs_and_can_be_ended() {
    let mut kept = blank();
    block_on(kept.adopt(1, b"first")).unwrap();
    kept.write(|store| store.keep(2, 2, b"second", None).unwrap());
    let trial = Some(Trial { number: 2, attempts: 2, confirm_s: 60 });
    let marks = Marks { live: Some(1), previous: None, trial };
    kept.write(|store| store.mark(marks).unwrap());
    let on_trial = [(2, Role::Trial { confirm_s: 60 }), (1, Role::Live)];
    assert_eq!(kept.start(), on_trial);
    assert_eq!(kept.store.marks().trial, Some(Trial { number: 2, attempts: 1, confirm_s: 60 }));
    let before = kept.flash.clone();
    block_on(kept.end_trial()).unwrap();
    assert_eq!(kept.start(), [(1, Role::Live)]);
    // Or it is not ended, but the board starts again and again.
    kept.flash = before;
    assert_eq!(kept.start(), on_trial);
    assert_eq!(kept.start(), [(1, Role::Live)]);
    assert_eq!(kept.start(), [(1, Role::Live)]);
}

#[test]
fn what_cannot_be_counted_is_not_tried() {
    let mut kept = blank();
    block_on(kept.adopt(1, b"first")).unwrap();
    kept.write(|store| store.keep(2, 2, b"second", None).unwrap());
    let trial = Some(Trial { number: 2, attempts: 2, confirm_s: 60 });
    kept.write(|store| store.mark(Marks { live: Some(1), previous: None, trial }).unwrap());
    kept.flash.is_broken = true;
    for _ in 0..5 {
        assert_eq!(kept.start(), [(1, Role::Live)]);
    }
}
