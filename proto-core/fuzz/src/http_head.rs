//! Heads of HTTP requests: fields right, repeated and broken, in pieces, against a reader of whole lines.

use recipe_api::request::{HeadBuffer, HeadError, HttpHead, MAX_HEAD, Method};

use crate::source::Source;

const LINES: [&str; 25] = [
    "Host: 127.0.0.1:8480",
    "host:localhost",
    "Host: [::1]:80",
    "Content-Length: 12",
    "content-length: 0",
    "Content-Length: 12, 12",
    "Content-Length: -1",
    "Transfer-Encoding: chunked",
    "Expect: 100-continue",
    "Expect: 200-ok",
    "Origin: http://127.0.0.1:8480",
    "Origin: null",
    "Sec-Fetch-Site: same-origin",
    "Authorization: Bearer 00112233445566778899aabbccddeeff",
    "Content-Type: application/json",
    "If-Match: \"1-c028d264\"",
    "If-None-Match: *",
    "X: y",
    "X:",
    " folded",
    "No colon",
    "Blank : before",
    "Tab:\tand blanks \t ",
    "Two: lines\nfor: some",
    "",
];
const FIRST: [&str; 10] = [
    "GET /api/v1/info HTTP/1.1",
    "POST /api/v1/apply HTTP/1.1",
    "PUT /api/v1/config HTTP/1.1",
    "HEAD /?revision=1&x=&=y HTTP/1.1",
    "OPTIONS * HTTP/1.1",
    "GET /api/v1/info HTTP/1.0",
    "GET http://a/ HTTP/1.1",
    "get / HTTP/1.1",
    "GET  / HTTP/1.1",
    "",
];

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let mut bytes = Vec::new();
    bytes.extend_from_slice(FIRST[input.below(FIRST.len())].as_bytes());
    let mut cuts = Vec::new();
    while !input.is_empty() && bytes.len() < 2 * MAX_HEAD {
        match input.u8() {
            kind @ 0..200 => {
                bytes.extend_from_slice(b"\r\n");
                bytes.extend_from_slice(LINES[usize::from(kind) % LINES.len()].as_bytes());
            }
            200..215 => bytes.extend_from_slice(b"\r\n\r\n"),
            215..235 => cuts.push(bytes.len()),
            235..240 => bytes.extend(std::iter::repeat_n(b'x', usize::from(input.u8()) * 8)),
            240..245 => bytes.push(b'\n'),
            _ => bytes.push(input.u8()),
        }
    }
    bytes.extend_from_slice(b"\r\n\r\nbody");

    let mut buffer = HeadBuffer::new();
    let mut taken = 0;
    let mut start = 0;
    for end in cuts.into_iter().chain([bytes.len()]) {
        let piece = &bytes[start.max(taken)..end.max(taken)];
        let count = buffer.push(piece);
        assert!(count <= piece.len());
        taken = start.max(taken) + count;
        start = end;
        if count < piece.len() {
            break;
        }
    }
    let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").map_or(bytes.len(), |at| at + 4);
    assert_eq!(taken, end.min(MAX_HEAD));
    let mut whole = HeadBuffer::new();
    assert_eq!(whole.push(&bytes), taken);
    assert_eq!(whole.head(), buffer.head(), "cut or whole");
    assert_eq!(buffer.push(b"more"), 0);
    let read = buffer.head();
    if end > MAX_HEAD {
        assert_eq!(read, Err(HeadError::TooLong));
        return;
    }
    assert_ne!(read, Err(HeadError::Incomplete));
    compare(std::str::from_utf8(&bytes[..end]).ok(), read);
}

fn compare(text: Option<&str>, read: Result<HttpHead<'_>, HeadError>) {
    let Some(text) = text else {
        // No field of ours may hold such bytes; another one may.
        return;
    };
    let expected = reference(text);
    match (&expected, &read) {
        (Some(Some(known)), Ok(head)) => {
            assert_eq!(known.method, head.method);
            assert_eq!(known.target, head.target);
            assert_eq!(
                known.fields,
                [
                    Some(head.host),
                    head.origin,
                    head.fetch_site,
                    head.authorization,
                    head.content_type,
                    head.if_match,
                    head.if_none_match,
                ]
            );
            assert_eq!((known.length, known.expects), (head.length, head.expects_continue));
            assert!(head.target.starts_with(head.path()));
        }
        (Some(Some(known)), Err(error)) => panic!("{error:?}, but it is {known:?}"),
        (Some(None), Ok(head)) => panic!("taken: {head:?}"),
        _ => {}
    }
}

#[derive(Debug)]
struct Known<'a> {
    method: Method,
    target: &'a str,
    fields: [Option<&'a str>; 7],
    length: u64,
    expects: bool,
}

const FIELDS: [&str; 7] =
    ["host", "origin", "sec-fetch-site", "authorization", "content-type", "if-match", "if-none-match"];

/// `Some(Some)`: it must be taken. `Some(None)`: it must be refused. `None`: it has characters that this reader
/// does not judge.
fn reference(text: &str) -> Option<Option<Known<'_>>> {
    let lines: Vec<&str> = text.strip_suffix("\r\n\r\n").expect("it is complete").split("\r\n").collect();
    let is_plain = |text: &str| text.bytes().all(|byte| matches!(byte, b' '..=b'~' | b'\t'));
    if lines.iter().any(|line| line.contains(['\n', '\r'])) {
        // The library knows a line end more, a lone LF, which is refused.
        return lines.iter().any(|line| line.contains('\n')).then_some(None);
    }
    if !lines.iter().all(|line| is_plain(line)) {
        return None;
    }
    let words: Vec<&str> = lines[0].split(' ').collect();
    let [method, target, "HTTP/1.1"] = words[..] else { return Some(None) };
    if method.is_empty() || !target.starts_with('/') {
        return Some(None);
    }
    let is_usual = |c: char| c.is_ascii_alphanumeric() || "/?=&._-".contains(c);
    if !method.chars().all(|c| c.is_ascii_alphabetic()) || !target.chars().all(is_usual) {
        return None;
    }
    let mut fields: Vec<(String, &str)> = Vec::new();
    for line in &lines[1..] {
        let Some((name, value)) = line.split_once(':') else { return Some(None) };
        if name.is_empty() || name.contains([' ', '\t']) {
            return Some(None);
        }
        if !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-') {
            return None;
        }
        fields.push((name.to_ascii_lowercase(), value.trim_matches([' ', '\t'])));
    }
    if fields.len() > 32 {
        return Some(None);
    }
    let all = |wanted: &str| {
        fields.iter().filter(|(name, _)| name == wanted).map(|(_, value)| *value).collect::<Vec<_>>()
    };
    let once = |wanted: &str| match all(wanted)[..] {
        [] => Ok(None),
        [one] => Ok(Some(one)),
        _ => Err(()),
    };
    let mut known = [None; 7];
    for (place, name) in known.iter_mut().zip(FIELDS) {
        let Ok(value) = once(name) else { return Some(None) };
        *place = value;
    }
    let (Ok(length), Ok(expect)) = (once("content-length"), once("expect")) else { return Some(None) };
    if !all("transfer-encoding").is_empty() || known[0].is_none() {
        return Some(None);
    }
    let length = match length {
        None => 0,
        Some(digits) if !digits.is_empty() && digits.chars().all(|c| c.is_ascii_digit()) => {
            match digits.parse() {
                Ok(length) => length,
                Err(_) => return Some(None),
            }
        }
        Some(_) => return Some(None),
    };
    let expects = match expect {
        None => false,
        Some(value) if value.eq_ignore_ascii_case("100-continue") => true,
        Some(_) => return Some(None),
    };
    let method = match method {
        "GET" => Method::Get,
        "HEAD" => Method::Head,
        "POST" => Method::Post,
        "PUT" => Method::Put,
        _ => Method::Other,
    };
    Some(Some(Known { method, target, fields: known, length, expects }))
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    vec![
        vec![0, 0],
        vec![1, 1, 215, 3, 10, 215, 13, 14, 8],
        vec![2, 0, 3, 15, 16, 220, 12],
        vec![0, 0, 17, 17, 236, 200, 17],
        vec![0, 0, 236, 255, 200],
        vec![4, 0, 19, 20, 21, 22, 23],
        [vec![0, 0], vec![17; 31]].concat(),
        [vec![0, 0], vec![17; 32]].concat(),
        vec![3, 2, 240, 250, 0xE9],
    ]
}
