//! Inventories of `ctl` and Sparkplug files, right, damaged, or any text: what is read is what TOML's own reader
//! finds by the tables of docs/ctl.md section 4 and docs/fleet.md, and a mistake is one line with its place.

use std::fmt::Debug;
use std::path::PathBuf;

use proto_core::sysvar::{Direction, VarRange};
use proto_core::time::Duration;
use recipe_config::file::{
    FileError, Listed, ReportRule, SparkplugFile, Text, parse_inventory, parse_sparkplug,
};
use recipe_ctl::Address;
use recipe_fuzz::source::Source;
use toml::{Table, Value};

const NAME: &str = "fuzz.toml";

/// Pieces of an inventory.
const GATEWAYS: [&str; 16] = [
    "[[gateway]]\n",
    "[gateway]\n",
    "name = \"press\"\n",
    "name = \"saw\"\n",
    "address = \"192.168.0.20\"\n",
    "address = \"cell-3:8480\"\n",
    "address = \"[fe80::1]:80\"\n",
    "address = \"a b\"\n",
    "host = \"10.0.2.15\"\n",
    "key = \"press.key\"\n",
    "key = \"\"\n",
    "port = 80\n",
    "name = \"a\\nb\"\n",
    "name = 3\n",
    "gateway = [{ name = \"press\", address = \"saw:1\" }]\n",
    "[[gateway]]\nname = \"drill\"\naddress = \"10.0.0.4\"\n",
];

/// Pieces of a Sparkplug file.
const TOLD: [&str; 36] = [
    "[broker]\n",
    "address = \"broker.plant.example:8883\"\n",
    "address = \"[::1]:1883\"\n",
    "address = \"[::1]\"\n",
    "address = \"a:0\"\n",
    "address = \"a:b:c\"\n",
    "ca = \"ca.pem\"\n",
    "plain = true\n",
    "plain = false\n",
    "login = \"login\"\n",
    "client_id = \"me\"\n",
    "keep_alive_s = 5\n",
    "keep_alive_s = 4\n",
    "[node]\n",
    "group = \"plant\"\n",
    "group = \"a/b\"\n",
    "name = \"press\"\n",
    "primary_host = \"scada\"\n",
    "bd_seq = \"bd\"\n",
    "[report]\n",
    "sample_ms = 100\n",
    "interval_ms = 99.99\n",
    "interval_ms = 250.5\n",
    "counter_interval_ms = 3600000\n",
    "values = [\"RobotState[1..6]\"]\n",
    "values = [\"BitInputReg[1]\"]\n",
    "[[rule]]\n",
    "values = \"ForceEnd[1..6]\"\n",
    "dead_band = 0.5\n",
    "dead_band = nan\n",
    "[broker]\naddress = \"b\"\nplain = true\n[node]\ngroup = \"g\"\nname = \"n\"\n",
    "rule = []\n",
    "[time]\n",
    "server = \"10.0.0.1\"\n",
    "server = \"ntp.plant.example:1123\"\n",
    "server = \"a:0\"\n",
];

pub(crate) fn run_inventory(input: &[u8]) {
    let text = text(input, &GATEWAYS);
    let check = |address: &str| address.parse::<Address>().map(|_| ());
    let read = parse_inventory(Text { name: NAME, toml: &text }, check);
    same(&text, read, inventory);
}

pub(crate) fn run_sparkplug(input: &[u8]) {
    let text = text(input, &TOLD);
    let check = |name: &str| match name.contains(['+', '/', '#']) {
        true => Err("no".to_owned()),
        false => Ok(()),
    };
    let read = parse_sparkplug(Text { name: NAME, toml: &text }, check);
    same(&text, read, sparkplug);
}

/// Pieces in any order, with other text between them.
fn text(input: &[u8], pieces: &[&str]) -> String {
    let mut input = Source::new(input);
    let mut text = String::new();
    while !input.is_empty() && text.len() < 2_000 {
        match input.u8() {
            0xFF => text.push_str(&String::from_utf8_lossy(input.run())),
            // Some characters less.
            0xFE => {
                let left = text.chars().count().saturating_sub(input.below(16));
                text = text.chars().take(left).collect();
            }
            nth => text.push_str(pieces[usize::from(nth) % pieces.len()]),
        }
    }
    text
}

#[track_caller]
fn same<T: PartialEq + Debug>(
    text: &str,
    read: Result<T, FileError>,
    reference: impl Fn(&Table) -> Option<T>,
) {
    if let Err(error) = &read {
        let message = error.to_string();
        assert!(message.starts_with("fuzz.toml:"), "{message}");
        assert!(!message.chars().any(char::is_control), "{message:?}");
    }
    let expected = text.parse::<Table>().ok().and_then(|table| reference(&table));
    assert_eq!(read.as_ref().ok(), expected.as_ref(), "{read:?}\n{text}");
}

fn only(table: &Table, keys: &[&str]) -> Option<()> {
    table.keys().all(|key| keys.contains(&key.as_str())).then_some(())
}

/// A text of 1 to `max` bytes; `None` if it is wrong, `Some(None)` if there is none.
fn words(table: &Table, key: &str, max: usize) -> Option<Option<String>> {
    let Some(value) = table.get(key) else { return Some(None) };
    let text = value.as_str()?;
    let is_control = |c: char| matches!(u32::from(c), 0..=0x1F | 0x7F..=0x9F);
    ((1..=max).contains(&text.len()) && !text.chars().any(is_control)).then(|| Some(text.to_owned()))
}

fn inventory(table: &Table) -> Option<Vec<Listed>> {
    only(table, &["gateway"])?;
    let mut listed: Vec<Listed> = Vec::new();
    for gateway in table.get("gateway")?.as_array()? {
        let gateway = gateway.as_table()?;
        only(gateway, &["name", "address", "host", "key"])?;
        let name = words(gateway, "name", 64)??;
        let (address, host) = (words(gateway, "address", 255)??, words(gateway, "host", 255)?);
        for text in [Some(&address), host.as_ref()].into_iter().flatten() {
            let address: Address = text.parse().ok()?;
            assert_eq!(address.to_string().parse(), Ok(address), "{text}");
        }
        if listed.iter().any(|other| other.name == name) {
            return None;
        }
        let key = words(gateway, "key", 4_096)?.map(PathBuf::from);
        listed.push(Listed { name, address, host, key });
    }
    (!listed.is_empty()).then_some(listed)
}

fn number(value: &Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|number| number as f64))
}

/// A time in milliseconds, to the microsecond.
fn millis(table: &Table, key: &str) -> Option<Option<Duration>> {
    let Some(value) = table.get(key) else { return Some(None) };
    let value = number(value).filter(|value| (100.0..=3_600_000.0).contains(value))?;
    Some(Some(Duration::from_micros((value * 1_000.0).round() as u64)))
}

fn sparkplug(table: &Table) -> Option<SparkplugFile> {
    only(table, &["broker", "node", "report", "rule", "time"])?;
    let broker = table.get("broker")?.as_table()?;
    only(broker, &["address", "ca", "plain", "login", "client_id", "keep_alive_s"])?;
    let node = table.get("node")?.as_table()?;
    only(node, &["group", "name", "primary_host", "bd_seq"])?;
    let nothing = Table::new();
    let report = table.get("report").map_or(Some(&nothing), Value::as_table)?;
    only(report, &["sample_ms", "interval_ms", "counter_interval_ms", "values"])?;
    let plain = broker.get("plain").map_or(Some(false), Value::as_bool)?;
    let ca = words(broker, "ca", 4_096)?;
    if ca.is_some() == plain {
        return None;
    }
    let (host, port) = place(&words(broker, "address", 255)??)?;
    let port = port.unwrap_or(if plain { 1_883 } else { 8_883 });
    let keep_alive = broker.get("keep_alive_s").map_or(Some(30), Value::as_integer)?;
    let keep_alive = Some(keep_alive).filter(|seconds| (5..=65_535).contains(seconds))?;
    let name = |key| {
        let name = words(node, key, 64)?;
        let is_wrong = name.as_ref().is_some_and(|name| name.chars().any(|c| "+/#".contains(c)));
        (!is_wrong).then_some(name)
    };
    let mut values = Vec::new();
    for value in report.get("values").map_or(Some(&Vec::new()), Value::as_array)? {
        let range = VarRange::parse(value.as_str()?).ok()?;
        values
            .push(Some(range).filter(|range| range.iter().all(|var| var.direction() == Direction::Output))?);
    }
    let mut rules = Vec::new();
    for rule in table.get("rule").map_or(Some(&Vec::new()), Value::as_array)? {
        let rule = rule.as_table()?;
        only(rule, &["values", "dead_band", "interval_ms"])?;
        let values = VarRange::parse(rule.get("values")?.as_str()?).ok()?;
        let dead_band = rule.get("dead_band").map_or(Some(0.0), number)?;
        let dead_band = Some(dead_band).filter(|band| (0.0..=1e9).contains(band))?;
        rules.push(ReportRule { values, dead_band, interval: millis(rule, "interval_ms")? });
    }
    if values.len() > 64 || rules.len() > 64 {
        return None;
    }
    let mut time_server = None;
    if let Some(time) = table.get("time") {
        let time = time.as_table()?;
        only(time, &["server"])?;
        let (server, port) = place(&words(time, "server", 255)??)?;
        time_server = Some((server, port.unwrap_or(123)));
    }
    let or = |key, default| Some(millis(report, key)?.unwrap_or(Duration::from_millis(default)));
    Some(SparkplugFile {
        time_server,
        host,
        port,
        ca: ca.map(PathBuf::from),
        login: words(broker, "login", 4_096)?.map(PathBuf::from),
        client_id: words(broker, "client_id", 128)?,
        keep_alive: Duration::from_secs(keep_alive as u64),
        group: name("group")??,
        node: name("name")??,
        primary_host: name("primary_host")?,
        bd_seq: words(node, "bd_seq", 4_096)?.map(PathBuf::from),
        sample: or("sample_ms", 500)?,
        interval: or("interval_ms", 500)?,
        counter_interval: or("counter_interval_ms", 10_000)?,
        values,
        rules,
    })
}

/// A host or an address, and a port if there is one. An address of IPv6 with a port is in brackets.
fn place(text: &str) -> Option<(String, Option<u16>)> {
    let (host, port) = if text.starts_with('[') && text.contains(']') {
        let end = text.find(']')?;
        let rest = &text[end + 1..];
        (&text[1..end], if rest.is_empty() { None } else { Some(rest.strip_prefix(':')?) })
    } else if text.matches(':').count() == 1 {
        let colon = text.find(':')?;
        (&text[..colon], Some(&text[colon + 1..]))
    } else {
        (text, None)
    };
    let port = match port {
        None => None,
        Some(port) => Some(port.parse::<u16>().ok().filter(|&port| port > 0)?),
    };
    let is_wrong = |c: char| c.is_whitespace() || matches!(c, '/' | '@' | '[' | ']');
    (!host.is_empty() && !host.chars().any(is_wrong)).then(|| (host.to_owned(), port))
}

pub(crate) fn inventory_seeds() -> Vec<Vec<u8>> {
    let mut seeds = vec![vec![15], vec![14], vec![0, 2, 4, 8, 9, 15], vec![0, 2, 5, 0, 2, 6], vec![]];
    seeds.extend((0..GATEWAYS.len() as u8).map(|nth| vec![0, 3, 5, nth]));
    seeds.extend(["# a\n", "name = '", "\u{0}", "[[gatway]]", "gateway = 3\n"].map(as_it_is));
    seeds
}

pub(crate) fn sparkplug_seeds() -> Vec<Vec<u8>> {
    let mut seeds = vec![
        vec![30],
        vec![30, 19, 20, 22, 23, 24, 26, 27, 28],
        vec![30, 32, 33],
        vec![30, 32, 34],
        vec![30, 32, 35],
        vec![0, 1, 6, 9, 10, 11, 13, 14, 16],
    ];
    seeds.extend((0..TOLD.len() as u8).flat_map(|nth| {
        [vec![30, nth], vec![0, nth, 7, 13, 14, 16], vec![30, 19, nth], vec![30, 26, 27, nth]]
    }));
    seeds.extend(["# a\n", "[broker]\naddress = '", "interval_ms = 1e400\n"].map(as_it_is));
    seeds
}

fn as_it_is(text: &str) -> Vec<u8> {
    [&[0xFF, text.len() as u8], text.as_bytes()].concat()
}
