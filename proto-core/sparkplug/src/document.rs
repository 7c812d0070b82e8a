//! The settings of a board's edge node, as the bytes that a client sends and the board stores (docs/fleet.md section
//! 6).
//!
//! In: settings, or bytes. Out: bytes, or settings. Bytes that [`NodeDocument::encode`] would not write are refused as
//! a whole. Numbers are little-endian; texts follow their length.
//! ```text
//! "RGWE" 1 0                                      tells nothing
//! "RGWE" 1 1 host port client_id login keep_alive_s group node primary_host
//!            sample_ms interval_ms counter_interval_ms time_server time_port values rules
//! ```

use heapless::{String, Vec};
use proto_core::sysvar::{Direction, SysVar, VarRange};
use proto_core::time::Duration;

use crate::bytes::ByteWriter;
use crate::gateway::PublishRule;
use crate::node::{Credential, Settings};
use crate::topic::{Id, IdError};

/// The longest document in bytes.
pub const MAX_DOCUMENT: usize = 3 * 1024;
/// The longest host name in bytes.
pub const MAX_HOST: usize = 128;
/// Maximum number of rules, and of ranges of values.
pub const MAX_RULES: usize = 64;

/// The name or address of a host.
pub type Host = String<MAX_HOST>;

/// What the edge node of a board publishes, and to which broker.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeDocument {
    /// The name or IPv4 address of the broker.
    pub host: Host,
    /// The TCP port of the broker.
    pub port: u16,
    /// The names of the node, and its MQTT settings.
    pub settings: Settings,
    /// The time between two samples of the gateway: 100 ms to an hour, like all times here.
    pub sample: Duration,
    /// The shortest time between two values of a variable or a state.
    pub interval: Duration,
    /// The shortest time between two values of a counter.
    pub counter_interval: Duration,
    /// The name or IPv4 address of an SNTP server, and its UDP port. `None`: UTC stays unknown.
    pub time_server: Option<(Host, u16)>,
    /// Variables of the controller that are published in addition to those that field ports send.
    pub values: Vec<VarRange, MAX_RULES>,
    /// Rules for single variables.
    pub rules: Vec<PublishRule, MAX_RULES>,
}

/// Why bytes are no valid document, or settings cannot be written as one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum DocumentError {
    /// The document does not begin with the magic bytes.
    Magic,
    /// The document has another version.
    Version {
        /// The version; only 1 can be read.
        found: u8,
    },
    /// The document is longer than [`MAX_DOCUMENT`].
    Long {
        /// Its length in bytes.
        len: usize,
    },
    /// It is cut off.
    Short,
    /// There are bytes after the end.
    Behind {
        /// Their number.
        count: usize,
    },
    /// A value is not allowed.
    Value {
        /// What the value is for.
        of: &'static str,
    },
    /// A name cannot be part of a topic.
    Name {
        /// What the name is for.
        of: &'static str,
        /// What is wrong with it.
        error: IdError,
    },
}

impl NodeDocument {
    /// Settings that are not known yet, with all bytes zero.
    pub const fn empty() -> Self {
        Self {
            host: String::new(),
            port: 0,
            settings: Settings::empty(),
            sample: Duration::ZERO,
            interval: Duration::ZERO,
            counter_interval: Duration::ZERO,
            time_server: None,
            values: Vec::new(),
            rules: Vec::new(),
        }
    }

    /// Reads a document into `self`. Returns `false` if it says that nothing is published.
    ///
    /// # Errors
    /// If the bytes are no valid document. The contents of `self` are invalid then.
    pub fn decode(&mut self, bytes: &[u8]) -> Result<bool, DocumentError> {
        if bytes.len() > MAX_DOCUMENT {
            return Err(DocumentError::Long { len: bytes.len() });
        }
        let mut from = From { rest: bytes };
        if from.array::<4>()? != MAGIC {
            return Err(DocumentError::Magic);
        }
        match from.byte()? {
            VERSION => {}
            found => return Err(DocumentError::Version { found }),
        }
        let tells = from.flag("what it is")?;
        if tells {
            self.read(&mut from)?;
        }
        match from.rest.len() {
            0 => Ok(tells),
            count => Err(DocumentError::Behind { count }),
        }
    }

    fn read(&mut self, from: &mut From<'_>) -> Result<(), DocumentError> {
        let wrong = |of| DocumentError::Value { of };
        self.host = from.host("the broker")?;
        self.port = from.port()?;
        let settings = &mut self.settings;
        settings.client_id = from.known_text("the client's name")?;
        settings.login = match from.flag("the login")? {
            true => Some((from.known_text("the user")?, from.text("the password")?)),
            false => None,
        };
        let seconds = u16::from_le_bytes(from.array()?);
        settings.keep_alive = match seconds {
            5.. => Duration::from_secs(seconds.into()),
            _ => return Err(wrong("the keep-alive")),
        };
        settings.group = from.id("the group")?;
        settings.node = from.id("the node")?;
        settings.primary_host =
            from.flag("the primary host")?.then(|| from.id("the primary host")).transpose()?;
        self.sample = from.time("the sample's time")?;
        self.interval = from.time("the interval")?;
        self.counter_interval = from.time("the counters' interval")?;
        self.time_server = match from.flag("the time server")? {
            true => Some((from.host("the time server")?, from.port()?)),
            false => None,
        };
        self.values.clear();
        for _ in 0..from.byte()? {
            let range = from.range()?;
            let is_controllers = range.iter().all(|var| var.direction() == Direction::Output);
            let is_pushed = is_controllers && self.values.push(range).is_ok();
            is_pushed.then_some(()).ok_or(wrong("the values"))?;
        }
        self.rules.clear();
        for _ in 0..from.byte()? {
            let vars = from.range()?;
            let dead_band = f64::from_le_bytes(from.array()?);
            if !(0.0..=1e9).contains(&dead_band) {
                return Err(wrong("a dead band"));
            }
            let min_interval = from.flag("a rule")?.then(|| from.time("a rule's interval")).transpose()?;
            self.rules.push(PublishRule { vars, dead_band, min_interval }).map_err(|_| wrong("the rules"))?;
        }
        Ok(())
    }

    /// Writes the document into `buf`, which must have [`MAX_DOCUMENT`] bytes, and returns the written part.
    pub fn encode<'b>(&self, buf: &'b mut [u8]) -> Result<&'b [u8], DocumentError> {
        let mut out = ByteWriter::new(buf);
        begin(&mut out, true);
        text(&mut out, &self.host);
        out.put(&self.port.to_le_bytes());
        let settings = &self.settings;
        text(&mut out, settings.client_id.as_str());
        out.byte(settings.login.is_some().into());
        if let Some((user, password)) = &settings.login {
            text(&mut out, user.as_str());
            text(&mut out, password.as_str());
        }
        let seconds = u16::try_from(settings.keep_alive.as_millis() / 1_000).unwrap_or(u16::MAX);
        out.put(&seconds.to_le_bytes());
        text(&mut out, settings.group.as_str());
        text(&mut out, settings.node.as_str());
        out.byte(settings.primary_host.is_some().into());
        if let Some(host) = &settings.primary_host {
            text(&mut out, host.as_str());
        }
        for duration in [self.sample, self.interval, self.counter_interval] {
            time(&mut out, duration);
        }
        out.byte(self.time_server.is_some().into());
        if let Some((server, port)) = &self.time_server {
            text(&mut out, server);
            out.put(&port.to_le_bytes());
        }
        out.byte(u8::try_from(self.values.len()).unwrap_or(u8::MAX));
        for values in &self.values {
            range(&mut out, *values);
        }
        out.byte(u8::try_from(self.rules.len()).unwrap_or(u8::MAX));
        for rule in &self.rules {
            range(&mut out, rule.vars);
            out.put(&rule.dead_band.to_le_bytes());
            out.byte(rule.min_interval.is_some().into());
            if let Some(interval) = rule.min_interval {
                time(&mut out, interval);
            }
        }
        let len = out.len();
        let bytes = out.finish().ok_or(DocumentError::Long { len })?;
        // Reads the result back, so that nothing is sent that a board would refuse.
        Self::empty().decode(bytes)?;
        Ok(bytes)
    }
}

/// The document that says that nothing is published.
pub const OFF: [u8; 6] = [b'R', b'G', b'W', b'E', VERSION, 0];

fn begin(out: &mut ByteWriter<'_>, tells: bool) {
    out.put(&MAGIC);
    out.put(&[VERSION, tells.into()]);
}

fn text(out: &mut ByteWriter<'_>, text: &str) {
    // The longest allowed text fits in a byte. A longer one would be refused when it is read.
    out.byte(u8::try_from(text.len()).unwrap_or(u8::MAX));
    out.put(text.as_bytes());
}

fn time(out: &mut ByteWriter<'_>, time: Duration) {
    out.put(&u32::try_from(time.as_millis()).unwrap_or(u32::MAX).to_le_bytes());
}

fn range(out: &mut ByteWriter<'_>, range: VarRange) {
    let ordinal =
        |var: Option<SysVar>| var.and_then(|var| u8::try_from(var.ordinal()).ok()).unwrap_or(u8::MAX);
    out.put(&[ordinal(range.iter().next()), ordinal(range.iter().last())]);
}

/// A reader of the bytes of a document.
struct From<'a> {
    rest: &'a [u8],
}

impl<'a> From<'a> {
    fn array<const LEN: usize>(&mut self) -> Result<[u8; LEN], DocumentError> {
        let (array, rest) = self.rest.split_first_chunk().ok_or(DocumentError::Short)?;
        self.rest = rest;
        Ok(*array)
    }

    fn byte(&mut self) -> Result<u8, DocumentError> {
        self.array::<1>().map(|[byte]| byte)
    }

    fn flag(&mut self, of: &'static str) -> Result<bool, DocumentError> {
        match self.byte()? {
            0 => Ok(false),
            1 => Ok(true),
            _ => Err(DocumentError::Value { of }),
        }
    }

    fn str(&mut self, of: &'static str) -> Result<&'a str, DocumentError> {
        let len = self.byte()?;
        let (text, rest) = self.rest.split_at_checked(len.into()).ok_or(DocumentError::Short)?;
        self.rest = rest;
        core::str::from_utf8(text).map_err(|_| DocumentError::Value { of })
    }

    /// A text for MQTT; it may be empty.
    fn text(&mut self, of: &'static str) -> Result<Credential, DocumentError> {
        let text = self.str(of)?;
        Credential::new(text).filter(|_| !text.contains('\0')).ok_or(DocumentError::Value { of })
    }

    fn known_text(&mut self, of: &'static str) -> Result<Credential, DocumentError> {
        self.text(of).and_then(|text| match text.as_str() {
            "" => Err(DocumentError::Value { of }),
            _ => Ok(text),
        })
    }

    fn id(&mut self, of: &'static str) -> Result<Id, DocumentError> {
        Id::new(self.str(of)?).map_err(|error| DocumentError::Name { of, error })
    }

    /// A name or an IPv4 address; a board does not support IPv6.
    fn host(&mut self, of: &'static str) -> Result<Host, DocumentError> {
        let host = self.str(of)?;
        let is_known = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-' | b'_');
        let is_host = !host.is_empty() && host.bytes().all(is_known);
        Host::try_from(host).ok().filter(|_| is_host).ok_or(DocumentError::Value { of })
    }

    fn port(&mut self) -> Result<u16, DocumentError> {
        match u16::from_le_bytes(self.array()?) {
            0 => Err(DocumentError::Value { of: "the port" }),
            port => Ok(port),
        }
    }

    fn time(&mut self, of: &'static str) -> Result<Duration, DocumentError> {
        match u32::from_le_bytes(self.array()?) {
            ms @ 100..=3_600_000 => Ok(Duration::from_millis(ms.into())),
            _ => Err(DocumentError::Value { of }),
        }
    }

    fn range(&mut self) -> Result<VarRange, DocumentError> {
        let [first, last] = self.array()?;
        let var = |ordinal: u8| SysVar::from_ordinal(ordinal.into());
        let range = var(first).zip(var(last)).and_then(|(first, last)| VarRange::of(first, last));
        range.ok_or(DocumentError::Value { of: "a variable" })
    }
}

impl core::fmt::Display for DocumentError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Magic => f.write_str("these are no settings of an edge node"),
            Self::Version { found } => write!(f, "version {found} is not read here; allowed: {VERSION}"),
            Self::Long { len } => write!(f, "{len} bytes; allowed: {MAX_DOCUMENT}"),
            Self::Short => f.write_str("the settings are cut off"),
            Self::Behind { count } => write!(f, "{count} bytes behind the settings"),
            Self::Value { of } => write!(f, "{of} is out of range"),
            Self::Name { of, error } => write!(f, "{of}: {error}"),
        }
    }
}

impl core::error::Error for DocumentError {}

const MAGIC: [u8; 4] = *b"RGWE";
const VERSION: u8 = 1;

#[cfg(test)]
#[path = "document_tests.rs"]
mod tests;
