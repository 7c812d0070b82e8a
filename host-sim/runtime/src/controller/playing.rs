//! The timeline of a run: its steps are operations like those of the control socket.

use std::rc::Rc;

use proto_core::time::Instant;
use tracing::{error, warn};

use super::ControllerRuntime;
use recipe_controller::ControllerInput;

impl ControllerRuntime {
    /// Executes the steps that are due, after each change of the controller.
    pub(super) fn play(&self) {
        // A step that is being executed changes the controller too.
        if self.timeline.borrow().is_none() || self.is_playing.replace(true) {
            return;
        }
        let deadline = loop {
            let now = self.clock.now();
            let next = self.timeline.borrow_mut().as_mut().and_then(|timeline| {
                timeline.observe(now, &self.controller.borrow());
                timeline.due(now)
            });
            let Some((step, operation)) = next else {
                break self.timeline.borrow().as_ref().map_or(Instant::NEVER, |timeline| timeline.deadline());
            };
            if let Err(error) = self.operate(&operation) {
                warn!(step, %error, "a step of the timeline was refused");
                self.controller.borrow_mut().note_refused(self.clock.now(), &operation, &error);
            }
        };
        self.is_playing.set(false);
        if let Err(error) = self.timeline_alarm.arm(deadline) {
            error!(%error, "cannot set the timer");
        }
    }

    /// Calls the timeline at its deadlines.
    pub(super) async fn keep_timeline(self: Rc<Self>) {
        loop {
            if let Err(error) = self.timeline_alarm.expired().await {
                error!(%error, "the timer failed");
                return;
            }
            self.input(ControllerInput::Tick);
        }
    }
}
