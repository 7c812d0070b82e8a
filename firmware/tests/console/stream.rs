//! The stream of events.

use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;

use recipe_test_kit::{PATIENCE, until};
use serde_json::Value;

use crate::board::{QemuBoard, panel};

/// The events of a stream.
pub(crate) struct Events(BufReader<TcpStream>);

impl Events {
    /// Follows a stream with this query.
    pub(crate) fn of(board: &QemuBoard, query: &str) -> Self {
        let line = format!("GET /api/v1/stream{query}");
        let fields = board.client.signature(&board.client.nonce(), &line, b"");
        let mut stream = board.client.narrow_connection().unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(&board.client.bytes(&line, &fields, b"")).unwrap();
        let mut events = Self(BufReader::new(stream));
        assert!(events.line().starts_with("HTTP/1.1 200 "));
        while !events.line().is_empty() {}
        events
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        assert_ne!(self.0.read_line(&mut line).unwrap(), 0, "the stream has ended");
        line.trim_end().to_owned()
    }

    /// The next event: its name and data.
    pub(crate) fn next(&mut self) -> (String, Value) {
        let name = self.line().strip_prefix("event: ").expect("an event").to_owned();
        let line = self.line();
        let data = serde_json::from_str(line.strip_prefix("data: ").expect("data")).unwrap();
        assert_eq!(self.line(), "");
        (name, data)
    }
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn state_and_values_come_several_times_a_second_and_frames_for_who_asks() {
    let board = QemuBoard::claimed(&panel(500));
    let mut plain = Events::of(&board, "");
    let mut names = Vec::new();
    let mut times = Vec::new();
    for _ in 0..12 {
        let (name, data) = plain.next();
        times.push(data["time_us"].as_u64().unwrap_or(0));
        names.push(name);
    }
    assert!(names.iter().all(|name| ["status", "values", "lost"].contains(&&**name)), "{names:?}");
    assert!(names.iter().filter(|name| *name == "status").count() >= 4, "{names:?}");

    let mut line = board.line();
    let mut followed = Events::of(&board, "?frames=1&port=device");
    // There is one ring.
    board.client.get("stream?frames=1").must_be(503);
    let frame = until("a frame of the panel", || {
        line.write_all(&[255, 255, 0, 5, 238, 238]).unwrap();
        let (name, data) = followed.next();
        (name == "frames").then(|| data["frames"][0].clone())
    });
    assert_eq!((&frame["port"], &frame["direction"]), (&"device".into(), &"in".into()));
    assert_eq!((&frame["verdict"], &frame["bytes"]), (&"frame".into(), &"ffff0005eeee".into()));
    assert!(frame["time_us"].as_u64().unwrap() > 0);
    drop(followed);
    // Its place is free again.
    until("another client may follow", || {
        let line = "GET /api/v1/info";
        let fields = board.client.signature(&board.client.nonce(), line, b"");
        let info = board.client.request(line, &fields, b"").must_be(200).json();
        (info["console"]["streams"] == 1).then_some(())
    });
    Events::of(&board, "?frames=1").next();
}
