//! The control socket of the emulator of a board's chip (docs/chip.md section 5).

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;

/// Asks the emulator on its socket; its answer.
///
/// # Panics
/// If it does not answer.
#[track_caller]
pub fn request(socket: &Path, words: &str) -> String {
    let mut stream = UnixStream::connect(socket).unwrap();
    writeln!(stream, "{words}").unwrap();
    let mut answer = String::new();
    BufReader::new(stream).read_line(&mut answer).unwrap();
    answer.trim_end().to_owned()
}

/// Tells the emulator what to do.
///
/// # Panics
/// If it does not do it.
#[track_caller]
pub fn command(socket: &Path, words: &str) {
    assert_eq!(request(socket, words), "done", "{words}");
}
