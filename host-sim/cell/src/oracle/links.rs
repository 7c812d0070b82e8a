//! The gateway's links: the expected result of what they receive, and checks of what they send.

use std::rc::Rc;

use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::field::{Coils, Cut};
use super::frame::{Frame, Raw};
use super::invariant::Wrong;
use super::spec::{Origin, Owned};
use super::upward::is_gap;
use super::wire::{Asked, Safe};
use super::{Invariant, Oracle, place};

impl Oracle {
    pub(super) fn link_bytes(&mut self, link: LinkId, bytes: &[u8], now: Instant) {
        self.traffic[place(link)].1 += 1;
        match link {
            LinkId::MODBUS => {
                let Self { modbus, map, spec, up, .. } = self;
                let refused = modbus.received(map, bytes, |var, raw| {
                    if spec.origin[var.ordinal()] == Some(Origin::Modbus) {
                        up.received(var, raw, now);
                    }
                });
                self.up.revoke_by_witnesses(&self.spec, now);
                if !refused.is_empty() {
                    self.refused.extend(refused);
                    self.rewrite_at = self.rewrite_at.min(now + REFUSED_PAUSE);
                }
                self.values_changed(now);
            }
            LinkId::STATE => {
                let mut held = std::mem::take(&mut self.links[place(link)].line.held);
                held.extend_from_slice(bytes);
                let packets = held.chunks_exact(PACKET);
                let left = packets.remainder().len();
                for packet in packets {
                    if self.links[place(link)].stream.takes(packet) {
                        self.up.state_packet(&self.spec, packet, now);
                        self.values_changed(now);
                    }
                }
                held.drain(..held.len() - left);
                self.links[place(link)].line.held = held;
            }
            LinkId::COMMAND | LinkId::URGENT => self.commands.hears(link, bytes),
            _ => self.recipe_bytes(link, bytes, now),
        }
    }

    pub(super) fn recipe_bytes(&mut self, link: LinkId, bytes: &[u8], now: Instant) {
        let all = Rc::clone(&self.spec);
        let Some(spec) = all.link(link) else { return };
        let Some(frame) = &spec.output else { return };
        if spec.is_datagram {
            if let Some(payload) = frame.payload_of(bytes) {
                self.frame_came(link, now);
                self.recipe_frame(frame, payload, now);
            }
            return;
        }
        let mut held = std::mem::take(&mut self.links[place(link)].line.held);
        held.extend_from_slice(bytes);
        let (mut cut, mut is_first) = (Cut::default(), true);
        while let Some(payload) = cut.next(frame, &held) {
            if std::mem::take(&mut is_first) {
                self.frame_came(link, now);
            }
            self.recipe_frame(frame, payload, now);
        }
        let line = &mut self.links[place(link)].line;
        line.held = held;
        line.remove(&cut);
    }

    /// One or more frames arrived on a recipe link.
    fn frame_came(&mut self, link: LinkId, now: Instant) {
        let before = self.up.frame_at[place(link)].replace(now);
        self.up.heard(now);
        if before.is_some() && is_gap(before, now) {
            self.up.controller_was_away(&self.spec, now);
        }
    }

    fn recipe_frame(&mut self, frame: &Frame, payload: &[u8], now: Instant) {
        let mut rest = payload;
        for &var in &frame.shown {
            let (bytes, after) = rest.split_at(var.size());
            rest = after;
            let mut raw = Raw::default();
            raw[..bytes.len()].copy_from_slice(bytes);
            if var.is_bits() {
                raw[0] &= var.valid_bits();
            }
            self.up.received(var, raw, now);
        }
        self.up.revoke_by_witnesses(&self.spec, now);
        self.values_changed(now);
    }

    pub(super) fn link_send(&mut self, link: LinkId, bytes: &[u8], now: Instant) -> Result<(), Wrong> {
        if !self.up.is_up(link) {
            return Err((Invariant::Line, "sent on a link that is not up".to_owned()));
        }
        match link {
            LinkId::COMMAND | LinkId::URGENT => {
                self.checks[Invariant::Once as usize] += 1;
                let command = self.commands.sent(link, bytes, now)?;
                self.robot.hands_over_command(command);
                Ok(())
            }
            LinkId::STATE => Err((Invariant::Ownership, "sent on the state link".to_owned())),
            LinkId::MODBUS => {
                if std::mem::replace(&mut self.links[place(link)].busy, true) {
                    return Err((
                        Invariant::Line,
                        "sent before the transport had taken the previous request".to_owned(),
                    ));
                }
                let asked = self.modbus.sent(&self.map, bytes, now)?;
                let mut safe = Safe::default();
                match asked {
                    Asked::Read { .. } => return Ok(()),
                    Asked::Write(values) => {
                        self.spec.has_whole_texts(&values)?;
                        for (var, raw) in values {
                            if self.up.known(var).safe {
                                safe.vars.push(var);
                            }
                            self.wrote(link, var, raw, now)?;
                        }
                    }
                    Asked::WriteBits(coils) => safe.bits = self.wrote_bits(coils, now)?,
                }
                self.modbus.carries_safe(safe);
                Ok(())
            }
            _ => self.recipe_send(link, bytes, now),
        }
    }

    pub(super) fn wrote(&mut self, link: LinkId, var: SysVar, raw: Raw, now: Instant) -> Result<(), Wrong> {
        self.looks_at_write();
        self.checks[Invariant::Edges as usize] += u64::from(var.is_bits());
        let carried = self.up.wrote(&self.spec, link, var, raw, now)?;
        self.robot.note_sent(var, raw, carried);
        Ok(())
    }

    fn wrote_bits(&mut self, coils: Coils, now: Instant) -> Result<Vec<(usize, u8)>, Wrong> {
        self.looks_at_write();
        self.checks[Invariant::Edges as usize] += 1;
        let (carried, safe) = self.up.wrote_bits(&self.spec, coils, now)?;
        for carried in carried {
            self.robot.note_sent(coils.var, [coils.on, 0, 0, 0], carried);
        }
        Ok(safe)
    }

    fn looks_at_write(&mut self) {
        self.writes += 1;
        let looked_at = [
            Invariant::Sent,
            Invariant::InTime,
            Invariant::FirstFrame,
            Invariant::Ownership,
            Invariant::NoReplay,
        ];
        for invariant in looked_at {
            self.checks[invariant as usize] += 1;
        }
    }

    pub(super) fn recipe_send(&mut self, link: LinkId, bytes: &[u8], now: Instant) -> Result<(), Wrong> {
        if std::mem::replace(&mut self.links[place(link)].busy, true) {
            return Err((
                Invariant::Line,
                "sent before the transport had taken the previous frame".to_owned(),
            ));
        }
        let all = Rc::clone(&self.spec);
        let found = all.link(link).and_then(|spec| {
            let frame = spec.input.as_ref()?;
            Some((spec, frame, frame.payload_of(bytes)?))
        });
        let Some((link_spec, frame, payload)) = found else {
            // The first datagram to the UDP server, which only announces the client.
            let is_greeting = link == LinkId::RECIPE_UDP && bytes.len() <= 2 && bytes.iter().all(|&b| b == 0);
            let wrong = (Invariant::Sent, "sent data that is neither a frame nor a greeting".to_owned());
            return if is_greeting { Ok(()) } else { Err(wrong) };
        };
        let mut rest = payload;
        let mut wanted = false;
        for &var in &frame.written {
            let (bytes, after) = rest.split_at(var.size());
            rest = after;
            let mut raw = Raw::default();
            raw[..bytes.len()].copy_from_slice(bytes);
            let is_ours = self.spec.owned[var.ordinal()].is_some_and(|owned| owned.way == link);
            if is_ours && !self.up.known(var).waiting.is_empty() {
                wanted = true;
                self.wrote(link, var, raw, now)?;
            } else {
                self.writes += 1;
                self.checks[Invariant::Sent as usize] += 1;
                self.checks[Invariant::InTime as usize] += 1;
                let carried = self.up.carried(&self.spec, link_spec, (var, raw), now)?;
                wanted |= is_ours && self.up.known(var).safe;
                self.robot.note_sent(var, raw, carried);
            }
        }
        if !wanted {
            return Err((Invariant::Sent, "a frame although no value waited".to_owned()));
        }
        self.up.handed_over[place(link)] = Some((now, self.up.era));
        self.up.sent_frame(&self.spec, link, now);
        Ok(())
    }

    /// Checks that no value that could be sent still waits.
    pub(super) fn nothing_waits(&mut self, now: Instant) -> Result<(), Wrong> {
        let mut left = self.up.waits;
        while left != 0 {
            let nth = left.trailing_zeros() as usize;
            left &= left - 1;
            let Some(Owned { way, .. }) = self.spec.owned[nth] else { continue };
            if self.up.known[nth].waiting.is_empty() {
                self.up.waits &= !(1 << nth);
                continue;
            }
            if !self.up.is_up(way) {
                continue;
            }
            let is_free = match self.spec.link(way) {
                None => self.modbus.is_free() && !self.links[place(way)].busy,
                Some(link) => self.links[place(way)].has_room() && self.up.is_ready(link, now),
            };
            if is_free {
                let var = SysVar::from_ordinal(nth).map_or_else(String::new, |var| var.to_string());
                return Err((Invariant::Delivered, format!("{var} waits although its link is free")));
            }
        }
        let is_free =
            self.up.is_up(LinkId::MODBUS) && self.modbus.is_free() && !self.links[place(LinkId::MODBUS)].busy;
        if let Some(var) = self.up.waiting_bits(&self.spec).filter(|_| is_free) {
            return Err((Invariant::Delivered, format!("bits of {var} wait although Modbus is free")));
        }
        Ok(())
    }
}

const PACKET: usize = 1_468;
/// A safe value that the controller refused is repeated after this time.
const REFUSED_PAUSE: Duration = Duration::from_millis(500);
