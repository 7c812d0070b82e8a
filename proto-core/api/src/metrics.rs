//! A gateway's state, counters and latencies as OpenMetrics text, for Prometheus.
//!
//! In: a [`Status`]. Out: text, one family of metrics at a time. Labels are the names of ports and links and
//! the reasons of rejections, never the values of variables. The names of counters are those of
//! `PortCounters` and `LinkCounters`: a `rejected_x` there is the reason `x` here.

use core::fmt::{self, Write};

use proto_core::engine::{PortState, PortStatus, Status};
use proto_core::histogram::{BUCKETS, Histogram};
use proto_core::link::LinkState;
use proto_core::time::Duration;
use serde::Serialize;

use crate::fields;
use crate::number::Whole;

/// The metric families of a gateway, written one after another.
#[derive(Debug, Clone)]
pub struct Families {
    next: MetricsStep,
}

#[derive(Debug, Clone, Copy)]
enum MetricsStep {
    Health,
    PortUp,
    PortAge,
    /// The rejections of one port. Those of all ports together would be the longest piece by far.
    Rejected(usize),
    PortCounter(usize),
    LinkUp,
    LinkHistory(usize),
    LinkCounter(usize),
    Latency(usize),
    Sleeps,
    End,
}

impl Default for Families {
    fn default() -> Self {
        Self::new()
    }
}

impl Families {
    /// Starts at the first family.
    pub const fn new() -> Self {
        Self { next: MetricsStep::Health }
    }

    /// Writes the next family, or a part of one, which may be empty. Returns `false` if none is left: the text is
    /// complete.
    ///
    /// # Errors
    /// If `out` fails. The text cannot be continued after that.
    pub fn write_next(&mut self, status: Status<'_>, out: &mut impl Write) -> Result<bool, fmt::Error> {
        self.next = match self.next {
            MetricsStep::Health => {
                let health = status.health().name();
                out.write_str("# TYPE rgw_health stateset\n")?;
                for name in ["running", "port-silent", "no-controller", "idle"] {
                    writeln!(out, "rgw_health{{rgw_health=\"{name}\"}} {}", u8::from(name == health))?;
                }
                MetricsStep::PortUp
            }
            MetricsStep::PortUp => {
                out.write_str("# TYPE rgw_port_working gauge\n")?;
                for port in status.ports() {
                    let is_working = u8::from(port.state == PortState::Working);
                    writeln!(out, "rgw_port_working{{port=\"{}\"}} {is_working}", Label(port.name))?;
                }
                MetricsStep::PortAge
            }
            MetricsStep::PortAge => {
                out.write_str("# TYPE rgw_port_age_seconds gauge\n# UNIT rgw_port_age_seconds seconds\n")?;
                for port in status.ports() {
                    if let Some(age) = port.age {
                        writeln!(
                            out,
                            "rgw_port_age_seconds{{port=\"{}\"}} {}",
                            Label(port.name),
                            Seconds(age)
                        )?;
                    }
                }
                out.write_str("# TYPE rgw_port_rejected counter\n")?;
                MetricsStep::Rejected(0)
            }
            MetricsStep::Rejected(nth) => match status.ports().nth(nth) {
                Some(port) => {
                    rejected(&port, out)?;
                    MetricsStep::Rejected(nth.saturating_add(1))
                }
                None => MetricsStep::PortCounter(0),
            },
            MetricsStep::PortCounter(nth) => {
                let ports = status.ports().map(|port| (port.name, port.counters));
                match counter(out, "port", nth, ports)? {
                    true => MetricsStep::PortCounter(nth.saturating_add(1)),
                    false => MetricsStep::LinkUp,
                }
            }
            MetricsStep::LinkUp => {
                out.write_str("# TYPE rgw_link_up gauge\n")?;
                for link in status.links() {
                    let is_up = u8::from(matches!(link.state, LinkState::Up { .. } | LinkState::Shared));
                    writeln!(out, "rgw_link_up{{link=\"{}\"}} {is_up}", Label(link.name))?;
                }
                MetricsStep::LinkHistory(0)
            }
            MetricsStep::LinkHistory(nth) => {
                let links = status.links().map(|link| (link.name, link.history));
                match counter(out, "link", nth, links)? {
                    true => MetricsStep::LinkHistory(nth.saturating_add(1)),
                    false => MetricsStep::LinkCounter(0),
                }
            }
            MetricsStep::LinkCounter(nth) => {
                let links = status.links().map(|link| (link.name, link.counters));
                match counter(out, "link", nth, links)? {
                    true => MetricsStep::LinkCounter(nth.saturating_add(1)),
                    false => MetricsStep::Latency(0),
                }
            }
            MetricsStep::Latency(nth) => {
                let latency = status.latency();
                let all = [
                    ("handed_over", &latency.handed_over),
                    ("arrived", &latency.arrived),
                    ("lateness", &latency.lateness),
                    ("modbus", &latency.modbus),
                ];
                match all.get(nth) {
                    Some((name, histogram)) => {
                        write_histogram(out, name, histogram)?;
                        MetricsStep::Latency(nth.saturating_add(1))
                    }
                    None => MetricsStep::Sleeps,
                }
            }
            MetricsStep::Sleeps => {
                writeln!(out, "# TYPE rgw_sleeps counter\nrgw_sleeps_total {}\n# EOF", status.sleeps())?;
                MetricsStep::End
            }
            MetricsStep::End => return Ok(false),
        };
        Ok(true)
    }

    /// Writes all families.
    pub fn write_all(mut self, status: Status<'_>, out: &mut impl Write) -> fmt::Result {
        while self.write_next(status, out)? {}
        Ok(())
    }
}

/// The rejection counters of a port; they form one family.
fn rejected(port: &PortStatus<'_>, out: &mut impl Write) -> fmt::Result {
    let mut written = Ok(());
    fields::each(port.counters, |name, value| {
        if let Some(reason) = name.strip_prefix(REJECTED)
            && written.is_ok()
        {
            let port = Label(port.name);
            written = writeln!(
                out,
                "rgw_port_rejected_total{{port=\"{port}\",reason=\"{reason}\"}} {}",
                Whole(value)
            );
        }
    });
    written
}

/// Writes the family of the `nth` field that is a count. Returns `false` if there is no such field.
fn counter<'a, C: Serialize + 'a>(
    out: &mut impl Write,
    of: &str,
    nth: usize,
    all: impl Iterator<Item = (&'a str, &'a C)>,
) -> Result<bool, fmt::Error> {
    let (mut is_there, mut is_begun) = (false, false);
    for (label, counters) in all {
        let (mut at, mut written) = (0_usize, Ok(()));
        fields::each(counters, |name, value| {
            // Rejections have a family of their own; times are in the histograms.
            if name.starts_with(REJECTED) || name.ends_with("_us") {
                return;
            }
            if at == nth && written.is_ok() {
                is_there = true;
                if !core::mem::replace(&mut is_begun, true) {
                    written = writeln!(out, "# TYPE rgw_{of}_{name} counter");
                }
                if written.is_ok() {
                    let (label, value) = (Label(label), Whole(value));
                    written = writeln!(out, "rgw_{of}_{name}_total{{{of}=\"{label}\"}} {value}");
                }
            }
            at = at.saturating_add(1);
        });
        written?;
    }
    Ok(is_there)
}

fn write_histogram(out: &mut impl Write, name: &str, histogram: &Histogram) -> fmt::Result {
    writeln!(out, "# TYPE rgw_{name}_seconds histogram\n# UNIT rgw_{name}_seconds seconds")?;
    let mut count = 0_u64;
    for (nth, samples) in histogram.buckets().iter().enumerate() {
        count = count.saturating_add((*samples).into());
        write!(out, "rgw_{name}_seconds_bucket{{le=\"")?;
        match nth.saturating_add(1) < BUCKETS {
            // A bucket counts durations shorter than its end, in whole microseconds.
            true => write!(
                out,
                "{}",
                Seconds(Duration::from_micros(Histogram::bucket_end(nth).as_micros().saturating_sub(1)))
            )?,
            false => out.write_str("+Inf")?,
        }
        writeln!(out, "\"}} {}", Whole(count))?;
    }
    let (count, sum) = (Whole(count), Seconds(histogram.sum()));
    writeln!(out, "rgw_{name}_seconds_count {count}\nrgw_{name}_seconds_sum {sum}")
}

const REJECTED: &str = "rejected_";

/// A duration, written in seconds without rounding.
struct Seconds(Duration);

impl fmt::Display for Seconds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let micros = self.0.as_micros();
        write!(f, "{}.{:06}", Whole(micros / 1_000_000), (micros % 1_000_000) as u32)
    }
}

/// A label value; quotes, backslashes and line feeds are escaped.
struct Label<'a>(&'a str);

impl fmt::Display for Label<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.chars().try_for_each(|c| match c {
            '\\' => f.write_str("\\\\"),
            '"' => f.write_str("\\\""),
            '\n' => f.write_str("\\n"),
            c => f.write_char(c),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::String;
    use std::vec::Vec;

    #[test]
    fn buckets_of_a_histogram_count_all_that_is_shorter() {
        let mut histogram = Histogram::new();
        for micros in [0, 1, 1, 3, 4, 5_000_000] {
            histogram.record(Duration::from_micros(micros));
        }
        let mut text = String::new();
        write_histogram(&mut text, "x", &histogram).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[2], "rgw_x_seconds_bucket{le=\"0.000000\"} 1");
        assert_eq!(lines[3], "rgw_x_seconds_bucket{le=\"0.000001\"} 3");
        assert_eq!(lines[4], "rgw_x_seconds_bucket{le=\"0.000003\"} 4");
        assert_eq!(lines[5], "rgw_x_seconds_bucket{le=\"0.000007\"} 5");
        assert_eq!(lines[24], "rgw_x_seconds_bucket{le=\"4.194303\"} 5");
        assert_eq!(
            lines[25..],
            ["rgw_x_seconds_bucket{le=\"+Inf\"} 6", "rgw_x_seconds_count 6", "rgw_x_seconds_sum 5.000009",]
        );
    }
}
