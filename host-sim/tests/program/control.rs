//! The simulated controller as a program: its counters, its events, and the commands that act on it.

use std::collections::BTreeSet;
use std::path::Path;

use rustix::process::Signal;
use serde_json::Value;

use super::BINARY;
use clap::CommandFactory;
use host_sim::cli::Cli;
use recipe_controller::KINDS;
use recipe_controller::operations::Operation;
use recipe_io::realtime::{self, Scheduling};
use recipe_test_kit::{HostSim, example, repository};

/// Every key of an object and of what is in it, but for names from the file and of variables.
fn keys(value: &Value, into: &mut BTreeSet<String>) {
    let Some(object) = value.as_object() else { return };
    for (key, value) in object {
        into.insert(key.clone());
        match (key.as_str(), value.as_object()) {
            ("registers" | "variables", _) => {}
            ("ports", Some(ports)) => ports.values().for_each(|port| keys(port, into)),
            _ => keys(value, into),
        }
    }
}

/// The words that a page shows as code.
fn documented(page: &Path) -> BTreeSet<String> {
    let text = std::fs::read_to_string(page).unwrap();
    let code = text.split('`').skip(1).step_by(2);
    let words = code.flat_map(|code| code.split(|c: char| !c.is_alphanumeric() && c != '_'));
    words.map(str::to_owned).collect()
}

#[test]
fn every_counter_of_the_controller_is_documented() {
    let folder = tempfile::tempdir().unwrap();
    let documented = documented(&repository().join("docs/devices.md"));
    for (file, device) in [
        ("rs485-system-controller.toml", "rs485=pty"),
        ("can-system-controller.toml", "can=slcan-pty"),
        ("udp-server-controller.toml", ""),
        ("client-controller.toml", ""),
    ] {
        let bind = format!("--bind={device}:{}", folder.path().join("line").display());
        let bind: &[&str] = if device.is_empty() { &[] } else { &[&bind] };
        let robot = BINARY.controller(&example(file), bind);
        let mut found = BTreeSet::new();
        keys(&robot.fresh(), &mut found);
        assert!(found.len() > 50, "{found:?}");
        let missing: Vec<_> = found.difference(&documented).collect();
        assert!(missing.is_empty(), "{file}: docs/devices.md section 4 does not name {missing:?}");
        robot.end();
    }
}

#[test]
fn the_events_file_holds_every_event_and_the_log_tells_them_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("events.jsonl");
    let events = format!("--events={}", file.display());
    let robot = BINARY.controller(&example("udp-server-controller.toml"), &[&events, "-v"]);
    robot.command("speed(50)", "set success");
    robot.command("state", "6:0:5:2");
    robot.ended_by(Signal::TERM);
    let text = std::fs::read_to_string(&file).unwrap();
    let events: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(events.iter().zip(1..).all(|(event, nth)| event["n"] == nth), "{text}");
    let kinds: BTreeSet<_> = events.iter().map(|event| event["event"].as_str().unwrap()).collect();
    for kind in ["started", "connected", "command", "reply", "speed"] {
        assert!(kinds.contains(kind), "{kind}: {text}");
    }
    // The next run replaces it; a wrong file stays and nothing is started.
    let robot = BINARY
        .controller(&example("udp-server-controller.toml"), &[&format!("--events={}", file.display()), "-v"]);
    robot.command("speed(50)", "set success");
    let said = recipe_test_kit::until("the words", || robot.log("speed: 100 % -> 50 %").pop());
    assert!(said.contains("INFO controller:") && said.contains("time_s="), "{said}");
    robot.end();
    assert!(std::fs::read_to_string(&file).unwrap().len() < text.len());
}

#[test]
fn a_ready_file_of_a_killed_run_is_gone_even_if_the_next_one_cannot_start() {
    let folder = tempfile::tempdir().unwrap();
    let ready = folder.path().join("ready.json");
    let controller = |extra: &[&str]| {
        let mut command = BINARY.run("controller", &example("udp-server-controller.toml"));
        command.args(recipe_test_kit::free_servers()).arg("--ready").arg(&ready).args(extra);
        command
    };
    for wrong in [["--set=listen.command=x"], ["--bind=wrong=pty:x"]] {
        let mut first = HostSim::start(&mut controller(&[]));
        first.kill();
        assert!(ready.exists());
        let output = controller(&wrong).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
        assert!(!ready.exists(), "{wrong:?}");
    }
}

#[test]
fn a_timeline_acts_by_itself_and_a_wrong_one_starts_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (file, events) = (folder.path().join("steps.toml"), folder.path().join("events.jsonl"));
    let steps = "[[step]]\nat_s = 0.2\ndo = \"set\"\nitems = { \"DI[3]\" = 1 }\n\
                 [[step]]\nwhen = { items = { \"DI[3]\" = 1 } }\nafter_s = 0.1\ndo = \"emergency_stop\"\n\
                 [[step]]\nwhen = { safety = \"stop0\" }\ndo = \"stop\"\n";
    std::fs::write(&file, steps).unwrap();
    let timeline = format!("--timeline={}", file.display());
    let options = [timeline.as_str(), &format!("--events={}", events.display()), "--time=factor=5"];
    let robot = BINARY.controller(&example("udp-server-controller.toml"), &options);
    robot.stats("the emergency stop", |stats| stats["safety"] != 5);
    let refused =
        recipe_test_kit::until("the warning", || robot.log("a step of the timeline was refused").pop());
    assert!(refused.contains("step=3"), "{refused}");
    robot.end();
    let text = std::fs::read_to_string(&events).unwrap();
    let done: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |kind: &str| done.iter().filter(|event| event["event"] == kind).collect::<Vec<_>>();
    let operations = of("operation");
    assert_eq!(
        (&operations[0]["do"], &operations[1]["do"]),
        (&"set".into(), &"emergency_stop".into()),
        "{text}"
    );
    let times = [&operations[0], &operations[1]].map(|event| event["time_s"].as_f64().unwrap());
    assert!(times[0] >= 0.2 && times[1] >= times[0] + 0.1, "{times:?}");
    let refused = of("refused");
    assert!(refused.len() == 1 && refused[0]["do"] == "stop" && refused[0]["error"].is_string(), "{text}");

    std::fs::write(&file, steps.replace("DI[3]\" = 1 }\n[[", "DI[99]\" = 1 }\n[[")).unwrap();
    let mut command = BINARY.run("controller", &example("udp-server-controller.toml"));
    let output = command.args(recipe_test_kit::free_servers()).arg(timeline).output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    let place = format!("{}:4:11: step[1].items.DI[99]: there is only DI[1..16]", file.display());
    assert!(output.status.code() == Some(2) && message.starts_with(&place), "{message}");
    assert!(output.stdout.is_empty());
}

/// `host-sim pendant`, told the address by the environment.
fn pendant(robot: &HostSim, line: &str) -> (Option<i32>, String, String) {
    let mut command = BINARY.command();
    command.env("HOST_SIM_CONTROL", robot.ready["control"].as_str().unwrap());
    let output = command.arg("pendant").args(line.split(' ')).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[track_caller]
fn done(robot: &HostSim, line: &str) -> String {
    let (code, out, err) = pendant(robot, line);
    assert_eq!((code, err.as_str()), (Some(0), ""), "{line}: {out}");
    out
}

#[test]
fn the_pendant_acts_on_a_running_controller() {
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("pick.jspf");
    std::fs::write(&script, "wait_ms(300); set(\"DO[1]\", true); log(\"done\");").unwrap();
    let robot = BINARY.controller(&example("udp-server-controller.toml"), &["--time=stepped"]);
    assert_eq!(done(&robot, "set DI[3]=1 WordInputReg[2]=on"), "done at 0.0 s\n");
    assert_eq!(
        done(&robot, "get DI[3] WordInputReg[2] AI_V[1]"),
        "AI_V[1]          0\nDI[3]            1\nWordInputReg[2]  1\n"
    );
    done(&robot, &format!("upload {}", script.display()));
    assert_eq!(done(&robot, "programs"), "pick.jspf\n");
    done(&robot, "run pick.jspf --speed 30");
    assert_eq!(done(&robot, "advance 0.1"), "done at 0.1 s\n");
    assert!(done(&robot, "state").contains("\nprogram   pick.jspf, running\nspeed     30.0 %\n"));
    assert_eq!(done(&robot, "wait program=none DO[1]=1"), "done at 0.3 s\n");
    let state = done(&robot, "state");
    assert!(
        state.contains("\nlast run  pick.jspf, run 1, finished\n") && state.ends_with("\nlog       done\n"),
        "{state}"
    );
    done(&robot, "fault command delay 0.5");
    done(&robot, "fault item RobotState[8] nan");
    let state = done(&robot, "state");
    assert!(state.contains("\nfault     kind=delay seconds=0.5 server=command\n"), "{state}");
    assert!(state.contains("\nfault     item=RobotState[8] kind=spoil value=nan\n"), "{state}");
    done(&robot, "heal");
    assert!(!done(&robot, "state").contains("fault"));
    let events = done(&robot, "events --kind log,program_started");
    assert_eq!(
        events,
        "   0.000000  program_started by=pendant program=pick.jspf run=1\n   0.300000  log             program=pick.jspf text=done\n"
    );
    let json: Value = serde_json::from_str(&done(&robot, "--json wait mode=remote")).unwrap();
    assert_eq!((&json["ok"], &json["result"], &json["time_s"]), (&true.into(), &Value::Null, &0.3.into()));
    assert!(done(&robot, "counters").contains("programs_started  "));

    for (line, code, why) in [
        ("wait mode=auto --timeout 0.5", 1, "not within 0.5 s: mode is remote, not auto\n"),
        ("set DI[17]=1", 1, "DI[17]: "),
        ("resume", 1, ""),
        ("set DI[1]", 2, "\"DI[1]\": no '='; write NAME=VALUE, such as DI[3]=1\n"),
        ("fault command delay", 2, "delay needs seconds\n"),
        ("estop", 2, "error: unrecognized subcommand 'estop'\n"),
        ("--to 127.0.0.1:1 state", 2, "127.0.0.1:1: nobody is there: "),
        ("--ready /dev/null state", 2, "--ready /dev/null: this is not the ready file of a controller\n"),
        ("--to= state", 2, "which controller? give --to ADDRESS or --ready FILE, or set HOST_SIM_CONTROL\n"),
    ] {
        let (exit, out, err) = pendant(&robot, line);
        assert_eq!((exit, out.as_str()), (Some(code), ""), "{line}: {err}");
        assert!(err.starts_with(why) && !err.is_empty(), "{line}: {err}");
    }
    robot.end();
}

#[test]
fn the_pendant_follows_events_until_the_controller_ends() {
    let robot = BINARY.controller(&example("udp-server-controller.toml"), &[]);
    let port = robot.at("control").port().to_string();
    let mut command = BINARY.command();
    let mut follower = recipe_test_kit::Process::start(command.args([
        "pendant",
        "--to",
        &port,
        "events",
        "-f",
        "--kind=mode",
    ]));
    let mode = recipe_test_kit::until("the event", || {
        done(&robot, "mode auto");
        done(&robot, "mode remote");
        follower.lines().first().cloned()
    });
    assert!(mode.contains("  mode            mode="), "{mode}");
    robot.end();
    assert_eq!(follower.ended().code(), Some(2));
    assert!(follower.all_errors().contains("the controller has closed the connection"));
}

#[test]
fn completions_know_the_commands() {
    for shell in ["bash", "zsh", "fish"] {
        let output = BINARY.command().args(["completions", shell]).output().unwrap();
        let script = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success() && script.contains("emergency-stop"), "{shell}");
    }
}

#[test]
fn real_time_scheduling_is_asked_for_unless_it_is_not_wanted() {
    let file = example("udp-server-controller.toml");
    let scheduling = |extra: &[&str]| {
        let robot = BINARY.controller(&file, &[&["-v"], extra].concat());
        let said =
            recipe_test_kit::until("the line", || robot.log("the simulated controller is running").pop());
        robot.end();
        said
    };
    let asked = scheduling(&[]);
    assert!(asked.contains("SCHED_FIFO"), "granted or refused: {asked}");
    for option in ["--no-realtime", "--time=stepped"] {
        let ordinary = scheduling(&[option]);
        assert!(
            ordinary.contains("scheduling=ordinary scheduling") && !ordinary.contains("FIFO"),
            "{ordinary}"
        );
    }
}

/// The log's own words do not show what the thread got: it was once asked for only where they were printed.
#[test]
fn the_threads_that_move_data_have_real_time_scheduling_where_it_is_allowed() {
    let is_allowed = std::thread::spawn(|| realtime::apply(Scheduling::FifoIfAllowed).word() == "fifo");
    let is_allowed = is_allowed.join().unwrap();
    let is_fifo = |program: &HostSim, thread: &str| {
        let read = |task: &Path, file: &str| std::fs::read_to_string(task.join(file)).unwrap_or_default();
        // A new thread is called as the one that made it until it has named itself.
        let task = recipe_test_kit::until("one thread of that name", || {
            let tasks = std::fs::read_dir(format!("/proc/{}/task", program.pid().as_raw_pid())).unwrap();
            let tasks = tasks.map(|task| task.unwrap().path());
            let named = tasks.filter(|task| read(task, "comm").trim() == thread).collect::<Vec<_>>();
            <[_; 1]>::try_from(named).ok().map(|[task]| task)
        });
        let stat = read(&task, "stat");
        // Behind the name in parentheses, which is the second field, the 41st is the policy.
        let policy = stat.rsplit_once(") ").and_then(|(_, rest)| rest.split(' ').nth(38)).unwrap();
        policy == SCHED_FIFO
    };
    let robot = BINARY.controller(&example("udp-server-controller.toml"), &[]);
    assert_eq!(is_fifo(&robot, "controller"), is_allowed);
    let folder = tempfile::tempdir().unwrap();
    let line = format!("--bind=force=pty:{}", folder.path().join("line").display());
    for (extra, expected) in [(&[][..], is_allowed), (&["--no-realtime"][..], false)] {
        let mut command = BINARY.run("gateway", &example("force-sensor.toml"));
        let gateway =
            HostSim::start(command.args(["--set", "controller.address=127.0.0.1", &line]).args(extra));
        assert_eq!(is_fifo(&gateway, "gateway"), expected, "{extra:?}");
        assert!(!is_fifo(&gateway, "host-sim"), "the console and the signals may wait");
        gateway.end();
    }
    robot.end();
}

/// The number of the policy in `/proc`.
const SCHED_FIFO: &str = "1";

#[test]
fn every_operation_and_event_is_documented_and_has_its_command() {
    let documented = documented(&repository().join("docs/control.md"));
    let unknown = serde_json::json!({ "do": "?" });
    let error = Operation::from_json(unknown.as_object().unwrap().clone()).unwrap_err().to_string();
    // "unknown variant `?`, expected one of `state`, `get`, ..."
    let operations: Vec<&str> = error.split('`').skip(3).step_by(2).collect();
    assert!(operations.len() > 30, "{error}");
    let cli = Cli::command();
    let pendant = cli.find_subcommand("pendant").unwrap();
    for operation in operations {
        assert!(documented.contains(operation), "docs/control.md does not name {operation}");
        // Following is an option of `events`.
        let command = if operation == "follow" { "events".to_owned() } else { operation.replace('_', "-") };
        assert!(pendant.find_subcommand(&command).is_some(), "host-sim pendant has no {command}");
    }
    for kind in KINDS {
        assert!(documented.contains(kind), "docs/control.md does not name the event {kind}");
    }
}
