//! What a file of version 0.2 means now is told where it applies, and not where a newer key has decided it.

use recipe_config::changes_since_0_2;
use recipe_config::file::{self, Text};

/// What is told of a file: the key without its recipe, and the sentence behind its place.
#[track_caller]
fn told(recipe: &str, port: &str) -> Vec<(String, String)> {
    let toml = format!(
        "[controller]\naddress = \"10.0.0.2\"\n[[recipe]]\nname = \"r\"\nmode = \"user\"\n{recipe}\n\
         [[port]]\nname = \"p\"\nrecipe = \"r\"\ntimeout_ms = 400\n{port}\n"
    );
    let text = Text { name: "test.toml", toml: &toml };
    let config = file::parse_gateway(text, &[]).unwrap();
    let frames = file::parse_frames(text, &[]).unwrap();
    let split = |(key, said): (Vec<String>, String)| {
        let (place, said) = said.split_once(": ").unwrap();
        let key = key.join(".");
        // Both say the same place.
        assert!(
            place.starts_with("port \"p\", ") && place.ends_with(key.rsplit('.').next().unwrap()),
            "{place} {key}"
        );
        (key.trim_start_matches("recipe.r.").to_owned(), said.to_owned())
    };
    changes_since_0_2(&config, &frames).into_iter().map(split).collect()
}

/// The keys only.
#[track_caller]
fn keys(recipe: &str, port: &str) -> Vec<String> {
    told(recipe, port).into_iter().map(|(key, _)| key).collect()
}

const LINE: &str = "bus = \"modbus-rtu\"\necho = false";

/// Exchanges of Modbus, each of its own slave and with `late_ms = 0`, which says nothing of late replies.
fn modbus(exchanges: &[&str]) -> String {
    let one = |(slave, keys): (usize, &&str)| {
        let late = if keys.contains("late_ms") { "" } else { "late_ms = 0\n" };
        let slave = if keys.contains("slave") { String::new() } else { format!("slave = {slave}\n") };
        format!("[[recipe.exchange]]\n{slave}{late}{keys}\n")
    };
    format!("kind = \"modbus-rtu\"\n{}", (1..).zip(exchanges).map(one).collect::<String>())
}

const WRITE: &str = "function = \"write-registers\"\naddress = 1\nwrite = [{ name = \"v\", type = \"word\", from = \"WordOutputReg[1]\" }]\n";
const RISES: &str = "on = [\"rising:BitOutputReg[3].0\"]\n";
const READ: &str = "function = \"read-holding-registers\"\naddress = 1\nevery_ms = 100\n";

fn with(keys: &str, more: &str) -> String {
    format!("{keys}{more}")
}

#[test]
fn events_are_told_once_and_not_where_the_file_decides() {
    let event = with(WRITE, RISES);
    let all = told(&modbus(&[&event]), LINE);
    let (on, retries) = (
        "a rise is sent once, with its values, within 400 ms (trigger_ms), or not at all. In 0.2 it was sent whenever that \
         became possible, with the values of then",
        "it is not repeated when its reply is lost. In 0.2 it was, once; retries = 1 does that, and the device may carry it \
         out twice",
    );
    let expected = [("exchange.1.on", on), ("exchange.1.retries", retries)];
    assert_eq!(all, expected.map(|(key, said)| (key.to_owned(), said.to_owned())));
    let keys_with = |more: &str| keys(&modbus(&[&with(&event, more)]), LINE);
    assert_eq!(keys_with("trigger_ms = 200\n"), ["exchange.1.retries"]);
    assert_eq!(keys_with("retries = 0\n"), ["exchange.1.on"]);
    assert_eq!(keys_with("retries = 1\n"), ["exchange.1.on"]);
    assert_eq!(keys_with("retries = 3\ntrigger_ms = 200\n"), [""; 0]);
    assert_eq!(keys_with("stop = true\n"), [""; 0]);
}

#[test]
fn what_the_start_asks_for_is_told() {
    let start = with(WRITE, "on = [\"start\"]\n");
    assert_eq!(keys(&modbus(&[&start]), LINE), ["exchange.1.retries", "exchange.1.on"]);
    let state = with(WRITE, "on = [\"start\"]\nevery_ms = 500\n");
    assert_eq!(keys(&modbus(&[&state]), LINE), ["exchange.1.on"]);
    let (_, said) = told(&modbus(&[&state]), "bus = \"modbus-rtu\"\necho = false\nabsent_ms = 700").remove(0);
    assert!(said.contains("only when the device was away for 700 ms or more (absent_ms"), "{said}");
    let read = READ.replace("every_ms = 100", "on = [\"start\"]");
    let read = with(&read, "read = [{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }]");
    assert_eq!(keys(&modbus(&[&read]), LINE), ["exchange.1.on"]);
}

#[test]
fn exchanges_with_one_bit_are_a_dialogue_and_that_is_told() {
    let step = |slave| with(WRITE, &format!("{RISES}slave = {slave}\ntrigger_ms = 100\nretries = 0\n"));
    let of = |slaves: [u8; 3]| {
        let steps = slaves.map(step);
        let told = told(&modbus(&steps.each_ref().map(|step| step.as_str())), LINE);
        told.into_iter().filter(|(key, _)| key.ends_with("on")).collect::<Vec<_>>()
    };
    assert_eq!(of([3, 4, 5]), []);
    let all = of([3, 4, 3]);
    assert!(all.len() == 1 && all[0].0 == "exchange.3.on", "{all:?}");
    assert!(all[0].1.starts_with("exchange 1 has the same bit, so this one is sent only after"), "{all:?}");
    let all = of([3, 3, 3]);
    assert!(all.len() == 2 && all[1].1.starts_with("exchange 2 has"), "{all:?}");
}

#[test]
fn echo_is_told_where_a_reply_may_be_one() {
    let coil =
        "function = \"write-coil\"\naddress = 1\nevery_ms = 100\nwrite = [{ name = \"c\", value = 1 }]";
    let line = "bus = \"modbus-rtu\"";
    assert_eq!(keys(&modbus(&[coil]), line), ["port.p.echo"]);
    assert_eq!(keys(&modbus(&[coil]), LINE), [""; 0]);
    assert_eq!(keys(&modbus(&[&with(WRITE, "every_ms = 100\n")]), line), [""; 0]);
}

#[test]
fn rejected_fields_are_told_where_others_are_in_the_frame() {
    let read = |fields: &str| with(READ, &format!("read = [{fields}]"));
    let word = "{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }";
    let signed = "{ name = \"b\", type = \"short\", to = \"WordInputReg[2]\" }";
    let of = |fields: &[&str]| told(&modbus(&[&read(&fields.join(", "))]), LINE);
    // No number does not fit; nothing else is in the frame; the file has decided.
    assert_eq!(of(&[word]), []);
    assert_eq!(of(&[signed]), []);
    let decided = signed.replace("to =", "as = \"int16\", to =");
    assert_eq!(of(&[word, &decided]), []);
    let all = of(&[word, signed]);
    assert_eq!(all[0].0, "exchange.1.read");
    assert_eq!(
        all[0].1,
        "what does not fit, or cannot be read, rejects only its field (\"b\"): the others are taken, and that field goes to \
         its value of on_timeout after 400 ms, or holds. In 0.2 it rejected the frame"
    );
    // A float may be no number, digits may be none.
    let float = "{ name = \"f\", type = \"float\", to = \"WordInputReg[3]\" }";
    assert!(of(&[word, float])[0].1.contains("(\"f\")"));
    let to_float = float.replace("WordInputReg[3]", "FloatInputReg[1]");
    let up = "[[recipe]]\nname = \"up\"\nkind = \"stream\"\nmode = \"realtime\"\n[recipe.input]\nhead = [1]\n\
              fields = [\"FloatInputReg[1]\"]\n[[port]]\nname = \"up\"\nbus = \"udp-listen\"\nrecipe = \"up\"\n\
              listen = \"0.0.0.0:5000\"";
    let all = told(&modbus(&[&read(&[word, &to_float].join(", "))]), &format!("{LINE}\n{up}"));
    assert!(all.len() == 1 && all[0].1.contains("(\"f\")"), "{all:?}");
    let digits = "kind = \"stream\"\n[recipe.input]\ntail = [13]\nfields = [\n{ name = \"x\", type = \"decimal\", width = 4, \
                  to = \"WordInputReg[1]\" },\n{ name = \"y\", type = \"byte\", to = \"WordInputReg[2]\" }]";
    let all = told(digits, "bus = \"rs485\"");
    assert!(all.len() == 1 && all[0].0 == "input" && all[0].1.contains("(\"x\")"), "{all:?}");
    // A frame of the controller's own form is rejected as a whole, as before.
    let plain = "kind = \"stream\"\n[recipe.input]\ntail = [13]\nfields = [\n{ name = \"x\", type = \"short\", \
                 to = \"WordInputReg[1]\" },\n{ name = \"y\", type = \"byte\", to = \"WordInputReg[2]\" }]";
    assert_eq!(told(plain, "bus = \"rs485\""), []);
    let can = "kind = \"can\"\n[[recipe.input.frame]]\nid = 1\nendian = \"big\"\nfields = [\n{ name = \"x\", type = \"short\", \
               to = \"WordInputReg[1]\" },\n{ name = \"y\", type = \"byte\", to = \"WordInputReg[2]\" }]";
    assert_eq!(keys(can, "bus = \"can\""), ["input.frame.1"]);
    // What a master writes is taken or refused as a whole.
    let block = format!(
        "kind = \"modbus-rtu-slave\"\naddress = 5\n[[recipe.block]]\ntable = \"holding-registers\"\naddress = 0\n\
         fields = [{word}, {signed}]"
    );
    assert_eq!(told(&block, "bus = \"modbus-rtu-slave\""), []);
}

#[test]
fn late_replies_are_told_of_those_that_look_alike_and_of_the_others_together() {
    let read = |to: u8| {
        let field = format!("{{ name = \"v{to}\", type = \"word\", to = \"WordInputReg[{to}]\" }}");
        with(READ, &format!("slave = 1\ntimeout_ms = 500\nlate_ms = 0\nread = [{field}]"))
    };
    let late = |exchanges: [String; 3]| {
        let exchanges = exchanges.map(|one| one.replace("late_ms = 0\n", "#late_ms\n"));
        let told = told(&modbus(&exchanges.each_ref().map(|one| one.as_str())), LINE);
        told.into_iter().filter(|(key, _)| key.ends_with("late_ms")).collect::<Vec<_>>()
    };
    let other = with(WRITE, "every_ms = 100\nslave = 1\nlate_ms = 0\n");
    let all = late([read(1), other.clone(), read(2)]);
    assert_eq!(all.len(), 2, "{all:?}");
    assert_eq!(all[0].0, "exchange.1.late_ms");
    assert!(
        all[0].1.contains("exchanges 1, 3 look alike") && all[0].1.contains("asked for 1500 ms after"),
        "{all:?}"
    );
    assert!(all[1].0 == "exchange.2.late_ms" && all[1].1.contains("(2)"), "{all:?}");
    let decided = read(1).replace("late_ms = 0", "late_ms = 5");
    let all = late([decided.clone(), other, decided.replace("v1", "v2").replace("Reg[1]", "Reg[2]")]);
    assert!(all.len() == 1 && all[0].0 == "exchange.2.late_ms", "{all:?}");
}

#[test]
fn refusals_and_silent_exchanges_are_told() {
    let change = with(WRITE, "on = [\"change\"]\n");
    let all = told(&modbus(&[&change]), LINE);
    assert!(all.len() == 1 && all[0].0 == "exchange.1.on" && all[0].1.contains("as busy (6)"), "{all:?}");
    assert_eq!(keys(&modbus(&[&with(&change, "every_ms = 100\n")]), LINE), [""; 0]);
    let period = with(WRITE, "every_ms = 100\nslave = 1\n");
    assert_eq!(keys(&modbus(&[&period]), LINE), [""; 0]);
    let two = [period.as_str(), &period.replace("address = 1", "address = 2")];
    assert_eq!(keys(&modbus(&two), LINE), ["exchange.1.slave"]);
    let sdo = "kind = \"can\"\n[[recipe.exchange]]\nevery_ms = 100\nlate_ms = 0\nrequest = { id = 0x605, fields = [{ name = \
               \"c\", type = \"byte\", value = 0x40 }, { pad = 7 }] }\nreply = { id = 0x585, fields = [{ name = \"v\", type = \
               \"byte\", to = \"WordInputReg[1]\" }, { pad = 7 }] }\n";
    assert_eq!(keys(sdo, "bus = \"can\""), ["exchange.1.refusal"]);
    let refusal = format!(
        "{sdo}refusal = {{ id = 0x585, fields = [{{ type = \"byte\", equals = 0x80 }}, {{ pad = 7 }}] }}\n"
    );
    assert_eq!(
        keys(
            &refusal
                .replace("{ name = \"v\"", "{ type = \"byte\", equals = 0x4F }, { name = \"v\"")
                .replace("\"WordInputReg[1]\" }, { pad = 7 }", "\"WordInputReg[1]\" }, { pad = 6 }"),
            "bus = \"can\""
        ),
        [""; 0]
    );
    assert_eq!(keys(&sdo.replace("0x605", "0x205"), "bus = \"can\""), [""; 0]);
}

#[test]
fn replies_of_the_controller_are_told_of_commands_that_have_such() {
    let commands = |command: &str| {
        format!(
            "kind = \"stream\"\n[recipe.input]\nhead = [1]\nfields = [{{ name = \"a\", type = \"byte\", commands = \
             {{ 1 = \"{command}\" }} }}]"
        )
    };
    for command in ["poweron", "poweroff", "enable", "disable"] {
        assert_eq!(keys(&commands(command), "bus = \"rs485\""), ["commands"], "{command}");
    }
    for command in ["stop", "run(pick.jspf,50)"] {
        assert_eq!(keys(&commands(command), "bus = \"rs485\""), [""; 0], "{command}");
    }
}
