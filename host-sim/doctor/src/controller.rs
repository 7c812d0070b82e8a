//! Findings about commands and the controller's states: why a reply is a failure.

use proto_core::command::Request;
use proto_core::config::ConfigView;
use proto_core::engine::ReplyCode;
use proto_core::wire::state::{OperationMode, ProgramState, RobotState, SafetyState, States};

use crate::Case;
use crate::command::{REPORTED_FOR, ago, is_command};
use crate::finding::{Cause, Finding, FindingPlace, Severity};
use crate::record::PortRecord;
use crate::state::ObservedPort;

/// Examines the newest command of each port, and the controller.
pub(crate) fn examine(case: &Case<'_>, findings: &mut Vec<Finding>) {
    for port in &case.status.ports {
        findings.extend(command(case, port));
    }
    if findings.iter().any(|finding| is_of_state(finding.cause)) || !has_commands(case.config) {
        return;
    }
    // Nobody has given a command yet.
    let states = case.status.controller.or(case.looked);
    if let Some(states) = states
        && let Some((cause, seen, likely, remedy)) = refusal(&states)
    {
        let place = FindingPlace::Controller;
        let expected = "remote or automatic mode, powered and enabled: the file has commands";
        findings.push(place.warning(cause, seen, expected, likely, remedy));
    }
}

fn is_of_state(cause: Cause) -> bool {
    use Cause::{Disabled, Manual, PowerOff, SafetyStop, Starting};
    matches!(cause, Manual | PowerOff | Disabled | SafetyStop | Starting)
}

/// Whether a value can pick a command.
pub fn has_commands(config: ConfigView<'_>) -> bool {
    config.fields.iter().any(is_command)
}

/// The newest command of a port, if it did not have the intended effect.
fn command(case: &Case<'_>, port: &ObservedPort) -> Option<Finding> {
    let place = FindingPlace::Port(port.name.clone());
    let given = port.command.clone().unwrap_or_else(|| "a command".to_owned());
    match port.reply {
        ReplyCode::Fail => failed(case, port, &place),
        ReplyCode::Pending | ReplyCode::Other => {
            let others = case.status.links.iter().filter_map(|link| link.other_text.as_ref());
            let mut others = others.filter(|other| other.age < REPORTED_FOR);
            let other = others.find(|other| other.command == port.command && other.command.is_some())?;
            Some(place.fault(
                Cause::OtherReply,
                format!("{given} answered{}: {:?}", ago(other.age), other.text),
                "success, fail or already, and the command's name",
                "A controller version with other words: nobody knows whether it was done",
                "Look at the robot: it is not sent again. Report the words, so that they can be read",
            ))
        }
        ReplyCode::NoReply => {
            let record = case.ports.iter().find(|record| record.port == port.id);
            let given_at = record.and_then(PortRecord::newest_command);
            let age = given_at.map(|at| case.status.at.saturating_since(at));
            if age.is_some_and(|age| age >= REPORTED_FOR) {
                return None;
            }
            let when = age.map_or_else(String::new, |age| format!(", given{}", ago(age)));
            Some(place.fault(
                Cause::NoReply,
                format!("no reply to {given}{when}"),
                "a reply from the command port",
                "The connection was lost, or the controller is busy or hangs",
                "Look at the controller's own log; the command may have been executed",
            ))
        }
        ReplyCode::NotSent => {
            let (why, age) = match &port.not_given {
                Some(last) if last.age >= REPORTED_FOR => return None,
                Some(last) => (last.text.as_str(), ago(last.age)),
                None => ("the link or its room was lacking", String::new()),
            };
            Some(place.fault(
                Cause::NotSent,
                format!("{given} was not sent{age}: {why}"),
                "",
                "A command is sent at once or not at all",
                "Give it again when the link to the command port is up and the commands before have their replies",
            ))
        }
        _ => None,
    }
}

fn failed(case: &Case<'_>, port: &ObservedPort, place: &FindingPlace) -> Option<Finding> {
    let last = port.failed.as_ref().filter(|last| last.age < REPORTED_FOR)?;
    let (command, age) = (last.command.as_str(), ago(last.age));
    let word = Request::parse(command.as_bytes()).map_or(command, |request| request.keyword().word());
    let then = last.controller.or(case.looked);
    let refused = |why: &str| format!("{command} refused{age}: {why}");
    let found = |severity, cause, seen: String, likely: &str, remedy: &str| {
        Some(place.found(severity, cause, seen, "", likely, remedy))
    };
    let fault = |cause, seen, likely: &str, remedy: &str| found(Severity::Fault, cause, seen, likely, remedy);
    let Some(states) = then else {
        // The two cases cannot be distinguished.
        if matches!(word, "stop" | "pause") {
            return found(
                Severity::Note,
                Cause::NothingToDo,
                format!("{command} failed{age}"),
                "Most often no program runs, and then the controller refuses it; the file needs no state stream, so \
                 nobody sees that",
                "If a program did run, look at the pendant's list of errors",
            );
        }
        return fault(
            Cause::CommandFailed,
            format!("{command} failed{age}"),
            "The controller says no more, and nobody sees its states: the file needs no state stream",
            "Look at the pendant: mode, power, emergency stop, the program's name",
        );
    };
    if let Some(why) = is_so_already(word, &states) {
        let likely = "The controller refuses what is so already, such as a stop while nothing runs";
        return found(Severity::Note, Cause::NothingToDo, refused(why), likely, "Nothing is to be done");
    }
    // `poweron` is the right command for an arm without power.
    let is_cure = |cause: Cause| match cause {
        Cause::PowerOff => word == "poweron",
        Cause::Disabled => word == "enable",
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
        (None, ProgramState::Stopped) if word == "resume" => fault(
            Cause::CommandFailed,
            refused("no program runs"),
            "There is nothing to resume",
            "Start a program first",
        ),
        _ => fault(
            Cause::CommandFailed,
            format!("{command} failed{age}"),
            "Mode, power and safety do not explain it",
            "Look at the pendant's list of errors",
        ),
    }
}

/// Why the command has nothing to do: the controller is already in the requested state.
fn is_so_already(word: &str, states: &States) -> Option<&'static str> {
    match (word, states.program, states.robot) {
        ("stop" | "pause", ProgramState::Stopped, _) => Some("no program runs"),
        ("stop", ProgramState::Stopping, _) => Some("the program is stopping already"),
        ("pause", ProgramState::Paused | ProgramState::Pausing, _) => Some("the program is paused already"),
        ("resume", ProgramState::Running, _) => Some("the program runs already"),
        ("disable", _, RobotState::Disable | RobotState::PowerOff) => Some("the arm is not enabled"),
        ("poweroff", _, RobotState::PowerOff) => Some("the arm is powered off already"),
        ("poweron", _, RobotState::Disable | RobotState::Enable) => Some("the arm has power already"),
        ("enable", _, RobotState::Enable) => Some("the arm is enabled already"),
        _ => None,
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

/// Why a controller in these states refuses commands.
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
        // Without power no safety function is active; the robot's own state is more precise.
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
