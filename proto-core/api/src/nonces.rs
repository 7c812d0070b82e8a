//! Nonces: each signed request carries one, which makes it valid once and only for a short time.
//!
//! Anyone may request a nonce, so handing one out must use up no resource. A nonce therefore contains its own time and
//! number, sealed with a secret of this run. Only nonces that came with a *valid* signature are remembered. When there
//! is no room for another, the oldest is forgotten, and every nonce that is as old or older is refused.

use core::fmt::Write;

use heapless::{String, Vec};
use proto_core::time::{Duration, Instant};

use crate::key::{self, Hash, Hex};

/// How long a nonce is valid.
pub const MAX_AGE: Duration = Duration::from_secs(30);
/// Number of used nonces that are remembered.
const MAX_USED: usize = 64;
/// Number of bytes of a nonce: time, number and seal.
const LEN: usize = 24;

/// A nonce as text.
pub type NonceText = String<{ LEN * 2 }>;

/// Hands out nonces and remembers the used ones.
#[derive(Debug, Clone)]
pub struct Nonces {
    secret: Hash,
    /// Number of the next nonce: nonces differ even if the clock stands still.
    next: u32,
    used: Vec<Used, MAX_USED>,
    /// Nonces that are as old as this or older are refused.
    floor: Option<Instant>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Used {
    at: Instant,
    number: u32,
}

/// Why a nonce is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NonceError {
    /// It was not handed out by this run.
    Unknown,
    /// It is too old.
    Old,
    /// It was used before.
    Used,
}

/// A nonce that was checked and may be used.
#[derive(Debug, Clone, Copy)]
pub struct Fresh(Used);

impl Nonces {
    /// No nonces yet. `secret` is random and different after each start.
    pub const fn new(secret: Hash) -> Self {
        Self { secret, next: 0, used: Vec::new(), floor: None }
    }

    /// Hands out a nonce.
    pub fn give(&mut self, now: Instant) -> NonceText {
        let used = Used { at: now, number: self.next };
        self.next = self.next.wrapping_add(1);
        let (time, number, seal) =
            (now.as_micros().to_be_bytes(), used.number.to_be_bytes(), self.seal(used));
        let mut text = NonceText::new();
        // Cannot fail: the text has room for all three.
        let _ = write!(text, "{}{}{}", Hex(&time), Hex(&number), Hex(&seal));
        text
    }

    /// Checks whether a nonce may be used, without using it.
    pub fn check(&self, now: Instant, text: &str) -> Result<Fresh, NonceError> {
        let bytes: [u8; LEN] = key::from_hex(text).ok_or(NonceError::Unknown)?;
        let (time, rest) = bytes.split_first_chunk::<8>().ok_or(NonceError::Unknown)?;
        let (number, seal) = rest.split_first_chunk::<4>().ok_or(NonceError::Unknown)?;
        let used =
            Used { at: Instant::from_micros(u64::from_be_bytes(*time)), number: u32::from_be_bytes(*number) };
        if !key::verify(&self.secret, &[time, number], seal) {
            return Err(NonceError::Unknown);
        }
        if now.saturating_since(used.at) > MAX_AGE || self.floor.is_some_and(|floor| used.at <= floor) {
            return Err(NonceError::Old);
        }
        match self.used.contains(&used) {
            true => Err(NonceError::Used),
            false => Ok(Fresh(used)),
        }
    }

    /// Marks a nonce as used.
    pub fn spend(&mut self, now: Instant, fresh: Fresh) {
        self.used.retain(|used| now.saturating_since(used.at) <= MAX_AGE);
        let oldest = self.used.iter().map(|used| used.at).min();
        if self.used.is_full()
            && let Some(oldest) = oldest
        {
            self.floor = self.floor.max(Some(oldest));
            self.used.retain(|used| used.at > oldest);
        }
        // Cannot fail: room was made above.
        let _ = self.used.push(fresh.0);
    }

    fn seal(&self, used: Used) -> [u8; 12] {
        let (time, number) = (used.at.as_micros().to_be_bytes(), used.number.to_be_bytes());
        let code = key::authenticate(&self.secret, &[&time, &number]);
        code.first_chunk().copied().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Instant = Instant::from_micros(1_000_000);

    #[test]
    fn one_counts_once_and_for_a_while() {
        let mut nonces = Nonces::new([9; 32]);
        let (first, second) = (nonces.give(START), nonces.give(START));
        assert_ne!(first, second);
        let fresh = nonces.check(START, &first).unwrap();
        nonces.spend(START, fresh);
        assert_eq!(nonces.check(START, &first).err(), Some(NonceError::Used));
        assert!(nonces.check(START + MAX_AGE, &second).is_ok());
        let late = START + MAX_AGE + Duration::from_micros(1);
        assert_eq!(nonces.check(late, &second).err(), Some(NonceError::Old));
        assert_eq!(nonces.check(late, &first).err(), Some(NonceError::Old));
    }

    #[test]
    fn one_of_another_run_or_made_up_is_unknown() {
        let mut nonces = Nonces::new([9; 32]);
        let other = Nonces::new([8; 32]).give(START);
        assert_eq!(nonces.check(START, &other).err(), Some(NonceError::Unknown));
        let own = nonces.give(START);
        for wrong in ["", "0", &own[1..], &own[..24], "é"] {
            assert_eq!(nonces.check(START, wrong).err(), Some(NonceError::Unknown), "{wrong}");
        }
        for at in 0..own.len() {
            let mut changed: std::string::String = own.as_str().into();
            let digit = if &own[at..=at] == "0" { "1" } else { "0" };
            changed.replace_range(at..=at, digit);
            assert_eq!(nonces.check(START, &changed).err(), Some(NonceError::Unknown), "digit {at}");
        }
    }

    #[test]
    fn however_many_are_used_none_counts_twice() {
        let mut nonces = Nonces::new([9; 32]);
        let mut given = std::vec::Vec::new();
        let mut now = START;
        for nth in 0_u64..200 {
            // Several nonces at the same instant.
            now = START + Duration::from_micros(nth / 3);
            given.push(nonces.give(now));
            let text = given.last().unwrap();
            if let Ok(fresh) = nonces.check(now, text) {
                nonces.spend(now, fresh);
            }
            assert!(given.iter().all(|used| nonces.check(now, used).is_err()), "after {nth}");
        }
        // Handing out many nonces invalidates none of those used in time.
        let mine = nonces.give(now);
        (0..10_000).for_each(|_| drop(nonces.give(now)));
        assert!(nonces.check(now + Duration::from_secs(1), &mine).is_ok());
    }
}
