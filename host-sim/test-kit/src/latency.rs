//! Latency histograms in a status or in statistics.

use serde_json::Value;

/// The samples that were added to a histogram, `latency.NAME`, between two documents: their number, and the buckets of
/// their median, 99th percentile and maximum.
///
/// # Panics
/// If one of them has no such histogram.
pub fn grown(before: &Value, after: &Value, name: &str) -> (u64, [usize; 3]) {
    let buckets = |document: &Value| -> Vec<u64> {
        let buckets = document["latency"][name]["buckets"].as_array().expect("a histogram");
        buckets.iter().map(|count| count.as_u64().expect("a number")).collect()
    };
    let grown: Vec<u64> =
        buckets(after).iter().zip(buckets(before)).map(|(after, before)| after - before).collect();
    let count: u64 = grown.iter().sum();
    let place = |share: u64| {
        let mut seen = 0;
        let reached = |samples: &u64| {
            seen += samples;
            seen * 100 >= count * share
        };
        grown.iter().position(reached).unwrap_or(0)
    };
    (count, [50, 99, 100].map(place))
}
