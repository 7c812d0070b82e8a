//! A batch shared between machines: determines which machine executes which runs.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

/// One of several shares of a batch, such as 2/3. The default is the whole batch, 1/1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Share {
    nth: usize,
    of: usize,
}

impl Share {
    /// Share `nth` of `of`, counted from 1. `None` if there is no such share, or `of` is more than [`MAX_SHARES`].
    pub fn new(nth: usize, of: usize) -> Option<Self> {
        (1 <= nth && nth <= of && of <= MAX_SHARES).then_some(Self { nth, of })
    }

    /// Number of the share, from 1.
    pub const fn nth(self) -> usize {
        self.nth
    }

    /// The number of shares.
    pub const fn of(self) -> usize {
        self.of
    }

    /// The runs of the share. They are contiguous, so each share with enough runs has all cells in turn. Empty only if
    /// there are fewer runs than shares.
    pub fn runs(self, all: usize) -> Range<usize> {
        let border = |nth: usize| (all as u128 * nth as u128 / self.of as u128) as usize;
        border(self.nth - 1)..border(self.nth)
    }
}

impl Default for Share {
    fn default() -> Self {
        Self { nth: 1, of: 1 }
    }
}

impl fmt::Display for Share {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.nth, self.of)
    }
}

/// The text is not a share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoShare;

impl fmt::Display for NoShare {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "not NTH/OF, from 1/OF to OF/OF with OF at most {MAX_SHARES}, such as 1/3")
    }
}

impl std::error::Error for NoShare {}

impl FromStr for Share {
    type Err = NoShare;

    fn from_str(text: &str) -> Result<Self, NoShare> {
        let number = |text: &str| match text.bytes().all(|byte| byte.is_ascii_digit()) {
            true => text.parse().map_err(|_| NoShare),
            false => Err(NoShare),
        };
        let (nth, of) = text.split_once('/').ok_or(NoShare)?;
        Self::new(number(nth)?, number(of)?).ok_or(NoShare)
    }
}

/// The largest number of shares.
pub const MAX_SHARES: usize = 10_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_run_is_in_one_share_and_shares_differ_by_one_run() {
        for all in [1, 2, 17, 18, 143, 600_000] {
            for of in [1, 2, 3, 7, 17, 100] {
                let shares: Vec<_> = (1..=of).map(|nth| Share::new(nth, of).unwrap().runs(all)).collect();
                assert_eq!(shares[0].start, 0);
                assert_eq!(shares[of - 1].end, all);
                assert!(shares.windows(2).all(|pair| pair[0].end == pair[1].start), "{shares:?}");
                assert!(shares.iter().all(|runs| runs.len().abs_diff(all / of) <= 1), "{shares:?}");
            }
        }
    }

    #[test]
    fn a_share_is_read_as_it_is_shown() {
        assert_eq!("2/3".parse(), Ok(Share { nth: 2, of: 3 }));
        assert_eq!(Share { nth: 2, of: 3 }.to_string(), "2/3");
        for wrong in ["", "1", "/", "0/3", "4/3", "1/0", "+1/3", "1/3/3", "1/10001", "1/99999999999999999999"]
        {
            assert_eq!(wrong.parse::<Share>(), Err(NoShare), "{wrong:?}");
        }
    }
}
