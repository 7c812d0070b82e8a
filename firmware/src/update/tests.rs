use std::vec;
use std::vec::Vec;

use embassy_futures::block_on;
use recipe_store::{BLANK, Flash, FlashWord, Geometry, SlotTrial, WORD, Word};
use recipe_update::{ImageFacts, TrialEnd};

use super::*;

const WORDS: u16 = 128;
const SEED: [u8; 32] = [7; 32];
const GOOD_A: SlotMarks = SlotMarks { good: Some(Slot::A), trial: None, last: None };

/// The other slot: three sectors of 4 KiB.
#[derive(Debug)]
struct Ram {
    words: Vec<Word>,
    erases: usize,
    /// Writes of this word are lost.
    worn: Option<usize>,
}

impl Ram {
    fn at(place: FlashWord) -> usize {
        usize::from(place.sector) * usize::from(WORDS) + usize::from(place.word)
    }
}

impl Flash for Ram {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: 3, words: WORDS }
    }

    fn read(&self, place: FlashWord) -> Word {
        self.words[Self::at(place)]
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        let at = Self::at(place);
        assert_eq!(self.words[at], BLANK, "written twice: {place:?}");
        if self.worn != Some(at) {
            self.words[at] = *word;
        }
    }

    async fn erase(&mut self, sector: u8) {
        self.erases += 1;
        self.words[usize::from(sector) * usize::from(WORDS)..][..usize::from(WORDS)].fill(BLANK);
    }
}

impl SlotFlash for Ram {
    fn whole(&self, place: FlashWord) -> Option<Word> {
        Some(self.read(place))
    }
}

/// A slot of which nothing is known.
fn unknown() -> Ram {
    Ram { words: vec![[0; WORD]; 3 * usize::from(WORDS)], erases: 0, worn: None }
}

fn board() -> Updates<Ram> {
    let key = PublicKey::of_seed(&SEED).bytes();
    let slots = Slots { running: Slot::A, key, own: unknown(), free: unknown() };
    Updates::new(Site { board: "test", slots: Ok(slots) }).unwrap()
}

fn image() -> Vec<u8> {
    (0..9_001_u32).map(|at| (at % 251) as u8).collect()
}

fn header(seed: &[u8; 32]) -> Header {
    let parts = ImageFacts {
        board: BoardName::parse("test").unwrap(),
        slot: Slot::B,
        version: VERSION,
        formats: FORMATS,
        store: recipe_store::VERSION,
    };
    Header::sign(parts, &image(), seed).unwrap()
}

fn put(updates: &mut Updates<Ram>, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
    block_on(updates.take(offset, bytes, Some((FORMATS.oldest, FORMATS.newest)), GOOD_A, Downgrade::Refused))
}

fn stage(updates: &Updates<Ram>) -> (UpdateStage, u32) {
    let incoming = updates.incoming().unwrap();
    (incoming.stage, incoming.received)
}

fn work(updates: &mut Updates<Ram>) {
    while updates.is_working() {
        block_on(updates.work());
    }
}

/// Sends what is missing in pieces of this length.
fn send(updates: &mut Updates<Ram>, piece: usize) -> Result<(), UpdateError> {
    for (bytes, at) in image().chunks(piece).zip((HEADER..).step_by(piece)) {
        if at as u32 >= stage(updates).1 {
            put(updates, at as u32, bytes)?;
        }
    }
    work(updates);
    Ok(())
}

#[test]
fn a_firmware_comes_in_pieces_and_is_whole() {
    for piece in [1_000, 4_096, 9_001] {
        let mut updates = board();
        put(&mut updates, 0, &header(&SEED).encode()).unwrap();
        assert_eq!(stage(&updates), (UpdateStage::Erasing, HEADER as u32));
        assert_eq!(put(&mut updates, HEADER as u32, &image()[..64]), Err(UpdateError::Busy));
        work(&mut updates);
        send(&mut updates, piece).unwrap();
        assert_eq!(stage(&updates), (UpdateStage::Ready, whole_length(&header(&SEED))));
        assert_eq!(updates.ready(None, GOOD_A, Downgrade::Refused), Ok(header(&SEED)));
        assert_eq!(updates.verify(&header(&SEED)), Ok(()));
    }
}

#[test]
fn a_short_firmware_is_ready_with_its_last_piece() {
    let mut updates = board();
    let image = &image()[..24];
    let head = Header::sign(*header(&SEED).parts(), image, &SEED).unwrap();
    put(&mut updates, 0, &head.encode()).unwrap();
    work(&mut updates);
    put(&mut updates, HEADER as u32, image).unwrap();
    assert_eq!(stage(&updates), (UpdateStage::Ready, whole_length(&head)));
    assert_eq!(updates.ready(None, GOOD_A, Downgrade::Refused), Ok(head));
}

#[test]
fn a_lost_connection_goes_on_and_nothing_is_erased_again() {
    let mut updates = board();
    let head = header(&SEED).encode();
    put(&mut updates, 0, &head).unwrap();
    work(&mut updates);
    put(&mut updates, HEADER as u32, &image()[..5_000]).unwrap();
    assert_eq!(put(&mut updates, 400, &image()[..64]), Err(UpdateError::Gap { expected: 5_192 }));
    let erased = updates.slots.as_ref().unwrap().free.erases;
    put(&mut updates, 0, &head).unwrap();
    assert_eq!(stage(&updates), (UpdateStage::Receiving, 5_192));
    put(&mut updates, 5_192, &image()[5_000..]).unwrap();
    work(&mut updates);
    assert_eq!(stage(&updates).0, UpdateStage::Ready);
    // Also after a restart: it is in its slot.
    let slots = updates.slots.unwrap();
    assert_eq!(slots.free.erases, erased);
    let mut updates = Updates::new(Site { board: "test", slots: Ok(slots) }).unwrap();
    put(&mut updates, 0, &head).unwrap();
    assert_eq!(stage(&updates).0, UpdateStage::Ready);
    assert_eq!(updates.slots.as_ref().unwrap().free.erases, erased);
}

#[test]
fn what_is_wrong_is_refused_and_says_why() {
    let mut updates = board();
    assert_eq!(put(&mut updates, 192, &[1]), Err(UpdateError::NoHeader));
    assert_eq!(put(&mut updates, 0, &[1]), Err(UpdateError::Alone));
    assert!(matches!(put(&mut updates, 0, &[1; HEADER]), Err(UpdateError::Header(_))));
    let trial = Some(SlotTrial { slot: Slot::A, attempts: 1, confirm_s: 60, before: 0 });
    let marks = SlotMarks { trial, ..GOOD_A };
    let head = header(&SEED).encode();
    let on_trial = block_on(updates.take(0, &head, None, marks, Downgrade::Refused));
    assert_eq!(on_trial, Err(UpdateError::Rule(recipe_update::UpdateRefused::OnTrial)));
    let kept = block_on(updates.take(0, &head, Some((FORMATS.oldest, 99)), GOOD_A, Downgrade::Refused));
    assert!(matches!(kept, Err(UpdateError::Rule(recipe_update::UpdateRefused::Format { kept: 99, .. }))));
    assert_eq!(updates.slots.as_ref().unwrap().free.erases, 0, "nothing was erased");
    assert_eq!(updates.ready(None, GOOD_A, Downgrade::Refused), Err(UpdateError::NotReady));
    // Changed on the way.
    put(&mut updates, 0, &head).unwrap();
    work(&mut updates);
    let mut changed = image();
    changed[4_000] ^= 1;
    put(&mut updates, HEADER as u32, &changed).unwrap();
    work(&mut updates);
    assert!(matches!(stage(&updates).0, UpdateStage::Failed(_)), "{:?}", stage(&updates));
    assert_eq!(updates.ready(None, GOOD_A, Downgrade::Refused), Err(UpdateError::NotReady));
    // It begins anew.
    put(&mut updates, 0, &head).unwrap();
    work(&mut updates);
    send(&mut updates, 3_000).unwrap();
    assert_eq!(stage(&updates).0, UpdateStage::Ready);
    // Of another key.
    let foreign = header(&[9; 32]);
    put(&mut updates, 0, &foreign.encode()).unwrap();
    work(&mut updates);
    send(&mut updates, 3_000).unwrap();
    assert_eq!(updates.verify(&foreign), Err(UpdateError::Foreign));
}

#[test]
fn flash_that_keeps_nothing_is_noticed() {
    let mut updates = board();
    updates.slots.as_mut().unwrap().free.worn = Some(40);
    put(&mut updates, 0, &header(&SEED).encode()).unwrap();
    work(&mut updates);
    let worn = UpdateError::Failed(ReceiveError::Worn(FlashWord { sector: 0, word: 40 }));
    assert_eq!(put(&mut updates, HEADER as u32, &image()), Err(worn));
    let received = stage(&updates).1;
    assert_eq!(put(&mut updates, received, &[1]), Err(worn));
}

#[test]
fn a_board_without_slots_says_why() {
    let mut updates: Updates<Ram> = Updates::new(Site { board: "test", slots: Err("no loader") }).unwrap();
    assert_eq!(put(&mut updates, 0, &header(&SEED).encode()), Err(UpdateError::Cannot("no loader")));
    assert_eq!(updates.cannot(), Some("no loader"));
    assert_eq!(updates.may_keep(3, GOOD_A), Ok(()));
}

#[test]
fn during_a_trial_only_what_the_firmware_before_reads_is_kept() {
    let mut updates = board();
    put(&mut updates, 0, &header(&SEED).encode()).unwrap();
    work(&mut updates);
    send(&mut updates, 4_096).unwrap();
    let trial = Some(SlotTrial { slot: Slot::A, attempts: 1, confirm_s: 60, before: 0 });
    let marks = SlotMarks { good: Some(Slot::B), trial, last: Some((Slot::A, TrialEnd::Failed)) };
    assert_eq!(updates.may_keep(FORMATS.newest, marks), Ok(()));
    assert_eq!(updates.may_keep(FORMATS.newest + 1, marks), Err(UpdateError::Format(FORMATS.newest + 1)));
}

#[test]
fn a_trial_is_confirmed_once_all_is_as_before_for_ten_seconds() {
    let at = |seconds: u64| Instant::from_secs(100 + seconds);
    let before = Works { links: 2, ports: 1 };
    assert_eq!(Works::of_code(before.code()), before);
    let mut trial = FirmwareTrial::new(at(0), 60, before);
    let none = Works::default();
    assert_eq!(trial.look(at(1), none, true), TrialVerdict::Waits(WaitsFor::Controller));
    assert_eq!(trial.look(at(2), Works { ports: 0, ..before }, true), TrialVerdict::Waits(WaitsFor::Ports));
    assert_eq!(trial.look(at(3), before, false), TrialVerdict::Waits(WaitsFor::Request));
    assert_eq!(trial.look(at(4), before, true), TrialVerdict::Waits(WaitsFor::Time));
    assert_eq!(trial.look(at(13), before, true), TrialVerdict::Waits(WaitsFor::Time));
    // Once more from the beginning.
    assert_eq!(trial.look(at(14), none, true), TrialVerdict::Waits(WaitsFor::Controller));
    assert_eq!(trial.look(at(15), before, true), TrialVerdict::Waits(WaitsFor::Time));
    assert_eq!(trial.look(at(25), Works { ports: 3, ..before }, true), TrialVerdict::Confirmed);
    let mut trial = FirmwareTrial::new(at(0), 60, before);
    assert_eq!(trial.look(at(59), none, true), TrialVerdict::Waits(WaitsFor::Controller));
    assert_eq!(trial.look(at(60), none, true), TrialVerdict::Over);
}
