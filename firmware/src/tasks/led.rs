//! The status LED (its table is in README.md).

use embassy_time::{Duration, Timer};

use super::watchdog::Pulse;

/// What the LED shows. It is on until the first pattern begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Condition {
    /// The configuration was refused: nothing runs.
    Refused,
    /// A link that the configuration needs is not up.
    NoController,
    /// All links are up; a field port is silent, gone or bus-off.
    PortSilent,
    /// All links are up and all field ports are alive.
    Running,
    /// The operation `identify` is active.
    Identify,
}

impl Condition {
    /// On and off times in milliseconds; at most a second in total.
    const fn pattern(self) -> &'static [(u64, u64)] {
        match self {
            Self::Refused => &[(100, 100)],
            Self::NoController => &[(100, 900)],
            Self::PortSilent => &[(100, 200), (100, 600)],
            Self::Running => &[(500, 500)],
            Self::Identify => &[(400, 100), (100, 100), (100, 100)],
        }
    }
}

/// Shows the condition forever; it is read before each period of the pattern.
pub async fn run(pulse: &Pulse, condition: impl Fn() -> Condition, mut set: impl FnMut(bool)) -> ! {
    loop {
        for &(lit, dark) in condition().pattern() {
            for (is_lit, millis) in [(true, lit), (false, dark)] {
                set(is_lit);
                pulse.idle(core::pin::pin!(Timer::after(Duration::from_millis(millis)))).await;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Condition; 5] = [
        Condition::Refused,
        Condition::NoController,
        Condition::PortSilent,
        Condition::Running,
        Condition::Identify,
    ];

    #[test]
    fn each_pattern_is_short_and_another_than_the_rest() {
        for (index, condition) in ALL.iter().enumerate() {
            let pattern = condition.pattern();
            let total: u64 = pattern.iter().map(|(lit, dark)| lit + dark).sum();
            assert!(total <= 1_000 && pattern.iter().all(|&(lit, dark)| lit >= 100 && dark >= 100));
            assert!(ALL[..index].iter().all(|other| other.pattern() != pattern));
        }
    }
}
