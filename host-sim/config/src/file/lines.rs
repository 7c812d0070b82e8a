//! The keys that ports have in both kinds of files.

use proto_core::config::{ConfigErrorKind, PortKey, Rs485, check_bitrate, check_cycle};
use proto_core::time::Duration;

use super::reader::{Result, TableReader};
use crate::keys::gateway::{BAUD, BITRATE, CYCLE, IDLE_GAP, PARITIES, PARITY, STOP_BITS, TURNAROUND};

/// The settings of a serial line, within their ranges.
pub(super) fn read_line(port: &TableReader<'_>) -> Result<Rs485> {
    let mut line = read_characters(port)?;
    (line.idle_gap, line.turnaround) = (port.time_or(&IDLE_GAP)?, port.time_or(&TURNAROUND)?);
    read_times(port, line)
}

/// The same of a line of Modbus RTU, which has the standard's silences by default.
pub(super) fn read_rtu_line(port: &TableReader<'_>, is_master: bool) -> Result<Rs485> {
    let line = read_characters(port)?;
    read_times(port, if is_master { line.with_rtu_turnaround() } else { line.with_rtu_silence() })
}

fn read_characters(port: &TableReader<'_>) -> Result<Rs485> {
    Ok(Rs485 {
        baud: port.integer_or(&BAUD)?,
        parity: port.word_or(&PARITY, &PARITIES)?,
        stop_bits: port.integer_or(&STOP_BITS)?,
        ..Rs485::default()
    })
}

fn read_times(port: &TableReader<'_>, mut line: Rs485) -> Result<Rs485> {
    line.idle_gap = port.time(&IDLE_GAP)?.unwrap_or(line.idle_gap);
    line.turnaround = port.time(&TURNAROUND)?.unwrap_or(line.turnaround);
    line.check().map_err(|(key, kind)| refused(port, key, kind))?;
    Ok(line)
}

pub(super) fn read_bitrate(port: &TableReader<'_>) -> Result<u32> {
    let bitrate = port.integer_or(&BITRATE)?;
    check_bitrate(bitrate).map_err(|kind| refused(port, PortKey::Bitrate, kind))?;
    Ok(bitrate)
}

pub(super) fn read_cycle(port: &TableReader<'_>) -> Result<Duration> {
    let cycle = port.time_or(&CYCLE)?;
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
        PortKey::To => "to",
        // A mistake without a key of its own concerns the port as a whole.
        _ => "name",
    }
}

fn refused(port: &TableReader<'_>, key: PortKey, kind: ConfigErrorKind) -> super::FileError {
    match port.optional(key_name(key)) {
        Some(item) => item.error(kind),
        None => port.error(kind),
    }
}
