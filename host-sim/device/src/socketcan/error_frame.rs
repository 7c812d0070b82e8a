//! Error frames of the kernel, as news of a CAN controller's error state.

use proto_core::engine::BusState;
use socketcan::errors::ControllerProblems;
use socketcan::{CanErrorFrame, EmbeddedFrame};

/// What an error frame says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum News {
    /// The controller's state is this now.
    State(BusState),
    /// The controller was started again after bus-off.
    Restarted,
    /// Nothing of its state.
    Other,
}

/// Decodes an error frame. The worst that it says counts: one frame may tell the state of either
/// direction.
pub(super) fn news(frame: CanErrorFrame) -> News {
    let error = frame.into_error();
    if error.is_bus_off() {
        return News::State(BusState::BusOff);
    }
    if error.is_restarted() {
        return News::Restarted;
    }
    let problems = error.controller().unwrap_or(ControllerProblems::empty());
    let says = |state| problems.intersects(state);
    if says(ControllerProblems::RX_PASSIVE | ControllerProblems::TX_PASSIVE) {
        News::State(BusState::Passive)
    } else if says(ControllerProblems::RX_WARNING | ControllerProblems::TX_WARNING) {
        News::State(BusState::Warning)
    } else if says(ControllerProblems::ACTIVE) {
        News::State(BusState::Active)
    } else {
        News::Other
    }
}

/// The transmit and the receive error counter, if the frame tells them.
pub(super) fn counters(frame: CanErrorFrame) -> Option<(u8, u8)> {
    let &[.., transmit, receive] = frame.data().first_chunk::<8>()?;
    match news(frame) {
        News::Restarted => Some((0, 0)),
        News::State(BusState::BusOff) => None,
        // The flag is as new as Linux 5.19, and the counters were there before.
        News::State(_) => Some((transmit, receive)),
        News::Other => {
            let flagged = frame.error_bits() & libc::CAN_ERR_CNT != 0;
            (flagged || (transmit, receive) != (0, 0)).then_some((transmit, receive))
        }
    }
}

/// Whether the adapter lost frames that it had received.
pub(super) fn is_overflow(frame: CanErrorFrame) -> bool {
    let problems = frame.into_error().controller().unwrap_or(ControllerProblems::empty());
    problems.contains(ControllerProblems::RX_OVERFLOW)
}

/// As people and statistics call it.
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

    fn of(class: u32, controller: i32) -> News {
        let data = [0, u8::try_from(controller).unwrap(), 0, 0, 0, 0, 0, 0];
        news(CanErrorFrame::new_error(class, &data).unwrap())
    }

    #[test]
    fn states_as_drivers_report_them() {
        let controller = libc::CAN_ERR_CRTL | libc::CAN_ERR_CNT;
        for (said, state) in [
            (libc::CAN_ERR_CRTL_RX_WARNING | libc::CAN_ERR_CRTL_TX_WARNING, BusState::Warning),
            (libc::CAN_ERR_CRTL_TX_WARNING, BusState::Warning),
            (libc::CAN_ERR_CRTL_RX_PASSIVE, BusState::Passive),
            (libc::CAN_ERR_CRTL_TX_PASSIVE | libc::CAN_ERR_CRTL_RX_WARNING, BusState::Passive),
            (libc::CAN_ERR_CRTL_ACTIVE, BusState::Active),
        ] {
            assert_eq!(of(controller, said), News::State(state), "{said:#x}");
        }
        assert_eq!(of(libc::CAN_ERR_BUSOFF | libc::CAN_ERR_CNT, 0), News::State(BusState::BusOff));
        assert_eq!(of(libc::CAN_ERR_BUSOFF | controller, 0x40), News::State(BusState::BusOff));
        assert_eq!(of(libc::CAN_ERR_RESTARTED, 0), News::Restarted);
    }

    #[test]
    fn counters_are_the_senders_and_the_receivers() {
        let of = |class: u32, controller: i32, told: [u8; 2]| {
            let data = [0, u8::try_from(controller).unwrap(), 0, 0, 0, 0, told[0], told[1]];
            counters(CanErrorFrame::new_error(class, &data).unwrap())
        };
        let controller = libc::CAN_ERR_CRTL;
        assert_eq!(
            of(controller | libc::CAN_ERR_CNT, libc::CAN_ERR_CRTL_TX_PASSIVE, [128, 3]),
            Some((128, 3))
        );
        // Without the flag they are where it would put them.
        assert_eq!(of(controller, libc::CAN_ERR_CRTL_RX_PASSIVE, [0, 128]), Some((0, 128)));
        assert_eq!(of(controller, libc::CAN_ERR_CRTL_ACTIVE, [0, 0]), Some((0, 0)));
        assert_eq!(of(libc::CAN_ERR_ACK, 0, [8, 0]), Some((8, 0)));
        assert_eq!(of(libc::CAN_ERR_RESTARTED, 0, [0, 0]), Some((0, 0)));
        // Nothing is told.
        assert_eq!(of(libc::CAN_ERR_ACK, 0, [0, 0]), None);
        assert_eq!(of(controller, libc::CAN_ERR_CRTL_RX_OVERFLOW, [0, 0]), None);
        assert_eq!(of(libc::CAN_ERR_BUSOFF, 0, [0, 0]), None);
    }

    #[test]
    fn an_overflow_is_of_what_was_received() {
        let of = |controller: i32| {
            let data = [0, u8::try_from(controller).unwrap(), 0, 0, 0, 0, 0, 0];
            is_overflow(CanErrorFrame::new_error(libc::CAN_ERR_CRTL, &data).unwrap())
        };
        assert!(of(libc::CAN_ERR_CRTL_RX_OVERFLOW));
        assert!(of(libc::CAN_ERR_CRTL_RX_OVERFLOW | libc::CAN_ERR_CRTL_RX_WARNING));
        assert!(!of(libc::CAN_ERR_CRTL_TX_OVERFLOW));
    }

    #[test]
    fn what_says_nothing_of_the_state_changes_none() {
        assert_eq!(of(libc::CAN_ERR_CRTL, libc::CAN_ERR_CRTL_RX_OVERFLOW), News::Other);
        assert_eq!(of(libc::CAN_ERR_CRTL, 0), News::Other);
        assert_eq!(of(libc::CAN_ERR_ACK | libc::CAN_ERR_PROT | libc::CAN_ERR_BUSERROR, 0), News::Other);
        assert_eq!(of(0, 0), News::Other);
    }
}
