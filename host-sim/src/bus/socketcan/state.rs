//! Error frames of the kernel, as news of a CAN controller's error state.

use proto_core::engine::BusState;
use socketcan::CanErrorFrame;
use socketcan::errors::ControllerProblems;

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
    fn what_says_nothing_of_the_state_changes_none() {
        assert_eq!(of(libc::CAN_ERR_CRTL, libc::CAN_ERR_CRTL_RX_OVERFLOW), News::Other);
        assert_eq!(of(libc::CAN_ERR_CRTL, 0), News::Other);
        assert_eq!(of(libc::CAN_ERR_ACK | libc::CAN_ERR_PROT | libc::CAN_ERR_BUSERROR, 0), News::Other);
        assert_eq!(of(0, 0), News::Other);
    }
}
