//! What the keys of events mean in the configuration, and every mistake in them.

use proto_core::config::{Bus, Echo, Exchange, GatewayConfig, OutcomeTo, Port, Triggers};
use proto_core::sysvar::SysVar;
use proto_core::time::Duration;
use recipe_config::file::{Text, parse_gateway};

use super::wrong_files::{Case, messages};

const EVENTS: &str = include_str!("good/events.toml");

fn parse(toml: &str) -> Box<GatewayConfig> {
    parse_gateway(Text { name: "events.toml", toml }, &[]).unwrap_or_else(|error| panic!("{error}"))
}

fn exchanges(config: &GatewayConfig, recipe: usize) -> &[Exchange] {
    config.view().exchanges_of(&config.recipes[recipe])
}

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn var(name: &str) -> Option<SysVar> {
    Some(SysVar::parse(name).unwrap())
}

#[test]
fn keys_of_events() {
    let config = parse(EVENTS);
    let [force, go, stop, position, serial] = exchanges(&config, 0) else { panic!("5 exchanges") };
    assert_eq!((force.trigger, force.late), (Some(ms(250)), Some(Duration::ZERO)));
    assert_eq!((force.retries, force.event_retries), (1, 1));
    let outcome = OutcomeTo {
        to: var("WordInputReg[20]"),
        code_to: var("WordInputReg[21]"),
        count_to: var("WordInputReg[22]"),
    };
    assert_eq!((force.outcome, force.stop, force.follow), (outcome, false, None));

    assert_eq!((go.when, go.follow, go.trigger), (Triggers::NEVER, Some(0), None));
    assert_eq!(go.outcome, OutcomeTo { to: var("WordInputReg[23]"), ..OutcomeTo::NONE });
    // Events are not repeated unless the file says so.
    assert_eq!((go.retries, go.event_retries), (1, 0));
    assert_eq!((position.retries, position.event_retries), (2, 0));

    assert!(stop.stop);
    assert_eq!((position.late, position.overdue), (Some(ms(2500)), Some(ms(400))));
    assert_eq!((serial.late, serial.overdue, serial.outcome), (None, Some(Port::NEVER), OutcomeTo::NONE));

    let [load, mark] = exchanges(&config, 1) else { panic!("2 exchanges") };
    assert_eq!((load.overdue, load.follow), (Some(Port::NEVER), None));
    assert_eq!((mark.overdue, mark.follow), (Some(ms(30_000)), Some(0)));
}

#[test]
fn what_ports_know_of_echoes_and_absences() {
    let echoes = |config: &GatewayConfig| -> Vec<_> {
        let echo = |port: &Port| match port.bus {
            Bus::Rs485(line) => (line.echo, port.absent),
            _ => panic!("{port:?}"),
        };
        config.ports.iter().map(echo).collect()
    };
    assert_eq!(echoes(&parse(EVENTS)), [(Echo::Auto, ms(5000)), (Echo::No, ms(3000))]);
    let given = EVENTS.replace("echo = false", "echo = true").replace("echo = \"auto\"\n", "");
    assert_eq!(echoes(&parse(&given)), [(Echo::Auto, ms(5000)), (Echo::Yes, ms(3000))]);
}

/// A step may stand before the one that it follows.
#[test]
fn the_order_of_steps_is_free() {
    let swapped = EVENTS
        .replace("name = \"force\"\nslave", "follow = \"move\"\nslave")
        .replace("on = [\"rising:BitOutputReg[3].0\"]\n", "");
    let swapped = swapped.replace("follow = \"force\"\n", "on = [\"rising:BitOutputReg[3].0\"]\n");
    let config = parse(&swapped);
    let follows: Vec<_> = exchanges(&config, 0).iter().map(|exchange| exchange.follow).collect();
    assert_eq!(follows, [Some(1), None, None, None, None]);
}

const fn events(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (EVENTS, from, to) }
}

#[rustfmt::skip]
const CASES: &[Case] = &[
    // In time.
    events("trigger_ms without an event", "every_ms = 100\n", "every_ms = 100\ntrigger_ms = 100\n"),
    events("trigger_ms of a stop", "stop = true", "stop = true\ntrigger_ms = 100"),
    events("trigger_ms of 20 s", "trigger_ms = 250", "trigger_ms = 20000"),
    events("trigger_ms of 0", "trigger_ms = 250", "trigger_ms = 0"),
    events("trigger_ms that is a text", "trigger_ms = 250", "trigger_ms = \"never\""),
    events("a negative late_ms", "late_ms = 2500", "late_ms = -1"),
    events("late_ms of two hours", "late_ms = 2500", "late_ms = 7200000"),
    events("late_ms of a request without a reply", "request = { head = [3], fields = [{ name = \"go\", type = \"byte\", value = 1 }] }\nreply = { head = [7], fields = [{ name = \"marked\", type = \"byte\", to = \"WordInputReg[4]\" }], timeout_ms = 30000 }", "late_ms = 10\nrequest = { head = [3], fields = [{ name = \"go\", type = \"byte\", value = 1 }] }"),
    events("late_ms where nobody answers", "slave = 9\nfunction = \"write-register\"\naddress = 0x11", "slave = 0\nlate_ms = 5\nfunction = \"write-register\"\naddress = 0x11"),
    // Steps.
    events("follow of an unknown name", "follow = \"force\"", "follow = \"fource\""),
    events("follow where no exchange has a name", "name = \"load\"\n", ""),
    events("follow that is a number", "follow = \"force\"", "follow = 0"),
    events("follow of itself", "name = \"move\"\nfollow = \"force\"", "name = \"move\"\nfollow = \"move\""),
    events("a circle", "name = \"force\"\nslave = 9\nfunction = \"write-register\"\naddress = 0x10\non = [\"rising:BitOutputReg[3].0\"]", "name = \"force\"\nslave = 9\nfunction = \"write-register\"\naddress = 0x10\nfollow = \"move\""),
    events("a circle behind the one that follows", "[[recipe.exchange]]\nname = \"load\"\non = [\"rising:BitOutputReg[4].0\"]", "[[recipe.exchange]]\nfollow = \"a\"\nrequest = { head = [9], fields = [{ pad = 1 }] }\n[[recipe.exchange]]\nname = \"a\"\nfollow = \"load\"\nrequest = { head = [9], fields = [{ pad = 1 }] }\nreply = { head = [10], fields = [{ pad = 1 }] }\n[[recipe.exchange]]\nname = \"load\"\nfollow = \"a\""),
    events("follow of an exchange without a reply", "reply = { head = [6], fields = [{ name = \"loaded\", type = \"byte\", to = \"WordInputReg[3]\" }], expect = \"event\" }\n", ""),
    events("follow of a write to all slaves", "trigger_ms = 250\nretries = 1\nlate_ms = 0\nwrite = [{ name = \"force\", type = \"word\", from = \"WordOutputReg[1]\" }]\noutcome = { to = \"WordInputReg[20]\", code_to = \"WordInputReg[21]\", count_to = \"WordInputReg[22]\" }", "write = [{ name = \"force\", type = \"word\", value = 1 }]\n[[recipe.exchange]]\nslave = 0\nfunction = \"write-register\"\naddress = 9\nname = \"all\"\nevery_ms = 10\nwrite = [{ name = \"x\", type = \"word\", value = 1 }]\n[[recipe.exchange]]\nslave = 9\nfunction = \"write-register\"\naddress = 8\nfollow = \"all\"\nwrite = [{ name = \"x\", type = \"word\", value = 1 }]"),
    events("neither follow nor a bit", "follow = \"load\"\n", ""),
    events("follow beside a bit", "follow = \"force\"", "follow = \"force\"\non = [\"rising:BitOutputReg[3].3\"]"),
    events("follow of one that stops", "on = [\"rising:BitOutputReg[3].7\"]\nstop = true", "follow = \"force\"\nstop = true"),
    events("a name twice", "name = \"move\"", "name = \"force\""),
    events("an empty name", "name = \"move\"", "name = \"\""),
    events("a name of 33 bytes", "name = \"move\"", "name = \"abcdefghijklmnopqrstuvwxyzabcdefg\""),
    // A stop.
    events("stop without a reply", "reply = { head = [6], fields = [{ name = \"loaded\", type = \"byte\", to = \"WordInputReg[3]\" }], expect = \"event\" }\n", "stop = true\n"),
    events("a stop of all slaves", "slave = 9\nfunction = \"write-coil\"", "slave = 0\nfunction = \"write-coil\""),
    events("a stop that is no bool", "stop = true", "stop = \"yes\""),
    // What became of it.
    events("outcome of a plain period", "late_ms = 2500\n", "outcome = { to = \"WordInputReg[30]\" }\n"),
    events("outcome to a bit", "code_to = \"WordInputReg[21]\"", "code_to = \"BitInputReg[3].4\""),
    events("outcome to a byte of bits", "outcome = { to = \"WordInputReg[23]\" }", "outcome = { to = \"BitInputReg[3]\" }"),
    events("outcome to what the robot writes", "outcome = { to = \"WordInputReg[23]\" }", "outcome = { count_to = \"WordOutputReg[20]\" }"),
    events("outcome to an unknown variable", "outcome = { to = \"WordInputReg[23]\" }", "outcome = { to = \"FloatInputReg[200]\" }"),
    events("outcome to one variable twice", "code_to = \"WordInputReg[21]\"", "code_to = \"WordInputReg[20]\""),
    events("outcome to a value of the device", "outcome = { to = \"WordInputReg[23]\" }", "outcome = { to = \"WordInputReg[1]\" }"),
    events("an empty outcome", "outcome = { to = \"WordInputReg[23]\" }", "outcome = {}"),
    events("an unknown key of an outcome", "outcome = { to = \"WordInputReg[23]\" }", "outcome = { two = \"WordInputReg[23]\" }"),
    events("an outcome that is a text", "outcome = { to = \"WordInputReg[23]\" }", "outcome = \"WordInputReg[23]\""),
    // Values that come when something happens.
    events("expect = \"event\" beside overdue_ms", "overdue_ms = 400", "overdue_ms = 400\nexpect = \"event\""),
    events("expect = \"event\" beside timeout_ms of a reply", "timeout_ms = 30000", "timeout_ms = 30000, expect = \"event\""),
    events("expect = \"steadily\"", "expect = \"event\"\nread", "expect = \"steadily\"\nread"),
    events("expect on a write", "follow = \"force\"\n", "follow = \"force\"\nexpect = \"event\"\n"),
    events("overdue_ms on a write", "follow = \"force\"\n", "follow = \"force\"\noverdue_ms = 5\n"),
    events("overdue_ms of 0", "overdue_ms = 400", "overdue_ms = 0"),
    events("timeout_ms of 0 of a reply", "timeout_ms = 30000", "timeout_ms = 0"),
    events("expect beside frames", "follow = \"load\"\n", "follow = \"load\"\nexpect = \"event\"\n"),
    events("expect of a request", "value = 1 }] }\nreply", "value = 1 }], expect = \"event\" }\nreply"),
    events("expect of a refusal", "timeout_ms = 30000 }", "timeout_ms = 30000 }\nrefusal = { head = [8], fields = [{ pad = 1 }], expect = \"event\" }"),
    // Ports.
    events("an echo that is another word", "echo = \"auto\"", "echo = \"maybe\""),
    events("absent_ms of 0", "absent_ms = 5000", "absent_ms = 0"),
    events("absent_ms that never ends", "absent_ms = 5000", "absent_ms = \"never\""),
];

#[test]
fn wrong_events() {
    insta::assert_snapshot!(messages(CASES, |_| "events.toml"));
}
