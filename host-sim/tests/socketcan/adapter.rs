//! A CAN adapter on a serial line, with an interface by the kernel's slcan driver.

use std::fs::File;
use std::io::{Read, Write};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

use rustix::fs::OFlags;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use recipe_test_kit::can::tool;
use recipe_test_kit::until;

/// The adapter's end of the line, and its interface.
pub(crate) struct Adapter {
    pub(crate) interface: &'static str,
    master: File,
    received: Arc<Mutex<Vec<u8>>>,
    daemon: Child,
    /// Held open: otherwise the adapter reads errors until the driver opens it.
    _line: File,
}

impl Adapter {
    /// Attaches the driver and brings the interface up.
    #[track_caller]
    pub(crate) fn new(interface: &'static str) -> Self {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let path = ptsname(&master, Vec::new()).unwrap().into_string().unwrap();
        let flags = OFlags::RDWR | OFlags::NOCTTY;
        let line = rustix::fs::open(&path, flags, rustix::fs::Mode::empty()).unwrap();
        let mut settings = tcgetattr(&line).unwrap();
        settings.make_raw();
        tcsetattr(&line, OptionalActions::Now, &settings).unwrap();
        let master = File::from(master);
        let received = Arc::<Mutex<Vec<u8>>>::default();
        let (mut reader, sink) = (master.try_clone().unwrap(), Arc::clone(&received));
        std::thread::spawn(move || {
            let mut buf = [0; 4_096];
            while let Ok(count) = reader.read(&mut buf) {
                sink.lock().unwrap().extend_from_slice(&buf[..count]);
            }
        });
        let daemon = Command::new("slcand")
            .args(["-F", "-o", "-s6", &path, interface])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let adapter = Self { interface, master, received, daemon, _line: File::from(line) };
        let place = format!("/sys/class/net/{interface}");
        until("the adapter's interface", || std::fs::exists(&place).unwrap().then_some(()));
        tool(&format!("ip link set {interface} up"));
        until("the adapter is opened", || adapter.received().contains("O\r").then_some(()));
        adapter
    }

    /// The driver's output so far.
    pub(crate) fn received(&self) -> String {
        String::from_utf8_lossy(&self.received.lock().unwrap()).into_owned()
    }

    pub(crate) fn forget(&self) {
        self.received.lock().unwrap().clear();
    }

    /// Sends a line, without its CR, to the driver.
    pub(crate) fn send(&self, line: &str) {
        (&self.master).write_all(format!("{line}\r").as_bytes()).unwrap();
    }
}

impl Drop for Adapter {
    fn drop(&mut self) {
        let _ = self.daemon.kill();
        let _ = self.daemon.wait();
    }
}
