//! The end of a run as people read it.

use proto_core::time::Duration;

use super::Soak;
use crate::cell::What;

/// What the cell's trace has kept, a line each.
pub fn show_trace(soak: &Soak) -> String {
    let mut text = String::new();
    for entry in soak.cell().trace().entries() {
        let after = Duration::from_micros(entry.at.saturating_since(soak.start).as_micros());
        let subject = subject(soak, entry.what, entry.subject);
        let seconds = format!("{}.{:06}", after.as_micros() / 1_000_000, after.as_micros() % 1_000_000);
        let bytes: Vec<String> =
            entry.bytes.iter().take(MOST_BYTES).map(|byte| format!("{byte:02X}")).collect();
        let more = if entry.bytes.len() > MOST_BYTES { " ..." } else { "" };
        let what = what(entry.what);
        text += &format!("{seconds:>12}  {what:<22} {subject:<14} {}{more}\n", bytes.join(" "));
    }
    text
}

fn what(what: What) -> &'static str {
    match what {
        What::LinkOpen => "gateway opens",
        What::LinkClose => "gateway closes",
        What::LinkUp => "link up",
        What::LinkDown => "link down",
        What::LinkSent => "gateway sends up",
        What::LinkReceived => "gateway receives",
        What::ControllerOpened => "controller accepts",
        What::ControllerClosed => "controller loses",
        What::ControllerReceived => "controller receives",
        What::PortSent => "port sends",
        What::PortReceived => "port receives",
        What::ControllerPortSent => "controller port sends",
        What::ControllerPortReceived => "controller port hears",
        What::Fault => "fault",
    }
}

fn subject(soak: &Soak, what: What, subject: u64) -> String {
    let engine = soak.cell().engine();
    match what {
        What::PortSent | What::PortReceived => {
            let port = soak.cell().gateway().ports.get(subject as usize);
            port.map_or_else(|| subject.to_string(), |port| port.name.as_str().to_owned())
        }
        What::LinkOpen
        | What::LinkClose
        | What::LinkUp
        | What::LinkDown
        | What::LinkSent
        | What::LinkReceived => {
            let link = engine.links().find(|link| u64::from(link.id.0) == subject);
            link.map_or_else(|| subject.to_string(), |link| link.kind.name().to_owned())
        }
        What::ControllerOpened | What::ControllerClosed | What::ControllerReceived => format!("#{subject}"),
        _ => subject.to_string(),
    }
}

const MOST_BYTES: usize = 48;
