//! Events: to the log, to the events file and to the clients that follow them.

use tracing::{Level, enabled, info, trace};

use super::ControllerRuntime;
use recipe_controller::Happened;

impl ControllerRuntime {
    pub(super) fn report_events(&self) {
        for client in self.control_clients.borrow().iter() {
            client.notify();
        }
        let controller = self.controller.borrow();
        let newest = controller.newest_event();
        let reported = self.reported.replace(newest);
        if newest == reported {
            return;
        }
        let in_words = enabled!(target: "controller", Level::INFO);
        if !in_words && self.events_file.is_none() {
            return;
        }
        for event in controller.events_since(reported + 1) {
            if let Some(file) = &self.events_file
                && let Ok(line) = serde_json::to_string(event)
            {
                file.write(&line);
            }
            let (time_s, what) = (event.time_s, &event.what);
            match what {
                // The program itself has logged it.
                Happened::Log { .. } => {}
                // A fast recipe writes hundreds of variables per second.
                Happened::Write { .. } => trace!(target: "controller", time_s, "{what}"),
                _ => info!(target: "controller", time_s, "{what}"),
            }
        }
    }
}
