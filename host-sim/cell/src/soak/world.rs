//! Random events at the controller while a cell runs: inputs change, programs set registers, a person presses a button.

use proto_core::config::{FieldSpec, GatewayConfig};
use proto_core::engine::Plan;
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType;
use proto_core::wire::state::OperationMode;

use crate::{Cell, Rng};
use recipe_config::InitialTarget;

/// Changes the variables that ports send, and the state of the controller.
#[derive(Debug)]
pub(super) struct World {
    rng: Rng,
    shown: Vec<SysVar>,
    /// Variables that are the length of a text.
    lengths: Vec<SysVar>,
    next: Instant,
}

impl World {
    pub(super) fn new(config: &GatewayConfig, now: Instant, rng: Rng) -> Self {
        let plan = Plan::new(config).ok();
        let is_shown = |var: &SysVar| plan.as_ref().is_some_and(|plan| plan.source(*var).is_some());
        // The simulated motion sets the arm's position.
        let shown =
            SysVar::all().filter(|var| var.direction() == Direction::Output && var.group() != "RobotState");
        let lengths = config.fields.iter().filter_map(|field| match *field {
            FieldSpec::TextOutput { length_from, .. } => length_from,
            _ => None,
        });
        let lengths = lengths.collect();
        Self { rng, shown: shown.filter(is_shown).collect(), lengths, next: now }
    }

    pub(super) fn next(&self) -> Instant {
        self.next
    }

    pub(super) fn poll(&mut self, cell: &mut Cell) {
        let now = cell.now();
        self.next = now + Duration::from_micros(self.rng.between(1_000, 400_000));
        match self.rng.below(2_000) {
            0 => cell.controller_mut().emergency_stop(now),
            1 => cell.controller_mut().protective_stop(now),
            2..10 => cell.controller_mut().clear_stop(now),
            10 => cell.controller_mut().set_mode(OperationMode::Manual),
            11..15 => cell.controller_mut().set_mode(OperationMode::Remote),
            _ if self.shown.is_empty() => {}
            _ => {
                let var = self.shown[self.rng.below(self.shown.len() as u64) as usize];
                let before = cell.controller().registers().var(var).as_f64();
                let value = match var.ty() {
                    // Changes one bit at a time, so each bit has its own edges.
                    ScalarType::Byte => {
                        let bit = 1 << self.rng.below(8);
                        f64::from((before as u8 ^ bit) & var.valid_bits())
                    }
                    // Most of these lengths fit.
                    ScalarType::Word if self.lengths.contains(&var) => self.rng.below(6) as f64,
                    ScalarType::Word => self.rng.below(65_536) as f64,
                    _ => self.rng.below(20_000) as f64 / 16.0,
                };
                // If the variable cannot have this value, nothing changes.
                let _ = cell.controller_mut().force(InitialTarget::Var(var), value);
            }
        }
    }
}
