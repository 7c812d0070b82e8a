//! Findings about commands and the controller's states: why a reply is a failure.

use proto_core::config::{FieldSpec, InputBinding};
use proto_core::engine::{PortStatus, ReplyCode};
use proto_core::wire::state::{OperationMode, ProgramState, RobotState, SafetyState, States};

use crate::Case;
use crate::finding::{Cause, Finding, Place, Severity, finding};

/// Looks at the newest command of each port, and at the controller.
pub(crate) fn examine(case: &Case<'_>, findings: &mut Vec<Finding>) {
    for port in case.status.ports() {
        findings.extend(command(case, &port));
    }
    if findings.iter().any(|finding| is_of_state(finding.cause)) || !has_commands(case) {
        return;
    }
    // Nobody has given a command yet.
    let states = case.status.controller().map(|controller| controller.states).or(case.looked);
    if let Some(states) = states
        && let Some((cause, seen, likely, remedy)) = refusal(&states)
    {
        let place = Place::Controller;
        let expected = "remote or automatic mode, powered and enabled: the file has commands";
        findings.push(finding((Severity::Warning, &place, cause), seen, expected, likely, remedy));
    }
}

fn is_of_state(cause: Cause) -> bool {
    use Cause::{Disabled, Manual, PowerOff, SafetyStop, Starting};
    matches!(cause, Manual | PowerOff | Disabled | SafetyStop | Starting)
}

fn has_commands(case: &Case<'_>) -> bool {
    case.config.fields.iter().any(|field| match field {
        FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => {
            matches!(to, InputBinding::Commands { .. })
        }
        _ => false,
    })
}

/// The newest command of a port, if something became of it that was not meant.
fn command(case: &Case<'_>, port: &PortStatus<'_>) -> Option<Finding> {
    let place = Place::Port(port.name.to_owned());
    let given = port.command.map_or_else(|| "a command".to_owned(), |command| command.to_string());
    let found = |severity, cause, [seen, expected, likely, remedy]: [String; 4]| {
        Some(finding((severity, &place, cause), seen, expected, likely, remedy))
    };
    match port.reply {
        ReplyCode::Fail => failed(case, port, &place),
        ReplyCode::NoReply => found(
            Severity::Fault,
            Cause::NoReply,
            [
                format!("no reply to {given}"),
                "a reply from the command port".into(),
                "The connection was lost, or the controller is busy or hangs".into(),
                "Look at the controller's own log; the command may have been carried out".into(),
            ],
        ),
        ReplyCode::NotSent => {
            let why = port.last_not_given.map_or("it was not sent", |last| last.why.text());
            found(
                Severity::Fault,
                Cause::NotSent,
                [
                    format!("{given} was not sent: {why}"),
                    String::new(),
                    "A command is sent at once or not at all".into(),
                    "Give it again when the link to the command port is up".into(),
                ],
            )
        }
        _ => None,
    }
}

fn failed(case: &Case<'_>, port: &PortStatus<'_>, place: &Place) -> Option<Finding> {
    let last = port.last_failed?;
    let command = last.command.to_string();
    let then = last.controller.map(|controller| controller.states).or(case.looked);
    let refused = |why: &str| format!("{command} refused: {why}");
    let fault = |cause, seen: String, likely: &str, remedy: &str| {
        Some(finding((Severity::Fault, place, cause), seen, "", likely, remedy))
    };
    let Some(states) = then else {
        return fault(
            Cause::CommandFailed,
            format!("{command} failed"),
            "The controller says no more, and nobody sees its states: the file needs no state stream",
            "Look at the pendant: mode, power, emergency stop, the program's name",
        );
    };
    // Power on is what a powered-off arm needs.
    let is_cure = |cause: Cause| match cause {
        Cause::PowerOff => command.starts_with("poweron"),
        Cause::Disabled => command.starts_with("enable"),
        _ => false,
    };
    if let Some((cause, seen, likely, remedy)) = refusal(&states)
        && !is_cure(cause)
    {
        return fault(cause, refused(&seen), likely, remedy);
    }
    let program = command.strip_prefix("run(").and_then(|rest| rest.strip_suffix(')'));
    match (program, states.program) {
        (Some(_), ProgramState::Running | ProgramState::Paused | ProgramState::TaskRunning) => fault(
            Cause::ProgramRuns,
            refused("a program runs or is paused"),
            "The controller runs one program at a time",
            "Stop it first, or wait until it has ended",
        ),
        (Some(name), _) => fault(
            Cause::ProgramName,
            refused(&format!(
                "the controller is in {} mode, powered and enabled, and no program runs",
                mode(states.mode)
            )),
            &format!("There is no program {name} in the controller, or it has a mistake"),
            "Compare the name with the pendant's list, with capitals, folder and .jspf",
        ),
        (None, ProgramState::Stopped) if command.starts_with("resume") || command.starts_with("pause") => {
            fault(
                Cause::CommandFailed,
                refused("no program runs"),
                "There is nothing to pause or to resume",
                "Start a program first",
            )
        }
        _ => fault(
            Cause::CommandFailed,
            format!("{command} failed"),
            "Mode, power and safety do not explain it",
            "Look at the pendant's list of errors",
        ),
    }
}

fn mode(mode: OperationMode) -> &'static str {
    match mode {
        OperationMode::Manual => "manual",
        OperationMode::Auto => "automatic",
        OperationMode::Remote => "remote",
        _ => "an unknown",
    }
}

/// What a controller in these states refuses commands for.
fn refusal(states: &States) -> Option<(Cause, String, &'static str, &'static str)> {
    if states.mode == OperationMode::Manual {
        return Some((
            Cause::Manual,
            "the controller is in manual mode".into(),
            "In manual mode it takes commands from the pendant only",
            "Turn the key or the switch of the pendant to automatic or remote mode",
        ));
    }
    match states.safety {
        // Without power there is nothing to watch: the robot's own state says it better.
        SafetyState::Run | SafetyState::Reduce | SafetyState::PowerOff => {}
        SafetyState::Stop0 | SafetyState::Stop1 | SafetyState::Stop2 => {
            return Some((
                Cause::SafetyStop,
                format!("the safety controller has stopped the robot ({})", states.safety.name()),
                "An emergency stop is pressed, a safety door is open, or the arm has collided",
                "Release the stop, close the door and acknowledge it at the pendant; then power on and enable",
            ));
        }
        other => {
            return Some((
                Cause::SafetyStop,
                format!("the safety controller does not watch the robot ({})", other.name()),
                "It is starting, waiting for an acknowledgement, being configured, or has failed",
                "Look at the safety page of the pendant",
            ));
        }
    }
    match states.robot {
        RobotState::Enable => None,
        RobotState::PowerOff => Some((
            Cause::PowerOff,
            "the arm is powered off".into(),
            "Programs start only with the arm powered and enabled",
            "Press power on and enable at the pendant, or give poweron and enable first",
        )),
        RobotState::Disable => Some((
            Cause::Disabled,
            "the arm is not enabled".into(),
            "Programs start only with the arm powered and enabled",
            "Press enable at the pendant, or give enable first",
        )),
        other => Some((
            Cause::Starting,
            format!("the controller is not ready ({})", other.name()),
            "It is still starting, or nobody is logged in",
            "Wait, or log in at the pendant",
        )),
    }
}
