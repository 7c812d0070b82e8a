use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::*;

#[derive(Debug, Clone, PartialEq)]
enum Event {
    Whole(Vec<u8>),
    TooLong,
    BadEscape,
    Cut,
}

fn event(piece: Piece<'_>) -> Event {
    match piece {
        Piece::Whole(bytes) => Event::Whole(bytes.to_vec()),
        Piece::TooLong(_) => Event::TooLong,
        Piece::BadEscape(_) => Event::BadEscape,
        Piece::Cut(_) => Event::Cut,
    }
}

fn feed(cutter: &mut Cutter, bytes: &[u8], tail: &[u8]) -> Vec<Event> {
    let mut rest = bytes;
    let mut events = Vec::new();
    while let Some(piece) = cutter.next_piece(&mut rest, tail) {
        events.push(event(piece));
    }
    assert!(rest.is_empty());
    events
}

fn by_tail() -> Cutter {
    Cutter::new(Boundary::Tail, None).unwrap()
}

fn escaped(escape: Escape) -> Cutter {
    Cutter::new(Boundary::Fields, Some(escape)).unwrap()
}

fn whole(bytes: &[u8]) -> Event {
    Event::Whole(bytes.to_vec())
}

fn stuffed(escape: Escape, frame: &[u8]) -> Vec<u8> {
    let mut out = vec![0xA5; escape.longest(frame.len())];
    out[..frame.len()].copy_from_slice(frame);
    let len = escape.stuff(frame.len(), &mut out).unwrap();
    out.truncate(len);
    out
}

#[test]
fn a_tail_ends_frames_however_they_are_cut() {
    let stream = b"123\r\n\r\nAB\rC\r\n";
    for cut in 0..stream.len() {
        let mut cutter = by_tail();
        let mut events = feed(&mut cutter, &stream[..cut], b"\r\n");
        events.extend(feed(&mut cutter, &stream[cut..], b"\r\n"));
        assert_eq!(events, [whole(b"123\r\n"), whole(b"\r\n"), whole(b"AB\rC\r\n")], "cut at {cut}");
    }
}

#[test]
fn the_last_bytes_of_a_frame_that_was_cut_are_no_frame() {
    let mut cutter = by_tail();
    assert_eq!(feed(&mut cutter, b"40065", b"\r\n"), []);
    assert_eq!(cutter.discard(), 5);
    assert!(!cutter.has_begun());
    // A second silence does not repair it.
    assert_eq!(feed(&mut cutter, b"94", b"\r\n"), []);
    assert_eq!(cutter.discard(), 2);
    assert_eq!(feed(&mut cutter, b"1\r\n4006594\r\n", b"\r\n"), [Event::Cut, whole(b"4006594\r\n")]);
    // Silence between frames has no effect.
    assert_eq!(cutter.discard(), 0);
    assert_eq!(feed(&mut cutter, b"1\r\n", b"\r\n"), [whole(b"1\r\n")]);
}

#[test]
fn a_frame_that_is_too_long_is_told_once() {
    let mut cutter = by_tail();
    let long = [vec![b'x'; 2000], b"\n".to_vec(), b"ok\n".to_vec()].concat();
    assert_eq!(feed(&mut cutter, &long, b"\n"), [Event::TooLong, whole(b"ok\n")]);
}

#[test]
fn silence_ends_a_frame() {
    let mut cutter = Cutter::new(Boundary::Silence, None).unwrap();
    assert_eq!(cutter.silence(), None);
    assert_eq!(feed(&mut cutter, &[1, 2], &[]), []);
    assert_eq!(feed(&mut cutter, &[3], &[]), []);
    assert_eq!(cutter.silence(), Some(Piece::Whole(&[1, 2, 3])));
    assert_eq!(cutter.silence(), None);
    assert_eq!(feed(&mut cutter, &[4; 600], &[]), []);
    assert_eq!(cutter.silence().map(event), Some(Event::TooLong));
    // The bytes up to the next silence are dropped too.
    assert_eq!(feed(&mut cutter, &[5], &[]), []);
    assert_eq!(cutter.discard(), 1);
    assert_eq!(feed(&mut cutter, &[6], &[]), []);
    assert_eq!(cutter.silence(), Some(Piece::Cut(&[6])));
    assert_eq!(feed(&mut cutter, &[7], &[]), []);
    assert_eq!(cutter.silence(), Some(Piece::Whole(&[7])));
}

#[test]
fn escapes_are_those_of_their_standards() {
    // RFC 1055; DLE doubled; the examples of the article on COBS.
    assert_eq!(stuffed(Escape::Slip, &[1, 0xC0, 0xDB]), [0xC0, 1, 0xDB, 0xDC, 0xDB, 0xDD, 0xC0]);
    assert_eq!(stuffed(Escape::Dle, &[1, 0x10, 3]), [0x10, 2, 1, 0x10, 0x10, 3, 0x10, 3]);
    assert_eq!(stuffed(Escape::Cobs, &[0]), [1, 1, 0]);
    assert_eq!(stuffed(Escape::Cobs, &[0, 0]), [1, 1, 1, 0]);
    assert_eq!(stuffed(Escape::Cobs, &[0x11, 0x22, 0, 0x33]), [3, 0x11, 0x22, 2, 0x33, 0]);
    assert_eq!(stuffed(Escape::Cobs, &[0x11, 0, 0, 0]), [2, 0x11, 1, 1, 1, 0]);
    let run: Vec<u8> = (1..=254).collect();
    assert_eq!(stuffed(Escape::Cobs, &run), [&[0xFF], &run[..], &[0]].concat());
    let run: Vec<u8> = (0..=254).collect();
    assert_eq!(stuffed(Escape::Cobs, &run), [&[1, 0xFF], &run[1..], &[0]].concat());
    let run: Vec<u8> = (1..=255).collect();
    assert_eq!(stuffed(Escape::Cobs, &run), [&[0xFF], &run[..254], &[2, 0xFF, 0]].concat());
}

#[test]
fn without_room_nothing_is_stuffed() {
    let mut out = [0xC0; 9];
    assert_eq!((Escape::Slip.stuff(4, &mut out), Escape::Slip.stuff(3, &mut out)), (None, Some(8)));
    assert_eq!(Escape::Dle.stuff(10, &mut [0; 9]), None);
}

#[test]
fn wrong_escapes_are_told_and_the_next_frame_is_taken() {
    let slip = [0xC0, 1, 0xDB, 7, 0xC0, 0xC0, 2, 0xDB, 0xC0, 3, 0xC0];
    let events = feed(&mut escaped(Escape::Slip), &slip, &[]);
    assert_eq!(events, [Event::BadEscape, Event::BadEscape, whole(&[3])]);
    let dle = [9, 0x10, 2, 1, 0x10, 2, 5, 0x10, 3, 8, 0x10, 7, 0x10, 2, 6, 0x10, 9, 6, 0x10, 3];
    let mut cutter = escaped(Escape::Dle);
    assert_eq!(feed(&mut cutter, &dle, &[]), [Event::BadEscape, whole(&[5]), Event::BadEscape]);
    // 9; 8, DLE, 7; and the bytes after the invalid escape.
    assert_eq!(cutter.skipped_bytes(), 1 + 3 + 3);
    let cobs = [5, 1, 2, 0, 2, 7, 0];
    assert_eq!(feed(&mut escaped(Escape::Cobs), &cobs, &[]), [Event::BadEscape, whole(&[7])]);
}

/// Splits the stream at all ends first, then decodes each piece separately.
fn reference(escape: Escape, stream: &[u8]) -> Vec<Event> {
    let mut events = Vec::new();
    match escape {
        Escape::Slip => {
            let pieces: Vec<&[u8]> = stream.split(|&byte| byte == END).collect();
            for piece in &pieces[..pieces.len() - 1] {
                let mut out = Vec::new();
                let mut bad = false;
                let mut rest = *piece;
                while let Some((&byte, after)) = rest.split_first() {
                    rest = after;
                    if byte != ESC {
                        out.push(byte);
                        continue;
                    }
                    match rest.split_first() {
                        Some((&ESC_END, after)) => (rest, _) = (after, out.push(END)),
                        Some((&ESC_ESC, after)) => (rest, _) = (after, out.push(ESC)),
                        other => {
                            bad = true;
                            if let Some((&byte, after)) = other {
                                (rest, _) = (after, out.push(byte));
                            }
                        }
                    }
                }
                match (piece.is_empty(), bad) {
                    (true, _) => {}
                    (_, true) => events.push(Event::BadEscape),
                    _ => events.push(Event::Whole(out)),
                }
            }
        }
        Escape::Cobs => {
            let pieces: Vec<&[u8]> = stream.split(|&byte| byte == 0).collect();
            for piece in pieces[..pieces.len() - 1].iter().filter(|piece| !piece.is_empty()) {
                let (mut out, mut at, mut bad) = (Vec::new(), 0, false);
                while at < piece.len() {
                    let code = usize::from(piece[at]);
                    bad = at + code > piece.len();
                    out.extend(&piece[at + 1..(at + code).min(piece.len())]);
                    at += code;
                    if code < 255 && at < piece.len() {
                        out.push(0);
                    }
                }
                events.push(if bad { Event::BadEscape } else { Event::Whole(out) });
            }
        }
        Escape::Dle => {
            let mut rest = stream;
            while let Some(at) = rest.windows(2).position(|pair| pair == [DLE, STX]) {
                let mut out = Vec::new();
                rest = &rest[at + 2..];
                loop {
                    match *rest {
                        [DLE, DLE, ref after @ ..] => (rest, _) = (after, out.push(DLE)),
                        [DLE, ETX, ref after @ ..] => {
                            events.push(Event::Whole(out));
                            rest = after;
                            break;
                        }
                        [DLE, STX, ..] => {
                            events.push(Event::BadEscape);
                            break;
                        }
                        [DLE, _, ref after @ ..] => {
                            events.push(Event::BadEscape);
                            rest = after;
                            break;
                        }
                        [] | [DLE] => return events,
                        [byte, ref after @ ..] => (rest, _) = (after, out.push(byte)),
                    }
                }
            }
        }
    }
    events
}

fn any_escape() -> impl Strategy<Value = Escape> {
    prop_oneof![Just(Escape::Dle), Just(Escape::Slip), Just(Escape::Cobs)]
}

fn any_byte() -> impl Strategy<Value = u8> {
    prop_oneof![
        2 => any::<u8>(),
        3 => prop::sample::select(vec![0, 1, STX, ETX, DLE, END, ESC, ESC_END, ESC_ESC]),
    ]
}

fn in_chunks(cutter: &mut Cutter, stream: &[u8], sizes: &[usize], tail: &[u8]) -> Vec<Event> {
    let mut events = Vec::new();
    let mut rest = stream;
    for &size in sizes.iter().cycle() {
        if rest.is_empty() {
            return events;
        }
        let (chunk, after) = rest.split_at(size.min(rest.len()));
        events.extend(feed(cutter, chunk, tail));
        rest = after;
    }
    events
}

proptest! {
    #[test]
    fn any_stream_gives_what_the_slow_reference_finds(
        escape in any_escape(),
        stream in prop::collection::vec(any_byte(), 0..300),
        sizes in prop::collection::vec(1_usize..20, 1..20),
    ) {
        let events = in_chunks(&mut escaped(escape), &stream, &sizes, &[]);
        prop_assert_eq!(events, reference(escape, &stream));
    }

    #[test]
    fn what_was_stuffed_comes_back(
        escape in any_escape(),
        frames in prop::collection::vec(prop::collection::vec(any_byte(), 1..510), 1..4),
        sizes in prop::collection::vec(1_usize..20, 1..20),
    ) {
        let stream: Vec<u8> = frames.iter().flat_map(|frame| stuffed(escape, frame)).collect();
        let events = in_chunks(&mut escaped(escape), &stream, &sizes, &[]);
        let frames: Vec<_> = frames.into_iter().map(Event::Whole).collect();
        prop_assert_eq!(events, frames);
    }

    #[test]
    fn a_tail_is_found_as_the_slow_reference_finds_it(
        tail in prop::collection::vec(0_u8..2, 1..9),
        stream in prop::collection::vec(0_u8..2, 0..300),
        sizes in prop::collection::vec(1_usize..20, 1..20),
    ) {
        let (mut expected, mut from) = (Vec::new(), 0);
        for at in 0..=stream.len() {
            if stream[from..at].ends_with(&tail) {
                expected.push(whole(&stream[from..at]));
                from = at;
            }
        }
        let mut cutter = by_tail();
        prop_assert_eq!(in_chunks(&mut cutter, &stream, &sizes, &tail), expected);
        prop_assert_eq!(cutter.held(), &stream[from..]);
    }
}
