//! What a board does not do itself: images, its first key, findings, captures and bundles are made here.

use std::io::Write;
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Duration;

use proto_core::config::{GatewayConfig, image};
use proto_core::engine::{Engine, Input, OUTPUT_BUFFER, Output, PortId};
use proto_core::time::{Duration as Span, Instant};
use recipe_api::documents::{Document, Pieces};
use recipe_config::file::{Text, parse_gateway};
use recipe_ctl::{Configuration, Failure, Stored, TrialOptions, Verdict};
use recipe_test_kit::example;
use serde_json::{Value, json};

use crate::server::*;

const FILE: &str = "force-sensor.toml";

fn config() -> Box<GatewayConfig> {
    let toml = std::fs::read_to_string(example(FILE)).unwrap();
    parse_gateway(Text { name: FILE, toml: &toml }, &[]).unwrap()
}

fn image() -> Vec<u8> {
    let mut bytes = vec![0; image::MAX_IMAGE];
    let len = image::encode(&*config(), &mut bytes).unwrap();
    bytes.truncate(len);
    bytes
}

/// What a force sensor sends that has the bytes of its head swapped.
fn frame() -> Vec<u8> {
    let mut frame = vec![0xAA, 0x48];
    for value in [1.25_f32, -0.5, 12.75, 0.031, -2.5, 100.0] {
        frame.extend(value.to_le_bytes());
    }
    frame.extend([0x0D, 0x0A]);
    frame
}

/// The stream of a board for some seconds of its clock: `status` five times a second, and the frames of its sensor.
fn stream() -> Vec<u8> {
    let mut engine = Box::new(Engine::<8>::new(&*config()).unwrap());
    let started = Instant::from_micros(1_000_000);
    let mut now = started;
    let mut handle = |now, input: Input<'_>| {
        engine.handle(now, input);
        while !matches!(engine.poll_output(now, &mut [0; OUTPUT_BUFFER]), Output::Sleep { .. }) {}
        let mut text = String::new();
        Pieces::of(Document::Status).write_all(engine.status(now), &mut text).unwrap();
        text
    };
    handle(now, Input::PortUp { port: PortId(0) });
    let mut stream = ENDLESS.to_vec();
    let hex: String = frame().iter().map(|byte| format!("{byte:02x}")).collect();
    for _ in 0..35 {
        let mut frames = Vec::new();
        let mut status = String::new();
        for _ in 0..10 {
            now += Span::from_millis(20);
            status = handle(now, Input::PortBytes { port: PortId(0), bytes: &frame() });
            frames.push(json!({
                "time_us": now.as_micros(), "port": "force", "direction": "in", "verdict": "no_frame",
                "text": "no frame found", "bytes": hex,
            }));
        }
        stream.extend(format!("event: status\ndata: {status}\n\n").as_bytes());
        let frames = json!({ "frames": frames, "lost": 0 });
        stream.extend(format!("event: frames\ndata: {frames}\n\n").as_bytes());
    }
    stream
}

/// A board that runs the force sensor's file.
fn board() -> Server {
    let (image, stream) = (image(), stream());
    let stored = Mutex::new(Vec::new());
    Server::start(move |asked| match (asked.method.as_str(), asked.path.as_str()) {
        ("GET", "info") => {
            ok(&json!({ "role": "board", "name": "rgw-3f21a0", "uptime_s": 100, "claimed": true }))
        }
        ("GET", "nonce") => ok(&json!({ "nonce": "0".repeat(48) })),
        ("GET", "config") => bytes(200, "application/octet-stream", "", &image),
        ("GET", "revisions") => {
            let stored: &Vec<u8> = &stored.lock().unwrap();
            // It is away for a moment, and then it runs what it was given.
            match stored.len() {
                0 => ok(&json!({ "live": 1, "running": 1, "base": "\"1-00000001\"", "kept": [] })),
                _ => ok(
                    &json!({ "live": 1, "running": 2, "trial": { "revision": 2, "left_s": 59.5 }, "kept": [] }),
                ),
            }
        }
        ("PUT", "config") => {
            assert_eq!(asked.field("If-Match"), Some("\"1-00000001\""));
            assert_eq!(asked.field("Content-Type"), Some("application/octet-stream"));
            image::decode(&asked.body).unwrap();
            asked.body.clone_into(&mut stored.lock().unwrap());
            document(201, "", &json!({ "waiting": 2, "live": 1, "running": 1 }))
        }
        ("POST", "apply") => document(202, "", &json!({ "revision": 2, "live": 1, "running": 1 })),
        ("GET", "stream?frames=1" | "stream?frames=1&port=force") => {
            let stream = stream.clone();
            Reply::Write(Box::new(move |connection| {
                connection.write_all(&stream)?;
                loop {
                    std::thread::sleep(Duration::from_millis(50));
                    connection.write_all(b":\n\n")?;
                }
            }))
        }
        ("GET", "status") => ok(&json!({ "health": "port-silent", "ports": { "force": {} } })),
        ("GET", "metrics") => bytes(200, "application/openmetrics-text", "", b"# EOF\n"),
        _ => not_found(),
    })
}

/// The controller of the examples is on this machine.
fn here() -> Vec<String> {
    vec!["controller.address=127.0.0.1".into()]
}

#[test]
fn a_board_is_not_given_its_own_address_as_the_controllers() {
    let server = board();
    let push = |configuration: &Configuration| recipe_ctl::push(&server.client(true), configuration, None);
    let error = push(&Configuration::read(&example(FILE), &[], None).unwrap()).unwrap_err();
    assert!(matches!(error, Failure::Wrong(_)), "{error:?}");
    assert!(error.message().contains("controller.address: this is the board itself"), "{error:?}");
    assert!(error.message().contains("--set controller.address=ADDRESS"), "{error:?}");
    assert!(!server.paths().iter().any(|path| path.starts_with("PUT")), "{:?}", server.paths());
    let other = vec!["controller.address=10.0.0.9".into()];
    push(&Configuration::read(&example(FILE), &other, None).unwrap()).unwrap();
    let put = server.asked().into_iter().find(|asked| asked.method == "PUT").unwrap();
    assert_eq!(image::decode(&put.body).unwrap().controller.address, "10.0.0.9");
}

#[test]
fn an_image_goes_to_a_board_and_not_to_a_host() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cell.img");
    std::fs::write(&path, image()).unwrap();
    let configuration = Configuration::read(&path, &[], None).unwrap();
    let server = board();
    recipe_ctl::push(&server.client(true), &configuration, None).unwrap();
    let put = server.asked().into_iter().find(|asked| asked.method == "PUT").unwrap();
    assert_eq!(put.body, image());
    let host = Server::start(|_| ok(&json!({ "role": "gateway" })));
    let error = recipe_ctl::push(&host.client(true), &configuration, None).unwrap_err();
    assert!(error.message().ends_with("a host takes the gateway file itself, TOML"), "{error:?}");
    let error = Configuration::read(&path, &here(), None).unwrap_err();
    assert!(error.message().contains("an image has no keys for --set"), "{error:?}");
    std::fs::write(&path, &image()[..40]).unwrap();
    assert!(matches!(Configuration::read(&path, &[], None), Err(Failure::Wrong(_))));
}

#[test]
fn a_host_takes_no_overrides() {
    let host = Server::start(|_| ok(&json!({ "role": "gateway" })));
    let configuration = Configuration::read(&example(FILE), &here(), None).unwrap();
    let error = recipe_ctl::push(&host.client(true), &configuration, None).unwrap_err();
    assert!(error.message().contains("--set is for boards"), "{error:?}");
}

#[test]
fn what_a_board_has_not_is_refused_before_anything_is_sent() {
    let mut toml = "[controller]\naddress = \"10.0.0.9\"\n".to_owned();
    for nth in 1..=3 {
        toml += &format!(
            "[[recipe]]\nname = \"r{nth}\"\nkind = \"stream\"\nmode = \"realtime\"\n[recipe.input]\nhead = [1, 2]\n\
             tail = [3, 4]\nfields = [\"WordInputReg[{nth}]\"]\n[[port]]\nname = \"line-{nth}\"\nbus = \"rs485\"\n\
             recipe = \"r{nth}\"\n"
        );
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cell.toml");
    std::fs::write(&path, toml).unwrap();
    Configuration::read(&path, &[], None).unwrap();
    for board in recipe_config::board::BOARDS {
        let error = Configuration::read(&path, &[], Some(board)).unwrap_err();
        assert!(error.message().contains("port.line-3.bus: the board"), "{error:?}");
        assert!(error.message().contains("has 2 RS-485 ports, and this is one more"), "{error:?}");
    }
}

#[test]
fn a_board_gets_an_image_and_is_waited_for() {
    let server = board();
    let configuration = Configuration::read(&example(FILE), &here(), None).unwrap();
    let trial = TrialOptions { confirm_s: 60.0, revision: None };
    let answer = recipe_ctl::push(&server.client(true), &configuration, Some(trial)).unwrap();
    let text = answer.text(WIDE);
    assert!(text.starts_with("revision 2 runs on trial; it is taken back in 60 s"), "{text}");
    let put = server.asked().into_iter().find(|asked| asked.method == "PUT").unwrap();
    assert_eq!(put.body, image());
    assert!(put.signed_nonce().is_some());
    let paths = server.paths();
    assert_eq!(paths.last().unwrap(), "GET revisions", "{paths:?}");
}

#[test]
fn a_board_that_takes_a_revision_back_is_believed() {
    let looks = Mutex::new(0);
    let server = Server::start(move |asked| match asked.path.as_str() {
        "nonce" => ok(&json!({ "nonce": "0".repeat(48) })),
        "apply" => document(202, "", &json!({ "revision": 2 })),
        _ => {
            let mut looks = looks.lock().unwrap();
            *looks += 1;
            let last = json!({ "revision": 2, "ended": "failed" });
            let mut shown = json!({ "running": 1, "live": 1, "last": last, "failure": "no room" });
            // It failed in the same way before, which is not to be taken for the end of this trial.
            match *looks {
                1 | 2 => shown["failure"] = json!("an old one"),
                3 => shown["trial"] = json!({ "revision": 2, "left_s": 60.0 }),
                _ => {}
            }
            ok(&shown)
        }
    });
    let trial = TrialOptions { confirm_s: 60.0, revision: None };
    let error = recipe_ctl::apply(&server.client(true), trial).unwrap_err();
    assert!(error.message().ends_with("revision 2: it did not start: no room"), "{error:?}");
}

#[test]
fn the_configuration_of_a_board_is_its_image() {
    let server = board();
    let stored = recipe_ctl::stored(&server.client(false), None).unwrap();
    assert_eq!(stored, Stored::Image(image()));
    assert_eq!(*stored.read().unwrap(), *config());
    let text = recipe_ctl::config(&server.client(false), None).unwrap().text(WIDE);
    assert!(text.starts_with(&format!("an image of {} bytes, with 1 ports", image().len())), "{text}");
}

#[test]
fn the_doctor_listens_to_a_board() {
    let server = board();
    let answer = recipe_ctl::doctor(&server.client(false), Duration::ZERO).unwrap();
    assert_eq!(answer.verdict(), Verdict::Trouble);
    let text = answer.text(WIDE);
    assert!(text.contains("port force: "), "{text}");
    assert!(
        text.contains("first seen AA 48") && text.contains("The bytes of the head are swapped"),
        "{text}"
    );
    let document: Value = serde_json::from_str(&answer.json()).unwrap();
    assert_eq!(document["findings"][0]["cause"], "head_swapped");
}

#[test]
fn a_capture_is_made_of_the_frames() {
    let server = board();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("force.pcapng");
    let second = Some(Duration::from_secs(1));
    let answer = recipe_ctl::capture(&server.client(false), &file, Some("force"), second).unwrap();
    assert!(answer.text(WIDE).ends_with("350 frames\n"), "{}", answer.text(WIDE));
    let bytes = std::fs::read(&file).unwrap();
    assert_eq!(bytes[..4], recipe_capture::pcapng::MAGIC);
    let count = bytes.windows(frame().len()).filter(|bytes| *bytes == frame()).count();
    assert_eq!(count, 350);
    let other = recipe_ctl::capture(&server.client(false), &file, Some("panel"), second).unwrap_err();
    assert_eq!(other, Failure::Wrong("there is no port panel; there are force".into()));
    std::fs::write(&file, "dear diary").unwrap();
    let error = recipe_ctl::capture(&server.client(false), &file, None, second).unwrap_err();
    assert!(error.message().contains("is no capture"), "{error:?}");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "dear diary");
}

#[test]
fn frames_are_traced_with_the_names_of_a_file() {
    let server = board();
    let names = recipe_ctl::Names::read(&example(FILE)).unwrap();
    let stopped = recipe_ctl::Stop::new().after(Duration::from_secs(1));
    let client = recipe_ctl::Client::new(
        server.at.to_string().parse().unwrap(),
        None,
        Duration::from_secs(20),
        stopped,
    )
    .unwrap();
    let mut out = Vec::new();
    recipe_ctl::trace(&client, Some("force"), Some(&names), false, &mut out).unwrap();
    let text = String::from_utf8(out).unwrap();
    assert_eq!(text.lines().count(), 350);
    let line = text.lines().nth(1).unwrap();
    assert!(line.starts_with("   0.020000  force  in   rejected: no frame found: AA 48"), "{line}");
}

#[test]
fn a_bundle_has_what_the_board_tells_and_says_what_is_missing() {
    let server = board();
    let bundle = recipe_ctl::bundle(&server.client(true)).unwrap();
    assert_eq!(bundle["info"]["name"], "rgw-3f21a0");
    assert_eq!(bundle["metrics"], "# EOF\n");
    assert_eq!(bundle["doctor"]["findings"][0]["cause"], "head_swapped");
    assert_eq!(bundle["config"]["image"].as_str().unwrap().len(), 2 * image().len());
    let missing: Vec<_> = bundle["missing"].as_object().unwrap().keys().collect();
    assert_eq!(missing, ["log", "values"]);
    assert!(!bundle.to_string().contains(KEY));
}

/// A board without a key, whose button is pressed when it is asked for the third time. It remembers what it was given.
fn unclaimed(file: PathBuf) -> Server {
    let state = Mutex::new((0, None::<String>));
    Server::start(move |asked| {
        let mut state = state.lock().unwrap();
        let (asked_for, key) = &mut *state;
        match asked.path.as_str() {
            "info" => {
                *asked_for += 1;
                let left = if key.is_none() && *asked_for > 2 { json!(59.0) } else { Value::Null };
                let mut info = json!({ "role": "board", "name": "rgw-3f21a0", "claimed": key.is_some() });
                if !left.is_null() {
                    info["claim_left_s"] = left;
                }
                ok(&info)
            }
            "claim" => {
                // It was written before it was sent.
                let digits = asked.json()["key"].as_str().unwrap().to_owned();
                assert_eq!(std::fs::read_to_string(&file).unwrap().trim_end(), digits);
                *key = Some(digits);
                ok(&json!({}))
            }
            "nonce" => ok(&json!({ "nonce": "0".repeat(48) })),
            "status" if asked.field("Authorization").is_some() => ok(&json!({ "health": "idle" })),
            _ => document(401, "", &json!({ "error": "the key is needed" })),
        }
    })
}

#[test]
fn a_key_is_written_before_it_is_sent_and_sent_once_the_button_is_pressed() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("cell.key");
    let server = unclaimed(file.clone());
    let mut told = Vec::new();
    let answer = recipe_ctl::claim(&server.client(false), &file, &mut |line| told.push(line.to_owned()));
    let text = answer.unwrap().text(WIDE);
    assert!(text.contains("it is claimed"), "{text}");
    assert_eq!(told[1], "press the button of rgw-3f21a0 within 60 s");
    let claims = server.paths().iter().filter(|path| *path == "POST claim").count();
    assert_eq!(claims, 1);
    let key = std::fs::read_to_string(&file).unwrap();
    assert!(!text.contains(key.trim_end()) && !told.concat().contains(key.trim_end()));
    // The answer was lost: the same again.
    let again = recipe_ctl::claim(&server.client(false), &file, &mut |_| {}).unwrap();
    assert!(again.text(WIDE).contains("it has this key already"));
    // Somebody else comes, and no key is made for nothing.
    let other = folder.path().join("other.key");
    let error = recipe_ctl::claim(&server.client(false), &other, &mut |_| {}).unwrap_err();
    assert!(error.message().contains("it has a key already"), "{error:?}");
    assert!(!other.exists());
}

#[test]
fn only_boards_are_claimed() {
    let server = Server::start(|_| ok(&json!({ "role": "gateway" })));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("key");
    let error = recipe_ctl::claim(&server.client(false), &file, &mut |_| {}).unwrap_err();
    assert!(error.message().contains("only a board is claimed, and this is a gateway"), "{error:?}");
    assert!(!file.exists());
}
