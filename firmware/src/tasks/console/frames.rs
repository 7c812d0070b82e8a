//! Frames on field ports as events of a stream.

use core::fmt::{self, Write};

use proto_core::engine::{PortId, TapDirection, TapPlace, TapRecord, TapVerdict};
use proto_core::wire::can::CanId;
use recipe_api::json;
use recipe_api::key::Hex;

use super::Console;
use super::answer::TextBuffer;

/// The only reader of the frame tap; released on drop.
pub(super) struct Follower<'c> {
    console: &'c Console,
    /// Restricts the frames to this port; `Some(None)`: there is no such port, and so no frames.
    port: Option<Option<PortId>>,
    /// Records dropped because the queue was full, not yet reported.
    lost: u32,
}

impl Console {
    /// Starts reading the tap. Returns `None` if it has a reader already: its ring buffer serves only one.
    pub(super) fn follow(&self, port: Option<Option<PortId>>) -> Option<Follower<'_>> {
        if self.is_followed.replace(true) {
            return None;
        }
        self.gateway.tap(|tap| tap.listen(true));
        Some(Follower { console: self, port, lost: 0 })
    }
}

impl Drop for Follower<'_> {
    fn drop(&mut self) {
        self.console.is_followed.set(false);
        self.console.gateway.tap(|tap| tap.listen(false));
    }
}

impl Follower<'_> {
    /// Writes an event with as many frames as fit; nothing if there are none.
    pub(super) fn write(&mut self, out: &mut TextBuffer<'_>) -> fmt::Result {
        let mut count = 0_usize;
        while out.left() > LONGEST {
            let mut bytes = [0; MOST_BYTES];
            let buf = &mut bytes;
            let Some(record) = self.console.gateway.tap(move |tap| tap.next(buf)) else { break };
            self.lost = self.lost.saturating_add(record.lost);
            let TapPlace::Port(id) = record.place else { continue };
            self.console.gateway.report(|status| {
                let Some(port) = status.ports().find(|port| port.id == id) else { return Ok(()) };
                if self.port.is_some_and(|only| only != Some(id)) {
                    return Ok(());
                }
                out.write_str(if count == 0 { "event: frames\ndata: {\"frames\":[" } else { "," })?;
                count = count.saturating_add(1);
                write(out, &record, port.name)
            })?;
        }
        if count > 0 {
            write!(out, "],\"lost\":{}}}\n\n", core::mem::take(&mut self.lost))?;
        }
        Ok(())
    }
}

/// Writes a frame with the same keys as the host's events, except decoded values.
fn write(out: &mut TextBuffer<'_>, record: &TapRecord<'_>, port: &str) -> fmt::Result {
    write!(out, "{{\"time_us\":{},\"port\":", record.at.as_micros())?;
    json::write_text(out, port)?;
    let direction = match record.direction {
        TapDirection::In => "in",
        TapDirection::Out => "out",
    };
    write!(out, ",\"direction\":\"{direction}\",\"verdict\":")?;
    match record.verdict {
        TapVerdict::Rejected(why) => {
            json::write(out, &why).map_err(|_| fmt::Error)?;
            write!(out, ",\"text\":\"{}\"", why.text())?;
        }
        _ => out.write_str("\"frame\"")?,
    }
    match record.can_id {
        Some(CanId::Standard(id)) => write!(out, ",\"id\":{id}")?,
        Some(CanId::Extended(id)) => write!(out, ",\"id\":{id},\"extended\":true")?,
        None => {}
    }
    if record.len > record.bytes.len() {
        write!(out, ",\"len\":{}", record.len)?;
    }
    write!(out, ",\"bytes\":\"{}\"}}", Hex(record.bytes))
}

/// Maximum number of bytes shown of a frame.
const MOST_BYTES: usize = 256;
/// Maximum length of a record: its bytes, a name with every character escaped, and the keys.
const LONGEST: usize = 2 * MOST_BYTES + 6 * 32 + 260;
