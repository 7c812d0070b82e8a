//! What several answers to one request mean in the configuration, what tells of a restart, and every mistake in them.

use proto_core::config::{Exchange, GatewayConfig, Restarted, Transaction};
use recipe_config::file::{Text, parse_gateway};

use super::wrong_files::{Case, messages};

const ANSWERS: &str = include_str!("good/answers.toml");

fn parse(toml: &str) -> Box<GatewayConfig> {
    parse_gateway(Text { name: "answers.toml", toml }, &[]).unwrap_or_else(|error| panic!("{error}"))
}

fn exchanges(config: &GatewayConfig, recipe: usize) -> &[Exchange] {
    config.view().exchanges_of(&config.recipes[recipe])
}

#[test]
fn answers_and_their_values() {
    let config = parse(ANSWERS);
    let [start, ..] = exchanges(&config, 0) else { panic!() };
    let Transaction::Frames { request, reply, refusal } = start.transaction else { panic!() };
    assert_eq!([request, reply, start.pending, refusal], [Some(0), Some(1), Some(2), Some(3)]);
    let written: Vec<_> = config.view().written_by(&config.recipes[0]).map(|var| var.to_string()).collect();
    assert_eq!(written, ["WordInputReg[1]", "WordInputReg[2]", "WordInputReg[3]"]);
    let home = exchanges(&config, 1)[0];
    let Transaction::Frames { refusal, .. } = home.transaction else { panic!() };
    assert!(home.pending.is_some() && refusal.is_some());
}

#[test]
fn what_tells_of_a_restart() {
    let config = parse(ANSWERS);
    let told =
        |recipe| exchanges(&config, recipe).iter().map(|exchange| exchange.restarted).collect::<Vec<_>>();
    let restarted = |field, value| Some(Restarted { field, value });
    assert_eq!(told(0), [None, None, restarted(1, 0.0)], "padding does not count");
    assert_eq!(told(2), [None, restarted(2, 0.0), restarted(0, 3.0)], "a constant does");
}

const fn case(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (ANSWERS, from, to) }
}

#[rustfmt::skip]
const CASES: &[Case] = &[
    case("a pending answer without a request", "on = [\"start\"]\nrequest = { head = [3], fields = [{ name = \"enable\", type = \"byte\", value = 1 }] }\nreply", "pending = { head = [9], fields = [{ pad = 1 }] }\nreply"),
    case("a pending answer without a reply", "reply = { id = 0x581, fields = [{ type = \"byte\", equals = 0 }] }\n", ""),
    case("a pending answer that is the reply", "equals = 1 }, { name = \"progress\"", "equals = 0 }, { name = \"progress\""),
    case("a pending answer behind a reply without a constant", "reply = { id = 0x581, fields = [{ type = \"byte\", equals = 0 }] }", "reply = { id = 0x581, fields = [{ pad = 1 }] }"),
    case("a refusal that is the beginning of the reply", "to = \"WordInputReg[3]\" }, { pad = 1 }]", "to = \"WordInputReg[3]\" }]"),
    case("a refusal on CAN that is the pending answer", "{ name = \"why\", type = \"byte\", to = \"WordInputReg[5]\" }", "{ type = \"byte\", equals = 1 }"),
    case("a pending answer like its request", "pending = { head = [6], fields = [{ type = \"byte\", equals = 1 },", "pending = { head = [2], fields = [{ pad = 1 },"),
    case("a command in a refusal", "to = \"WordInputReg[3]\"", "commands = { 1 = \"stop\" }"),
    case("a counter in a pending answer", "to = \"WordInputReg[2]\"", "counter = true"),
    case("a variable that two answers write", "to = \"WordInputReg[3]\"", "to = \"WordInputReg[2]\""),
    case("an output of the robot in a refusal", "to = \"WordInputReg[3]\"", "to = \"WordOutputReg[3]\""),
    case("a value that a refusal can never bring", "to = \"WordInputReg[3]\"", "to = \"WordInputReg[3]\", min = 9, max = 3"),
    case("timeout_ms of a pending answer", "pending = { head = [6],", "pending = { timeout_ms = 5, head = [6],"),
    case("a pending answer of Modbus", "address = 1\n", "address = 1\npending = { fields = [{ pad = 1 }] }\n"),
    case("a pending answer that is no table", "pending = { id = 0x581, fields = [{ type = \"byte\", equals = 1 }] }", "pending = 1"),
    // A restart.
    case("restarted that is no number", "bits = 1, restarted = 0", "bits = 1, restarted = true"),
    case("restarted of 2 in one bit", "bits = 1, restarted = 0", "bits = 1, restarted = 2"),
    case("half a number", "restarted = 3", "restarted = 0.5"),
    case("two fields that tell", "to = \"BitInputReg[3].0\"", "to = \"BitInputReg[3].0\", restarted = 1"),
    case("restarted of a device without a start", "peer = 1\non = [\"start\"]", "peer = 2\non = [\"start\"]"),
    case("restarted of a constant", "{ equals = 1 }", "{ equals = 1, restarted = 1 }"),
    case("restarted in a refusal", "to = \"WordInputReg[3]\"", "to = \"WordInputReg[3]\", restarted = 1"),
    case("restarted in a pending answer", "to = \"WordInputReg[2]\"", "to = \"WordInputReg[2]\", restarted = 1"),
    case("restarted in a request", "{ name = \"enable\", type = \"byte\", value = 1 }", "{ name = \"enable\", type = \"byte\", value = 1, restarted = 1 }"),
    case("restarted in an input part", "mode = \"user\"\n\n[[recipe.exchange]]\npeer = 1\n", "mode = \"user\"\ninput = { head = [9], fields = [{ name = \"x\", type = \"byte\", restarted = 1 }] }\n\n[[recipe.exchange]]\npeer = 1\n"),
];

#[test]
fn wrong_answers() {
    insta::assert_snapshot!(messages(CASES, |_| "answers.toml"));
}
