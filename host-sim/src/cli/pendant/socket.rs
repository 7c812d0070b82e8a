//! A connection to a control socket.

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use serde_json::Value;

pub(super) struct Socket {
    read: BufReader<TcpStream>,
    address: String,
}

impl Socket {
    pub(super) fn connect(address: &str) -> Result<Self, String> {
        let refused = |why: String| format!("{address}: {why}");
        let found = address.to_socket_addrs().map_err(|error| refused(error.to_string()))?;
        let mut last = "no address".to_owned();
        for place in found {
            match TcpStream::connect_timeout(&place, TIMEOUT) {
                Ok(stream) => {
                    return Ok(Self { read: BufReader::new(stream), address: address.to_owned() });
                }
                Err(error) => last = error.to_string(),
            }
        }
        Err(refused(format!("nobody is there: {last}")))
    }

    /// Makes a request and returns its answer.
    pub(super) fn ask(&mut self, request: &Value) -> Result<Value, String> {
        let line = format!("{request}\n");
        // If it is closed already, the answer says why.
        let _ = self.read.get_mut().write_all(line.as_bytes());
        self.line()
    }

    /// The next line.
    pub(super) fn line(&mut self) -> Result<Value, String> {
        let mut line = String::new();
        let lost = |why: &dyn std::fmt::Display| format!("{}: {why}", self.address);
        match self.read.read_line(&mut line) {
            Ok(0) => Err(lost(&"the controller has closed the connection")),
            Ok(_) => serde_json::from_str(&line).map_err(|_| lost(&"this is not a control socket")),
            Err(error) => Err(lost(&error)),
        }
    }
}

/// How long connecting may take. Answers may take longer: `wait` and `advance` have their own time.
const TIMEOUT: Duration = Duration::from_secs(5);
