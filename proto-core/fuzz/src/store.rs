//! What a board keeps in flash: any contents, then changes with words that are not kept and power cuts
//! (docs/store.md).

use std::collections::BTreeMap;

use recipe_store::{
    Adoption, BLANK, Flash, FlashWord, Geometry, MAX_DATA, Marks, MountError, Put, PutStep, RecordKey, Store,
    Trial, WORD, Word,
};

use crate::image::crc32;
use crate::source::Source;

/// By their numbers on the flash.
const KEYS: [RecordKey; 18] = [
    RecordKey::Image(0),
    RecordKey::Image(1),
    RecordKey::Image(2),
    RecordKey::Image(3),
    RecordKey::Image(4),
    RecordKey::Image(5),
    RecordKey::Image(6),
    RecordKey::Image(7),
    RecordKey::Marks,
    RecordKey::Access,
    RecordKey::BirthSequence,
    RecordKey::Adopted,
    RecordKey::Counter(0),
    RecordKey::Counter(1),
    RecordKey::Counter(2),
    RecordKey::Edge,
    RecordKey::Slots,
    RecordKey::Generation,
];

/// Value and data of each key.
type Held = BTreeMap<usize, (u64, Vec<u8>)>;

struct Nor {
    geometry: Geometry,
    words: Vec<Word>,
    /// One write of so many leaves a word that cannot be read.
    fails_of: u32,
    writes: u32,
}

impl Nor {
    fn at(&self, place: FlashWord) -> usize {
        assert!(place.sector < self.geometry.sectors && place.word < self.geometry.words, "{place:?}");
        usize::from(place.sector) * usize::from(self.geometry.words) + usize::from(place.word)
    }

    fn sector(&self, sector: u8) -> &[Word] {
        let words = usize::from(self.geometry.words);
        &self.words[usize::from(sector) * words..][..words]
    }

    fn do_write(&mut self, place: FlashWord, word: &Word) {
        let at = self.at(place);
        assert_eq!(self.words[at], BLANK, "a word is written twice: {place:?}");
        self.writes += 1;
        let fails = self.fails_of > 0 && self.writes.is_multiple_of(self.fails_of);
        self.words[at] = if fails { [0; WORD] } else { *word };
    }

    fn do_erase(&mut self, sector: u8) {
        let (at, words) = (self.at(FlashWord { sector, word: 0 }), usize::from(self.geometry.words));
        self.words[at..at + words].fill(BLANK);
    }
}

impl Flash for Nor {
    fn geometry(&self) -> Geometry {
        self.geometry
    }

    fn read(&self, place: FlashWord) -> Word {
        self.words[self.at(place)]
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        self.do_write(place, word);
    }

    async fn erase(&mut self, sector: u8) {
        self.do_erase(sector);
    }
}

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let geometry = Geometry { sectors: 2 + input.u8() % 3, words: 8 + u16::from(input.u8() % 64) };
    let blank = vec![BLANK; usize::from(geometry.sectors) * usize::from(geometry.words)];
    let mut flash = Nor { geometry, words: blank, fails_of: 0, writes: 0 };
    let mut is_ours = true;
    for _ in 0..input.u8() % 32 {
        is_ours = false;
        fill(&mut flash, &mut input);
    }
    flash.fails_of = match input.u8() {
        few @ 1..=40 => u32::from(few) + 2,
        _ => 0,
    };
    let mut left = 48;
    while let Some(mut store) = mounted(&flash) {
        let held = held_by(&store, &flash);
        if input.is_empty() || left == 0 {
            return;
        }
        left -= 1;
        change(&mut store, &mut flash, &mut input, &held, is_ours);
        if input.u8() & 1 == 1 {
            // Without a restart between.
            let held = held_by(&store, &flash);
            change(&mut store, &mut flash, &mut input, &held, is_ours);
        }
    }
}

/// Puts something into the flash: heads, records, noise.
fn fill(flash: &mut Nor, input: &mut Source<'_>) {
    let (kind, sector) = (input.u8(), input.u8() % flash.geometry.sectors);
    let word = u16::from(input.u8()) % flash.geometry.words;
    let at = flash.at(FlashWord { sector, word });
    match kind % 8 {
        0..=2 => {
            let version = if kind & 0x80 == 0 { 1_u32 } else { u32::from(input.u8()) };
            let parts = [*b"RGSs", version.to_le_bytes(), sequence(input).to_le_bytes()];
            let at = flash.at(FlashWord { sector, word: 0 });
            flash.words[at] = sealed(&parts.concat());
        }
        3..=5 => {
            let (key, sequence, tag) = (u32::from(input.u8() % 20), sequence(input), input.u64());
            let data = input.run();
            let mut padded = data.to_vec();
            padded.resize(data.len().next_multiple_of(WORD), 0);
            let len = if kind & 0x80 == 0 { data.len() as u32 } else { input.u32() };
            let head = [&b"RGSr"[..], &sequence.to_le_bytes(), &key.to_le_bytes(), &len.to_le_bytes()];
            let head = [&head.concat()[..], &tag.to_le_bytes(), &crc32(&padded).to_le_bytes()].concat();
            let words = padded.chunks(WORD).map(|part| part.try_into().expect("whole words"));
            let record = std::iter::once(sealed(&head)).chain(words).chain([sealed(&head)]);
            for (slot, word) in flash.words[at..].iter_mut().zip(record) {
                *slot = word;
            }
        }
        6 => flash.words[at] = [0; WORD],
        _ => flash.words[at][input.below(WORD)] ^= 1 << input.below(8),
    }
}

/// Small ones, and the largest.
fn sequence(input: &mut Source<'_>) -> u32 {
    match input.u8() {
        small @ 0..0xF0 => u32::from(small),
        large => u32::MAX - u32::from(large - 0xF0),
    }
}

fn sealed(head: &[u8]) -> Word {
    let mut word = [0; WORD];
    word[..head.len()].copy_from_slice(head);
    let check = crc32(&word[..28]);
    word[28..].copy_from_slice(&check.to_le_bytes());
    word
}

/// The store of this flash, which holds what section 2 of the page says. `None` if it is another version's.
fn mounted(flash: &Nor) -> Option<Store> {
    let read = Store::mount(flash);
    match (reference(flash), read) {
        (Ok(held), Ok(store)) => {
            assert_eq!(held_by(&store, flash), held);
            Some(store)
        }
        (Err(found), Err(error)) => {
            assert_eq!(error, MountError::Version { found });
            None
        }
        (held, read) => panic!("{held:?}, and read {read:?}"),
    }
}

fn held_by(store: &Store, flash: &Nor) -> Held {
    let mut room = vec![0xA5; MAX_DATA];
    let mut held = Held::new();
    for (code, key) in KEYS.into_iter().enumerate() {
        let Some(found) = store.find(key) else { continue };
        let data = store.get(flash, key, &mut room).expect("there is room").to_vec();
        assert_eq!(data.len(), found.len);
        assert_eq!(store.get(flash, key, &mut room[..found.len.saturating_sub(1)]).is_some(), found.len == 0);
        held.insert(code, (found.tag, data));
    }
    held
}

fn u32_at(word: &Word, at: usize) -> u32 {
    u32::from_le_bytes(word[at..at + 4].try_into().expect("four bytes"))
}

/// The page's section 2, read word by word; or the version of a sector that has another one.
fn reference(flash: &Nor) -> Result<Held, u32> {
    let is_sealed = |word: &Word| u32_at(word, 28) == crc32(&word[..28]);
    let mut sectors: Vec<(u32, u8)> = Vec::new();
    for sector in 0..flash.geometry.sectors {
        let head = &flash.sector(sector)[0];
        if head.starts_with(b"RGSs") && is_sealed(head) {
            if u32_at(head, 4) != 1 {
                return Err(u32_at(head, 4));
            }
            sectors.push((u32_at(head, 8), sector));
        }
    }
    sectors.sort();
    sectors.dedup_by_key(|(sequence, _)| *sequence);
    let mut newest: BTreeMap<usize, (u32, u64, Vec<u8>)> = BTreeMap::new();
    for (_, sector) in sectors {
        let mut rest = &flash.sector(sector)[1..];
        while let Some((head, behind)) = rest.split_first() {
            rest = behind;
            let (key, len) = (u32_at(head, 8) as usize, u32_at(head, 12) as usize);
            let words = len.div_ceil(WORD);
            let is_head = head.starts_with(b"RGSr") && is_sealed(head) && key < 18 && len <= MAX_DATA;
            if !is_head || words + 1 > behind.len() {
                continue;
            }
            let (data, end) = behind.split_at(words);
            rest = &end[1..];
            let (sequence, mut data) = (u32_at(head, 4), data.concat());
            let is_whole = end[0] == *head && crc32(&data) == u32_at(head, 24);
            if is_whole && newest.get(&key).is_none_or(|(before, ..)| sequence >= *before) {
                data.truncate(len);
                let tag = u64::from(u32_at(head, 20)) << 32 | u64::from(u32_at(head, 16));
                newest.insert(key, (sequence, tag, data));
            }
        }
    }
    Ok(newest.into_iter().map(|(key, (_, tag, data))| (key, (tag, data))).collect())
}

/// One change, which may be cut. In a flash that only the store has written, everything else stays.
fn change(store: &mut Store, flash: &mut Nor, input: &mut Source<'_>, held: &Held, is_ours: bool) {
    let kind = input.u8();
    let cut = match input.u8() {
        at @ 0..64 => Some(u32::from(at)),
        _ => None,
    };
    let numbers: Vec<u32> = store.revisions().iter().map(|kept| kept.number).collect();
    assert!(numbers.is_sorted_by(|one, next| one < next), "{numbers:?}");
    let mut number = || match input.u8() {
        none @ 0..32 => (none & 1 == 1).then_some(u32::from(none)),
        some => numbers.get(usize::from(some) % 9).copied(),
    };
    let begun = match kind % 8 {
        0..=2 => {
            let code = usize::from(kind >> 3) % KEYS.len();
            let (tag, data) = (input.u64(), input.run());
            let new = (code, (tag, data.to_vec()));
            store.put(KEYS[code], tag, data).ok().map(|put| (put, Some(new)))
        }
        3..=4 => {
            let (forget, digest) = (number(), input.u32());
            let next = numbers.last().map_or(1, |last| last.saturating_add(u32::from(kind >> 7)));
            store.keep(next, digest, input.run(), forget).ok().map(|put| (put, None))
        }
        5 => {
            let (live, previous, trial) = (number(), number(), number());
            let trial =
                trial.map(|number| Trial { number, attempts: input.u8() % 4, confirm_s: input.u16() });
            // Some name one whose trial has ended; a wrong number is refused like the others.
            let ways = [
                recipe_store::TrialEnd::Confirmed,
                recipe_store::TrialEnd::NotConfirmed,
                recipe_store::TrialEnd::TakenBack,
                recipe_store::TrialEnd::Failed,
            ];
            let last = match kind >> 3 & 1 {
                1 => live.map(|number| (number, ways[usize::from(kind >> 4) % ways.len()])),
                _ => None,
            };
            let marks = Marks { live, previous, trial, last };
            let put = store.mark(marks).ok();
            let put = put.map(|put| (put, None));
            if put.is_some() {
                assert!([live, previous].iter().flatten().all(|number| numbers.contains(number)));
            }
            put
        }
        6 => {
            let marks = store.at_start().marks;
            marks.and_then(|marks| store.mark(marks).ok()).map(|put| (put, None))
        }
        _ => match store.adopt(input.u32(), input.run()) {
            Ok(Adoption::Write(put)) => Some((put, None)),
            Ok(Adoption::Done) | Err(_) => None,
        },
    };
    let Some((put, new)) = begun else {
        return assert_eq!(held_by(store, flash), *held, "nothing was begun");
    };
    let ended = carry_out(put, flash, cut);
    let now = match ended {
        Ended::Cut => match Store::mount(flash) {
            Ok(again) => {
                *store = again;
                held_by(store, flash)
            }
            // Only of what was there at the beginning.
            Err(_) => return assert!(!is_ours),
        },
        _ => held_by(store, flash),
    };
    if let (Ended::Well, Some((code, new))) = (&ended, &new) {
        assert_eq!(now.get(code), Some(new), "what was written");
    }
    if !is_ours {
        return;
    }
    let changed: Vec<usize> = (0..KEYS.len()).filter(|code| now.get(code) != held.get(code)).collect();
    assert!(changed.len() <= 1, "{changed:?} changed at once");
    if let (Some((code, new)), [changed]) = (&new, &changed[..]) {
        assert_eq!((code, now.get(changed)), (changed, Some(new)), "old or new");
    }
    if ended == Ended::Badly {
        assert!(changed.is_empty(), "it said that it failed");
    }
}

#[derive(Debug, PartialEq, Eq)]
enum Ended {
    Well,
    Badly,
    Cut,
}

fn carry_out(mut put: Put<'_, '_>, flash: &mut Nor, cut: Option<u32>) -> Ended {
    let Geometry { sectors, words } = flash.geometry;
    // Each sector once, erased and filled; some records again, and some erases.
    let most = (u32::from(sectors) + 9) * (u32::from(words) + 4);
    for nth in 0.. {
        assert!(nth <= most, "a change that does not end");
        if cut == Some(nth) {
            return Ended::Cut;
        }
        match put.next(flash) {
            PutStep::Erase(sector) => flash.do_erase(sector),
            PutStep::Write(place, word) => flash.do_write(place, &word),
            PutStep::End(Ok(())) => return Ended::Well,
            PutStep::End(Err(_)) => return Ended::Badly,
        }
    }
    unreachable!("it is counted")
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    // Nothing is there: counters and images until sectors are full, without and with cuts and failing words.
    let counters = [0x60, 0xFF, 1, 2, 3, 4, 5, 6, 7, 8, 0, 0];
    let images = [0x83, 0xFF, 0x40, 1, 2, 3, 4, 40].into_iter().chain([0x5A; 40]).chain([0]);
    let images: Vec<u8> = images.collect();
    let marks = [5, 0xFF, 0x40, 0x41, 0x42, 2, 60, 0, 0, 6, 0xFF, 0];
    let adopted = [7, 0xFF, 1, 2, 3, 4, 3, 9, 9, 9, 0];
    let mut seeds = Vec::new();
    for geometry in [[0, 0], [1, 24], [2, 63]] {
        for fails in [0, 5, 17] {
            let head = [&geometry[..], &[0, fails]].concat();
            seeds.push([&head[..], &counters.repeat(12)].concat());
            seeds.push([&head[..], &images, &images, &images, &marks, &images, &marks].concat());
            seeds.push([&head[..], &adopted, &adopted, &adopted, &marks].concat());
            for cut in [0, 1, 2, 3, 5, 8] {
                let mut cut_images = images.clone();
                cut_images[1] = cut;
                seeds.push([&head[..], &images, &cut_images, &counters, &cut_images, &marks].concat());
            }
        }
    }
    // What is there: heads with records behind, another version, noise.
    let head = [0, 0, 0, 3];
    let record = [3, 0, 1, 0, 7, 1, 0, 0, 0, 9, 0, 0, 0, 5, 1, 2, 3, 4, 5];
    let marked = [4, 0, 5, 8, 9, 0, 0xFF, 0xFF, 0, 0, 0, 0, 0, 0];
    seeds.push([&[1, 24, 3][..], &head, &record, &marked, &[0], &counters, &images].concat());
    seeds.push([&[0, 8, 2][..], &[0x80, 1, 0, 2, 1], &record, &[0], &counters].concat());
    seeds
        .push([&[0, 8, 3][..], &[0, 0, 0, 0xFF], &[0, 1, 0, 0xF0], &record, &[0], &images, &images].concat());
    seeds.push([&[2, 8, 4][..], &head, &[6, 0, 3], &[7, 0, 2, 5, 5], &record, &[0], &counters].concat());
    seeds
}
