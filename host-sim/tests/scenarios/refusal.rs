//! Configurations that cannot be used: the gateway says why, and its field ports stay silent.

use super::case::{Case, Scenario};
use super::environment::Plan;
use super::examples::ROBOT;

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("a_damaged_configuration_is_refused", |case| refused(case, Spoil::Damaged)),
        Scenario::new("a_cut_configuration_is_refused", |case| refused(case, Spoil::Cut)),
        Scenario::new("a_missing_configuration_is_refused", |case| refused(case, Spoil::Missing)),
        Scenario::new("a_port_without_a_device_is_refused", |case| refused(case, Spoil::NoDevice)),
    ]
}

/// What is wrong with a configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Spoil {
    /// A part is another than was written.
    Damaged,
    /// Its end is missing.
    Cut,
    /// It is not there.
    Missing,
    /// It asks for a port that nothing is there for.
    NoDevice,
}

fn refused(case: &Case, spoil: Spoil) {
    let robot = case.robot(ROBOT).start();
    let plan: Plan<'_> = match spoil {
        Spoil::NoDevice => case.gateway_of(THREE_LINES),
        _ => case.gateway("rs485-system.toml"),
    };
    let reason = plan.robot(&robot).refused(spoil);
    let expected: &[&str] = match spoil {
        Spoil::Damaged => &["unknown key", "damaged"],
        Spoil::Cut => &["spoilt.toml", "cut", BEHIND_THE_END],
        Spoil::Missing => &["No such file", "cannot read", ERASED],
        Spoil::NoDevice => &["port line-3 needs exactly one device", "this board has 2 RS-485 ports"],
    };
    assert!(expected.iter().any(|words| reason.contains(words)), "{spoil:?}: {reason}");
}

/// In flash an image that was cut goes on with erased bytes.
const BEHIND_THE_END: &str = "the image is damaged";
/// Flash without an image.
const ERASED: &str = "not a configuration image: it begins with [FF, FF, FF, FF]";
const THREE_LINES: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "shown"
kind = "stream"
mode = "user"
[recipe.output]
head = [255]
fields = [{ name = "always", type = "byte", value = 1 }]

[[port]]
name = "line-1"
bus = "rs485"
recipe = "shown"

[[port]]
name = "line-2"
bus = "rs485"
recipe = "shown"

[[port]]
name = "line-3"
bus = "rs485"
recipe = "shown"
"#;
