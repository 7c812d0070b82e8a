//! Histograms of a status or of statistics.

use serde_json::Value;

/// What a histogram grew by between two documents that have it as `latency.NAME`: the number of samples, and the
/// buckets that hold the median, 99 % and the longest.
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
