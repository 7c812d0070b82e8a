//! The keys that ports have in both kinds of files.

use proto_core::config::{PortKey, Rs485};

use super::reader::{Result, TableReader};
use crate::keys::gateway::{BAUD, IDLE_GAP, PARITIES, PARITY, STOP_BITS, TURNAROUND};

/// The settings of a serial line, within their ranges; `usual` sets the default silences.
pub(super) fn read_line(port: &TableReader<'_>, usual: fn(Rs485) -> Rs485) -> Result<Rs485> {
    let mut line = usual(Rs485 {
        baud: port.integer_or(&BAUD)?,
        parity: port.word_or(&PARITY, &PARITIES)?,
        stop_bits: port.integer_or(&STOP_BITS)?,
        ..Rs485::DEFAULT
    });
    line.idle_gap = port.time(&IDLE_GAP)?.unwrap_or(line.idle_gap);
    line.turnaround = port.time(&TURNAROUND)?.unwrap_or(line.turnaround);
    Ok(line)
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
        // A mistake without its own key concerns the port as a whole.
        _ => "name",
    }
}
