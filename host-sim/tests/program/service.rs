//! A run as a service of systemd: it says when it is ready, that it works, and that it ends.

use std::os::unix::net::UnixDatagram;
use std::time::{Duration, Instant};

use recipe_test_kit::{HostSim, PATIENCE, example};
use rustix::process::Signal;

use super::BINARY;

/// The socket of a service manager.
struct Manager(UnixDatagram);

impl Manager {
    /// The next thing that it is told.
    #[track_caller]
    fn is_told(&self) -> String {
        let mut told = [0; 256];
        let len = self.0.recv(&mut told).expect("the manager is told something");
        String::from_utf8(told[..len].to_vec()).unwrap()
    }
}

#[test]
fn a_service_manager_is_told_of_the_beginning_the_work_and_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("notify");
    let manager = Manager(UnixDatagram::bind(&socket).unwrap());
    manager.0.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut command = BINARY.run("gateway", &example("force-sensor.toml"));
    command.args(["--set", "controller.address=127.0.0.1", "--bind"]);
    command.arg(format!("force=pty:{}", folder.path().join("line").display()));
    command.env("NOTIFY_SOCKET", &socket).env("WATCHDOG_USEC", "300000").env_remove("WATCHDOG_PID");
    let mut gateway = HostSim::start(&mut command);
    assert_eq!(manager.is_told(), "READY=1\nSTATUS=running\n");
    let begin = Instant::now();
    for _ in 0..6 {
        assert_eq!(manager.is_told(), "WATCHDOG=1\n");
    }
    assert!(begin.elapsed() >= Duration::from_millis(400), "three times in 300 ms, not all at once");
    gateway.signal(Signal::TERM);
    let end = std::iter::from_fn(|| Some(manager.is_told())).find(|told| told != "WATCHDOG=1\n");
    assert_eq!(end.as_deref(), Some("STOPPING=1\nSTATUS=ending\n"));
    assert!(gateway.ended().success());
}
