use super::*;

const GOOD: &str =
    "[broker]\naddress = \"broker\"\nca = \"ca.pem\"\n[node]\ngroup = \"hall\"\nname = \"press\"\n";

fn read(toml: &str) -> std::result::Result<SparkplugFile, String> {
    let check = |name: &str| match name.contains('/') {
        true => Err("'/' is not allowed in it".to_owned()),
        false => Ok(()),
    };
    parse_sparkplug(Text { name: "s.toml", toml }, check).map_err(|error| error.to_string())
}

#[test]
fn what_is_left_out_has_its_default() {
    let file = read(GOOD).unwrap();
    assert_eq!((&*file.host, file.port, file.ca), ("broker", 8883, Some("ca.pem".into())));
    assert_eq!((file.keep_alive, file.sample), (Duration::from_secs(30), Duration::from_millis(500)));
    assert_eq!(file.counter_interval, Duration::from_secs(10));
    assert_eq!((file.primary_host, file.login, file.rules.len()), (None, None, 0));
    let plain = read(&GOOD.replace("ca = \"ca.pem\"", "plain = true")).unwrap();
    assert_eq!((plain.port, plain.ca), (1883, None));
}

#[test]
fn addresses_have_a_port_or_not() {
    let of = |address: &str| {
        let file = read(&GOOD.replace("\"broker\"", &format!("{address:?}")))?;
        Ok::<_, String>((file.host, file.port))
    };
    for (address, host, port) in [
        ("10.0.0.1", "10.0.0.1", 8883),
        ("10.0.0.1:1", "10.0.0.1", 1),
        ("b.example:65535", "b.example", 65_535),
        ("[::1]:9", "::1", 9),
        ("[::1]", "::1", 8883),
        ("::1", "::1", 8883),
    ] {
        assert_eq!(of(address), Ok((host.to_owned(), port)));
    }
    for wrong in ["b:0", "b:65536", "b:", ":9", "[::1]9", "mqtt://b", "a b", "u@b"] {
        assert!(of(wrong).unwrap_err().starts_with("s.toml:2:11: broker.address: "), "{wrong}");
    }
}

#[test]
fn a_mistake_has_its_place_and_says_what_is_allowed() {
    for (toml, expected) in [
        (String::new(), "s.toml:1:1: broker is missing; a table with address and ca"),
        (GOOD.replace("ca = \"ca.pem\"\n", ""), "s.toml:1:1: broker: ca is missing; the authorities"),
        (GOOD.replace("ca = ", "plain = true\nca = "), "s.toml:1:1: broker: ca is for TLS"),
        (GOOD.replace("group", "grp"), "s.toml:5:1: node.grp: unknown key; allowed: group, name"),
        (GOOD.replace("\"hall\"", "\"a/b\""), "s.toml:5:9: node.group: \"a/b\": '/' is not allowed in it"),
        (format!("{GOOD}[report]\nsample_ms = 1"), "s.toml:8:13: report.sample_ms: 1 is out of range"),
        (
            format!("{GOOD}[report]\nvalues = [\"FloatInputReg[1]\"]"),
            "s.toml:8:11: report.values[1]: only variables of the controller",
        ),
        (format!("{GOOD}[time]\n"), "s.toml:7:1: time: server is missing"),
        (format!("{GOOD}[time]\nserver = \"a b\""), "s.toml:8:10: time.server: \"a b\" is no host"),
        (format!("{GOOD}[[rule]]\nvalues = \"Force[1]\""), "s.toml:8:10: rule[1].values: "),
        (
            format!("{GOOD}[[rule]]\nvalues = \"ForceEnd[1]\"\ndead_band = -1"),
            "s.toml:9:13: rule[1].dead_band: -1 is out of range; allowed: 0..=1000000000",
        ),
    ] {
        let error = read(&toml).unwrap_err();
        assert!(error.starts_with(expected), "{error}\n{expected}");
    }
}

#[test]
fn rules_and_values_are_read() {
    let file = read(&format!(
        "{GOOD}primary_host = \"scada\"\n[report]\nvalues = [\"RobotState[1..6]\"]\n[[rule]]\nvalues = \"ForceEnd[1..6]\"\ndead_band = 0.5\n[[rule]]\nvalues = \"FloatInputReg[1]\"\ninterval_ms = 2000\n"
    ))
    .unwrap();
    assert_eq!((file.primary_host.as_deref(), file.values[0].iter().len()), (Some("scada"), 6));
    let rules: Vec<_> = file.rules.iter().map(|rule| (rule.dead_band, rule.interval)).collect();
    assert_eq!(rules, [(0.5, None), (0.0, Some(Duration::from_secs(2)))]);
}
