//! Frames that end with a tail, or with silence: how received bytes are cut into frames (docs/configuration.md section
//! 4, "Frames of varying length").
//!
//! Written from that page, independent of the engine's cutters.

use proto_core::device::Boundary;

use super::{LineWatch, Verdict};
use crate::oracle::device::Seen;
use crate::oracle::spec::PortSpec;
use crate::oracle::varying::{Unlike, see};

/// The bytes between two ends of frames.
pub(in crate::oracle) enum Piece {
    Whole(Vec<u8>),
    TooLong,
    /// The beginning of the frame is missing.
    Cut,
}

/// Frames that end with a tail, or with silence.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::oracle) struct CutWatch {
    /// Bytes before the held ones are missing.
    is_cut: bool,
    /// The newest eight bytes, because the beginning of a tail may have been discarded.
    before: [u8; 8],
    before_len: usize,
}

impl LineWatch {
    /// Handles received bytes of a line whose frames are cut; `late`: there may have been silence before them. Returns
    /// the frames that have ended.
    pub(in crate::oracle) fn cut_bytes(
        &mut self,
        cut: Boundary,
        tail: &[u8],
        bytes: &[u8],
        late: bool,
    ) -> Vec<Piece> {
        let mut pieces = Vec::new();
        if cut == Boundary::Silence && late && (!self.held.is_empty() || self.cut.is_cut) {
            self.cut_off();
        }
        for &byte in bytes {
            self.held.push(byte);
            if cut == Boundary::Tail && self.ends_with(tail) {
                pieces.push(self.cut_piece());
            }
        }
        pieces
    }

    fn ends_with(&self, tail: &[u8]) -> bool {
        let before = &self.cut.before[..self.cut.before_len];
        [before, &self.held[..]].concat().ends_with(tail)
    }

    /// Whether silence would end a frame.
    pub(in crate::oracle) fn cut_has_begun(&self, cut: Boundary) -> bool {
        !self.held.is_empty() || cut == Boundary::Silence && self.cut.is_cut
    }

    /// The held bytes have ended.
    pub(in crate::oracle) fn cut_piece(&mut self) -> Piece {
        let was_cut = std::mem::take(&mut self.cut).is_cut;
        let bytes = std::mem::take(&mut self.held);
        if was_cut {
            self.discarded += bytes.len().min(LONGEST) as u64;
            self.frame_bytes += bytes.len().saturating_sub(LONGEST) as u64;
            return Piece::Cut;
        }
        self.frame_bytes += bytes.len() as u64;
        if bytes.len() > LONGEST { Piece::TooLong } else { Piece::Whole(bytes) }
    }

    /// There was silence, or bytes are missing: everything up to the next end is dropped, including the held bytes.
    pub(in crate::oracle) fn cut_off(&mut self) {
        let newest = self.held.iter().rev().take(8).rev().copied();
        let before = self.cut.before[..self.cut.before_len].iter().copied();
        let newest: Vec<u8> = before.chain(newest).collect();
        let newest = &newest[newest.len().saturating_sub(8)..];
        let was_cut = self.cut.is_cut || !self.held.is_empty();
        self.cut = CutWatch { is_cut: was_cut, before: [0; 8], before_len: newest.len() };
        self.cut.before[..newest.len()].copy_from_slice(newest);
        self.discarded += self.held.len().min(LONGEST) as u64;
        self.frame_bytes += self.held.len().saturating_sub(LONGEST) as u64;
        self.held.clear();
    }
}

impl LineWatch {
    /// These bytes are lost, so the frame that they began cannot be trusted.
    pub(in crate::oracle) fn lose(&mut self, port: &PortSpec, bytes: &[u8]) {
        let Some(frame) = port.inputs.first().filter(|_| port.framing != Boundary::Fields) else { return };
        let counted = (self.discarded, self.frame_bytes);
        self.cut_bytes(port.framing, &frame.tail, bytes, false);
        self.cut_off();
        (self.discarded, self.frame_bytes) = counted;
    }

    /// The bytes between two ends are accepted or rejected as one frame.
    pub(in crate::oracle) fn judge_piece(&mut self, port: &PortSpec, piece: &Piece) -> Option<Verdict> {
        let whole = match piece {
            Piece::Whole(whole) => whole,
            Piece::TooLong => return Some(Verdict::WrongLength),
            Piece::Cut => return None,
        };
        let frame = port.inputs.first()?;
        Some(match see(frame, whole) {
            Ok((_, Seen::Ours)) => self.judge(frame, 0, whole),
            Ok((_, Seen::Other | Seen::Nothing)) | Err(Unlike::Content) => Verdict::OtherDevice,
            Ok((_, Seen::WrongChecksum)) => Verdict::WrongChecksum,
            Err(Unlike::Length) => Verdict::WrongLength,
        })
    }
}

/// The longest frame in bytes.
const LONGEST: usize = 512;
