//! Names for tools that allow fewer characters than a file: C identifiers of at most 32 characters.
//!
//! In: the name of a recipe, port, field or variable, any UTF-8. Out: an identifier, always the same for the same name,
//! and as readable as possible:
//!
//! | in the name | in the identifier | example |
//! |---|---|---|
//! | ASCII letters and digits | as they are | `force` |
//! | `_` between two of them | `_` | `left_hand` |
//! | `-` | `__` | `thumb-turn`: `thumb__turn` |
//! | a number in brackets | `_`, the number, `_` | `RobotState[8]`: `RobotState_8_` |
//! | any other character, a digit at the beginning, and a `_` that would be read as one of these | `_x`, its code point in hexadecimal, `_` | `3d`: `_x33_d` |
//!
//! [`unmangle`] returns the name, so two names never have the same identifier. A longer identifier than 32 characters
//! is cut after 22 at most and ends with `_h` and eight hexadecimal digits, a hash of the whole name. Only these can
//! collide, which [`Names`] finds.

use std::collections::BTreeMap;
use std::fmt;

/// Maximum number of characters of an identifier, from DBC.
pub const MAX_IDENTIFIER: usize = 32;

/// The identifier of a name.
pub fn mangle(name: &str) -> String {
    let tokens = tokens(name);
    whole(&tokens).unwrap_or_else(|| shortened(name, &tokens))
}

/// The identifier of a name, if it is short enough.
fn whole(tokens: &[String]) -> Option<String> {
    let identifier = if tokens.is_empty() { "_".to_owned() } else { tokens.concat() };
    (identifier.len() <= MAX_IDENTIFIER).then_some(identifier)
}

/// The identifier of a name that is too long. If the result could be unmangled to another name, it is cut further.
fn shortened(name: &str, tokens: &[String]) -> String {
    let hash = format!("_h{:08x}", hash(name));
    let mut kept = 0;
    let mut len = 0;
    for token in tokens {
        len += token.len();
        if len > MAX_IDENTIFIER - HASH_LEN {
            break;
        }
        kept += 1;
    }
    let mut candidates = (0..=kept).rev().map(|kept| tokens[..kept].concat() + &hash);
    // The hash alone cannot be unmangled: no name begins with `_`.
    candidates.find(|identifier| unmangle(identifier).is_none()).unwrap_or_else(|| hash.clone())
}

/// The name of an identifier; `None` if the identifier has a hash or belongs to no name.
pub fn unmangle(identifier: &str) -> Option<String> {
    if identifier == "_" {
        return Some(String::new());
    }
    let mut name = String::new();
    let mut rest = identifier;
    while let Some(first) = rest.chars().next() {
        if let Some(len) = number_at(rest) {
            name += &format!("[{}]", &rest[1..len - 1]);
            rest = &rest[len..];
        } else if let Some(len) = code_at(rest) {
            name.push(char::from_u32(u32::from_str_radix(&rest[2..len - 1], 16).ok()?)?);
            rest = &rest[len..];
        } else if let Some(after) = rest.strip_prefix("__") {
            name.push('-');
            rest = after;
        } else {
            name.push(first);
            rest = &rest[first.len_utf8()..];
        }
    }
    (whole(&tokens(&name)).as_deref() == Some(identifier)).then_some(name)
}

/// The identifiers of one scope, such as the signals of a message, which must be unique.
#[derive(Debug, Clone, Default)]
pub struct Names {
    by_identifier: BTreeMap<String, String>,
}

impl Names {
    /// The identifier of `name`, which may be added more than once.
    ///
    /// # Errors
    /// [`Collision`] if another name of the scope has it.
    pub fn add(&mut self, name: &str) -> Result<String, Collision> {
        self.add_as(name, mangle(name))
    }

    /// The identifier of a name that must be new.
    ///
    /// # Errors
    /// [`Collision`] with another name or with the same name.
    pub fn add_new(&mut self, name: &str) -> Result<String, Collision> {
        let identifier = mangle(name);
        match self.by_identifier.get(&identifier) {
            Some(other) => Err(Collision { names: [other.clone(), name.to_owned()], identifier }),
            None => self.add_as(name, identifier),
        }
    }

    fn add_as(&mut self, name: &str, identifier: String) -> Result<String, Collision> {
        match self.by_identifier.get(&identifier) {
            Some(other) if other != name => {
                Err(Collision { names: [other.clone(), name.to_owned()], identifier })
            }
            Some(_) => Ok(identifier),
            None => {
                self.by_identifier.insert(identifier.clone(), name.to_owned());
                Ok(identifier)
            }
        }
    }
}

/// Two names of one scope have the same identifier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Collision {
    /// The names.
    pub names: [String; 2],
    /// The identifier.
    pub identifier: String,
}

impl fmt::Display for Collision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [one, other] = &self.names;
        let Self { identifier, .. } = self;
        if one == other {
            return write!(f, "there are two {one:?} where only one can be called {identifier}");
        }
        write!(
            f,
            "{one:?} and {other:?} would both be called {identifier}, because they are long; rename one of them"
        )
    }
}

impl std::error::Error for Collision {}

/// Length of `_h` and eight digits.
const HASH_LEN: usize = 10;

/// Keywords of DBC.
const KEYWORDS: [&str; 1] = ["VERSION"];

/// The identifier in pieces, none of which may be cut in two.
fn tokens(name: &str) -> Vec<String> {
    let chars: Vec<char> = name.chars().collect();
    let is_plain =
        |at: Option<usize>| at.and_then(|at| chars.get(at)).is_some_and(char::is_ascii_alphanumeric);
    let mut tokens = Vec::new();
    let mut at = 0;
    while let Some(&c) = chars.get(at) {
        let rest: String = chars[at..].iter().collect();
        let is_first_of_keyword = at == 0 && KEYWORDS.contains(&name);
        match c {
            'a'..='z' | 'A'..='Z' if !is_first_of_keyword => tokens.push(c.to_string()),
            '0'..='9' if at > 0 => tokens.push(c.to_string()),
            '_' if is_plain(at.checked_sub(1)) && is_plain(Some(at + 1)) && !is_read_as_another(&rest) => {
                tokens.push("_".into());
            }
            '-' => tokens.push("__".into()),
            '[' => match index_at(&rest) {
                Some(index) => {
                    tokens.push(format!("_{index}_"));
                    at += index.len() + 2;
                    continue;
                }
                None => tokens.push(escaped(c)),
            },
            _ => tokens.push(escaped(c)),
        }
        at += 1;
    }
    tokens
}

fn escaped(c: char) -> String {
    format!("_x{:x}_", u32::from(c))
}

/// Whether a `_` copied from a name would be read as the beginning of an index, an escaped character or the hash. The
/// identifier continues as the name does, up to the next character that is not a letter or a digit; this one becomes
/// something that begins with `_`.
fn is_read_as_another(rest: &str) -> bool {
    let plain: String = rest[1..].chars().take_while(char::is_ascii_alphanumeric).collect();
    let ends = rest.len() == plain.len() + 1;
    let seen = if ends { format!("_{plain}") } else { format!("_{plain}_") };
    let is_hash = ends && plain.len() == HASH_LEN - 1 && plain.starts_with('h') && is_hex(&plain[1..]);
    number_at(&seen).is_some() || code_at(&seen).is_some() || is_hash
}

/// The number in a `[number]` at the beginning of `text`.
fn index_at(text: &str) -> Option<&str> {
    let (index, _) = text.strip_prefix('[')?.split_once(']')?;
    (!index.is_empty() && index.bytes().all(|byte| byte.is_ascii_digit())).then_some(index)
}

/// The length of a `_number_` at the beginning of `text`.
fn number_at(text: &str) -> Option<usize> {
    let (number, _) = text.strip_prefix('_')?.split_once('_')?;
    (!number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit())).then_some(number.len() + 2)
}

/// The length of a `_xcode_` at the beginning of `text`.
fn code_at(text: &str) -> Option<usize> {
    let (code, _) = text.strip_prefix("_x")?.split_once('_')?;
    (!code.is_empty() && is_hex(code)).then_some(code.len() + 3)
}

fn is_hex(text: &str) -> bool {
    text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

/// FNV-1a of 32 bits.
fn hash(name: &str) -> u32 {
    name.bytes().fold(0x811C_9DC5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn usual_names_stay_readable() {
        for (name, identifier) in [
            ("force", "force"),
            ("left_hand", "left_hand"),
            ("force_1", "force_1"),
            ("thumb-turn", "thumb__turn"),
            ("rs485-1", "rs485__1"),
            ("RobotState[8]", "RobotState_8_"),
            ("BitInputReg[3].0", "BitInputReg_3__x2e_0"),
            ("3d", "_x33_d"),
            ("力", "_x529b_"),
            ("a_1_b", "a_x5f_1_b"),
            ("a_1", "a_1"),
            ("a__b", "a_x5f__x5f_b"),
            ("_a", "_x5f_a"),
            ("a_xbeef", "a_xbeef"),
            ("a_xbeef_", "a_x5f_xbeef_x5f_"),
            ("VERSION", "_x56_ERSION"),
            ("", "_"),
            ("_", "_x5f_"),
            ("a_h0123abcd", "a_x5f_h0123abcd"),
        ] {
            assert_eq!(mangle(name), identifier, "{name}");
            assert_eq!(unmangle(identifier).as_deref(), Some(name), "{identifier}");
        }
    }

    #[test]
    fn long_names_end_with_a_hash() {
        let long = "the-force-at-the-end-of-the-arm-in-newtons";
        assert_eq!(mangle(long).len(), 32);
        assert!(mangle(long).starts_with("the__force__at__the__"), "{}", mangle(long));
        assert_ne!(mangle(long), mangle(&format!("{long}2")));
        assert_eq!(unmangle(&mangle(long)), None);
    }

    #[test]
    fn what_is_no_identifier_of_ours_is_no_name() {
        for other in ["_a_", "a_", "__x", "a_x41_", "a_x5F_", "_x00_", "a_xffffffff_", "1a", "a b"] {
            let name = unmangle(other);
            assert!(name.as_ref().is_none_or(|name| mangle(name) == other), "{other}: {name:?}");
        }
        assert_eq!(unmangle("a_"), None);
        assert_eq!(unmangle("a_x41_"), None);
    }

    #[test]
    fn a_collision_is_found() {
        let mut names = Names::default();
        assert_eq!(names.add("force").unwrap(), "force");
        assert_eq!(names.add("force").unwrap(), "force");
        // Two names with one hash are hard to come by.
        let collision = names.add_as("other", "force".into()).unwrap_err();
        assert_eq!(collision.names, ["force".to_owned(), "other".to_owned()]);
        assert!(collision.to_string().contains("rename"), "{collision}");
    }

    /// Names of what the rules treat differently, in any order.
    fn tricky() -> impl Strategy<Value = String> {
        let pieces = [
            "_",
            "__",
            "-",
            "[",
            "]",
            "[1]",
            "[12]",
            "x",
            "x5f",
            "5",
            "12",
            "h",
            "a",
            "Zz",
            "力",
            ".",
            "é",
            "h0123abcd",
            "f",
        ];
        prop::collection::vec(prop::sample::select(pieces.to_vec()), 0..9).prop_map(|parts| parts.concat())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(4000))]

        #[test]
        fn every_identifier_is_one_and_leads_back(name in prop_oneof![tricky(), any::<String>(), "[a-z_\\-\\[\\]0-9]{0,14}"]) {
            let identifier = mangle(&name);
            prop_assert!(identifier.len() <= MAX_IDENTIFIER);
            prop_assert!(!identifier.as_bytes()[0].is_ascii_digit());
            prop_assert!(identifier.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_'));
            if whole(&tokens(&name)).is_some() {
                prop_assert_eq!(unmangle(&identifier), Some(name));
            } else {
                prop_assert_eq!(unmangle(&identifier), None);
            }
        }

        #[test]
        fn two_names_never_share_an_identifier(one in tricky(), other in tricky()) {
            prop_assume!(one != other);
            prop_assert_ne!(mangle(&one), mangle(&other));
        }
    }
}
