//! The control socket of the emulator of a board's chip (docs/chip.md section 5).

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;

/// Sends a request to the emulator's socket and returns its reply.
///
/// # Panics
/// If it does not reply.
#[track_caller]
pub fn request(socket: &Path, words: &str) -> String {
    let mut stream = UnixStream::connect(socket).unwrap();
    writeln!(stream, "{words}").unwrap();
    let mut answer = String::new();
    BufReader::new(stream).read_line(&mut answer).unwrap();
    answer.trim_end().to_owned()
}

/// Sends a command to the emulator's socket.
///
/// # Panics
/// If its reply is not `done`.
#[track_caller]
pub fn command(socket: &Path, words: &str) {
    assert_eq!(request(socket, words), "done", "{words}");
}
