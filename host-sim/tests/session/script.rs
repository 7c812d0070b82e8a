//! The session itself.

use std::path::PathBuf;

use recipe_test_kit::{Process, until};
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::BINARY;
use crate::ctl::{Ctl, TIMEOUT};
use crate::target::Target;

/// From a file to a cell that is in service, with everything that goes wrong on the way.
#[track_caller]
pub(crate) fn session(target: &mut dyn Target) {
    let mut session = Session { target, live: 0 };
    session.begins();
    session.is_given_another_configuration();
    session.shows_its_frames();
    session.loses_its_device();
    session.refuses_what_is_wrong();
    session.takes_back_what_nobody_confirms();
    session.is_killed_in_the_middle_of_a_push();
}

struct Session<'a> {
    target: &'a mut dyn Target,
    /// The revision that was confirmed.
    live: u64,
}

impl Session<'_> {
    fn ctl(&self) -> Ctl {
        let (to, host) = (self.target.address(), self.target.host());
        Ctl { to, host, key: Some(self.file("key")), timeout: TIMEOUT }
    }

    fn file(&self, name: &str) -> PathBuf {
        self.target.folder().path().join(name)
    }

    /// Writes a configuration; returns its path.
    fn written(&self, name: &str, text: &str) -> String {
        let path = self.file(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    }

    fn config(&self, timeout_ms: u32) -> String {
        self.written("cell.toml", &self.target.config(timeout_ms))
    }

    /// Checked, keyed, started, its device connected.
    fn begins(&mut self) {
        let file = self.written(FIRST, &self.target.config(500));
        let checked = BINARY.command().args(["check", &file]).output().unwrap();
        assert!(checked.status.success(), "{checked:?}");
        let made = BINARY.command().args(["ctl", "keygen"]).arg(self.file("key")).output().unwrap();
        assert!(made.status.success(), "{made:?}");
        self.target.start(file.as_ref());
        self.target.claim();
        self.target.plug();
        self.is_running();
        let info = self.ctl().done(&["info"]);
        assert!(info.contains("role") && info.contains("version"), "{info}");
    }

    /// Waits until everything works, which `status` says by its exit code.
    #[track_caller]
    fn is_running(&self) {
        let printed = self.ctl().until(0, &["status"]);
        assert!(printed.out.contains("health  ") && printed.out.contains("running"), "{printed:?}");
    }

    fn is_given_another_configuration(&mut self) {
        let ctl = self.ctl();
        let file = self.config(400);
        let before = ctl.json(&["revisions"])["running"].clone();
        let stored = ctl.json(&["push", &file]);
        assert_eq!(stored["running"], before, "it only waits");
        self.live = stored["waiting"].as_u64().unwrap();
        let applied = ctl.json(&["apply", "--confirm-s", "60"]);
        assert_eq!((&applied["running"], applied["live"] == self.live), (&json!(self.live), false));
        let shown = ctl.done(&["revisions"]);
        assert!(shown.contains("running, on trial") && shown.contains("taken back in"), "{shown}");
        assert_eq!(ctl.done(&["confirm"]), format!("revision {} is live\n", self.live));
        self.is_running();
        // It runs before its first frame has come.
        until("the new gateway has the device's value", || {
            let shown = ctl.json(&["values", "DigitalOut"]);
            (shown["values"]["DigitalOutputCommand[1]"]["value"] == 5).then_some(())
        });
    }

    /// What goes on until somebody presses Ctrl-C ends well then.
    fn shows_its_frames(&mut self) {
        let ctl = self.ctl();
        for args in [&["trace", "device"][..], &["status", "--watch"], &["values", "Digital", "--watch"]] {
            let mut goes_on = Process::start(&mut ctl.command(&[&["--json"], args].concat()));
            let is_there = |shown: &Value| match args[0] {
                "trace" => shown["port"] == "device" && shown["bytes"] == "ffff0005eeee",
                "status" => shown["health"] == "running",
                _ => shown["values"]["DigitalOutputCommand[1]"]["value"] == 5,
            };
            // The gateway has just been replaced: what is shown first may be from before its first frame.
            let mut shown = (0..100).map(|_| serde_json::from_str(&goes_on.line()).unwrap());
            assert!(shown.any(|shown: Value| is_there(&shown)), "{args:?}: {:?}", goes_on.lines().last());
            goes_on.end_by(Signal::INT);
        }
        if self.target.has_names() {
            let mut goes_on = Process::start(&mut ctl.command(&["trace"]));
            let line = goes_on.line();
            assert!(line.ends_with("  device  in   input  order=0  outputs=5"), "{line}");
            goes_on.end_by(Signal::INT);
        }
        let file = self.file("cell.pcapng");
        let capture = ctl.done(&["capture", file.to_str().unwrap(), "--port", "device", "--for", "1s"]);
        assert!(capture.starts_with(file.to_str().unwrap()), "{capture}");
        let bytes = std::fs::read(&file).unwrap();
        assert_eq!(bytes[..4], [0x0A, 0x0D, 0x0D, 0x0A]);
        assert!(bytes.windows(6).any(|bytes| bytes == [255, 255, 0, 5, 238, 238]), "{} bytes", bytes.len());
        let file = self.file("bundle.json");
        ctl.done(&["bundle", file.to_str().unwrap()]);
        let text = std::fs::read_to_string(&file).unwrap();
        let bundle: Value = serde_json::from_str(&text).unwrap();
        for part in ["info", "status", "values", "revisions", "metrics", "doctor", "log", "config"] {
            assert!(bundle.get(part).is_some(), "no {part} in {text}");
        }
        let key = std::fs::read_to_string(self.file("key")).unwrap();
        assert!(!text.contains(key.trim_end()));
        ctl.done(&["identify", "--seconds", "1"]);
        assert!(!ctl.done(&["log", "-n", "5"]).is_empty());
        assert!(ctl.done(&["metrics"]).ends_with("# EOF\n"));
    }

    fn loses_its_device(&mut self) {
        let ctl = self.ctl();
        ctl.until(0, &["doctor"]);
        self.target.pull();
        let printed = ctl.until(3, &["doctor"]);
        assert!(printed.out.contains("port device: "), "{printed:?}");
        assert!(printed.out.contains("  remedy    "), "{printed:?}");
        ctl.run(&["status"]).must_be(3);
        self.target.plug();
        self.is_running();
        assert_eq!(ctl.until(0, &["doctor"]).out, "nothing found\n");
    }

    fn refuses_what_is_wrong(&mut self) {
        let ctl = self.ctl();
        let before = ctl.json(&["revisions"])["kept"].clone();
        let wrong = self.target.config(300).replace("recipe = \"panel\"", "recipe = \"pannel\"");
        let line = 1 + wrong.lines().position(|line| line.contains("pannel")).unwrap();
        let file = self.written("wrong.toml", &wrong);
        let printed = ctl.run(&["push", &file, "--apply"]).must_be(2);
        assert!(printed.err.starts_with(&format!("{file}:{line}:")), "{printed:?}");
        assert!(printed.err.contains("port.device.recipe"), "{printed:?}");
        let keyless = Ctl { key: None, ..ctl.clone() };
        let right = self.config(300);
        let printed = keyless.run(&["push", &right]).must_be(1);
        assert!(printed.err.contains("the key is needed"), "{printed:?}");
        assert_eq!(ctl.json(&["revisions"])["kept"], before);
        ctl.run(&["confirm"]).must_be(1);
    }

    fn takes_back_what_nobody_confirms(&mut self) {
        let ctl = self.ctl();
        let file = self.config(300);
        let trial = self.target.short_trial_s().to_string();
        let applied = ctl.json(&["push", &file, "--apply", "--confirm-s", &trial]);
        let revision = applied["trial"]["revision"].clone();
        assert_eq!(revision, self.live + 1);
        let back = until("it is taken back", || {
            let printed = ctl.run(&["--json", "revisions"]);
            let shown: Value = serde_json::from_str(&printed.out).ok()?;
            (shown["running"] == self.live).then_some(shown)
        });
        assert_eq!(back["last"], json!({ "revision": revision, "ended": "not-confirmed" }));
        self.is_running();
    }

    /// Whenever it is killed, it starts with the revision that is live, and whatever it keeps is whole.
    fn is_killed_in_the_middle_of_a_push(&mut self) {
        let live = self.ctl().json(&["config"]);
        for round in 0..KILLS {
            let timeout_ms = 1_000 + round;
            let file = self.config(timeout_ms);
            // One whose power is cut ends no connection.
            let impatient = Ctl { timeout: "3s", ..self.ctl() };
            let mut push = impatient.command(&["push", &file]).spawn().unwrap();
            std::thread::sleep(self.target.push_takes() * round / KILLS);
            self.target.kill();
            // It had done it before, or it says that it could not.
            let code = push.wait().unwrap().code();
            assert!(matches!(code, Some(0 | 1)), "{code:?}");
            self.target.start(&self.file(FIRST));
            let ctl = self.ctl();
            let shown = ctl.json(&["revisions"]);
            let own = json!(self.live);
            assert_eq!((&shown["running"], &shown["live"]), (&own, &own), "{shown}");
            assert_eq!(ctl.json(&["config"]), live);
            for entry in shown["kept"].as_array().unwrap() {
                let number = entry["revision"].to_string();
                let kept = ctl.json(&["config", "--revision", &number]);
                let digits = kept["image"].as_str().map(str::len);
                let is_whole = kept["toml"].as_str().is_some_and(|toml| toml.ends_with("= 128 }\n"));
                assert!(is_whole || digits.is_some_and(|digits| digits > 100), "{kept}");
            }
        }
        self.target.pull();
        self.target.plug();
        self.is_running();
    }
}

/// The file that it is started with. Nobody changes it: on a host it would count as another configuration.
const FIRST: &str = "first.toml";
/// Times that it is killed, each a little later than the one before.
const KILLS: u32 = 8;
