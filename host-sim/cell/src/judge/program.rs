//! The robot's program: sets bits that request events, and changes values.

use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::rules::{MOVE_BIT, Rules, STOP_BIT};
use crate::{Cell, Rng};
use recipe_config::InitialTarget;

/// Sets the robot's registers.
#[derive(Debug)]
pub(crate) struct Program {
    rng: Rng,
    words: Vec<SysVar>,
    keeps: Option<SysVar>,
    limits: Vec<(SysVar, u16)>,
    /// When each bit falls again.
    falls: [Option<Instant>; 2],
    next: Instant,
    next_kept: Instant,
}

impl Program {
    pub(super) fn new(rules: &Rules, now: Instant, rng: Rng) -> Self {
        let words = rules.sources().filter(|var| Some(*var) != rules.keeps).collect();
        let limits = rules.limits.clone();
        Self { rng, words, keeps: rules.keeps, limits, falls: [None; 2], next: now, next_kept: now }
    }

    pub(crate) fn next(&self) -> Instant {
        self.falls.into_iter().flatten().fold(self.next, Instant::min)
    }

    pub(crate) fn poll(&mut self, cell: &mut Cell) {
        let now = cell.now();
        for (nth, bit) in [MOVE_BIT, STOP_BIT].into_iter().enumerate() {
            if self.falls[nth].is_some_and(|at| at <= now) {
                self.falls[nth] = None;
                set_bit(cell, bit, false);
            }
        }
        if now < self.next {
            return;
        }
        self.next = now + Duration::from_micros(1_000) + self.rng.up_to(Duration::from_millis(700));
        if now >= self.next_kept
            && let Some(var) = self.keeps
        {
            // Usually short pauses; sometimes pauses long enough for everything to come to rest.
            let most = [2_000, 40_000][self.rng.below(2) as usize];
            self.next_kept = now + self.rng.up_to(Duration::from_millis(most));
            let value = self.rng.between(1, 60_000);
            set(cell, var, value as u16);
        }
        match self.rng.below(16) {
            // A pulse with new values, which may also change during the pulse.
            0..7 => {
                for nth in 0..self.words.len() {
                    self.change(cell, nth);
                }
                self.pulse(cell, 0, 400);
            }
            // A short pulse, so another may come before the first event is done.
            7 | 8 => {
                self.pulse(cell, 0, 60);
                self.next = now + Duration::from_millis(70) + self.rng.up_to(Duration::from_millis(60));
            }
            9 => self.pulse(cell, 1, 500),
            // Both bits at the same time.
            10 if self.rng.below(3) == 0 => {
                self.pulse(cell, 0, 300);
                self.pulse(cell, 1, 300);
            }
            _ => {
                let nth = self.rng.below(self.words.len() as u64) as usize;
                self.change(cell, nth);
            }
        }
    }

    fn change(&mut self, cell: &mut Cell, nth: usize) {
        let var = self.words[nth];
        let most = self.limits.iter().find(|(limited, _)| *limited == var).map(|(_, most)| u64::from(*most));
        let value = match most {
            Some(most) if self.rng.below(8) == 0 && most < 65_000 => self.rng.between(most + 1, 65_535),
            Some(most) => self.rng.between(1, most),
            None => self.rng.between(1, 65_535),
        };
        set(cell, var, value as u16);
    }

    fn pulse(&mut self, cell: &mut Cell, nth: usize, most: u64) {
        let bit = [MOVE_BIT, STOP_BIT][nth];
        set_bit(cell, bit, true);
        let lasts = Duration::from_millis(20) + self.rng.up_to(Duration::from_millis(most));
        self.falls[nth] = Some(cell.now() + lasts);
    }
}

fn set(cell: &mut Cell, var: SysVar, value: u16) {
    // Cannot fail: a word can have any value.
    let _ = cell.controller_mut().force(InitialTarget::Var(var), f64::from(value));
}

fn set_bit(cell: &mut Cell, bit: u8, on: bool) {
    let (var, ..) = super::bits();
    let before = cell.controller().registers().var(var).as_f64() as u8;
    let after = if on { before | 1 << bit } else { before & !(1 << bit) };
    let _ = cell.controller_mut().force(InitialTarget::Var(var), f64::from(after));
}
