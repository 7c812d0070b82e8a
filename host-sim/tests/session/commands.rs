//! The command line of `ctl`: arguments, files, exit codes, completions.

use recipe_test_kit::example;

use crate::BINARY;

struct Ran {
    code: Option<i32>,
    out: String,
    err: String,
}

fn run(args: &[&str], gateway: Option<&str>) -> Ran {
    let mut command = BINARY.command();
    command.env_remove("HOST_SIM_GATEWAY").env_remove("HOST_SIM_GATEWAY_KEY").arg("ctl").args(args);
    command.envs(gateway.map(|gateway| ("HOST_SIM_GATEWAY", gateway)));
    let output = command.output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    Ran { code: output.status.code(), out: text(output.stdout), err: text(output.stderr) }
}

#[track_caller]
fn wrong(args: &[&str], words: &str) {
    let ran = run(args, None);
    assert_eq!((ran.code, ran.out.as_str()), (Some(2), ""), "{args:?}: {}", ran.err);
    assert!(ran.err.contains(words), "{args:?}: {}", ran.err);
}

#[test]
fn mistakes_are_told_before_anything_is_asked() {
    // Nobody is at this address; what is wrong here comes first.
    let nobody = "127.0.0.1:1";
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    std::fs::write(path("open.key"), "00112233445566778899aabbccddeeff\n").unwrap();
    std::fs::write(path("cells.toml"), "[[gateway]]\nname = \"a\"\naddress = \"127.0.0.1:1\"\nkind = 1\n")
        .unwrap();
    let two = "[[gateway]]\nname = \"a\"\naddress = \"127.0.0.1:1\"\n[[gateway]]\nname = \"b\"\naddress = \"127.0.0.1:1\"\n";
    std::fs::write(path("two.toml"), two).unwrap();
    wrong(&["info"], "which gateway? give --to ADDRESS");
    wrong(&["--to", "http://a", "info"], "is not an address but a link");
    wrong(&["--to", nobody, "--key", &path("open.key"), "info"], "others may use it, its mode is 0644");
    wrong(&["--to", nobody, "--key", &path("none.key"), "info"], "No such file");
    wrong(&["--to", nobody, "push", &path("none.toml")], "none.toml: cannot be read");
    wrong(&["--to", nobody, "push", &path("open.key")], "open.key:1:");
    let controller = example("rs485-system-controller.toml");
    wrong(&["--to", nobody, "push", controller.to_str().unwrap()], "this is a controller file");
    let file = example("force-sensor.toml");
    let file = file.to_str().unwrap();
    wrong(&["--to", nobody, "push", file, "--confirm-s", "5"], "--apply");
    wrong(&["--to", nobody, "apply", "--confirm-s", "0.5"], "not within 1 to 3600 s");
    wrong(&["--to", nobody, "confirm", "--batch", "2"], "are for an inventory");
    wrong(&["--to", nobody, "--inventory", &path("two.toml"), "info"], "cannot be used with");
    wrong(
        &["--inventory", &path("two.toml"), "--only", "a", "--host", "10.0.2.15", "info"],
        "in an inventory write host = \"ADDRESS\"",
    );
    wrong(
        &["--inventory", &path("cells.toml"), "info"],
        "cells.toml:4:1: gateway.a.kind: unknown key of a gateway",
    );
    wrong(&["--inventory", &path("two.toml"), "--only", "c", "info"], "has no such gateway; it has a, b");
    wrong(&["--inventory", &path("two.toml"), "trace"], "choose one with --only NAME");
    wrong(&["--inventory", &path("two.toml"), "status", "--watch"], "choose one with --only NAME");
    let tls = "[broker]\naddress = \"b\"\nca = \"c\"\n[node]\ngroup = \"g\"\nname = \"n\"\n";
    std::fs::write(path("tls.toml"), tls).unwrap();
    wrong(&["--to", nobody, "edge", &path("tls.toml")], "tls.toml: broker.ca: a board speaks no TLS");
    wrong(&["--to", nobody, "edge", &path("open.key")], "open.key:1:");
    wrong(&["--to", nobody, "edge", "--restart"], "--restart is for a file or --off");
    wrong(&["--inventory", &path("two.toml"), "edge", &path("tls.toml")], "a Sparkplug file names one node");
    wrong(&["keygen", &path("open.key")], "keys are not replaced");
    wrong(&["--to", nobody, "nonsense"], "nonsense");
    assert!(run(&["info"], Some("a b")).err.contains("HOST_SIM_GATEWAY: "));
}

#[test]
fn who_is_not_reached_is_named_and_the_exit_code_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let inventory = folder.path().join("cells.toml");
    let text = "[[gateway]]\nname = \"press\"\naddress = \"127.0.0.1:1\"\n[[gateway]]\nname = \"saw\"\naddress = \"127.0.0.1:2\"\n";
    std::fs::write(&inventory, text).unwrap();
    let inventory = inventory.to_str().unwrap();
    let ran = run(&["--inventory", inventory, "status"], None);
    assert_eq!(ran.code, Some(1), "{}", ran.err);
    assert_eq!(ran.err, "2 of 2 gateways failed: press, saw\n");
    let lines: Vec<_> = ran.out.lines().collect();
    assert_eq!(lines[1], "press    127.0.0.1:1: nobody is there: 127.0.0.1:1: Connection refused");
    let ran = run(&["--inventory", inventory, "--only", "saw", "info"], None);
    assert_eq!((ran.code, ran.out.as_str()), (Some(1), ""));
    assert!(ran.err.starts_with("127.0.0.1:2: nobody is there"), "{}", ran.err);
    let ran = run(&["info"], Some("127.0.0.1:1"));
    assert_eq!(ran.code, Some(1));
}

#[test]
fn a_new_key_is_printed_nowhere() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.key");
    let ran = run(&["keygen", file.to_str().unwrap()], None);
    assert_eq!(ran.code, Some(0), "{}", ran.err);
    let key = std::fs::read_to_string(&file).unwrap();
    assert_eq!(key.len(), 33);
    assert!(!ran.out.contains(key.trim_end()) && !ran.err.contains(key.trim_end()));
}

#[test]
fn completions_know_its_commands() {
    for shell in ["bash", "zsh", "fish"] {
        let output = BINARY.command().args(["completions", shell]).output().unwrap();
        let script = String::from_utf8(output.stdout).unwrap();
        for word in
            ["ctl", "inventory", "revisions", "rollback", "claim", "keygen", "stop-on-failure", "confirm-s"]
        {
            assert!(script.contains(word), "{shell} has no {word}");
        }
    }
}

#[test]
fn help_teaches() {
    let ran = run(&["--help"], None);
    for words in ["Examples:", "Exit codes: 0 done, 1", "HOST_SIM_GATEWAY_KEY", "claim", "bundle"] {
        assert!(ran.out.contains(words), "{words:?} is not in\n{}", ran.out);
    }
    for command in ["push", "doctor", "claim", "capture", "status"] {
        let ran = run(&[command, "--help"], None);
        assert!(ran.out.contains("xample"), "{command}: {}", ran.out);
    }
}

/// An ELF file of an Arm core: a vector table and some bytes at this address.
fn program(start: u32) -> Vec<u8> {
    let mut code: Vec<u8> =
        [0x2002_0000, start + 9].iter().flat_map(|word: &u32| word.to_le_bytes()).collect();
    code.extend(0..200);
    let mut elf = b"\x7FELF\x01\x01\x01".to_vec();
    elf.resize(16, 0);
    elf.extend([2, 0, 40, 0]);
    let len = code.len() as u32;
    elf.extend([1, 0, 52, 0, 0].iter().flat_map(|word: &u32| word.to_le_bytes()));
    elf.extend([52, 32, 1, 40, 0, 0].iter().flat_map(|half: &u16| half.to_le_bytes()));
    elf.extend([1, 84, start, start, len, len, 5, 4].iter().flat_map(|word| word.to_le_bytes()));
    [elf, code].concat()
}

#[test]
fn firmware_is_signed_and_shown() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    for key in ["key", "other"] {
        let ran = run(&["keygen", "--signing", &path(key)], None);
        assert!(ran.code == Some(0) && ran.out.contains("its public key, for loaders: "), "{}", ran.err);
    }
    std::fs::write(path("a.elf"), program(0x0802_0400)).unwrap();
    std::fs::write(path("b.elf"), program(0x0810_0400)).unwrap();
    let (key, update) = (path("key"), path("update.rgu"));
    let sign = |a: &str, b: &str, version: &str| {
        let files = [path(a), path(b)];
        let of = ["sign", "--signing-key", &key, "--board", "nucleo-h743zi", "--version", version];
        run(&[&of[..], &["--slot-a", &files[0], "--slot-b", &files[1], "-o", &update]].concat(), None)
    };
    let ran = sign("b.elf", "a.elf", "0.3.0");
    assert_eq!(ran.code, Some(2));
    assert!(ran.err.contains("b.elf: ") && ran.err.contains("it is not linked for slot A"), "{}", ran.err);
    assert_eq!(sign("a.elf", "b.elf", "3").code, Some(2));
    let ran = sign("a.elf", "b.elf", "0.3.0");
    assert_eq!(ran.code, Some(0), "{}", ran.err);
    assert!(
        ran.out.contains("update.rgu: firmware 0.3.0 for nucleo-h743zi: slot A 400 bytes"),
        "{}",
        ran.out
    );
    for (public, code, words) in [("key.pub", 0, "of this key"), ("other.pub", 3, "of another key")] {
        let ran = run(&["inspect", &update, "--public-key", &path(public)], None);
        assert_eq!((ran.code, ran.out.matches(words).count()), (Some(code), 2), "{}", ran.out);
    }
    let ran = run(&["inspect", &update, "--slot", "b", "-o", &path("b.bin")], None);
    assert!(ran.out.contains("b.bin: 1232 bytes for address 08100000"), "{}{}", ran.out, ran.err);
    let boards = path("boards.toml");
    std::fs::write(&boards, "[[gateway]]\nname = \"a\"\naddress = \"127.0.0.1:1\"\n").unwrap();
    let (one, many) = (["--to", "127.0.0.1:1", "update"], ["--inventory", &boards, "update"]);
    for more in [&["--batch", "3"][..], &["--stop-on-failure"], &["--report", "x"]] {
        wrong(&[&one[..], &[&update], more].concat(), "are for --inventory FILE without --try");
        wrong(&[&many[..], &[&update, "--try"], more].concat(), "are for --inventory FILE without --try");
    }
    wrong(&[&one[..], &[&update, "--confirm-s", "60"]].concat(), "need --try");
    wrong(&[&many[..], &[&key]].concat(), "not an update file");
    wrong(&[&many[..], &[&update, "--report", &path("none/report")]].concat(), "none/report: ");
    let ran = run(&[&many[..], &[&update, "--json", "--report", &path("report")]].concat(), None);
    assert_eq!(ran.code, Some(1), "{}", ran.err);
    assert!(ran.out.contains(r#""outcome":"failed","step":"inspect""#), "{}", ran.out);
    assert!(
        ran.err.starts_with("a: is asked what it runs\na: failed at inspect: 127.0.0.1:1: "),
        "{}",
        ran.err
    );
    assert!(ran.err.contains("\n0 of 1 boards run 0.3.0: 0 updated, 0 before; 1 failed; "), "{}", ran.err);
    let report = std::fs::read_to_string(path("report")).unwrap();
    assert!(report.contains("\"failed\": 1"), "{report}");
    wrong(&["inspect", &key], "not an update file");
    wrong(&["keygen", "--signing", &key], "keys are not replaced");
}
