//! The keys that ports have in both kinds of files.

use proto_core::config::{Bus, ConfigErrorKind, Parity, PortKey, Rs485, check_bitrate, check_cycle};
use proto_core::time::Duration;

use super::reader::{Reader, Result};

/// The keys of a serial line.
pub(super) const LINE_KEYS: [&str; 5] = ["baud", "parity", "stop_bits", "idle_gap_ms", "turnaround_us"];

/// The settings of a serial line, within their ranges.
pub(super) fn read_line(port: &Reader<'_>) -> Result<Rs485> {
    read_times(port, read_characters(port)?)
}

/// The same of a line of Modbus RTU, which has the standard's silences by default.
pub(super) fn read_rtu_line(port: &Reader<'_>, is_master: bool) -> Result<Rs485> {
    let line = read_characters(port)?;
    read_times(port, if is_master { line.with_rtu_turnaround() } else { line.with_rtu_silence() })
}

fn read_characters(port: &Reader<'_>) -> Result<Rs485> {
    let mut line = Rs485::default();
    if let Some(item) = port.optional("baud") {
        line.baud = item.integer(1_200..=4_000_000)?;
    }
    if let Some(item) = port.optional("parity") {
        line.parity = item.choice(&[("none", Parity::None), ("even", Parity::Even), ("odd", Parity::Odd)])?;
    }
    if let Some(item) = port.optional("stop_bits") {
        line.stop_bits = item.integer(1..=2)?;
    }
    Ok(line)
}

fn read_times(port: &Reader<'_>, mut line: Rs485) -> Result<Rs485> {
    if let Some(item) = port.optional("idle_gap_ms") {
        line.idle_gap = item.time(1e3)?;
    }
    if let Some(item) = port.optional("turnaround_us") {
        line.turnaround = item.time(1.0)?;
    }
    line.check().map_err(|(key, kind)| refused(port, key, kind))?;
    Ok(line)
}

pub(super) fn read_bitrate(port: &Reader<'_>) -> Result<u32> {
    let bitrate =
        port.optional("bitrate").map_or(Ok(Bus::BITRATE), |item| item.integer(0..=i64::from(u32::MAX)))?;
    check_bitrate(bitrate).map_err(|kind| refused(port, PortKey::Bitrate, kind))?;
    Ok(bitrate)
}

pub(super) fn read_cycle(port: &Reader<'_>) -> Result<Duration> {
    let cycle = port.optional("cycle_ms").map_or(Ok(Duration::from_millis(4)), |item| item.time(1e3))?;
    check_cycle(cycle).map_err(|kind| refused(port, PortKey::Cycle, kind))?;
    Ok(cycle)
}

/// The file's key for a key of the configuration.
pub(super) fn key_name(key: PortKey) -> &'static str {
    match key {
        PortKey::Recipe => "recipe",
        PortKey::Cycle => "cycle_ms",
        PortKey::Timeout => "timeout_ms",
        PortKey::OnTimeout => "on_timeout",
        PortKey::StaleAfter => "stale_after_ms",
        PortKey::Health => "health",
        PortKey::SafeAtStart => "safe_at_start",
        PortKey::Refresh => "refresh_ms",
        PortKey::Baud => "baud",
        PortKey::StopBits => "stop_bits",
        PortKey::IdleGap => "idle_gap_ms",
        PortKey::Turnaround => "turnaround_us",
        PortKey::Echo => "echo",
        PortKey::Bitrate => "bitrate",
        PortKey::Listen => "listen",
        // A mistake without a key of its own concerns the port as a whole.
        _ => "name",
    }
}

fn refused(port: &Reader<'_>, key: PortKey, kind: ConfigErrorKind) -> super::FileError {
    match port.optional(key_name(key)) {
        Some(item) => item.error(kind),
        None => port.error(kind),
    }
}
