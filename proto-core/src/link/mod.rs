//! Supervises one link to the controller: when to open it, give it up, and try again.
//!
//! In: the driver's reports, and the engine's judgement of the peer. Out: actions and a deadline. Does not know
//! sockets, protocols or addresses.

use crate::time::{Duration, Instant};

/// Timeouts of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LinkTimings {
    /// A link that is not up within this time is given up.
    pub(crate) connect_timeout: Duration,
    /// The wait after the first loss; doubled after each further one.
    pub(crate) backoff_min: Duration,
    /// The longest wait.
    pub(crate) backoff_max: Duration,
    /// After this time up, the next wait is the shortest one again.
    pub(crate) settled_after: Duration,
    /// A link without received bytes for this long is closed; `None` if silence is normal.
    pub(crate) silence: Option<Duration>,
}

impl LinkTimings {
    /// For TCP links to the controller.
    pub(crate) const TCP: Self = Self {
        connect_timeout: Duration::from_secs(2),
        backoff_min: Duration::from_millis(100),
        backoff_max: Duration::from_secs(5),
        settled_after: Duration::from_secs(5),
        silence: None,
    };

    /// For links that the controller opens; it may do so only after days, which is not a failure.
    pub(crate) const LISTENING: Self =
        Self { connect_timeout: Duration::MAX, backoff_max: Self::TCP.backoff_min, ..Self::TCP };

    /// Closes the link after `silence` without received bytes.
    #[must_use]
    pub(crate) const fn with_silence(self, silence: Duration) -> Self {
        Self { silence: Some(silence), ..self }
    }
}

/// The state of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
// Otherwise the tag would be as wide as an instant, and take two registers on a Cortex-M.
#[repr(u8)]
pub enum LinkState {
    /// Closed; opened again at `retry_at`.
    Down {
        /// When it is opened again.
        retry_at: Instant,
    },
    /// Opened, not yet up; given up at `until`.
    Opening {
        /// When it is given up.
        until: Instant,
    },
    /// Up.
    Up {
        /// When it came up.
        since: Instant,
    },
    /// Not opened: the peer accepts only one connection, and another link carries this link's traffic.
    Shared,
}

impl LinkState {
    /// One word for logs and statistics.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Down { .. } => "down",
            Self::Opening { .. } => "opening",
            Self::Up { .. } => "up",
            Self::Shared => "shared",
        }
    }
}

/// An action for the driver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LinkAction {
    /// Open the link and report whether it came up or failed.
    Open,
    /// Close it and stop reporting about it.
    Close,
}

/// Counters of a link since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default))]
pub struct LinkHistory {
    /// Number of times the link came up.
    pub connects: u32,
    /// Number of times it was lost after it was up, by either side.
    pub losses: u32,
    /// Number of times it could not be opened.
    pub failed_opens: u32,
    /// Number of times it was closed because of silence.
    pub silences: u32,
}

/// Supervisor of one link.
#[derive(Debug, Clone)]
pub(crate) struct Supervisor {
    timings: &'static LinkTimings,
    state: LinkState,
    /// Number of times the wait has doubled.
    doubled: u8,
    heard: Instant,
    action: Option<LinkAction>,
    history: LinkHistory,
}

impl Supervisor {
    /// The supervisor of a link that is opened at once.
    pub(crate) const fn new(timings: &'static LinkTimings) -> Self {
        Self {
            timings,
            state: LinkState::Down { retry_at: Instant::ZERO },
            doubled: 0,
            heard: Instant::ZERO,
            action: None,
            history: LinkHistory { connects: 0, losses: 0, failed_opens: 0, silences: 0 },
        }
    }

    pub(crate) const fn state(&self) -> LinkState {
        self.state
    }

    pub(crate) const fn is_up(&self) -> bool {
        matches!(self.state, LinkState::Up { .. })
    }

    /// Counters since the start.
    pub(crate) const fn history(&self) -> &LinkHistory {
        &self.history
    }

    /// The driver reports that the link is up. Returns false if that was not expected: the report is late, and the
    /// driver has already been told to close the link.
    pub(crate) fn up(&mut self, now: Instant) -> bool {
        if !matches!(self.state, LinkState::Opening { .. }) || self.is_to_be_opened() {
            return false;
        }
        self.state = LinkState::Up { since: now };
        self.heard = now;
        self.history.connects = self.history.connects.saturating_add(1);
        true
    }

    /// The driver reports that the link is gone or could not be opened. Returns whether the link was up.
    pub(crate) fn down(&mut self, now: Instant) -> bool {
        if self.is_to_be_opened() {
            return false;
        }
        let was = self.state;
        if !matches!(was, LinkState::Down { .. } | LinkState::Shared) {
            self.fall(now);
        }
        matches!(was, LinkState::Up { .. })
    }

    /// Whether the driver has yet to open the link: until then, its reports are about an earlier connection.
    fn is_to_be_opened(&self) -> bool {
        self.action == Some(LinkAction::Open)
    }

    pub(crate) fn heard(&mut self, now: Instant) {
        self.heard = now;
    }

    /// The engine gives the link up, because the peer sends invalid data or nothing.
    pub(crate) fn give_up(&mut self, now: Instant) {
        if !matches!(self.state, LinkState::Down { .. } | LinkState::Shared) {
            self.fall(now);
            self.action = Some(LinkAction::Close);
        }
    }

    /// From now on, another link carries this link's traffic.
    pub(crate) fn share(&mut self, now: Instant) {
        self.give_up(now);
        self.state = LinkState::Shared;
    }

    /// The link carries its own traffic again; opens it after the shortest wait.
    pub(crate) fn unshare(&mut self, now: Instant) {
        if self.state == LinkState::Shared {
            self.doubled = 0;
            self.state = LinkState::Down { retry_at: now + self.backoff() };
        }
    }

    /// Checks the deadlines. Returns whether the link was up and has just been given up because of silence.
    pub(crate) fn advance(&mut self, now: Instant) -> bool {
        match self.state {
            LinkState::Down { retry_at } if now >= retry_at && self.action.is_none() => {
                self.state = LinkState::Opening { until: now + self.timings.connect_timeout };
                self.action = Some(LinkAction::Open);
            }
            LinkState::Opening { until } if now >= until => self.give_up(now),
            LinkState::Up { .. } if now >= self.silent_at() => {
                self.history.silences = self.history.silences.saturating_add(1);
                self.give_up(now);
                return true;
            }
            _ => {}
        }
        false
    }

    /// Takes the pending action for the driver.
    pub(crate) fn take_action(&mut self) -> Option<LinkAction> {
        self.action.take()
    }

    /// When to call [`Self::advance`], after [`Self::take_action`].
    pub(crate) fn deadline(&self) -> Instant {
        match self.state {
            LinkState::Down { retry_at } => retry_at,
            LinkState::Opening { until } => until,
            LinkState::Up { .. } => self.silent_at(),
            LinkState::Shared => Instant::NEVER,
        }
    }

    fn silent_at(&self) -> Instant {
        self.timings.silence.map_or(Instant::NEVER, |silence| self.heard + silence)
    }

    fn fall(&mut self, now: Instant) {
        match self.state {
            LinkState::Up { since } => {
                self.history.losses = self.history.losses.saturating_add(1);
                if now.saturating_since(since) >= self.timings.settled_after {
                    self.doubled = 0;
                }
            }
            _ => self.history.failed_opens = self.history.failed_opens.saturating_add(1),
        }
        self.state = LinkState::Down { retry_at: now + self.backoff() };
        self.doubled = self.doubled.saturating_add(1);
    }

    /// The wait after the next loss.
    fn backoff(&self) -> Duration {
        let times = 1_u64.checked_shl(self.doubled.into()).unwrap_or(u64::MAX);
        self.timings.backoff_min.saturating_mul(times).min(self.timings.backoff_max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: fn(u64) -> Instant = Instant::from_millis;

    fn opened(at: Instant) -> Supervisor {
        let mut link = Supervisor::new(const { &LinkTimings::TCP.with_silence(Duration::from_secs(2)) });
        link.advance(at);
        assert_eq!(link.take_action(), Some(LinkAction::Open));
        assert_eq!(link.take_action(), None, "an action is told once");
        link
    }

    #[test]
    fn a_refused_link_is_tried_again_later_and_later_up_to_the_bound() {
        let mut link = opened(MS(0));
        let mut now = MS(0);
        for wait in [100, 200, 400, 800, 1600, 3200, 5000, 5000] {
            assert!(!link.down(now));
            assert_eq!(link.deadline(), now + Duration::from_millis(wait));
            now = link.deadline();
            link.advance(now);
            assert_eq!(link.take_action(), Some(LinkAction::Open));
        }
        assert_eq!(link.history().failed_opens, 8);
    }

    #[test]
    fn a_link_that_held_starts_again_from_the_shortest_wait() {
        let mut link = opened(MS(0));
        link.down(MS(0));
        link.advance(MS(100));
        link.take_action();
        assert!(link.up(MS(100)));
        link.heard(MS(5000));
        assert!(link.down(MS(5100)));
        assert_eq!(link.deadline(), MS(5200));
    }

    #[test]
    fn a_connection_that_never_comes_up_is_closed() {
        let mut link = opened(MS(0));
        assert_eq!(link.deadline(), MS(2000));
        link.advance(MS(2000));
        assert_eq!(link.take_action(), Some(LinkAction::Close));
        assert!(!link.up(MS(2001)), "too late");
    }

    #[test]
    fn a_report_from_before_it_is_opened_says_nothing() {
        let mut link = Supervisor::new(&LinkTimings::TCP);
        link.advance(MS(0));
        assert!(!link.down(MS(0)) && !link.up(MS(0)));
        assert_eq!((link.take_action(), link.state().name()), (Some(LinkAction::Open), "opening"));
        assert!(link.up(MS(1)));
    }

    #[test]
    fn silence_closes_a_link_that_should_talk() {
        let mut link = opened(MS(0));
        link.up(MS(10));
        link.heard(MS(500));
        assert!(!link.advance(MS(2499)));
        assert!(link.advance(MS(2500)));
        assert_eq!(link.take_action(), Some(LinkAction::Close));
        assert_eq!(link.history().silences, 1);
        assert_eq!(link.history().losses, 1);
    }
}
