//! The store, on flash with arbitrary contents.

use core::hint::black_box;

use recipe_store::{
    Adoption, Flash, FlashWord, Geometry, Marks, Put, PutStep, RecordKey, Slot, SlotMarks, SlotTrial, Store,
    Trial, Word, newest,
};

use crate::{any, bytes, out_buf};

/// Flash of unknown size and contents.
pub(crate) struct Any;

impl Flash for Any {
    fn geometry(&self) -> Geometry {
        any(Geometry { sectors: 2, words: 4096 })
    }

    fn read(&self, place: FlashWord) -> Word {
        black_box(place);
        any([0; 32])
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        black_box((place, word));
    }

    async fn erase(&mut self, sector: u8) {
        black_box(sector);
    }
}

pub(crate) fn all() {
    if let Some(mut store) = store_mount() {
        store_questions(black_box(&store));
        store_move(black_box(&store));
        store_changes(black_box(&mut store));
    }
}

#[inline(never)]
fn store_mount() -> Option<Store> {
    Store::mount(&Any).ok()
}

#[inline(never)]
fn store_questions(store: &Store) {
    let mut out = [0; 64];
    black_box(store.get(&Any, any(RecordKey::Image(3)), out_buf(&mut out)));
    black_box(store.image(&Any, any(7), out_buf(&mut out)));
    black_box((store.revisions(), store.revision(any(7)), store.marks(), store.at_start()));
    black_box((store.access_key(&Any), store.counter(any(1)), store.birth_sequence()));
    black_box(store.is_adopted(any(1), any(2)));
}

/// The valid one of two places, and moves.
#[inline(never)]
fn store_move(store: &Store) {
    if let Ok(newest) = newest(&Any, &Any) {
        black_box((newest.store.slots(), newest.store.generation(), newest.side, newest.may_move));
    }
    let mut relocation = store.relocate();
    while !matches!(black_box(relocation.next(&Any, &Any)), PutStep::End(_)) {}
    black_box(relocation.moved().is_some());
}

#[inline(never)]
fn store_changes(store: &mut Store) {
    let trial = any(Some(Trial { number: 3, attempts: 1, confirm_s: 1 }));
    let marks = any(Marks { live: Some(1), trial, ..Marks::default() });
    let _ = store.mark(marks).map(store_put);
    let _ = store.keep(any(1), any(2), bytes(), any(None)).map(store_put);
    let _ = store.put(any(RecordKey::Counter(1)), any(2), bytes()).map(store_put);
    let _ = store.set_access_key(any(&[0; 16])).map(store_put);
    let _ = store.set_counter(any(1), any(2)).map(store_put);
    let on_trial = SlotTrial { slot: Slot::B, attempts: 3, confirm_s: 60, before: 0 };
    let slots = any(SlotMarks { good: Some(Slot::A), trial: Some(on_trial), last: None });
    let _ = store.mark_slots(slots).map(store_put);
    let _ = store.set_birth_sequence(any(1)).map(store_put);
    if let Ok(Adoption::Write(put)) = store.adopt(any(1), bytes()) {
        store_put(put);
    }
}

#[inline(never)]
fn store_put(mut put: Put<'_, '_>) {
    while !matches!(black_box(put.next(&Any)), PutStep::End(_)) {}
}
