//! Counts durations in buckets of doubling width: enough for a median, a 99th percentile and a maximum, in constant
//! memory and with a few instructions per sample.
//!
//! In: durations. Out: counts, percentiles, the maximum. Does not know what is measured.

use crate::time::Duration;

/// Number of buckets of a [`Histogram`].
pub const BUCKETS: usize = 24;

/// Durations in power-of-two buckets of microseconds.
///
/// Bucket 0 counts durations below 1 µs, bucket `n` durations from 2^(n-1) µs to below 2^n µs, and the last one all
/// from 2^22 µs (4.2 s) on. Counts saturate at 2^32 - 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Histogram {
    counts: [u32; BUCKETS],
    sum_us: u64,
    max_us: u32,
}

impl Default for Histogram {
    fn default() -> Self {
        Self::new()
    }
}

impl Histogram {
    /// An empty histogram. All its bytes are 0.
    pub const fn new() -> Self {
        Self { counts: [0; BUCKETS], sum_us: 0, max_us: 0 }
    }

    /// Adds a sample.
    pub fn record(&mut self, duration: Duration) {
        self.record_micros(u32::try_from(duration.as_micros()).unwrap_or(u32::MAX));
    }

    /// Adds a sample in microseconds.
    pub(crate) fn record_micros(&mut self, micros: u32) {
        let bits = u32::BITS.saturating_sub(micros.leading_zeros()) as usize;
        if let Some(count) = self.counts.get_mut(bits.min(BUCKETS - 1)) {
            *count = count.saturating_add(1);
        }
        self.sum_us = self.sum_us.wrapping_add(u64::from(micros));
        if micros > self.max_us {
            self.max_us = micros;
        }
    }

    /// The number of samples.
    pub fn count(&self) -> u64 {
        self.counts.iter().map(|&count| u64::from(count)).sum()
    }

    /// The sum of all samples. A sample longer than 2^32 µs (71 minutes) counts as 2^32 µs.
    pub const fn sum(&self) -> Duration {
        Duration::from_micros(self.sum_us)
    }

    /// The longest sample; zero if there is none.
    pub const fn max(&self) -> Duration {
        Duration::from_micros(self.max_us as u64)
    }

    /// The count of each bucket.
    pub const fn buckets(&self) -> &[u32; BUCKETS] {
        &self.counts
    }

    /// The upper end of bucket `index`: all its samples were shorter. [`Duration::MAX`] for the last bucket and beyond.
    pub const fn bucket_end(index: usize) -> Duration {
        if index < BUCKETS - 1 { Duration::from_micros(1 << index) } else { Duration::MAX }
    }

    /// The duration that `per_mille` thousandths of the samples did not exceed, rounded up to the end of its bucket,
    /// but at most the longest sample. `None` without samples. Use 500 for the median, 990 for the 99th percentile.
    pub fn percentile(&self, per_mille: u16) -> Option<Duration> {
        let count = self.count();
        if count == 0 {
            return None;
        }
        let wanted = count.saturating_mul(u64::from(per_mille.min(1000))).div_ceil(1000).max(1);
        let mut seen = 0_u64;
        let bucket = self.counts.iter().position(|&samples| {
            seen = seen.saturating_add(u64::from(samples));
            seen >= wanted
        });
        Some(bucket.map_or(self.max(), |index| Self::bucket_end(index).min(self.max())))
    }

    /// Adds the samples of another histogram.
    pub fn merge(&mut self, other: &Self) {
        for (count, more) in self.counts.iter_mut().zip(other.counts) {
            *count = count.saturating_add(more);
        }
        self.sum_us = self.sum_us.wrapping_add(other.sum_us);
        self.max_us = self.max_us.max(other.max_us);
    }
}

#[cfg(feature = "serde")]
impl serde::Serialize for Histogram {
    /// Count, median, 99th percentile and maximum in microseconds, and the buckets. Percentiles are absent without
    /// samples.
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        #[derive(serde::Serialize)]
        struct SerializedHistogram<'a> {
            count: u64,
            #[serde(skip_serializing_if = "Option::is_none")]
            p50_us: Option<u64>,
            #[serde(skip_serializing_if = "Option::is_none")]
            p99_us: Option<u64>,
            #[serde(skip_serializing_if = "Option::is_none")]
            max_us: Option<u64>,
            sum_us: u64,
            buckets: &'a [u32; BUCKETS],
        }
        let micros = |duration: Duration| duration.as_micros();
        let shown = SerializedHistogram {
            count: self.count(),
            p50_us: self.percentile(500).map(micros),
            p99_us: self.percentile(990).map(micros),
            max_us: self.percentile(1000).map(|_| u64::from(self.max_us)),
            sum_us: self.sum_us,
            buckets: &self.counts,
        };
        shown.serialize(serializer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(micros: impl IntoIterator<Item = u64>) -> Histogram {
        let mut histogram = Histogram::new();
        micros.into_iter().for_each(|us| histogram.record(Duration::from_micros(us)));
        histogram
    }

    #[test]
    fn each_sample_is_in_the_bucket_whose_edges_enclose_it() {
        for us in (0..5_000).chain([4_194_303, 4_194_304, 8_388_608, u64::from(u32::MAX), u64::MAX]) {
            let histogram = of([us]);
            let bucket = histogram.buckets().iter().position(|&count| count == 1).unwrap();
            let sample = Duration::from_micros(us);
            assert!(sample < Histogram::bucket_end(bucket) || bucket == BUCKETS - 1, "{us}");
            assert!(bucket == 0 || sample >= Histogram::bucket_end(bucket - 1), "{us}");
            assert_eq!(histogram.count(), 1);
        }
    }

    #[test]
    fn percentiles_are_bucket_ends_and_never_beyond_the_longest() {
        let histogram = of((0..98).map(|_| 100).chain([900, 3_000]));
        assert_eq!(histogram.percentile(500), Some(Duration::from_micros(128)));
        assert_eq!(histogram.percentile(990), Some(Duration::from_micros(1024)));
        assert_eq!(histogram.percentile(1000), Some(Duration::from_micros(3_000)));
        assert_eq!(histogram.percentile(0), Some(Duration::from_micros(128)));
        assert_eq!(histogram.max(), Duration::from_micros(3_000));
        assert_eq!(histogram.sum(), Duration::from_micros(98 * 100 + 3_900));
    }

    #[test]
    fn without_a_sample_there_is_no_percentile() {
        assert_eq!(Histogram::new().percentile(500), None);
        assert_eq!(Histogram::new().count(), 0);
    }

    #[test]
    fn merged_histograms_count_as_one() {
        let mut first = of([1, 2, 3, 70_000]);
        first.merge(&of([0, 5, 9_000_000]));
        assert_eq!(first, of([1, 2, 3, 70_000, 0, 5, 9_000_000]));
    }
}
