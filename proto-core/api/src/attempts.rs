//! Wrong keys: an address with five of them within a minute has to wait.
//!
//! A key of 128 bits cannot be guessed at any rate. The limit keeps logs short and shows who tries. It counts per
//! address, so one computer of the cell cannot lock out another.

use core::net::IpAddr;

use heapless::Vec;
use proto_core::time::{Duration, Instant};

/// Number of wrong keys after which an address has to wait.
pub const MAX_WRONG: usize = 5;
/// The time within which wrong keys are counted.
pub const WINDOW: Duration = Duration::from_secs(60);
/// Number of addresses that are remembered. Of more, the one without a wrong key for the longest time is forgotten.
const MAX_ADDRESSES: usize = 16;

/// Who sent wrong keys, and when.
#[derive(Debug, Clone, Default)]
pub struct Attempts {
    addresses: Vec<Address, MAX_ADDRESSES>,
}

#[derive(Debug, Clone)]
struct Address {
    at: IpAddr,
    wrong: Vec<Instant, MAX_WRONG>,
}

impl Attempts {
    /// No wrong keys yet.
    pub const fn new() -> Self {
        Self { addresses: Vec::new() }
    }

    /// How long this address has to wait; `None` if it may try.
    pub fn must_wait(&self, now: Instant, address: IpAddr) -> Option<Duration> {
        let known = self.addresses.iter().find(|known| known.at == address)?;
        let oldest = *known.wrong.first().filter(|_| known.wrong.is_full())?;
        Some((oldest + WINDOW).saturating_since(now)).filter(|wait| *wait > Duration::ZERO)
    }

    /// Counts a wrong key.
    pub fn was_wrong(&mut self, now: Instant, address: IpAddr) {
        for known in &mut self.addresses {
            known.wrong.retain(|at| now.saturating_since(*at) < WINDOW);
        }
        self.addresses.retain(|known| !known.wrong.is_empty());
        if let Some(known) = self.addresses.iter_mut().find(|known| known.at == address) {
            // Never full here: an address with this many has to wait, and its requests are not checked.
            let _ = known.wrong.push(now);
            return;
        }
        let newest = |known: &Address| known.wrong.last().copied();
        if self.addresses.is_full() {
            let oldest = self.addresses.iter().map(newest).min();
            let mut is_gone = false;
            // Any of them, if several are equally old.
            self.addresses
                .retain(|known| Some(newest(known)) != oldest || core::mem::replace(&mut is_gone, true));
        }
        let mut wrong = Vec::new();
        let _ = wrong.push(now);
        let _ = self.addresses.push(Address { at: address, wrong });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::net::Ipv4Addr;

    const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

    fn at(seconds: u64) -> Instant {
        Instant::ZERO + Duration::from_secs(seconds)
    }

    #[test]
    fn five_in_a_minute_are_enough() {
        let mut attempts = Attempts::new();
        for second in 0..5 {
            assert_eq!(attempts.must_wait(at(second * 10), HERE), None);
            attempts.was_wrong(at(second * 10), HERE);
        }
        assert_eq!(attempts.must_wait(at(40), HERE), Some(Duration::from_secs(20)));
        assert_eq!(attempts.must_wait(at(40), IpAddr::V4(Ipv4Addr::new(10, 0, 0, 1))), None);
        assert_eq!(attempts.must_wait(at(59), HERE), Some(Duration::from_secs(1)));
        // The oldest wrong key is a minute old, so one more attempt is allowed.
        assert_eq!(attempts.must_wait(at(60), HERE), None);
        attempts.was_wrong(at(60), HERE);
        assert_eq!(attempts.must_wait(at(60), HERE), Some(Duration::from_secs(10)));
    }

    #[test]
    fn wrong_keys_a_quarter_of_a_minute_apart_lock_nobody_out() {
        let mut attempts = Attempts::new();
        for second in 0..100 {
            attempts.was_wrong(at(second * 15), HERE);
            assert_eq!(attempts.must_wait(at(second * 15), HERE), None);
        }
    }

    #[test]
    fn many_addresses_push_out_the_one_that_was_silent_the_longest() {
        let mut attempts = Attempts::new();
        let address = |nth: u32| IpAddr::V4(Ipv4Addr::from_bits(nth));
        (0..5).for_each(|_| attempts.was_wrong(at(0), HERE));
        for nth in 0..15 {
            attempts.was_wrong(at(1), address(nth));
        }
        assert!(attempts.must_wait(at(1), HERE).is_some());
        attempts.was_wrong(at(2), address(99));
        assert!(attempts.must_wait(at(2), HERE).is_none());
        assert_eq!(attempts.addresses.len(), 16);
    }
}
