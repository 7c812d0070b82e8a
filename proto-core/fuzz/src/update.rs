//! Update files and headers of firmware: anything, right ones, and right ones changed (docs/update.md section 3).

use recipe_update::{
    BoardName, FILE_HEAD, Formats, HEADER, Header, ImageFacts, PublicKey, Slot, UpdateFile, Version,
    file_head, link_padding,
};

use crate::image::crc32;
use crate::source::Source;

const SEED: [u8; 32] = [0x42; 32];

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let mut bytes = if input.u8().is_multiple_of(4) { input.run().to_vec() } else { file(&mut input) };
    let mut is_changed = false;
    for _ in 0..input.u8() % 4 {
        if bytes.is_empty() {
            break;
        }
        is_changed = true;
        change(&mut bytes, &mut input);
    }
    // A header may be right behind a file head that is not.
    if let Some(header) = bytes.get(FILE_HEAD..).and_then(|rest| rest.first_chunk::<HEADER>()) {
        check_header(header, is_changed);
    }
    let read = UpdateFile::parse(&bytes);
    let expected = reference(&bytes);
    assert_eq!(read.is_ok(), expected.is_some(), "{read:?}");
    let (Ok(read), Some(expected)) = (read, expected) else { return };
    let links: Vec<(u32, &[u8])> =
        read.links().map(|link| (link.header.slot().number().into(), link.image)).collect();
    let mut sorted = expected.clone();
    sorted.sort_by_key(|(slot, _)| *slot);
    assert_eq!(links, sorted);
    for link in read.links() {
        assert_eq!(link.header.encode(), *link.header_bytes);
        assert!(link.check().is_ok() || is_changed);
    }
}

/// A file with one or two links, most of which belong together.
fn file(input: &mut Source<'_>) -> Vec<u8> {
    let mut links = Vec::new();
    let count = 1 + input.u8() % 3;
    let minor = input.u8();
    for nth in 0..count {
        let slot = Slot::of_number(nth % 2).expect("there are two");
        let minor = if input.u8() == 0xFF { minor ^ 1 } else { minor };
        let parts = ImageFacts {
            board: BoardName::parse("nucleo-h743zi").expect("a name"),
            slot,
            version: Version::new(0, minor.into(), 1),
            formats: Formats::new(1, 3, 3).expect("they fit"),
            store: 1,
        };
        let mut image = input.run().to_vec();
        image.push(nth);
        let header = Header::sign(parts, &image, &SEED).expect("it is not empty");
        links.extend(header.encode());
        links.extend(&image);
        links.resize(links.len() + link_padding(image.len()), 0xFF);
    }
    [&file_head(count.into(), (FILE_HEAD + links.len()) as u32)[..], &links].concat()
}

fn change(bytes: &mut Vec<u8>, input: &mut Source<'_>) {
    let at = usize::from(input.u16()) % bytes.len();
    match input.u8() % 6 {
        0 => bytes.truncate(at),
        1 => bytes.push(input.u8()),
        // A field of the first header, with its CRC made right.
        2 if bytes.len() >= FILE_HEAD + HEADER => {
            let field = FILE_HEAD + 64 + input.below(124);
            bytes[field] = input.u8();
            let crc = crc32(&bytes[FILE_HEAD + 64..FILE_HEAD + 188]);
            bytes[FILE_HEAD + 188..FILE_HEAD + 192].copy_from_slice(&crc.to_le_bytes());
        }
        // The length that it says.
        3 if bytes.len() >= FILE_HEAD => {
            let len = bytes.len() as u32;
            bytes[12..16].copy_from_slice(&len.to_le_bytes());
        }
        // The filler behind the last image.
        4 => {
            let last = bytes.len() - 1;
            bytes[last.saturating_sub(at % 32)] ^= 1 << input.below(8);
        }
        _ => bytes[at] ^= 1 << input.below(8),
    }
}

fn check_header(bytes: &[u8; HEADER], is_changed: bool) {
    let read = Header::parse(bytes);
    assert_eq!(read.is_ok(), is_header(bytes), "{read:?}");
    let Ok(header) = read else { return };
    assert_eq!(header.encode(), *bytes);
    assert!(header.verify(&PublicKey::of_seed(&SEED)).is_ok() || is_changed);
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

/// The table of section 3, line by line.
fn is_header(bytes: &[u8]) -> bool {
    let board = &bytes[80..96];
    let name: Vec<u8> = board.iter().copied().take_while(|byte| *byte != 0).collect();
    let is_name = !name.is_empty()
        && name.iter().all(|byte| b"abcdefghijklmnopqrstuvwxyz0123456789-".contains(byte))
        && board[name.len()..].iter().all(|byte| *byte == 0);
    let (oldest, newest, written) = (u32_at(bytes, 168), u32_at(bytes, 172), u32_at(bytes, 176));
    bytes[64..68] == *b"RGFW"
        && u32_at(bytes, 68) == 1
        && u32_at(bytes, 72) < 2
        && u32_at(bytes, 76) > 0
        && is_name
        && bytes[166..168] == [0, 0]
        && (oldest..=newest).contains(&written)
        && u32_at(bytes, 188) == crc32(&bytes[64..188])
}

/// Slot and image of each link, if it is a file.
fn reference(bytes: &[u8]) -> Option<Vec<(u32, &[u8])>> {
    let is_file = bytes.len() >= 16
        && bytes[..4] == *b"RGUP"
        && u32_at(bytes, 4) == 1
        && (1..=2).contains(&u32_at(bytes, 8))
        && u32_at(bytes, 12) as usize == bytes.len();
    if !is_file {
        return None;
    }
    let (mut links, mut at) = (Vec::new(), 16);
    let mut first: Option<Vec<u8>> = None;
    for _ in 0..u32_at(bytes, 8) {
        let header = bytes.get(at..at + 192).filter(|header| is_header(header))?;
        // Board, version, formats and store are those of one firmware.
        let common = [&header[80..96], &header[160..184]].concat();
        if *first.get_or_insert(common.clone()) != common {
            return None;
        }
        let (slot, len) = (u32_at(header, 72), u32_at(header, 76) as usize);
        let image = bytes.get(at + 192..at + 192 + len)?;
        let end = at + 192 + len.next_multiple_of(32);
        if bytes.get(at + 192 + len..end)?.iter().any(|byte| *byte != 0xFF) {
            return None;
        }
        if links.iter().any(|(other, _)| *other == slot) {
            return None;
        }
        links.push((slot, image));
        at = end;
    }
    (at == bytes.len()).then_some(links)
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let image = [0x81, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16];
    let mut seeds = vec![[&[1, 1, 3, 0][..], &image, &[0], &image, &[0]].concat()];
    for change in 0..6_u8 {
        for at in [0_u8, 4, 8, 12, 16, 80, 84, 100, 200, 230] {
            seeds.push(
                [&[1, 1, 3, 0][..], &image, &[0], &image, &[2, at, 0, change, at, 1, 12, 1, 3, 0]].concat(),
            );
        }
    }
    seeds.push([&[1, 0, 3, 0xFF][..], &image].concat());
    seeds.push([&[1, 2, 3, 0][..], &image, &[0], &image, &[0], &image].concat());
    seeds
}
