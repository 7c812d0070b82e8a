//! Executing operations.

use std::collections::BTreeMap;

use proto_core::command::{Action, Percent};
use proto_core::time::{Duration, Instant};
use serde_json::{Map, Value, json};

use super::{AfterRestart, Done, Number, Operation, Refused, check_kinds, refused};
use crate::Controller;
use crate::common::number;
use crate::program::{self, Script};

impl Controller {
    /// Executes an operation. Then call [`Self::poll_output`] until it returns
    /// [`ControllerOutput::Sleep`](crate::ControllerOutput::Sleep). `now` must not be earlier than in the last call.
    ///
    /// # Errors
    /// [`Refused`]; nothing changed. `follow`, `advance` and `wait` are always refused: the caller executes them.
    pub fn operate(&mut self, now: Instant, operation: &Operation) -> Done {
        self.quiet.ends();
        self.begin(now);
        if self.is_shut_down {
            return refused("the controller is shut down");
        }
        self.advance(now);
        let before = (!operation.is_reading()).then(|| self.recorder.before(&self.registers)).flatten();
        let result = self.execute_operation(now, operation)?;
        if !operation.is_reading() {
            self.operation_done(now, operation);
            if !matches!(operation, Operation::Restart { .. }) {
                self.note_writes(now, before, "control");
            }
            self.settle(now);
        }
        Ok(result)
    }

    fn execute_operation(&mut self, now: Instant, operation: &Operation) -> Done {
        match operation {
            Operation::State {} => return Ok(self.state(now)),
            Operation::Get { items } => return self.get_items(items),
            Operation::Counters {} => return Ok(json!(self.counters())),
            Operation::Programs {} => {
                return Ok(self.scripts.iter().map(Script::name).collect());
            }
            Operation::Events { since, kinds, max } => return self.kept_events(*since, kinds, *max),
            Operation::Set { items } => self.set_items(items)?,
            Operation::Mode { mode } => self.set_mode((*mode).into()),
            Operation::EmergencyStop {} => self.emergency_stop(now),
            Operation::ProtectiveStop {} => self.protective_stop(now),
            Operation::Collide { axis } => {
                if !matches!(axis, 1..=6 | 11..=16 | 20) {
                    return refused(format!(
                        "axis: {axis} is no place of a collision; there are 1 to 6, 11 to 16 and 20"
                    ));
                }
                self.collide(now, *axis);
            }
            Operation::Clear {} => self.clear_stop(now),
            Operation::Hold { safety: Some(hold) } => self.hold_safety(now, *hold),
            Operation::Hold { safety: None } => self.release_safety(),
            Operation::Reduced { on: true } => self.enter_reduced(now),
            Operation::Reduced { on: false } => self.leave_reduced(now),
            Operation::RaiseError { code: 0, .. } => return refused("code: 0 means that there is no error"),
            Operation::RaiseError { code, text } => self.machine.raise(*code, text.as_str()),
            Operation::ClearError {} => self.machine.clear_error(),
            Operation::PowerOn {} => self.press(now, Action::PowerOn)?,
            Operation::PowerOff {} => self.press(now, Action::PowerOff)?,
            Operation::Enable {} => self.press(now, Action::Enable)?,
            Operation::Disable {} => self.press(now, Action::Disable)?,
            Operation::Stop {} => self.press(now, Action::Stop)?,
            Operation::Pause {} => self.press(now, Action::Pause)?,
            Operation::Resume {} => self.press(now, Action::Resume)?,
            Operation::Run { program, speed_percent } => self.run_at_pendant(now, program, *speed_percent)?,
            Operation::Upload { program, script } => self.upload(program, script)?,
            Operation::Remove { program } => self.remove(program)?,
            Operation::Recipe { port, recipe } => self.give_recipe(now, port, recipe.as_deref())?,
            Operation::Cycle { port, ms } => self.give_cycle(now, port, *ms)?,
            Operation::Restart { registers: AfterRestart::Initial } => self.restart(now),
            Operation::Restart { registers: AfterRestart::Cleared } => self.restart_cleared(now),
            Operation::Fault(fault) => self.begin_fault(fault)?,
            Operation::Heal { server, port, item, transitions } => {
                self.heal_some(*server, port.as_deref(), item.as_deref(), *transitions)?;
            }
            Operation::Follow { .. } | Operation::Advance { .. } | Operation::Wait { .. } => {
                return refused("this is not possible here");
            }
        }
        Ok(Value::Null)
    }

    fn get_items(&self, items: &[String]) -> Done {
        let mut values = Map::new();
        for name in items {
            let value = self.item(name).map_err(|error| Refused(error.to_string()))?;
            values.insert(name.clone(), number(value));
        }
        Ok(Value::Object(values))
    }

    fn kept_events(&self, since: u64, kinds: &[String], max: usize) -> Done {
        check_kinds(kinds)?;
        let wanted = |kind: &str| kinds.is_empty() || kinds.iter().any(|wanted| wanted == kind);
        let mut next = self.newest_event() + 1;
        let mut events = Vec::new();
        for event in self.events_since(since) {
            if events.len() >= max {
                next = event.number;
                break;
            }
            if wanted(event.what.kind()) {
                events.push(event);
            }
        }
        let lost = self.dropped_events().saturating_sub(since.saturating_sub(1));
        Ok(json!({ "events": events, "next": next, "lost": lost }))
    }

    fn set_items(&mut self, items: &BTreeMap<String, Number>) -> Result<(), Refused> {
        let before = self.registers.clone();
        for (name, value) in items {
            if let Err(error) = self.force_item(name, value.value()) {
                self.registers = before;
                return refused(error.to_string());
            }
        }
        Ok(())
    }

    fn press(&mut self, now: Instant, action: Action) -> Result<(), Refused> {
        match self.act(now, action) {
            Ok(_) => Ok(()),
            Err(_) => refused(self.newest_error()),
        }
    }

    fn newest_error(&self) -> String {
        self.machine.error().map_or_else(String::new, |error| error.message.clone())
    }

    fn run_at_pendant(&mut self, now: Instant, program: &str, speed: Option<f32>) -> Result<(), Refused> {
        let speed = match speed {
            None => None,
            Some(percent) => match Percent::new(percent) {
                Some(speed) => Some(speed),
                None => return refused(format!("speed_percent: {percent} is not within (0, 100]")),
            },
        };
        let Some(script) = program::named(&self.scripts, program).cloned() else {
            return Err(self.no_program(program));
        };
        if self.machine.check_run_at_pendant().is_err() {
            return refused(self.newest_error());
        }
        if speed.is_some() {
            // The value is within the allowed range.
            let _ = self.machine.set_speed(speed);
        }
        match self.start_program(now, &script, None, "pendant") {
            Ok(()) => Ok(()),
            Err(_) => refused(self.newest_error()),
        }
    }

    fn no_program(&self, name: &str) -> Refused {
        let names: Vec<&str> = self.scripts.iter().map(Script::name).collect();
        let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        Refused(format!("program: there is no program {name}; there are {names}"))
    }

    /// Checks the program's name in an operation that runs it, as commands do, or removes it.
    pub(crate) fn check_program(&self, operation: &Operation) -> Result<(), Refused> {
        let (program, is_there) = match operation {
            Operation::Run { program, .. } => (program, program::named(&self.scripts, program).is_some()),
            Operation::Remove { program } => {
                (program, self.scripts.iter().any(|script| script.name() == program))
            }
            _ => return Ok(()),
        };
        if is_there { Ok(()) } else { Err(self.no_program(program)) }
    }

    fn check_idle(&self, program: &str) -> Result<(), Refused> {
        match self.program_name() == Some(program) {
            true => refused(format!("{program} runs; stop it first")),
            false => Ok(()),
        }
    }

    fn upload(&mut self, program: &str, text: &str) -> Result<(), Refused> {
        self.check_idle(program)?;
        let is_name = !program.is_empty()
            && program.len() <= MAX_NAME
            && program.chars().all(|c| !c.is_control() && !"()\",".contains(c));
        if !is_name {
            return refused(format!(
                "program: {program:?} is no name: 1 to {MAX_NAME} characters without ( ) , \""
            ));
        }
        let place = self.scripts.iter().position(|script| script.name() == program);
        if place.is_none() && self.scripts.len() >= MAX_PROGRAMS {
            return refused(format!("there are {MAX_PROGRAMS} programs already"));
        }
        let script =
            Script::compile(program, text).map_err(|error| Refused(format!("{program}: {error}")))?;
        match place.and_then(|nth| self.scripts.get_mut(nth)) {
            Some(place) => *place = script,
            None => self.scripts.push(script),
        }
        Ok(())
    }

    fn remove(&mut self, program: &str) -> Result<(), Refused> {
        self.check_idle(program)?;
        let Some(nth) = self.scripts.iter().position(|script| script.name() == program) else {
            return Err(self.no_program(program));
        };
        self.scripts.remove(nth);
        Ok(())
    }

    pub(super) fn port_index(&self, name: &str) -> Result<usize, Refused> {
        self.port_named(name).map_err(|error| Refused(format!("port: {error}")))
    }

    fn give_recipe(&mut self, now: Instant, port: &str, recipe: Option<&str>) -> Result<(), Refused> {
        let nth = self.port_index(port)?;
        let recipe = match recipe {
            None => None,
            Some(name) => {
                let recipes = &self.config.recipes;
                let Some(index) = recipes.iter().position(|recipe| recipe.name == name) else {
                    let names: Vec<_> = recipes.iter().map(|recipe| recipe.name.as_str()).collect();
                    return refused(format!(
                        "recipe: there is no recipe {name}; there are {}",
                        names.join(", ")
                    ));
                };
                Some(index)
            }
        };
        self.assign_recipe(now, nth, recipe).map_err(|error| Refused(format!("{port}: {error}")))
    }

    fn give_cycle(&mut self, now: Instant, port: &str, ms: f64) -> Result<(), Refused> {
        let nth = self.port_index(port)?;
        if !(4.0..=MAX_CYCLE_MS).contains(&ms) {
            return refused(format!("ms: {ms} is not within 4 to {MAX_CYCLE_MS}"));
        }
        let epoch = self.port_epoch(nth, now);
        if let Some(port) = self.ports.get_mut(nth) {
            port.set_cycle(now, epoch, Duration::from_micros((ms * 1_000.0).round() as u64));
        }
        Ok(())
    }
}

/// Maximum length of a program's name.
const MAX_NAME: usize = 200;
const MAX_PROGRAMS: usize = 256;
const MAX_CYCLE_MS: f64 = 3_600_000.0;
