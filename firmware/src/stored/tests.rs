use std::vec;
use std::vec::Vec as List;

use embassy_futures::block_on;
use recipe_store::{BLANK, FlashWord, Geometry, Put, Trial, Word};

use super::*;

#[derive(Debug, Clone)]
struct PlainFlash {
    words: List<Word>,
    bytes: List<u8>,
    /// From here on nothing is written.
    is_broken: bool,
    writes: u32,
}

const WORDS: u16 = 256;

impl PlainFlash {
    fn new() -> Self {
        Self { words: vec![BLANK; 2 * usize::from(WORDS)], bytes: List::new(), is_broken: false, writes: 0 }
    }

    fn at(place: FlashWord) -> usize {
        usize::from(place.sector) * usize::from(WORDS) + usize::from(place.word)
    }
}

impl Flash for PlainFlash {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: 2, words: WORDS }
    }

    fn read(&self, place: FlashWord) -> Word {
        self.words[Self::at(place)]
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        self.writes += 1;
        if !self.is_broken {
            self.words[Self::at(place)] = *word;
        }
    }

    async fn erase(&mut self, sector: u8) {
        self.words[usize::from(sector) * usize::from(WORDS)..][..usize::from(WORDS)].fill(BLANK);
    }
}

impl StoreFlash for PlainFlash {
    fn bytes(&mut self, found: FoundRecord) -> Option<&[u8]> {
        self.bytes = self.words[Self::at(found.data)..].as_flattened().get(..found.len)?.to_vec();
        Some(&self.bytes)
    }
}

impl StoredConfig<PlainFlash> {
    fn restart(&mut self) {
        *self = StoredConfig::open(StorePlaces::one(self.flash.clone())).unwrap();
    }

    fn write(&mut self, put: impl FnOnce(&mut Store) -> Put<'_, 'static>) {
        block_on(put(&mut self.store).execute(&mut self.flash)).unwrap();
    }

    /// Numbers and roles of a start.
    fn start(&mut self) -> List<(u32, Role)> {
        self.restart();
        let mut candidates = Vec::new();
        let _ = block_on(self.candidates(&mut candidates));
        candidates.iter().map(|(revision, role)| (revision.number, *role)).collect()
    }
}

fn blank() -> StoredConfig<PlainFlash> {
    StoredConfig::open(StorePlaces::one(PlainFlash::new())).unwrap()
}

#[test]
fn an_image_outside_the_store_is_taken_over_once() {
    let mut stored = blank();
    assert_eq!(stored.start(), []);
    assert!(block_on(stored.adopt(1, b"first")).unwrap());
    assert_eq!(stored.start(), [(1, Role::Live)]);
    let writes = stored.flash.writes;
    assert!(!block_on(stored.adopt(1, b"first")).unwrap());
    assert_eq!(stored.flash.writes, writes, "nothing is written at the other starts");
    // Another one was put there.
    assert!(block_on(stored.adopt(2, b"second")).unwrap());
    assert_eq!(stored.start(), [(2, Role::Live), (1, Role::Previous)]);
    let (revision, _) = stored.store.at_start().candidates[0];
    assert_eq!(stored.image(revision), Some(&b"second"[..]));
    // What was changed in the store since then stays.
    stored.write(|store| store.mark(Marks { live: Some(1), previous: Some(2), ..Marks::default() }).unwrap());
    assert!(!block_on(stored.adopt(2, b"second")).unwrap());
    assert_eq!(stored.start(), [(1, Role::Live), (2, Role::Previous)]);
}

#[test]
fn a_trial_is_counted_before_it_runs_and_can_be_ended() {
    let mut stored = blank();
    block_on(stored.adopt(1, b"first")).unwrap();
    stored.write(|store| store.keep(2, 2, b"second", None).unwrap());
    let trial = Some(Trial { number: 2, attempts: 2, confirm_s: 60 });
    let marks = Marks { live: Some(1), trial, ..Marks::default() };
    stored.write(|store| store.mark(marks).unwrap());
    let on_trial = [(2, Role::Trial { confirm_s: 60 }), (1, Role::Live)];
    assert_eq!(stored.start(), on_trial);
    assert_eq!(stored.store.marks().trial, Some(Trial { number: 2, attempts: 1, confirm_s: 60 }));
    let before = stored.flash.clone();
    block_on(stored.end_trial(TrialEnd::NotConfirmed)).unwrap();
    assert_eq!(stored.store.marks().last, Some((2, TrialEnd::NotConfirmed)));
    assert_eq!(stored.start(), [(1, Role::Live)]);
    // Or it is not ended, but the board starts again and again.
    stored.flash = before;
    assert_eq!(stored.start(), on_trial);
    assert_eq!(stored.start(), [(1, Role::Live)]);
    assert_eq!(stored.start(), [(1, Role::Live)]);
}

#[test]
fn what_is_confirmed_is_live_and_what_is_forgotten_has_no_end() {
    let mut stored = blank();
    block_on(stored.adopt(1, b"first")).unwrap();
    block_on(stored.keep(2, 2, b"second", None)).unwrap();
    block_on(stored.begin_trial(2, 60)).unwrap();
    assert_eq!(stored.start(), [(2, Role::Trial { confirm_s: 60 }), (1, Role::Live)]);
    block_on(stored.make_live(2, Some(1))).unwrap();
    assert_eq!(stored.start(), [(2, Role::Live), (1, Role::Previous)]);
    assert_eq!(stored.store.marks().last, Some((2, TrialEnd::Confirmed)));
    block_on(stored.keep(3, 3, b"third", None)).unwrap();
    block_on(stored.begin_trial(3, 60)).unwrap();
    block_on(stored.end_trial(TrialEnd::TakenBack)).unwrap();
    // In the place of 3, which the mark would name.
    block_on(stored.keep(4, 4, b"fourth", Some(3))).unwrap();
    assert_eq!(stored.store.marks().last, None);
}

#[test]
fn an_image_is_read_in_parts_and_the_key_is_kept() {
    let mut stored = blank();
    let image: List<u8> = (0..1_000_u16).map(|nth| nth as u8).collect();
    block_on(stored.keep(1, 1, &image, None)).unwrap();
    let mut read = List::new();
    let mut buf = [0; 96];
    while let Some(part @ [_, ..]) = stored.image_part(1, read.len(), &mut buf) {
        read.extend_from_slice(part);
    }
    assert_eq!(read, image);
    assert_eq!(stored.image_part(2, 0, &mut buf), None);
    assert_eq!(stored.access_key(), None);
    block_on(stored.set_access_key(&[7; 16])).unwrap();
    stored.restart();
    assert_eq!(stored.access_key(), Some([7; 16]));
}

#[test]
fn what_cannot_be_counted_is_not_tried() {
    let mut stored = blank();
    block_on(stored.adopt(1, b"first")).unwrap();
    stored.write(|store| store.keep(2, 2, b"second", None).unwrap());
    let trial = Some(Trial { number: 2, attempts: 2, confirm_s: 60 });
    stored.write(|store| store.mark(Marks { live: Some(1), trial, ..Marks::default() }).unwrap());
    stored.flash.is_broken = true;
    for _ in 0..5 {
        assert_eq!(stored.start(), [(1, Role::Live)]);
    }
}

#[test]
fn a_store_in_the_bank_of_the_program_is_moved_once() {
    let image = |number: u8| vec![number; 700];
    let mut stored = blank();
    block_on(stored.keep(1, 1, &image(1), None)).unwrap();
    block_on(stored.make_live(1, None)).unwrap();
    let (first, second) = (stored.flash.clone(), PlainFlash::new());
    let open = |own| {
        StoredConfig::open(StorePlaces { first: first.clone(), second: Some(second.clone()), own }).unwrap()
    };
    assert!(!open(Side::First).is_to_be_moved());
    let mut moved = open(Side::Second);
    assert!(moved.is_to_be_moved());
    block_on(moved.move_home()).unwrap();
    assert!(!moved.is_to_be_moved());
    let live = moved.store().revision(1).unwrap();
    assert_eq!(moved.image(live), Some(&image(1)[..]));
    assert_eq!(moved.store().marks().live, Some(1));
    // The next start finds it there, and the firmware before moves it back.
    let second = moved.flash.clone();
    let again = |own| {
        StoredConfig::open(StorePlaces { first: first.clone(), second: Some(second.clone()), own })
            .unwrap()
            .is_to_be_moved()
    };
    assert!(!again(Side::Second) && again(Side::First));
}

#[test]
fn long_images_make_the_oldest_give_way() {
    let mut stored = blank();
    let len = usize::from(WORDS) * WORD / 4;
    for number in 1..=9 {
        block_on(stored.keep(number, number, &vec![number as u8; len], None)).unwrap();
        block_on(stored.make_live(number, stored.store().marks().live)).unwrap();
    }
    let numbers: List<u32> = stored.store().revisions().iter().map(|stored| stored.number).collect();
    assert!(numbers.ends_with(&[8, 9]) && numbers.len() < 8, "{numbers:?}");
    stored.restart();
    assert_eq!(stored.store().marks().live, Some(9));
}
