//! A running controller and a client of its control socket.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;

use serde_json::{Value, json};

use recipe_config::SimConfig;
use recipe_config::file::load_controller;
use recipe_runtime::Handle;
use recipe_runtime::controller::{ControllerOptions, Pace, start_with};
use recipe_test_kit::{PATIENCE, SERVERS, example};

/// An example file, on free ports.
pub(super) fn config(name: &str) -> SimConfig {
    let free = SERVERS.map(|server| format!("listen.{server}=0"));
    load_controller(&example(name), &free).unwrap()
}

/// A controller on a clock of this pace.
#[track_caller]
pub(super) fn start(config: SimConfig, pace: Pace) -> Handle {
    start_with(config, ControllerOptions { pace, ..ControllerOptions::default() }).unwrap()
}

#[track_caller]
pub(super) fn connect(handle: &Handle, server: &str) -> TcpStream {
    let stream = TcpStream::connect(handle.place(server)).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.set_nodelay(true).unwrap();
    stream
}

/// A client of the control socket.
pub(super) struct Control {
    read: BufReader<TcpStream>,
}

impl Control {
    #[track_caller]
    pub(super) fn of(handle: &Handle) -> Self {
        Self { read: BufReader::new(connect(handle, "control")) }
    }

    pub(super) fn send(&mut self, text: &str) {
        self.read.get_mut().write_all(text.as_bytes()).unwrap();
        self.read.get_mut().write_all(b"\n").unwrap();
    }

    pub(super) fn stream(&mut self) -> &mut TcpStream {
        self.read.get_mut()
    }

    /// The next line; empty at the end.
    #[track_caller]
    pub(super) fn text(&mut self) -> String {
        let mut line = String::new();
        match self.read.read_line(&mut line) {
            Err(error) if error.kind() == std::io::ErrorKind::ConnectionReset => String::new(),
            read => {
                read.unwrap();
                line.trim_end().to_owned()
            }
        }
    }

    #[track_caller]
    pub(super) fn line(&mut self) -> Value {
        let text = self.text();
        serde_json::from_str(&text).unwrap_or_else(|error| panic!("{text:?}: {error}"))
    }

    #[track_caller]
    pub(super) fn ask(&mut self, request: Value) -> Value {
        self.send(&request.to_string());
        self.line()
    }

    /// The result of a request that is carried out.
    #[track_caller]
    pub(super) fn done(&mut self, request: Value) -> Value {
        let mut answer = self.ask(request.clone());
        assert_eq!(answer["ok"], true, "{request}: {answer}");
        answer["result"].take()
    }

    /// The error of a request that is refused.
    #[track_caller]
    pub(super) fn refused(&mut self, request: Value) -> String {
        let answer = self.ask(request.clone());
        assert_eq!(answer["ok"], false, "{request}: {answer}");
        answer["error"].as_str().unwrap().to_owned()
    }

    /// The time of the newest answer, from a new one.
    #[track_caller]
    pub(super) fn time_s(&mut self) -> f64 {
        self.ask(json!({ "do": "programs" }))["time_s"].as_f64().unwrap()
    }

    /// What remains until the connection is closed.
    pub(super) fn rest(&mut self) -> String {
        let mut rest = Vec::new();
        // A reset is an end too.
        let _ = self.read.read_to_end(&mut rest);
        String::from_utf8(rest).unwrap()
    }
}
