//! Error frames of the kernel: the error state and the error counters of a CAN controller.

use proto_core::engine::BusState;
use socketcan::errors::ControllerProblems;
use socketcan::{CanErrorFrame, EmbeddedFrame};

/// What an error frame says about the controller's state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StateChange {
    State(BusState),
    /// The controller was restarted after bus-off.
    Restarted,
    Other,
}

/// The state in an error frame, which may contain the states of both directions: the worst one counts.
pub(super) fn state_change(frame: CanErrorFrame) -> StateChange {
    let error = frame.into_error();
    if error.is_bus_off() {
        return StateChange::State(BusState::BusOff);
    }
    if error.is_restarted() {
        return StateChange::Restarted;
    }
    let problems = error.controller().unwrap_or(ControllerProblems::empty());
    let says = |state| problems.intersects(state);
    if says(ControllerProblems::RX_PASSIVE | ControllerProblems::TX_PASSIVE) {
        StateChange::State(BusState::Passive)
    } else if says(ControllerProblems::RX_WARNING | ControllerProblems::TX_WARNING) {
        StateChange::State(BusState::Warning)
    } else if says(ControllerProblems::ACTIVE) {
        StateChange::State(BusState::Active)
    } else {
        StateChange::Other
    }
}

/// The transmit and the receive error counter, if the frame contains them.
pub(super) fn counters(frame: CanErrorFrame) -> Option<(u8, u8)> {
    let &[.., transmit, receive] = frame.data().first_chunk::<8>()?;
    match state_change(frame) {
        StateChange::Restarted => Some((0, 0)),
        StateChange::State(BusState::BusOff) => None,
        // Linux before 5.19 sets the counters without the flag.
        StateChange::State(_) => Some((transmit, receive)),
        StateChange::Other => {
            let flagged = frame.error_bits() & libc::CAN_ERR_CNT != 0;
            (flagged || (transmit, receive) != (0, 0)).then_some((transmit, receive))
        }
    }
}

pub(super) fn is_overflow(frame: CanErrorFrame) -> bool {
    let problems = frame.into_error().controller().unwrap_or(ControllerProblems::empty());
    problems.contains(ControllerProblems::RX_OVERFLOW)
}

/// The state's name in logs and statistics.
pub(super) const fn name(state: BusState) -> &'static str {
    match state {
        BusState::Active => "active",
        BusState::Warning => "warning",
        BusState::Passive => "passive",
        BusState::BusOff => "bus-off",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(class: u32, controller: i32) -> StateChange {
        let data = [0, u8::try_from(controller).unwrap(), 0, 0, 0, 0, 0, 0];
        state_change(CanErrorFrame::new_error(class, &data).unwrap())
    }

    #[test]
    fn states_as_drivers_report_them() {
        let controller = libc::CAN_ERR_CRTL | libc::CAN_ERR_CNT;
        for (problems, state) in [
            (libc::CAN_ERR_CRTL_RX_WARNING | libc::CAN_ERR_CRTL_TX_WARNING, BusState::Warning),
            (libc::CAN_ERR_CRTL_TX_WARNING, BusState::Warning),
            (libc::CAN_ERR_CRTL_RX_PASSIVE, BusState::Passive),
            (libc::CAN_ERR_CRTL_TX_PASSIVE | libc::CAN_ERR_CRTL_RX_WARNING, BusState::Passive),
            (libc::CAN_ERR_CRTL_ACTIVE, BusState::Active),
        ] {
            assert_eq!(of(controller, problems), StateChange::State(state), "{problems:#x}");
        }
        assert_eq!(of(libc::CAN_ERR_BUSOFF | libc::CAN_ERR_CNT, 0), StateChange::State(BusState::BusOff));
        assert_eq!(of(libc::CAN_ERR_BUSOFF | controller, 0x40), StateChange::State(BusState::BusOff));
        assert_eq!(of(libc::CAN_ERR_RESTARTED, 0), StateChange::Restarted);
    }

    #[test]
    fn counters_are_transmit_and_receive() {
        let of = |class: u32, controller: i32, counters_of: [u8; 2]| {
            let data = [0, u8::try_from(controller).unwrap(), 0, 0, 0, 0, counters_of[0], counters_of[1]];
            counters(CanErrorFrame::new_error(class, &data).unwrap())
        };
        let controller = libc::CAN_ERR_CRTL;
        assert_eq!(
            of(controller | libc::CAN_ERR_CNT, libc::CAN_ERR_CRTL_TX_PASSIVE, [128, 3]),
            Some((128, 3))
        );
        // Without the flag they are at the same place.
        assert_eq!(of(controller, libc::CAN_ERR_CRTL_RX_PASSIVE, [0, 128]), Some((0, 128)));
        assert_eq!(of(controller, libc::CAN_ERR_CRTL_ACTIVE, [0, 0]), Some((0, 0)));
        assert_eq!(of(libc::CAN_ERR_ACK, 0, [8, 0]), Some((8, 0)));
        assert_eq!(of(libc::CAN_ERR_RESTARTED, 0, [0, 0]), Some((0, 0)));
        // No counters.
        assert_eq!(of(libc::CAN_ERR_ACK, 0, [0, 0]), None);
        assert_eq!(of(controller, libc::CAN_ERR_CRTL_RX_OVERFLOW, [0, 0]), None);
        assert_eq!(of(libc::CAN_ERR_BUSOFF, 0, [0, 0]), None);
    }

    #[test]
    fn only_a_receive_overflow_counts() {
        let of = |controller: i32| {
            let data = [0, u8::try_from(controller).unwrap(), 0, 0, 0, 0, 0, 0];
            is_overflow(CanErrorFrame::new_error(libc::CAN_ERR_CRTL, &data).unwrap())
        };
        assert!(of(libc::CAN_ERR_CRTL_RX_OVERFLOW));
        assert!(of(libc::CAN_ERR_CRTL_RX_OVERFLOW | libc::CAN_ERR_CRTL_RX_WARNING));
        assert!(!of(libc::CAN_ERR_CRTL_TX_OVERFLOW));
    }

    #[test]
    fn other_errors_do_not_change_the_state() {
        assert_eq!(of(libc::CAN_ERR_CRTL, libc::CAN_ERR_CRTL_RX_OVERFLOW), StateChange::Other);
        assert_eq!(of(libc::CAN_ERR_CRTL, 0), StateChange::Other);
        assert_eq!(
            of(libc::CAN_ERR_ACK | libc::CAN_ERR_PROT | libc::CAN_ERR_BUSERROR, 0),
            StateChange::Other
        );
        assert_eq!(of(0, 0), StateChange::Other);
    }
}
