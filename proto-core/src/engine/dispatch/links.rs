//! Link inputs. Those of connections to devices are passed on (`device_links.rs`).
//!
//! In: a link came up or went down, received bytes, or its transport took some. Out: values in the store, results of
//! commands, and which ports and links may now have an output. Does not know what travels on a link.

use super::EngineView;
use crate::engine::clock::Dirty;
use crate::engine::io::LinkId;
use crate::time::Instant;

impl EngineView<'_> {
    pub(crate) fn link_up(&mut self, link: LinkId) {
        if self.device_link(link).is_some() {
            return self.device_up(link);
        }
        self.links.up(link, self.store);
        self.arm_link(link);
    }

    pub(crate) fn link_down(&mut self, link: LinkId) {
        if self.device_link(link).is_some() {
            return self.device_down(link);
        }
        self.links.down(link, self.store);
        self.carry_results();
        self.arm_link(link);
    }

    pub(crate) fn link_sent(&mut self, link: LinkId) {
        if self.device_link(link).is_some() {
            return self.device_sent(link);
        }
        let deadline = self.links.sent(link);
        self.clock.dirty.add(self.links.ask_of(link));
        self.arm(deadline);
    }

    pub(crate) fn link_acked(&mut self, link: LinkId, left: u32) {
        if self.device_link(link).is_some() {
            return self.device_acked(link, left);
        }
        self.links.acked(link, left, self.store);
        self.clock.dirty.add(self.links.ask_of(link));
        self.arm(self.links.view().deadline_of(link));
    }

    pub(crate) fn link_bytes(&mut self, link: LinkId, bytes: &[u8], now: Instant) {
        if self.device_link(link).is_some() {
            return self.device_bytes(link, bytes, now);
        }
        let is_up = self.links.heard(link, bytes.len(), now);
        let mut rest = if is_up { bytes } else { &[] };
        loop {
            if is_up {
                let before = rest;
                rest = self.links.received(link, rest, self.store);
                let taken = before.get(..before.len().saturating_sub(rest.len())).unwrap_or(&[]);
                self.tap.came(link, taken, now);
            }
            self.carry_results();
            let dirty = self.store.outbox.dirty();
            let (asked, deadline) = self.links.asked_by_bytes(link, &dirty, now);
            self.clock.dirty.add(self.links.ask_for(&dirty, asked));
            self.arm(deadline);
            self.image_changed();
            if rest.is_empty() {
                return;
            }
        }
    }

    /// After an event that may change a link's deadline, or close it.
    fn arm_link(&mut self, link: LinkId) {
        self.clock.dirty.add(Dirty::LINKS);
        self.clock.dirty.add(Dirty::ACTIONS);
        self.arm(self.links.view().deadline_of(link));
    }
}
