//! Configurations that cannot be used: the gateway says why, and its field ports stay silent.

use super::case::{Case, Scenario};
use super::environment::Plan;
use super::examples::ROBOT;

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("a_damaged_configuration_is_refused", |case| refused(case, Defect::Damaged)),
        Scenario::new("a_cut_configuration_is_refused", |case| refused(case, Defect::Cut)),
        Scenario::new("a_missing_configuration_is_refused", |case| refused(case, Defect::Missing)),
        Scenario::new("a_port_without_a_device_is_refused", |case| refused(case, Defect::NoDevice)),
    ]
}

/// A defect of a configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Defect {
    /// Its content is damaged.
    Damaged,
    /// Its end is missing.
    Cut,
    /// It does not exist.
    Missing,
    /// It has a port without a device.
    NoDevice,
}

fn refused(case: &Case, defect: Defect) {
    let robot = case.robot(ROBOT).start();
    let plan: Plan<'_> = match defect {
        Defect::NoDevice => case.gateway_of(THREE_LINES),
        _ => case.gateway("rs485-system.toml"),
    };
    let reason = plan.robot(&robot).refused(defect);
    let expected: &[&str] = match defect {
        Defect::Damaged => &["unknown key", "damaged"],
        Defect::Cut => &["spoilt.toml", "cut", BEHIND_THE_END],
        Defect::Missing => &["No such file", "cannot read", ERASED],
        Defect::NoDevice => &["port line-3 needs exactly one device", "this board has 2 RS-485 ports"],
    };
    assert!(expected.iter().any(|words| reason.contains(words)), "{defect:?}: {reason}");
}

/// In flash, erased bytes follow a truncated image.
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
