//! What must arrive at the controller once a path to it works: urgent commands and safe values.

use std::collections::BTreeMap;

use proto_core::engine::LinkId;
use proto_core::time::{Duration, Instant};

use super::{Path, Robot, StopRequest};
use crate::oracle::field::show;
use crate::oracle::frame::Raw;
use crate::oracle::invariant::Wrong;
use crate::oracle::spec::Spec;
use crate::oracle::upward::Upward;
use crate::oracle::{Invariant, Oracle};

impl Robot {
    /// Since when all paths that carry values have worked; `None` if one does not.
    fn all_sound(&self, paths: &[Path]) -> Option<Instant> {
        let needed = paths.iter().filter(|path| path.link != LinkId::COMMAND && path.link != LinkId::URGENT);
        let mut since = Instant::ZERO;
        for path in needed {
            since = since.max(*self.sound.get(&path.link)?).max(*self.served.get(&path.link)?);
        }
        Some(since)
    }

    /// Checks urgent commands that have had a working path for long enough; returns their number.
    fn urgent(&self, now: Instant) -> Result<u64, Wrong> {
        let ways = [LinkId::COMMAND, LinkId::URGENT];
        let Some(could) = ways.iter().filter_map(|link| self.sound.get(link)).min() else { return Ok(0) };
        let mut checked = 0;
        for StopRequest { command, has_arrived, not_before } in &self.stop_requests {
            checked += 1;
            let had_a_way = now.saturating_since(command.picked.max(*could).max(*not_before));
            if !has_arrived && had_a_way > STOP_ARRIVES {
                let what = format!(
                    "{} is asked for and has not arrived, although a way has worked for {had_a_way}",
                    command.text
                );
                return Err((Invariant::StopArrives, what));
            }
        }
        Ok(checked)
    }

    /// Checks safe values of overdue owners, if everything has worked for long enough; returns their number.
    fn safe_values(&self, spec: &Spec, up: &Upward, all: Instant, now: Instant) -> Result<u64, Wrong> {
        let mut checked = 0;
        for &var in &spec.safe_vars {
            let Some(owned) = spec.owned[var.ordinal()] else { continue };
            let known = up.known(var);
            let (Some(safe), Some(_), Some(heard)) = (owned.safe, known.accepted, known.heard) else {
                continue;
            };
            let silent = heard + spec.ports[owned.port].timeout;
            let mut could = silent.max(all);
            if spec.link(owned.way).is_some() {
                let Some(ready) = self.ready.get(&owned.way) else { continue };
                could = could.max(*ready);
            }
            let at = var.image_offset();
            let places = at..at + var.size();
            let is_foreign = self.foreign_writes.range(places.clone()).any(|(_, when)| *when > silent);
            if now.saturating_since(could) <= SAFE_ARRIVES || now < could || is_foreign {
                continue;
            }
            checked += 1;
            let Some(there) = self.inputs.get(places) else { continue };
            if there != &safe[..var.size()] {
                let mut raw = Raw::default();
                raw[..there.len()].copy_from_slice(there);
                let what = format!(
                    "{var} is {} at the controller; its owner has been silent for {} and its safe value is {}",
                    show(var, raw),
                    now.saturating_since(heard),
                    show(var, safe)
                );
                return Err((Invariant::SafeArrives, what));
            }
        }
        for (share, state) in spec.shares.iter().zip(&up.shares) {
            let (Some(safe), Some(accepted)) = (share.safe, state.accepted) else { continue };
            let silent = accepted + spec.ports[share.port].timeout;
            let could = silent.max(all);
            let at = share.var.image_offset();
            let is_foreign = self.foreign_writes.get(&at).is_some_and(|when| *when > silent);
            if now.saturating_since(could) <= SAFE_ARRIVES || now < could || is_foreign {
                continue;
            }
            checked += 1;
            let there = self.inputs.get(at).map(|byte| byte & share.mask);
            if there.is_some_and(|there| there != safe) {
                let what = format!(
                    "bits {:#010b} of {} are not their safe values {safe:#010b} at the controller; their owner has \
                     been silent for {}",
                    share.mask,
                    share.var,
                    now.saturating_since(accepted)
                );
                return Err((Invariant::SafeArrives, what));
            }
        }
        Ok(checked)
    }
}

impl Oracle {
    /// Checks what must have arrived, given the present state of paths and inputs. Called at intervals.
    pub(crate) fn survey(&mut self, paths: &[Path], inputs: &[u8], now: Instant) {
        if self.violation.is_some() {
            return;
        }
        self.truth.forget_old(now);
        self.remembered = self.controller.size() + self.commands.len() + self.robot.len() + self.truth.len();
        for path in paths {
            if self.robot.conns.insert(path.link, path.conn) != Some(path.conn) {
                self.robot.sound.remove(&path.link);
                self.robot.served.remove(&path.link);
            }
            note(&mut self.robot.sound, path.link, path.is_sound, now);
            note(&mut self.robot.served, path.link, path.is_sound && path.is_served, now);
        }
        for link in &self.spec.links {
            let is_ready = self.up.is_up(link.id) && self.up.is_ready(link, now);
            note(&mut self.robot.ready, link.id, is_ready, now);
        }
        self.robot.find_foreign_writes(inputs, now);
        let result = self.robot.urgent(now);
        self.checks[Invariant::StopArrives as usize] += *result.as_ref().unwrap_or(&1);
        self.judge(now, &[], result.map(drop));
        self.robot.all_sound_since = self.robot.all_sound(paths);
        if let Some(all) = self.robot.all_sound_since {
            let result = self.robot.safe_values(&self.spec, &self.up, all, now);
            self.checks[Invariant::SafeArrives as usize] += *result.as_ref().unwrap_or(&1);
            self.judge(now, &[], result.map(drop));
        }
        self.survey_exchanges(now);
    }
}

/// Records since when a condition has held.
fn note(since: &mut BTreeMap<LinkId, Instant>, link: LinkId, is_so: bool, now: Instant) {
    if is_so {
        since.entry(link).or_insert(now);
    } else {
        since.remove(&link);
    }
}

/// An urgent command arrives within this time once it is requested and a path works.
const STOP_ARRIVES: Duration = Duration::from_millis(1_500);
/// A safe value arrives within this time once its owner is overdue and all paths work.
pub(super) const SAFE_ARRIVES: Duration = Duration::from_millis(1_500);
