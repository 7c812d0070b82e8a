//! Firmware updates: headers, files and slots with arbitrary contents.

use core::fmt;
use core::hint::black_box;

use recipe_store::Slot;
use recipe_update::{
    BoardName, Check, Downgrade, Formats, HEADER, Header, ImageFacts, Machine, PublicKey, Receive,
    ReceiveStep, RunningFirmware, SlotFlash, SlotMarks, SlotTrial, UpdateFile, Version, begin_trial, choose,
    confirm, end_trial, header_of, may_keep,
};

use crate::store::Any;
use crate::{any, bytes};

impl SlotFlash for Any {
    fn whole(&self, place: recipe_store::FlashWord) -> Option<recipe_store::Word> {
        black_box(place);
        any(Some([0; 32]))
    }
}

impl Machine for Any {
    type Flash = Self;

    fn flash(&self, slot: Slot) -> &Self {
        black_box(slot);
        self
    }

    fn mark(&mut self, marks: SlotMarks) -> bool {
        black_box(marks);
        any(true)
    }

    fn passed_over(&mut self, slot: Slot, _: &dyn fmt::Display) {
        black_box(slot);
    }
}

fn marks() -> SlotMarks {
    let trial = SlotTrial { slot: Slot::B, attempts: 3, confirm_s: 60, before: 0 };
    any(SlotMarks { good: Some(Slot::A), trial: Some(trial), last: None })
}

pub(crate) fn all() {
    let Some(board) = update_names() else { return };
    let Some(key) = update_key() else { return };
    update_loader(&board, &key);
    update_marks();
    if let Some(header) = update_header() {
        update_receive(header, board);
        update_rules(&header);
    }
    update_file();
}

#[inline(never)]
fn update_names() -> Option<BoardName> {
    black_box((Version::parse(any("1.2.3")), Formats::new(any(1), any(2), any(3))));
    BoardName::parse(any("nucleo-h743zi"))
}

#[inline(never)]
fn update_key() -> Option<PublicKey> {
    PublicKey::parse(any(&[0; 32]))
}

#[inline(never)]
fn update_header() -> Option<Header> {
    let header = Header::parse(any(&[0; HEADER])).ok()?;
    black_box((header.encode(), header.signed()));
    Some(header)
}

#[inline(never)]
fn update_loader(board: &BoardName, key: &PublicKey) {
    black_box(choose(&mut Any, any(Some(marks())), board, key));
}

#[inline(never)]
fn update_marks() {
    let [now, slot] = [0_u8, 1].map(any);
    black_box((Slot::of_number(slot), begin_trial(marks(), any(Slot::B), any(60), now)));
    black_box((confirm(marks(), any(Slot::B)), end_trial(marks(), any(recipe_update::TrialEnd::Failed))));
}

#[inline(never)]
fn update_rules(header: &Header) {
    let ImageFacts { formats, .. } = *header.parts();
    black_box(may_keep(any(3), &formats, any(Some(&formats)), marks()));
}

#[inline(never)]
fn update_receive(header: Header, board: BoardName) {
    black_box(header_of(&Any, any(Slot::A), &board).is_ok());
    black_box(Check::contents(header).step(&Any, any(128)));
    black_box(Check::damage(header).step(&Any, any(128)));
    let running =
        any(RunningFirmware { board, slot: Slot::A, version: Version::new(0, 1, 0), kept: Some((1, 3)) });
    let begun = Receive::begin(header, &running, marks(), any(Downgrade::Allowed), &Any);
    let Ok(mut receive) = begun else { return };
    loop {
        match black_box(receive.next(&Any)) {
            ReceiveStep::Take { offset } => _ = black_box(receive.take(offset, bytes())),
            ReceiveStep::End(_) => return,
            _ => {}
        }
    }
}

#[inline(never)]
fn update_file() {
    let Ok(file) = UpdateFile::parse(bytes()) else { return };
    black_box(file.link(any(Slot::B)).map(|link| link.check()));
}
