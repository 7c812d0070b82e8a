//! Names of groups, nodes, devices and hosts, and the topics that contain them (Sparkplug 3.0, chapter 4).

use heapless::String;

use crate::bytes::ByteWriter;

/// The longest name in bytes.
pub const MAX_ID: usize = 64;

/// The name of a group, a node, a device or a host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Id(String<MAX_ID>);

/// Why a text is not a valid name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum IdError {
    /// The name is empty.
    Empty,
    /// The name is longer than [`MAX_ID`].
    Long {
        /// Its length in bytes.
        len: usize,
    },
    /// The name has a control character, or one with a meaning in topics: `+`, `/` or `#`.
    Reserved {
        /// The character.
        character: char,
    },
}

impl Id {
    /// Checks a name.
    pub fn new(name: &str) -> Result<Self, IdError> {
        check(name)?;
        String::try_from(name).map(Self).map_err(|_| IdError::Long { len: name.len() })
    }

    /// The name of an idle node.
    pub(crate) const fn empty() -> Self {
        Self(String::new())
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Checks whether a name can be part of a topic.
pub(crate) fn check(name: &str) -> Result<(), IdError> {
    let is_reserved = |c: &char| matches!(c, '+' | '/' | '#') || c.is_control();
    match name.chars().find(is_reserved) {
        _ if name.is_empty() => Err(IdError::Empty),
        Some(character) => Err(IdError::Reserved { character }),
        None if name.len() > MAX_ID => Err(IdError::Long { len: name.len() }),
        None => Ok(()),
    }
}

impl core::fmt::Display for IdError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Empty => f.write_str("empty"),
            Self::Long { len } => write!(f, "{len} bytes; allowed: {MAX_ID}"),
            Self::Reserved { character } => write!(f, "{character:?} is not allowed in it"),
        }
    }
}

impl core::error::Error for IdError {}

/// The type of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verb {
    Birth,
    Data,
    Death,
    Command,
}

/// Writes the topic of a message of the node, or of one of its devices.
pub(crate) fn write(out: &mut ByteWriter<'_>, group: &Id, verb: Verb, node: &Id, device: Option<&str>) {
    out.put(b"spBv1.0/");
    out.put(group.0.as_bytes());
    out.put(if device.is_some() { b"/D" } else { b"/N" });
    out.put(match verb {
        Verb::Birth => b"BIRTH/",
        Verb::Data => b"DATA/",
        Verb::Death => b"DEATH/",
        Verb::Command => b"CMD/",
    });
    out.put(node.0.as_bytes());
    if let Some(device) = device {
        out.put(b"/");
        out.put(device.as_bytes());
    }
}

/// Whether the node receives its commands on this topic.
pub(crate) fn is_command(topic: &str, group: &Id, node: &Id) -> bool {
    let rest = topic.strip_prefix("spBv1.0/").and_then(|rest| rest.strip_prefix(group.as_str()));
    rest.and_then(|rest| rest.strip_prefix("/NCMD/")) == Some(node.as_str())
}

pub(crate) fn write_state(out: &mut ByteWriter<'_>, host: &Id) {
    out.put(STATE.as_bytes());
    out.put(host.0.as_bytes());
}

/// Whether the host publishes its state on this topic.
pub(crate) fn is_state(topic: &str, host: &Id) -> bool {
    topic.strip_prefix(STATE) == Some(host.as_str())
}

const STATE: &str = "spBv1.0/STATE/";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_parts_of_topics() {
        assert_eq!(Id::new("press 4, 冲压").map(|id| id.as_str() == "press 4, 冲压"), Ok(true));
        assert_eq!(Id::new(""), Err(IdError::Empty));
        assert_eq!(Id::new("a/b"), Err(IdError::Reserved { character: '/' }));
        assert_eq!(Id::new("a+"), Err(IdError::Reserved { character: '+' }));
        assert_eq!(Id::new("#"), Err(IdError::Reserved { character: '#' }));
        assert_eq!(Id::new("a\0"), Err(IdError::Reserved { character: '\0' }));
        assert!(Id::new(&"x".repeat_to(64)).is_ok());
        assert_eq!(Id::new(&"x".repeat_to(65)), Err(IdError::Long { len: 65 }));
    }

    trait Repeat {
        fn repeat_to(&self, len: usize) -> std::string::String;
    }

    impl Repeat for str {
        fn repeat_to(&self, len: usize) -> std::string::String {
            std::string::String::from(self).repeat(len)
        }
    }

    #[test]
    fn only_its_own_topics_are_commands_and_states() {
        let (group, node) = (Id::new("hall").unwrap(), Id::new("press").unwrap());
        assert!(is_command("spBv1.0/hall/NCMD/press", &group, &node));
        for other in [
            "spBv1.0/hall/NCMD/press2",
            "spBv1.0/hall/NCMD/press/x",
            "spBv1.0/hall2/NCMD/press",
            "spBv1.0/hall/DCMD/press",
            "spAv1.0/hall/NCMD/press",
        ] {
            assert!(!is_command(other, &group, &node), "{other}");
        }
        assert!(is_state("spBv1.0/STATE/press", &node) && !is_state("spBv1.0/STATE/press2", &node));
    }
}
