//! The document `update`: running and incoming firmware, and a trial (docs/api.md section 9).

use core::fmt::{self, Write};

use embassy_time::Instant;
use recipe_api::json;
use recipe_api::key::Hex;
use recipe_api::response::{ContentType, StatusCode};
use recipe_store::TrialEnd;
use recipe_update::{Header, Slot};

use super::Console;
use super::answer::{Reply, TextBuffer, busy, nothing_kept};
use crate::tasks::store::{FirmwareView, StoreHandle};
use crate::update::{Incoming, UpdateStage, build_of, whole_length};

impl Console {
    /// Reply with the document and this status.
    #[inline(never)]
    pub(super) fn firmware(&self, buf: &mut [u8], status: StatusCode) -> Reply {
        if self.store.is_none() {
            return nothing_kept(buf);
        }
        match self.store.and_then(StoreHandle::firmware) {
            Some(view) => Reply::new(buf, status, ContentType::Json, |out| write(out, &view)),
            // The store is being read or moved.
            None => busy(buf),
        }
    }
}

fn write(out: &mut TextBuffer<'_>, view: &FirmwareView) -> fmt::Result {
    write!(out, "{{\"board\":\"{}\",\"version\":\"{}\"", view.board, env!("CARGO_PKG_VERSION"))?;
    if let Some(build) = &view.build {
        write!(out, ",\"sha512\":\"{}\"", Hex(build))?;
    }
    if let Some(slot) = view.slot {
        write!(out, ",\"slot\":\"{}\"", letter(slot))?;
    }
    if let Some(good) = view.marks.good {
        write!(out, ",\"good\":\"{}\"", letter(good))?;
    }
    if let Some(key) = &view.key {
        write!(out, ",\"key\":\"{}\"", Hex(key))?;
    }
    if let Some(why) = view.cannot {
        out.write_str(",\"cannot\":")?;
        json::write_text(out, why)?;
    }
    if let Some((until, waits_for)) = view.trial {
        let left = until.saturating_duration_since(Instant::now()).as_millis();
        let name = waits_for.name();
        write!(
            out,
            ",\"trial\":{{\"left_s\":{}.{:03},\"waits_for\":\"{name}\"}}",
            left / 1_000,
            left % 1_000
        )?;
    }
    if let Some(other) = &view.other {
        out.write_str(",\"other\":{")?;
        write_header(out, other)?;
        out.write_char('}')?;
    }
    if let Some(Incoming { header, stage, received }) = &view.incoming {
        let state = match stage {
            UpdateStage::Erasing => "erasing",
            UpdateStage::Receiving => "receiving",
            UpdateStage::Checking => "checking",
            UpdateStage::Ready => "ready",
            UpdateStage::Failed(_) => "failed",
        };
        write!(out, ",\"incoming\":{{\"state\":\"{state}\",")?;
        write_header(out, header)?;
        write!(out, ",\"length\":{},\"received\":{received}", whole_length(header))?;
        if let UpdateStage::Failed(why) = stage {
            out.write_str(",\"why\":")?;
            json::write_text(out, why)?;
        }
        out.write_char('}')?;
    }
    if let Some((slot, ended)) = view.marks.last {
        let ended = match ended {
            TrialEnd::Confirmed => "confirmed",
            TrialEnd::NotConfirmed => "not_confirmed",
            TrialEnd::TakenBack => "taken_back",
            TrialEnd::Failed => "failed",
        };
        write!(out, ",\"last\":{{\"slot\":\"{}\",\"ended\":\"{ended}\"}}", letter(slot))?;
    }
    out.write_char('}')
}

fn write_header(out: &mut TextBuffer<'_>, header: &Header) -> fmt::Result {
    write!(out, "\"version\":\"{}\",\"sha512\":\"{}\"", header.version(), Hex(&build_of(header)))
}

fn letter(slot: Slot) -> char {
    match slot {
        Slot::A => 'A',
        Slot::B => 'B',
    }
}
