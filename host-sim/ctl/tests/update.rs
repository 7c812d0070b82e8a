//! `ctl update` against a board that is a thread: its answers are those of docs/api.md section 9.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use recipe_api::key::Hex;
use recipe_ctl::update::{Downgrade, Plan, update};
use recipe_ctl::{Client, Failure, Stop, Update, Verdict};
use recipe_update::{
    BoardName, FILE_HEAD, Formats, HEADER, Header, ImageFacts, PublicKey, Slot, Version, file_head,
    link_padding,
};

const SEED: [u8; 32] = [7; 32];

/// What the board has, and how it fails.
#[derive(Default)]
struct Board {
    header: Vec<u8>,
    image: Vec<u8>,
    length: usize,
    slot_b: bool,
    on_trial: bool,
    confirmed: bool,
    /// This many requests are cut off.
    lost: usize,
    /// Links that are up on trial.
    links: usize,
    /// It runs this build of 0.3.0.
    build: Option<&'static str>,
    requests: Vec<String>,
}

impl Board {
    fn document(&self) -> String {
        let key: String =
            PublicKey::of_seed(&SEED).bytes().iter().map(|byte| format!("{byte:02x}")).collect();
        let slot = if self.slot_b { "B" } else { "A" };
        let mut text = format!(
            "{{\"board\":\"nucleo-h743zi\",\"version\":\"0.2.0\",\"slot\":\"{slot}\",\"key\":\"{key}\""
        );
        if let Some(digits) = self.build {
            text = text.replace("0.2.0", "0.3.0") + &format!(",\"sha512\":\"{digits}\"");
        }
        if self.on_trial {
            text += ",\"trial\":{\"left_s\":50.5,\"waits_for\":\"time\"}";
        }
        if self.confirmed {
            text += ",\"last\":{\"slot\":\"B\",\"ended\":\"confirmed\"}";
        }
        if !self.header.is_empty() && !self.slot_b {
            let received = HEADER + self.image.len();
            let state = if received == self.length { "ready" } else { "receiving" };
            text += &format!(
                ",\"incoming\":{{\"state\":\"{state}\",\"version\":\"0.3.0\",\"sha512\":\"00\",\"length\":{},\"received\":{received}}}",
                self.length
            );
        }
        text + "}"
    }

    fn answer(&mut self, line: &str, body: &[u8]) -> (u16, String) {
        self.requests.push(line.to_owned());
        let (method, target) = line.split_once(' ').unwrap();
        match (method, target.split('?').next().unwrap()) {
            ("GET", "/api/v1/update") => (200, self.document()),
            ("GET", "/api/v1/status") => {
                let links = if self.slot_b { self.links } else { 1 };
                let link = if links > 0 { "up" } else { "connecting" };
                (
                    200,
                    format!(
                        "{{\"health\":\"running\",\"ports\":{{}},\"links\":{{\"state\":{{\"state\":\"{link}\"}}}}}}"
                    ),
                )
            }
            ("PUT", "/api/v1/update") => {
                let offset: usize = target.split_once("offset=").unwrap().1.parse().unwrap();
                if offset == 0 {
                    if self.header != body {
                        self.header = body.to_vec();
                        self.image.clear();
                        let header = Header::parse(body.try_into().unwrap()).unwrap();
                        self.length = HEADER + header.length() as usize;
                    }
                } else if offset == HEADER + self.image.len() {
                    self.image.extend_from_slice(body);
                } else {
                    return (409, "{\"error\":\"the next bytes are others\"}".to_owned());
                }
                (200, self.document())
            }
            ("POST", "/api/v1/update/try") => {
                (self.slot_b, self.on_trial) = (true, true);
                (202, self.document())
            }
            ("POST", "/api/v1/update/confirm") => {
                (self.on_trial, self.confirmed) = (false, true);
                (200, self.document())
            }
            _ => (404, "{\"error\":\"there is no such path\"}".to_owned()),
        }
    }
}

fn serve(mut stream: TcpStream, board: &Mutex<Board>) -> Option<()> {
    let mut reader = BufReader::new(stream.try_clone().ok()?);
    let mut first = String::new();
    reader.read_line(&mut first).ok()?;
    let mut length = 0;
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).ok()?;
        if let Some(value) = line.to_ascii_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().ok()?;
        }
        if line.trim().is_empty() {
            break;
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).ok()?;
    let mut board = board.lock().unwrap();
    if first.starts_with("PUT") && !board.image.is_empty() && board.lost > 0 {
        board.lost -= 1;
        return None;
    }
    let (status, text) = board.answer(first.trim_end().trim_end_matches(" HTTP/1.1"), &body);
    write!(
        stream,
        "HTTP/1.1 {status} x\r\nContent-Type: application/json\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{text}",
        text.len()
    )
    .ok()
}

fn board(state: Board) -> (Arc<Mutex<Board>>, Client) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string().parse().unwrap();
    let board = Arc::new(Mutex::new(state));
    let shared = Arc::clone(&board);
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let _ = serve(stream, &shared);
        }
    });
    (board, Client::new(address, None, Duration::from_secs(20), Stop::new()).unwrap())
}

fn image() -> Vec<u8> {
    (0..50_000_u32).map(|at| (at % 241) as u8).collect()
}

fn file(name: &str, seed: &[u8; 32]) -> Update {
    let mut links = Vec::new();
    for slot in Slot::ALL {
        let parts = ImageFacts {
            board: BoardName::parse(name).unwrap(),
            slot,
            version: Version::new(0, 3, 0),
            formats: Formats::new(1, 3, 3).unwrap(),
            store: 1,
        };
        links.extend(Header::sign(parts, &image(), seed).unwrap().encode());
        links.extend(image());
        links.resize(links.len() + link_padding(image().len()), 0xFF);
    }
    let mut bytes = file_head(2, (FILE_HEAD + links.len()) as u32).to_vec();
    bytes.extend(links);
    Update::of(bytes).unwrap()
}

const SEND: Plan = Plan { trial_s: None, confirm: false, downgrade: Downgrade::Refused };

#[test]
fn a_firmware_is_sent_in_pieces_also_over_lost_connections() {
    let (board, client) = board(Board { lost: 2, ..Board::default() });
    let mut told = Vec::new();
    update(&client, &file("nucleo-h743zi", &SEED), SEND, &mut |line| told.push(line.to_owned())).unwrap();
    assert_eq!(board.lock().unwrap().image, image());
    assert!(
        told.iter().any(|line| line == "0.2.0 runs on this nucleo-h743zi; 0.3.0 goes into slot B"),
        "{told:?}"
    );
    let headers = board.lock().unwrap().requests.iter().filter(|line| line.ends_with("offset=0")).count();
    assert!((2..=3).contains(&headers), "after a lost connection it begins with the header");
    // Once more: it is there.
    update(&client, &file("nucleo-h743zi", &SEED), SEND, &mut |_| {}).unwrap();
    let requests = board.lock().unwrap().requests.clone();
    assert!(requests.last().is_some_and(|line| line.ends_with("offset=0")), "{requests:?}");
}

#[test]
fn it_is_confirmed_if_the_board_does_as_well_as_before() {
    let plan = Plan { trial_s: Some(60), confirm: true, ..SEND };
    let (state, client) = board(Board { links: 1, ..Board::default() });
    let answer = update(&client, &file("nucleo-h743zi", &SEED), plan, &mut |_| {}).unwrap();
    assert_eq!(answer.verdict(), Verdict::Well);
    assert!(state.lock().unwrap().confirmed);
    // Without its link it is not.
    let plan = Plan { confirm: false, ..plan };
    let (state, client) = board(Board { links: 0, ..Board::default() });
    let answer = update(&client, &file("nucleo-h743zi", &SEED), plan, &mut |_| {}).unwrap();
    assert_eq!((answer.verdict(), state.lock().unwrap().confirmed), (Verdict::Trouble, false));
}

#[test]
fn the_build_that_runs_is_not_sent_and_another_one_of_the_version_is() {
    let update_file = file("nucleo-h743zi", &SEED);
    let same = Hex(&update_file.links()[0].header.hash()[..8]).to_string().leak();
    for (build, is_sent) in [(&*same, false), ("0b0b0b0b0b0b0b0b", true)] {
        let (board, client) = board(Board { build: Some(build), ..Board::default() });
        let answer = update(&client, &update_file, SEND, &mut |_| {}).unwrap();
        assert_eq!((answer.verdict(), board.lock().unwrap().image == image()), (Verdict::Well, is_sent));
    }
}

#[test]
fn what_the_board_would_refuse_is_never_sent() {
    for (name, seed, why) in [
        ("mps2-an500", SEED, "for the board mps2-an500"),
        ("nucleo-h743zi", [9; 32], "not signed with the key"),
    ] {
        let (board, client) = board(Board::default());
        let failure = update(&client, &file(name, &seed), SEND, &mut |_| {}).unwrap_err();
        assert!(matches!(&failure, Failure::Refused(text) if text.contains(why)), "{failure:?}");
        assert_eq!(board.lock().unwrap().requests, ["GET /api/v1/update"]);
    }
}
