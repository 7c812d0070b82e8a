//! Findings about CAN ports: the bus, and ids that no recipe has.

use proto_core::config::{Bus, Parts};
use proto_core::engine::BusState;
use proto_core::sysvar::Direction;
use proto_core::wire::can::CanId;

use crate::finding::{Cause, Finding, Severity};
use crate::port_case::PortCase;
use crate::record::SeenId;

/// Examines the bus and its frames.
pub(crate) fn examine(seen: &PortCase<'_>, state: BusState, findings: &mut Vec<Finding>) {
    match state {
        BusState::BusOff => {
            findings.push(bus(seen, Cause::BusOff, "the CAN controller is bus-off"));
            return;
        }
        BusState::Passive => {
            findings.push(bus(seen, Cause::BusErrors, "the CAN controller is error-passive"))
        }
        BusState::Active | BusState::Warning => {}
    }
    let recipe_ids: Vec<CanId> = seen.case.config.can_ids(seen.recipe, Direction::Input).collect();
    if recipe_ids.is_empty() || !seen.is_silent() || seen.counters.frames_in > 0 {
        return;
    }
    let foreign: Vec<&SeenId> =
        seen.record.ids().iter().filter(|one| !recipe_ids.contains(&one.id)).collect();
    let counters = &seen.counters;
    if counters.rejected_length > 0 {
        findings.extend(length(seen, &recipe_ids));
    } else if counters.rejected_remote > 0 {
        findings.push(seen.place.fault(
            Cause::Remote,
            format!("{} remote frames", counters.rejected_remote),
            "frames with data",
            "Another node asks for the data, and the device does not send it",
            "Let the device send by itself",
        ));
    } else if let Some((one, meant)) = other_kind(&foreign, &recipe_ids) {
        findings.push(seen.place.fault(
            Cause::IdKind,
            format!("id {} seen {} times", one.id, one.count()),
            format!("id {meant}"),
            "The number is right; one is an id of 11 bits and the other of 29",
            "Write `extended` of the frame in the recipe as the device has it",
        ));
    } else if !foreign.is_empty() {
        findings.push(ids(seen, foreign, &recipe_ids));
    } else if seen.recipe.exchanges.len == 0 && seen.case.running.as_millis() >= 3_000 {
        findings.push(nothing(seen, &recipe_ids));
    }
}

fn bus(seen: &PortCase<'_>, cause: Cause, what: &str) -> Finding {
    let bitrate = bitrate(seen);
    seen.place.fault(
        cause,
        what,
        "error-active",
        "Nobody acknowledges, or the nodes have different bit rates: a wire is open or swapped, a terminator \
         is missing, or no other node is on",
        format!("Check CAN-H and CAN-L, 120 ohm at both ends, and that all nodes have {bitrate} bit/s"),
    )
}

fn bitrate(seen: &PortCase<'_>) -> u32 {
    match seen.port.bus {
        Bus::Can { bitrate } => bitrate,
        _ => 0,
    }
}

fn words(ids: &[CanId]) -> String {
    let shown: Vec<_> = ids.iter().take(4).map(CanId::to_string).collect();
    let more = if ids.len() > 4 { " and others" } else { "" };
    format!("{}{more}", shown.join(", "))
}

/// Ids that no recipe has, the most frequent first.
fn ids(seen: &PortCase<'_>, mut foreign: Vec<&SeenId>, recipe_ids: &[CanId]) -> Finding {
    foreign.sort_by_key(|one| std::cmp::Reverse(one.count()));
    let shown: Vec<_> =
        foreign.iter().take(4).map(|one| format!("id {} seen {} times", one.id, one.count())).collect();
    seen.place.fault(
        Cause::ForeignIds,
        shown.join(", "),
        format!("id {}", words(recipe_ids)),
        "The device has another number, or the ids of the recipe are another device's",
        "Set the device's number, or write the id that is seen in the recipe",
    )
}

/// An id with the number of one in a recipe but of the other kind.
fn other_kind<'a>(foreign: &[&'a SeenId], recipe_ids: &[CanId]) -> Option<(&'a SeenId, CanId)> {
    let number = |id: CanId| match id {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id,
    };
    foreign.iter().find_map(|one| {
        let meant = recipe_ids.iter().find(|id| number(**id) == number(one.id))?;
        Some((*one, *meant))
    })
}

fn length(seen: &PortCase<'_>, recipe_ids: &[CanId]) -> Option<Finding> {
    let one = seen.record.ids().iter().find(|one| recipe_ids.contains(&one.id))?;
    let Parts::Can { input, .. } = &seen.recipe.parts else { return None };
    let frame = input.iter().find(|frame| frame.id == one.id)?;
    let fields = frame.fields.of(seen.case.config.fields);
    let sizes = fields.iter().map(|field| match field {
        proto_core::config::FieldSpec::System(var) => Some(var.size()),
        proto_core::config::FieldSpec::UserInput { ty, .. } => Some(ty.size()),
        _ => None,
    });
    let expected = sizes.sum::<Option<usize>>();
    Some(seen.place.fault(
        Cause::CanLength,
        format!("id {} with {} bytes", one.id, one.len),
        expected.map_or("the length of the recipe".into(), |len| format!("{len} bytes")),
        "The fields of the recipe are not those of the device",
        "Correct the fields of this id in the recipe",
    ))
}

fn nothing(seen: &PortCase<'_>, recipe_ids: &[CanId]) -> Finding {
    let severity = if seen.status.age.is_some() { Severity::Fault } else { Severity::Warning };
    let seconds = seen.status.age.unwrap_or(seen.case.running).as_millis() / 1000;
    if seen.record.fd_frames > 0 {
        return seen.place.fault(
            Cause::CanLength,
            format!("{} CAN FD frames", seen.record.fd_frames),
            "classic CAN frames",
            "The device sends CAN FD",
            "Set the device to classic CAN",
        );
    }
    seen.place.found(
        severity,
        Cause::NoBytes,
        format!("0 frames in {seconds} s"),
        format!("id {}", words(recipe_ids)),
        "The device is off or not started, has another bit rate, or a wire is open",
        format!(
            "Check the power, CAN-H and CAN-L, and the bit rate ({} bit/s); some devices need a start message, \
             such as CANopen's",
            bitrate(seen)
        ),
    )
}
