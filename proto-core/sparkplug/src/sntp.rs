//! UTC from an SNTP server (RFC 4330), for a board without a clock of its own.
//!
//! In: datagrams of the server, the current time. Out: requests, and UTC once a reply is known to answer the newest
//! request. Does not know sockets. The server is trusted, as nothing here is authenticated (docs/threats.md).
//!
//! A driver calls [`Sntp::poll`], sends the request that it returns, passes each datagram of the server to
//! [`Sntp::receive`], and waits until [`Sntp::deadline`].

use proto_core::time::{Duration, Instant};

/// Length of a request, and of a reply without an authenticator, in bytes.
pub const PACKET: usize = 48;

/// A client of one server.
#[derive(Debug, Clone, Copy)]
pub struct Sntp {
    next: Instant,
    /// The unanswered request: its time stamp, and when it was sent.
    asked: Option<([u8; 8], Instant)>,
    /// Number of requests in a row without a usable reply.
    failures: u8,
    random: u64,
    counters: SntpCounters,
}

/// Counters since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SntpCounters {
    /// Requests that were sent.
    pub requests: u32,
    /// Replies that gave the time.
    pub replies: u32,
    /// Datagrams that were refused.
    pub refused: u32,
}

/// Why a datagram does not give the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ReplyError {
    /// The datagram is shorter than a reply.
    Short {
        /// Its length in bytes.
        len: usize,
    },
    /// There was no request, or the datagram answers another one.
    Originate,
    /// It is not the reply of a server, or its version is unknown.
    Mode {
        /// The byte with leap indicator, version and mode.
        first: u8,
    },
    /// The server wants fewer or no requests (kiss-o'-death).
    Kiss {
        /// Its code, such as `RATE`.
        code: [u8; 4],
    },
    /// The server is not synchronised itself.
    Unsynchronised,
    /// The time is 0, or in a year that is not plausible.
    Time,
    /// The reply came so late that it is too inaccurate.
    Late,
}

impl core::fmt::Display for ReplyError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Short { .. } => "a reply is too short",
            Self::Originate => "a reply is none to the request",
            Self::Mode { .. } => "a reply is none of a server of SNTP",
            Self::Kiss { .. } => "it wants to be left alone",
            Self::Unsynchronised => "it does not know the time itself",
            Self::Time => "it tells an impossible time",
            Self::Late => "a reply came too late",
        })
    }
}

impl core::error::Error for ReplyError {}

impl Sntp {
    /// A client that sends its first request at once. `seed` must differ at each start.
    pub const fn new(seed: u64) -> Self {
        let counters = SntpCounters { requests: 0, replies: 0, refused: 0 };
        Self { next: Instant::ZERO, asked: None, failures: 0, random: seed | 1, counters }
    }

    /// Counters since the start.
    pub const fn counters(&self) -> SntpCounters {
        self.counters
    }

    /// When to call [`Sntp::poll`] next.
    pub const fn deadline(&self) -> Instant {
        self.next
    }

    /// The next request, if it is due.
    pub fn poll(&mut self, now: Instant) -> Option<[u8; PACKET]> {
        if now < self.next {
            return None;
        }
        // A request counts as failed until its reply arrives.
        self.failures = self.failures.saturating_add(1);
        self.next = now + self.pause();
        self.counters.requests = self.counters.requests.saturating_add(1);
        // The server returns this stamp unchanged. A random one cannot be guessed without seeing the request, and does
        // not reveal when the board was started.
        let stamp = self.next_random().to_be_bytes();
        self.asked = Some((stamp, now));
        let mut request = [0; PACKET];
        let (head, rest) = request.split_at_mut(PACKET.saturating_sub(8));
        if let Some(first) = head.first_mut() {
            // Version 4, client.
            *first = 0b00_100_011;
        }
        rest.iter_mut().zip(stamp).for_each(|(place, byte)| *place = byte);
        Some(request)
    }

    /// UTC at `now` from a datagram of the server, in milliseconds since 1970.
    ///
    /// # Errors
    /// Why the datagram does not give the time. It is counted as refused.
    pub fn receive(&mut self, now: Instant, datagram: &[u8]) -> Result<u64, ReplyError> {
        let told = self.told(now, datagram);
        match told {
            Ok(_) => {
                self.counters.replies = self.counters.replies.saturating_add(1);
                (self.asked, self.failures) = (None, 0);
                self.next = now + USUAL;
            }
            Err(error) => {
                self.counters.refused = self.counters.refused.saturating_add(1);
                // This server is not asked again soon. The reply is genuine: only the server knows the stamp.
                if matches!(error, ReplyError::Kiss { .. }) {
                    (self.asked, self.failures) = (None, DOUBLINGS);
                    self.next = now + LONGEST;
                }
            }
        }
        told
    }

    fn told(&self, now: Instant, datagram: &[u8]) -> Result<u64, ReplyError> {
        let short = ReplyError::Short { len: datagram.len() };
        let reply: &[u8; PACKET] = datagram.first_chunk().ok_or(short)?;
        let (words, _) = reply.as_chunks::<4>();
        let &[[first, stratum, ..], _, _, code, _, _, stamp_high, stamp_low, _, _, seconds, fraction] = words
        else {
            return Err(short);
        };
        let (stamp, at) = self.asked.ok_or(ReplyError::Originate)?;
        if stamp.as_chunks::<4>().0 != [stamp_high, stamp_low] {
            return Err(ReplyError::Originate);
        }
        // Version 3 or 4, server.
        if !matches!(first >> 3 & 0b111, 3 | 4) || first & 0b111 != 4 {
            return Err(ReplyError::Mode { first });
        }
        match stratum {
            0 => return Err(ReplyError::Kiss { code }),
            1..=15 if first >> 6 != 3 => {}
            _ => return Err(ReplyError::Unsynchronised),
        }
        let round_trip = now.saturating_since(at);
        if round_trip > LATEST {
            return Err(ReplyError::Late);
        }
        let (seconds, fraction) = (u32::from_be_bytes(seconds), u32::from_be_bytes(fraction));
        if seconds == 0 && fraction == 0 {
            return Err(ReplyError::Time);
        }
        // Seconds wrap in 2036: a value that would be before 1968 belongs to the next era (RFC 4330 section 3).
        let era = if seconds & 0x8000_0000 == 0 { 1_u64 << 32 } else { 0 };
        let since_1900 = u64::from(seconds).saturating_add(era);
        let seconds = since_1900.checked_sub(FROM_1900_TO_1970).ok_or(ReplyError::Time)?;
        let millis = u64::from(fraction).saturating_mul(1_000) >> 32;
        let utc_ms = seconds.saturating_mul(1_000).saturating_add(millis);
        if !PLAUSIBLE.contains(&utc_ms) {
            return Err(ReplyError::Time);
        }
        // The reply was sent half a round trip ago.
        Ok(utc_ms.saturating_add(round_trip.as_millis() >> 1))
    }

    /// The pause after a request without a reply: 4 s, doubled each time up to 17 min, less a random quarter.
    fn pause(&mut self) -> Duration {
        let doublings = u32::from(self.failures.saturating_sub(1).min(DOUBLINGS));
        let most = FIRST.as_micros().checked_shl(doublings).unwrap_or(0);
        let quarter = (most >> 2).max(1);
        let less = self.next_random().checked_rem(quarter).unwrap_or(0);
        Duration::from_micros(most.saturating_sub(less))
    }

    fn next_random(&mut self) -> u64 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        self.random
    }
}

/// The first pause without a reply.
const FIRST: Duration = Duration::from_secs(4);
/// How often the pause is doubled: up to 1024 s.
const DOUBLINGS: u8 = 8;
/// The pause after a reply.
const USUAL: Duration = Duration::from_secs(1_024);
/// The pause after a kiss-o'-death.
const LONGEST: Duration = Duration::from_secs(3_600);
/// The longest accepted round trip; the error of the time is at most half of it.
const LATEST: Duration = Duration::from_secs(2);
/// Seconds from 1900 to 1970.
const FROM_1900_TO_1970: u64 = 2_208_988_800;
/// Milliseconds since 1970: from 2024, before which this program did not exist, to 2100.
const PLAUSIBLE: core::ops::Range<u64> = 1_704_067_200_000..4_102_444_800_000;

#[cfg(test)]
#[path = "sntp_tests.rs"]
mod tests;
