//! What is valid and often a mistake is warned of; what is meant so is not.

use recipe_config::file::{self, Text};

/// The warnings of a gateway file with this recipe on one port.
#[track_caller]
fn warnings(recipe: &str, port: &str) -> Vec<String> {
    let toml = format!(
        "[controller]\naddress = \"10.0.0.2\"\n[[recipe]]\nname = \"r\"\nmode = \"user\"\n{recipe}\n\
         [[port]]\nname = \"p\"\nrecipe = \"r\"\n{port}\n"
    );
    let config = file::parse_gateway(Text { name: "test.toml", toml: &toml }, &[]).unwrap();
    let view = config.view();
    view.warnings().map(|warning| view.describe_warning(warning).to_string()).collect()
}

fn read(function: &str, address: u32) -> String {
    format!(
        "kind = \"modbus-rtu\"\n[[recipe.exchange]]\nslave = 1\nevery_ms = 50\nfunction = \"{function}\"\n\
         address = {address}\nread = [{{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }}]"
    )
}

const MODBUS: &str = "bus = \"modbus-rtu\"";

#[test]
fn numbers_of_a_manual_are_no_addresses() {
    let told = |number, first, address| {
        format!(
            "recipe \"r\", exchange 1: {number} looks like the number of a manual that counts from {first}; if it is, \
             write {address}, the address on the line"
        )
    };
    assert_eq!(warnings(&read("read-holding-registers", 40_005), MODBUS), [told(40_005, 40_001, 4)]);
    assert_eq!(warnings(&read("read-input-registers", 30_001), MODBUS), [told(30_001, 30_001, 0)]);
    for (function, address) in [
        ("read-holding-registers", 4),
        ("read-holding-registers", 30_001),
        ("read-input-registers", 40_001),
        ("read-holding-registers", 0xFFFF),
    ] {
        assert_eq!(warnings(&read(function, address), MODBUS), [""; 0], "{function} {address}");
    }
    let block = "kind = \"modbus-rtu-slave\"\naddress = 5\n[[recipe.block]]\ntable = \"input-registers\"\n\
                 address = 30011\nfields = [{ name = \"x\", type = \"word\", from = \"WordOutputReg[1]\" }]";
    let told = warnings(block, "bus = \"modbus-rtu-slave\"");
    assert!(
        told[0].starts_with("recipe \"r\", block 1: 30011 ") && told[0].contains("write 10,"),
        "{told:?}"
    );
}

#[test]
fn both_addresses_of_a_function_are_looked_at() {
    let exchange = "kind = \"modbus-rtu\"\n[[recipe.exchange]]\nslave = 1\nevery_ms = 50\n\
                    function = 23\naddress = 40003\nwrite_address = 40101\n\
                    read = [{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }]\n\
                    write = [{ name = \"b\", type = \"word\", value = 1 }]";
    let told = warnings(exchange, MODBUS);
    assert!(told.len() == 2 && told[0].contains("write 2,") && told[1].contains("write 100,"), "{told:?}");
}

/// A line whose frames have a byte with these keys.
fn byte(keys: &str) -> String {
    format!(
        "kind = \"stream\"\n[recipe.input]\nhead = [1]\nfields = [{{ name = \"a\", type = \"byte\", {keys} }}]"
    )
}

const SECOND: &str = "bus = \"rs485\"\ntimeout_ms = 1000";

#[test]
fn a_stop_on_an_edge_is_told() {
    for (keys, stop) in [
        ("bits = 1, commands = { rising = \"stop\" }", "stop"),
        ("bits = 1, commands = { rising = \"pause\", falling = \"resume\" }, base = \"keep\"", "pause"),
        ("bits = 1, commands = { 1 = \"poweroff\" }", "poweroff"),
    ] {
        let told = warnings(&byte(keys), SECOND);
        let said = format!("commands = {{ level = \"{stop}\" }} stops as long as the bit is 1");
        assert!(told.len() == 1 && told[0].ends_with(&said), "{keys}: {told:?}");
    }
    for keys in [
        "bits = 1, commands = { level = \"stop\" }",
        "bits = 1, commands = { falling = \"stop\" }",
        "bits = 1, commands = { rising = \"resume\" }",
        "commands = { 1 = \"stop\" }",
    ] {
        assert_eq!(warnings(&byte(keys), SECOND), [""; 0], "{keys}");
    }
}

#[test]
fn a_short_timeout_that_forgets_the_base_is_told() {
    let first = "bus = \"rs485\"";
    let commands = byte("commands = { 1 = \"resume\" }");
    let told = warnings(&commands, first);
    assert_eq!(
        told,
        [
            "port \"p\": after 100 ms without a frame, the next value picks no command; for a device that sends less \
          often set a longer timeout_ms, for one that sends only changes base = \"keep\" as well"
        ]
    );
    assert_eq!(warnings(&commands, "bus = \"rs485\"\ntimeout_ms = 249").len(), 1);
    assert_eq!(warnings(&commands, "bus = \"rs485\"\ntimeout_ms = 250"), [""; 0]);
    assert_eq!(warnings(&byte("commands = { 1 = \"resume\" }, base = \"keep\""), first), [""; 0]);
    assert_eq!(warnings(&byte("commands = { 1 = \"resume\" }, when = \"frame\""), first), [""; 0]);
    // What is asked comes as often as it is asked.
    let asked = read("read-holding-registers", 4)
        .replace("to = \"WordInputReg[1]\"", "commands = { 1 = \"resume\" }");
    assert_eq!(warnings(&asked, MODBUS), [""; 0]);
}

#[test]
fn numbers_of_six_digits_are_refused_with_their_address() {
    for (function, number, address) in
        [("read-holding-registers", 400_005, 4), ("read-input-registers", 365_536, 65_535)]
    {
        let toml = format!(
            "[controller]\naddress = \"10.0.0.2\"\n[[recipe]]\nname = \"r\"\n{}\n",
            read(function, number)
        );
        let error =
            file::parse_gateway(Text { name: "test.toml", toml: &toml }, &[]).unwrap_err().to_string();
        let said = format!(
            "{number} is out of range; allowed: 0..=65535; on the line, what a manual calls so has the address {address}"
        );
        assert!(error.ends_with(&said), "{error}");
    }
}

#[test]
fn a_device_that_is_told_once_is_to_be_looked_for() {
    let exchange = |slave: u8, keys: &str| {
        format!(
            "[[recipe.exchange]]\nslave = {slave}\nfunction = \"write-register\"\naddress = 1\n{keys}\nwrite = \
             [{{ name = \"mode{slave}\", type = \"word\", value = 3 }}]\n"
        )
    };
    let recipe = |exchanges: &[String]| format!("kind = \"modbus-rtu\"\n{}", exchanges.concat());
    let once = "on = [\"start\", \"change\"]";
    let told = warnings(
        &recipe(&[exchange(7, once), exchange(7, "on = [\"change\"]")]),
        "bus = \"modbus-rtu\"\necho = false",
    );
    assert_eq!(
        told,
        [
            "recipe \"r\": no exchange with slave 7 has a period, so nobody notices that it was without power, and what it \
          was told is not told again; write every_ms in one of them, such as 500"
        ]
    );
    let told = warnings(
        &recipe(&[exchange(7, "every_ms = 100"), exchange(7, once), exchange(8, once)]),
        "bus = \"modbus-rtu\"\necho = false",
    );
    assert!(told.len() == 1 && told[0].contains("slave 8 "), "{told:?}");
    for keys in ["every_ms = 100", "on = [\"rising:BitOutputReg[3].0\"]", "on = [\"start\"]\nevery_ms = 500"]
    {
        let told = warnings(&recipe(&[exchange(7, keys)]), "bus = \"modbus-rtu\"\necho = false");
        let told: Vec<_> =
            told.iter().filter(|said| !said.contains("no exchange with stop = true")).collect();
        assert_eq!(told, [""; 0], "{keys}");
    }
    // All slaves are no device.
    assert_eq!(warnings(&recipe(&[exchange(0, once)]), "bus = \"modbus-rtu\"\necho = false"), [""; 0]);
}

#[test]
fn what_is_shown_to_users_looks_for_its_devices() {
    for folder in ["host-sim/configs", "host-sim/templates"] {
        for entry in std::fs::read_dir(recipe_test_kit::repository().join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let Ok(config) = file::load_gateway(&path, &[]) else { continue };
            let view = config.view();
            let told: Vec<_> = view.warnings().map(|one| view.describe_warning(one).to_string()).collect();
            assert!(!told.iter().any(|told| told.contains("has a period")), "{}: {told:?}", path.display());
        }
    }
}

/// What is said of a field with these keys.
fn negative(recipe: &str) -> Vec<String> {
    let toml = format!("[controller]\naddress = \"10.0.0.2\"\n[[recipe]]\nname = \"r\"\n{recipe}\n");
    let frames = file::parse_frames(Text { name: "test.toml", toml: &toml }, &[]).unwrap();
    recipe_config::negative_numbers(&frames).into_iter().map(|(_, said)| said).collect()
}

#[test]
fn negative_numbers_of_a_variable_that_has_none_are_told() {
    let field = |keys: &str| {
        let fields = format!("{{ name = \"n\", type = \"byte\", equals = 3 }}, {{ name = \"a\", {keys} }}");
        let part = format!("[recipe.input]\nhead = [1]\nfields = [{fields}]");
        format!("kind = \"stream\"\nmode = \"user\"\n{part}")
    };
    let to = "to = \"WordInputReg[1]\"";
    let said = "recipe \"r\", field \"a\": WordInputReg[1] takes 0..=65535, so a negative number is rejected; \
                write as = \"int16\", an offset, or offset = 0 if there is none";
    for keys in ["type = \"float\"", "type = \"short\", scale = 0.1", "type = \"int24\", endian = \"big\""] {
        assert_eq!(negative(&field(&format!("{keys}, {to}"))), [said], "{keys}");
    }
    for keys in [
        "type = \"float\", offset = 32768",
        "type = \"float\", offset = 0",
        "type = \"short\", as = \"int16\"",
        "type = \"short\", min = 0",
        "type = \"word\"",
        "type = \"byte\"",
        "type = \"dword\", scale = 0.01",
        "type = \"word\", bits = \"0..11\"",
        "type = \"short\", scale = -1",
    ] {
        assert_eq!(negative(&field(&format!("{keys}, {to}"))), [""; 0], "{keys}");
    }
    let asked = read("read-holding-registers", 4).replace("type = \"word\"", "type = \"short\"");
    assert_eq!(negative(&asked), [said]);
}

#[test]
fn a_timeout_that_two_frames_do_not_fit_is_told() {
    let floats = "fields = [{ name = \"a\", type = \"float\" }, { name = \"b\", type = \"float\" }, \
                  { name = \"c\", type = \"word\", to = \"WordInputReg[1]\" }]";
    let frame = format!("kind = \"stream\"\n[recipe.input]\nhead = [1]\ntail = [2]\n{floats}");
    let port = |keys: &str| format!("bus = \"rs485\"\n{keys}");
    assert_eq!(
        warnings(&frame, &port("timeout_ms = 2")),
        [
            "port \"p\": a frame takes 1042 µs on the line, but the timeout is 2 ms, so one lost frame or a short \
             pause makes the port silent; write two periods of the device or more in timeout_ms"
        ]
    );
    assert_eq!(warnings(&frame, &port("timeout_ms = 3")), [""; 0]);
    assert_eq!(warnings(&frame, &port("baud = 9600\ntimeout_ms = 24")).len(), 1);
    assert_eq!(warnings(&frame, &port("baud = 9600\ntimeout_ms = 26")), [""; 0]);
}

#[test]
fn what_events_may_cost_is_told() {
    let recipe = |keys: &str| {
        format!(
            "kind = \"modbus-rtu\"\n[[recipe.exchange]]\nslave = 3\nfunction = \"write-register\"\naddress = \
             1\n{keys}\nwrite = [{{ name = \"go\", type = \"word\", value = 1 }}]\n"
        )
    };
    let port = "bus = \"modbus-rtu\"\necho = false";
    let rises = "on = [\"rising:BitOutputReg[3].0\"]";
    let stop = recipe("on = [\"rising:BitOutputReg[3].1\"]\nstop = true");
    let with_stop = format!("{}{}", recipe(rises), stop.trim_start_matches("kind = \"modbus-rtu\"\n"));
    assert_eq!(warnings(&with_stop, port), [""; 0]);
    assert_eq!(
        warnings(&recipe(rises), port),
        [
            "recipe \"r\", exchange 1: a bit triggers a write to device 3, and no exchange with stop = true stops it; if it \
          moves something, add one"
        ]
    );
    let told = warnings(&recipe(&format!("{rises}\nretries = 1")), port);
    assert!(told.iter().any(|said| said.contains("may carry it out twice")), "{told:?}");
    assert!(warnings(&with_stop, MODBUS).iter().any(|said| said.contains("write echo = false")));
    let bits = with_stop.replace("\"write-register\"", "22").replace("value = 1", "bits = 3, value = 1");
    assert!(warnings(&bits, MODBUS).iter().any(|said| said.contains("write echo = false")));
    let slow = "kind = \"modbus-rtu\"\n[[recipe.exchange]]\nslave = 1\nfunction = \"read-holding-registers\"\naddress = \
                0\nevery_ms = 1000\nread = [{ pad = 248 }, { name = \"v\", type = \"word\", to = \"WordInputReg[1]\" }]\n";
    let told = warnings(slow, "bus = \"modbus-rtu\"\nbaud = 9600\ntimeout_ms = 3000");
    assert!(told.iter().any(|said| said.contains("it is always too late")), "{told:?}");
}
