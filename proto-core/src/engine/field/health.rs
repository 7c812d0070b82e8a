//! Which output fields and variables show the health of ports, and what a port's health is.

use heapless::Vec;

use super::port::FieldPort;
use super::turns::PeerState;
use crate::config::{MAX_PORTS, PortValue};
use crate::engine::io::{LinkId, PortState};
use crate::engine::values::store::InputFrame;
use crate::image::{GroupId, MAX_EXTRA};
use crate::sysvar::SysVar;
use crate::time::{Duration, Instant};

/// Health is checked for changes to report to the robot at this period; [`PortValue::Alive`] is also reported at once
/// when it becomes 0.
pub(crate) const CHECK_EVERY: Duration = Duration::from_millis(100);
/// Period at which unchanged values are repeated: an unconfirmed write, another master or a restarted controller may
/// have undone them.
pub(crate) const REPEAT_EVERY: Duration = Duration::from_secs(1);

const MOST: usize = MAX_PORTS * PortValue::NAMES.len();

/// A value of health that an output field shows.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shown {
    pub of: Of,
    /// Its place among the image's extra values.
    pub extra: u8,
}

/// The source of a shown value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Of {
    /// The health of the port with this index in the engine.
    Port(u8, PortValue),
    /// Whether the link is up.
    Link(LinkId),
}

/// A variable that shows the health of a port to the robot.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HealthVariable {
    pub port: u8,
    pub value: PortValue,
    pub var: SysVar,
    /// The value with which the variable was last set.
    pub last: Option<u32>,
}

/// What is shown of the health of ports, to devices and to the robot.
#[derive(Debug, Clone)]
pub(crate) struct PortsHealth {
    pub shown: Vec<Shown, MAX_EXTRA>,
    pub variables: Vec<HealthVariable, MOST>,
    /// Whether anything is reported to the robot: health, or outcomes of events.
    pub is_reported: bool,
    /// The group of the variables.
    pub group: GroupId,
    pub report_at: Instant,
    pub repeat_at: Instant,
}

impl PortsHealth {
    pub(crate) const fn new() -> Self {
        let (report_at, repeat_at) = (Instant::ZERO, Instant::ZERO);
        Self {
            shown: Vec::new(),
            variables: Vec::new(),
            is_reported: false,
            group: GroupId(0),
            report_at,
            repeat_at,
        }
    }

    pub(crate) fn clear(&mut self) {
        self.shown.clear();
        self.variables.clear();
        self.is_reported = false;
        self.group = GroupId(0);
        self.report_at = Instant::ZERO;
        self.repeat_at = Instant::ZERO;
    }

    /// Index of the port whose health the variable shows.
    pub(crate) fn owner(&self, var: SysVar) -> Option<u8> {
        self.variables.iter().find(|own| own.var == var).map(|own| own.port)
    }
}

/// Health of the port with this index in the engine.
pub(crate) fn state_of(
    index: usize,
    port: &FieldPort,
    frames: &[InputFrame],
    peers: &[PeerState],
) -> PortState {
    let mut own = frames.iter().filter(|frame| usize::from(frame.port) == index);
    let peers = port.line().map_or(&[][..], |line| line.peers.of(peers));
    port.state(own.any(InputFrame::is_overdue) || peers.iter().any(PeerState::is_away))
}
