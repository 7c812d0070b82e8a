//! UTC from a server of SNTP (RFC 4330), for a board without a clock of its own.
//!
//! In: datagrams of the server, the present. Out: requests, and UTC once a reply can be trusted to be the answer to
//! the newest request. Knows no sockets. A server is only believed: nothing here is authenticated (docs/threats.md).
//!
//! A driver calls [`Sntp::poll`], sends the request that it returns, gives each datagram of the server to
//! [`Sntp::receive`], and waits until [`Sntp::deadline`].

use proto_core::time::{Duration, Instant};

/// Length of a request, and of a reply without keys.
pub const PACKET: usize = 48;

/// A client of one server.
#[derive(Debug, Clone, Copy)]
pub struct Sntp {
    next: Instant,
    /// The request that was not answered: its time stamp, and when it left.
    asked: Option<([u8; 8], Instant)>,
    /// Requests without a reply that was of use, one after the other.
    failures: u8,
    random: u64,
    counters: SntpCounters,
}

/// Counts since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SntpCounters {
    /// Requests.
    pub requests: u32,
    /// Replies that told the time.
    pub replies: u32,
    /// Datagrams that were no such reply.
    pub refused: u32,
}

/// Why a datagram does not tell the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ReplyError {
    /// Fewer bytes than a reply has.
    Short {
        /// Its bytes.
        len: usize,
    },
    /// Nothing was asked, or it answers another request.
    Originate,
    /// It is no server's reply, or of an unknown version.
    Mode {
        /// Leap indicator, version and mode.
        first: u8,
    },
    /// The server wants no more requests, or fewer (kiss-o'-death).
    Kiss {
        /// Its code, such as `RATE`.
        code: [u8; 4],
    },
    /// The server does not know the time itself.
    Unsynchronised,
    /// It says 0, or a year that a reply of today cannot have.
    Time,
    /// It came so late that it says little.
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
    /// A client that asks at once. `seed` is another one at each start.
    pub const fn new(seed: u64) -> Self {
        let counters = SntpCounters { requests: 0, replies: 0, refused: 0 };
        Self { next: Instant::ZERO, asked: None, failures: 0, random: seed | 1, counters }
    }

    /// Counts since the start.
    pub const fn counters(&self) -> SntpCounters {
        self.counters
    }

    /// When it is to be polled again.
    pub const fn deadline(&self) -> Instant {
        self.next
    }

    /// The next request, if it is due.
    pub fn poll(&mut self, now: Instant) -> Option<[u8; PACKET]> {
        if now < self.next {
            return None;
        }
        // It counts as failed until its reply is there.
        self.failures = self.failures.saturating_add(1);
        self.next = now + self.pause();
        self.counters.requests = self.counters.requests.saturating_add(1);
        // The server returns this stamp as it is. A random one can be guessed by nobody who does not see the request,
        // and does not tell when the board was started.
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

    /// Milliseconds since 1970, at `now`, of a datagram of the server.
    ///
    /// # Errors
    /// Why it does not tell the time. It is counted.
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
                // One who says so is not asked again soon. Only the server knows the stamp.
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
        // Seconds wrap in 2036: what is before 1968 as seconds since 1900 is of the next era (RFC 4330 section 3).
        let era = if seconds & 0x8000_0000 == 0 { 1_u64 << 32 } else { 0 };
        let since_1900 = u64::from(seconds).saturating_add(era);
        let seconds = since_1900.checked_sub(FROM_1900_TO_1970).ok_or(ReplyError::Time)?;
        let millis = u64::from(fraction).saturating_mul(1_000) >> 32;
        let utc_ms = seconds.saturating_mul(1_000).saturating_add(millis);
        if !PLAUSIBLE.contains(&utc_ms) {
            return Err(ReplyError::Time);
        }
        // It left half a round trip ago.
        Ok(utc_ms.saturating_add(round_trip.as_millis() >> 1))
    }

    /// The pause until another request if this one is not answered: 4 s, and twice as long each time up to 17 min, less
    /// a random quarter.
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

/// The first pause after a request without a reply.
const FIRST: Duration = Duration::from_secs(4);
/// How often it is doubled: up to 1024 s.
const DOUBLINGS: u8 = 8;
/// The pause after a reply.
const USUAL: Duration = Duration::from_secs(1_024);
/// The pause after a kiss-o'-death.
const LONGEST: Duration = Duration::from_secs(3_600);
/// The longest round trip; half of it is how wrong the time can be.
const LATEST: Duration = Duration::from_secs(2);
/// Seconds from 1900 to 1970.
const FROM_1900_TO_1970: u64 = 2_208_988_800;
/// Milliseconds since 1970: from 2024, before which there was no such program, to 2100.
const PLAUSIBLE: core::ops::Range<u64> = 1_704_067_200_000..4_102_444_800_000;

#[cfg(test)]
#[path = "sntp_tests.rs"]
mod tests;
