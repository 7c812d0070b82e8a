//! A Sparkplug file: where and how a gateway publishes.
//!
//! In: a TOML file with `[broker]`, `[node]`, `[report]` and `[[rule]]`. Out: plain data. Does not know which
//! characters a name may have. Passwords are in files of their own.

use std::path::{Path, PathBuf};

use proto_core::sysvar::{Direction, VarRange};
use proto_core::time::Duration;

use super::document::SourceTree;
use super::inventory::text_of;
use super::reader::{Result, TableReader, TableValue};
use super::{Text, with_text};
use crate::keys::Key;
use crate::keys::sparkplug::{
    ADDRESS, BD_SEQ, BROKER, CA, CLIENT_ID, COUNTERS, DEAD_BAND, FILE, GROUP, INTERVAL, KEEP_ALIVE, LOGIN,
    NAME, NODE, PLAIN, PRIMARY_HOST, REPORT, RULE, RULE_INTERVAL, RULE_VALUES, SAMPLE, SERVER, TIME_TABLE,
    VALUES,
};

/// Where and how a gateway publishes.
#[derive(Debug, Clone, PartialEq)]
pub struct SparkplugFile {
    /// The broker's name or address.
    pub host: String,
    /// Its port.
    pub port: u16,
    /// The file of certificate authorities, relative to this file's folder; `None` without TLS.
    pub ca: Option<PathBuf>,
    /// The file with user and password.
    pub login: Option<PathBuf>,
    /// The client id for the broker; `None`: made of the group and the node.
    pub client_id: Option<String>,
    /// The keep-alive.
    pub keep_alive: Duration,
    /// The group.
    pub group: String,
    /// The edge node.
    pub node: String,
    /// The primary host to wait for.
    pub primary_host: Option<String>,
    /// The file that stores the session number.
    pub bd_seq: Option<PathBuf>,
    /// Sampling interval of the gateway.
    pub sample: Duration,
    /// Minimum time between two values.
    pub interval: Duration,
    /// Minimum time between two values of a counter.
    pub counter_interval: Duration,
    /// Further variables of the controller.
    pub values: Vec<VarRange>,
    /// Exceptions.
    pub rules: Vec<ReportRule>,
    /// Boards only: the server for UTC, and its port.
    pub time_server: Option<(String, u16)>,
}

/// How some variables are published.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReportRule {
    /// The variables.
    pub values: VarRange,
    /// A number is published if it differs from the last published one by more than this.
    pub dead_band: f64,
    /// Minimum time between two values.
    pub interval: Option<Duration>,
}

/// Reads a Sparkplug file. `check` returns what is wrong with the name of a group, a node or a host.
///
/// # Errors
/// The first mistake, with its place.
pub fn load_sparkplug(
    path: &Path,
    check: impl Fn(&str) -> std::result::Result<(), String>,
) -> Result<SparkplugFile> {
    let folder = path.parent().unwrap_or(Path::new("")).to_owned();
    let mut file = with_text(path, |text| parse_sparkplug(text, &check))?;
    for path in [&mut file.ca, &mut file.login, &mut file.bd_seq] {
        *path = path.take().map(|path| folder.join(path));
    }
    Ok(file)
}

/// As [`load_sparkplug`], from a text; paths of files stay as they are.
///
/// # Errors
/// The first mistake, with its place.
pub fn parse_sparkplug(
    text: Text<'_>,
    check: impl Fn(&str) -> std::result::Result<(), String>,
) -> Result<SparkplugFile> {
    let document = SourceTree::parse(text.name, text.toml, &[])?;
    let root = TableReader::root(&document, &FILE)?;
    let broker = root.required("broker", "a table with address and ca")?.table(&BROKER)?;
    let node = root.required("node", "a table with group and name")?.table(&NODE)?;
    let report = root.optional("report").map(|item| item.table(&REPORT)).transpose()?;
    let path = |table: &TableReader<'_>, key: &Key| {
        table.optional(key.name).map(|item| text_of(&item, 4_096).map(PathBuf::from)).transpose()
    };
    let name = |item: TableValue<'_>| {
        let name = text_of(&item, 64)?;
        check(&name).map_err(|why| item.error(format!("{name:?}: {why}")))?;
        Ok(name)
    };
    let ca = path(&broker, &CA)?;
    match (&ca, broker.flag(&PLAIN)?) {
        (None, false) => {
            let hint = "the authorities that the broker is trusted by; without TLS: plain = true";
            return Err(broker.error(format!("ca is missing; {hint}")));
        }
        (Some(_), true) => return Err(broker.error("ca is for TLS, and plain = true is without it")),
        _ => {}
    }
    let address = broker.required(ADDRESS.name, "such as \"broker.plant.example:8883\"")?;
    let (host, port) = host_and_port(&address, if ca.is_some() { 8883 } else { 1883 })?;
    let client_id = broker.optional(CLIENT_ID.name).map(|item| text_of(&item, 128)).transpose()?;
    let time = |key: &Key| match &report {
        Some(report) => report.time_or(key),
        None => Ok(crate::keys::time(key, default_of(key))),
    };
    let mut values = Vec::new();
    if let Some(item) = report.as_ref().and_then(|report| report.optional(VALUES.name)) {
        let items = item.array("of variables")?;
        if items.len() > 64 {
            return Err(item.error(format!("{} items; allowed: 64", items.len())));
        }
        for item in items {
            let vars = variables(&item)?;
            if vars.iter().any(|var| var.direction() == Direction::Input) {
                return Err(item.error("only variables of the controller; field ports tell what they write"));
            }
            values.push(vars);
        }
    }
    let mut rules = Vec::new();
    for rule in root.any_tables("rule")? {
        rule.check(&RULE)?;
        let values = variables(&rule.required(RULE_VALUES.name, "such as \"ForceEnd[1..6]\"")?)?;
        let dead_band = match rule.optional(DEAD_BAND.name) {
            None => 0.0,
            Some(item) => match item.number()? {
                number if DEAD_BAND.limits().take(number) => number,
                number => {
                    return Err(
                        item.error(format!("{number} is out of range; allowed: {}", DEAD_BAND.limits()))
                    );
                }
            },
        };
        rules.push(ReportRule { values, dead_band, interval: rule.time(&RULE_INTERVAL)? });
        if rules.len() > 64 {
            return Err(rule.error("more than 64 rules"));
        }
    }
    let time_server = match root.optional("time") {
        Some(item) => {
            let server = item.table(&TIME_TABLE)?.required(SERVER.name, "such as \"10.0.0.1\"")?;
            Some(host_and_port(&server, 123)?)
        }
        None => None,
    };
    Ok(SparkplugFile {
        time_server,
        host,
        port,
        login: path(&broker, &LOGIN)?,
        ca,
        client_id,
        keep_alive: Duration::from_secs(broker.integer_or(&KEEP_ALIVE)?),
        group: name(node.required(GROUP.name, "the group")?)?,
        node: name(node.required(NAME.name, "what the node is called in its group")?)?,
        primary_host: node.optional(PRIMARY_HOST.name).map(name).transpose()?,
        bd_seq: path(&node, &BD_SEQ)?,
        sample: time(&SAMPLE)?,
        interval: time(&INTERVAL)?,
        counter_interval: time(&COUNTERS)?,
        values,
        rules,
    })
}

fn default_of(key: &Key) -> f64 {
    match key.need {
        crate::keys::Need::Integer(value) => value as f64,
        _ => 0.0,
    }
}

fn variables(item: &TableValue<'_>) -> Result<VarRange> {
    let text = item.string()?;
    VarRange::parse(text).map_err(|error| item.error(error))
}

/// `HOST`, `HOST:PORT`, `ADDRESS`, `[ADDRESS]:PORT`.
fn host_and_port(item: &TableValue<'_>, default: u16) -> Result<(String, u16)> {
    let text = text_of(item, 255)?;
    let refused = |why: &str| item.error(format!("{text:?} is {why}; write HOST or HOST:PORT"));
    let (host, port) = match text.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((host, "")) => (host, None),
        Some((host, rest)) => (host, Some(rest.strip_prefix(':').ok_or_else(|| refused("no address"))?)),
        None => match text.split_once(':') {
            Some((host, port)) if !port.contains(':') => (host, Some(port)),
            _ => (text.as_str(), None),
        },
    };
    let port = match port {
        None => default,
        Some(port) => match port.parse() {
            Ok(port @ 1..) => port,
            _ => return Err(refused("no address with a port of 1..=65535")),
        },
    };
    if host.is_empty() || host.contains(|c: char| c.is_whitespace() || "/@[]".contains(c)) {
        return Err(refused("no host"));
    }
    Ok((host.to_owned(), port))
}

#[cfg(test)]
#[path = "sparkplug_tests.rs"]
mod tests;
