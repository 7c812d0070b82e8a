//! Counters and states, for a display, a log or an LED.

use proto_core::engine::{self, LinkId, PortId, PortState};
use proto_core::link::{LinkHistory, LinkState};

use crate::memory::{bytes, give, shared};
use crate::{Gateway, Status};

/// Number of the link to port 2000.
pub const RGW_LINK_COMMAND: u8 = 0;
/// Number of the link to port 2001.
pub const RGW_LINK_STATE: u8 = 1;
/// Number of the Modbus link.
pub const RGW_LINK_MODBUS: u8 = 2;
/// Number of the link to the UDP recipe server of the controller.
pub const RGW_LINK_RECIPE_UDP: u8 = 3;
/// Number of the link of port 0, if that is a listening port; the numbers of other ports follow.
pub const RGW_LINK_FIRST_PORT: u8 = 4;
/// Number of the second link to port 2000, for commands that stop the robot. It is the highest number.
pub const RGW_LINK_URGENT: u8 = 12;

// The numbers of the header are the engine's.
const _: () = {
    assert!(LinkId::COMMAND.0 == RGW_LINK_COMMAND);
    assert!(LinkId::STATE.0 == RGW_LINK_STATE);
    assert!(LinkId::MODBUS.0 == RGW_LINK_MODBUS);
    assert!(LinkId::RECIPE_UDP.0 == RGW_LINK_RECIPE_UDP);
    assert!(LinkId::of_port(PortId(0)).0 == RGW_LINK_FIRST_PORT);
    assert!(LinkId::URGENT.0 == RGW_LINK_URGENT);
};

/// Counters of a field port. They wrap after 2^32.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct PortCounters {
    /// Frames accepted.
    pub frames_in: u32,
    /// Bytes received (CAN: data bytes).
    pub bytes_in: u32,
    /// Frames handed over to the driver.
    pub frames_out: u32,
    /// Bytes handed over to the driver (CAN: data bytes).
    pub bytes_out: u32,
    /// Frames rejected for a value that is not finite (D22).
    pub rejected_not_finite: u32,
    /// Frames rejected because a bound value did not fit its variable (D22).
    pub rejected_out_of_range: u32,
    /// CAN frames ignored because the recipe does not have their id (D17).
    pub rejected_id: u32,
    /// CAN frames rejected because their length is not the declared one (D17).
    pub rejected_length: u32,
    /// Remote frames ignored (D17).
    pub rejected_remote: u32,
    /// Frames rejected because their checksum is wrong.
    pub rejected_checksum: u32,
    /// Frames rejected because a field is not a number, such as a letter among digits.
    pub rejected_unreadable: u32,
    /// Frames that are right and of another device: a constant is not ours.
    pub rejected_other_device: u32,
    /// Frames rejected because their alive counter is that of the frame before: the device may be
    /// frozen.
    pub rejected_counter: u32,
    /// Fields of accepted frames of devices that were rejected.
    pub rejected_fields: u32,
    /// Fields of accepted frames that have no value now, as the device says.
    pub fields_without_value: u32,
    /// Frames received on a port whose recipe has no input part.
    pub rejected_no_input: u32,
    /// Frames that began with the head but did not end with the tail (D19).
    pub tail_mismatches: u32,
    /// Bytes dropped while looking for a frame (D19).
    pub resync_bytes: u32,
    /// Bytes of partial frames discarded after silence (D19), and bytes discarded because they waited
    /// while the gateway itself slept.
    pub discarded_bytes: u32,
    /// Chunks of bytes, or CAN frames, discarded because they waited while the gateway itself slept.
    pub asleep: u32,
    /// Accepted frames in which reserved bits were masked (D22).
    pub masked: u32,
    /// Accepted frames whose alive counter is not the next one: frames between are missing.
    pub counter_jumps: u32,
    /// Frames with a text that is ignored, such as that of a scanner that read nothing.
    pub ignored: u32,
    /// Bit values replaced by newer ones because the queue of edges was full.
    pub edges_lost: u32,
    /// Values dropped before they were written: older than the port's timeout, or waiting for a link
    /// that was lost.
    pub values_expired: u32,
    /// Accepted frames with a value that was dropped because its link was down.
    pub undelivered: u32,
    /// Accepted frames with a value that was withheld until its neighbours were read back.
    pub withheld: u32,
    /// Cycles in which no output frame could be sent in time (D20).
    pub skipped_cycles: u32,
    /// Cycles in which no output frame was sent because its sources were stale or unknown.
    pub stale_cycles: u32,
    /// Requests without a good reply, after all repetitions.
    pub unanswered: u32,
    /// Requests that the device refused.
    pub refused: u32,
    /// Times an input frame became overdue.
    pub timeouts: u32,
    /// Times the device was reported gone.
    pub downs: u32,
    /// Times the CAN controller was reported bus-off.
    pub bus_offs: u32,
    /// Commands picked by a value.
    pub commands: u32,
    /// Commands that could not be sent.
    pub commands_dropped: u32,
    /// Values in no entry of their command table.
    pub commands_unknown: u32,
    /// Values in a command table that only set the base.
    pub commands_based: u32,
}

/// Counters of a link. They wrap after 2^32.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct LinkCounters {
    /// Times the link came up.
    pub connects: u32,
    /// Times it was lost after it had been up, whichever side closed it.
    pub losses: u32,
    /// Times it could not be opened.
    pub failed_opens: u32,
    /// Times it was closed because nothing arrived.
    pub silences: u32,
    /// Requests, frames or commands sent.
    pub sent: u32,
    /// Answers, frames or packets accepted.
    pub received: u32,
    /// Bytes received.
    pub bytes_in: u32,
    /// Requests without an answer within the timeout.
    pub timeouts: u32,
    /// Exceptions and failure replies.
    pub refused: u32,
    /// Malformed answers, frames and packets.
    pub malformed: u32,
    /// Received values that were not finite; the variables are unknown until a readable value comes.
    pub unreadable: u32,
    /// Connections reset because the peer's transport had not acknowledged data before its deadline.
    pub unacknowledged: u32,
    /// Bytes dropped while looking for a frame.
    pub resync_bytes: u32,
    /// Time from the newest request to its answer, in microseconds.
    pub round_trip_us: u32,
    /// The longest such time, in microseconds.
    pub round_trip_max_us: u32,
}

/// The counters with these names, under the same names.
macro_rules! copied {
    ($($from:ident: $($counter:ident)+);+) => { Self { $($($counter: $from.$counter,)+)+ } };
}

impl From<&engine::PortCounters> for PortCounters {
    fn from(counters: &engine::PortCounters) -> Self {
        copied! {
            counters: frames_in bytes_in frames_out bytes_out
                rejected_not_finite rejected_out_of_range rejected_id rejected_length rejected_remote
                rejected_checksum rejected_unreadable rejected_other_device rejected_counter
                rejected_fields fields_without_value
                rejected_no_input
                tail_mismatches resync_bytes discarded_bytes asleep masked counter_jumps ignored
                edges_lost values_expired undelivered withheld
                skipped_cycles stale_cycles unanswered refused timeouts downs bus_offs
                commands commands_dropped commands_unknown commands_based
        }
    }
}

impl From<(&LinkHistory, &engine::LinkCounters)> for LinkCounters {
    fn from((history, counters): (&LinkHistory, &engine::LinkCounters)) -> Self {
        copied! {
            history: connects losses failed_opens silences;
            counters: sent received bytes_in timeouts refused malformed unreadable unacknowledged resync_bytes
                round_trip_us round_trip_max_us
        }
    }
}

// All counters have one size: none of the engine's is missing here.
const _: () = {
    assert!(size_of::<PortCounters>() == size_of::<engine::PortCounters>());
    assert!(size_of::<LinkCounters>() == size_of::<LinkHistory>() + size_of::<engine::LinkCounters>());
};

/// Health of a field port.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PortHealth {
    /// Its input frames come in time; a port without an input part only has to be there.
    Working = 0,
    /// An input frame is overdue, or none has come yet.
    Silent = 1,
    /// Its CAN controller is bus-off.
    BusOff = 2,
    /// Its device is gone.
    Gone = 3,
}

/// State of a link.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinkHealth {
    /// Closed; it is opened again later.
    Down = 0,
    /// Opened, not yet up.
    Opening = 1,
    /// Usable.
    Up = 2,
    /// Not opened: the controller takes only one connection; another link carries its traffic.
    Shared = 3,
}

/// A field port.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct PortInfo {
    /// Its counters.
    pub counters: PortCounters,
    /// Its health.
    pub health: PortHealth,
    /// The result of the newest command that its values picked: one of `rgw_reply_code`.
    pub reply_code: u8,
}

/// The result of the newest command that a port's values picked.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReplyCode {
    /// No value has picked a command yet.
    None = 0,
    /// Waiting to be sent, or for the reply.
    Pending = 1,
    /// The controller replied that it succeeded.
    Success = 2,
    /// The controller replied that it failed.
    Fail = 3,
    /// The controller sent another reply.
    Other = 4,
    /// No reply came in time, or the link was lost before it came.
    NoReply = 5,
    /// It was not sent: the link was down, or too many were waiting.
    NotSent = 6,
}

// The numbers of the header are the engine's.
const _: () = {
    use proto_core::engine::ReplyCode as Core;
    assert!(ReplyCode::None as u8 == Core::None as u8);
    assert!(ReplyCode::Pending as u8 == Core::Pending as u8);
    assert!(ReplyCode::Success as u8 == Core::Success as u8);
    assert!(ReplyCode::Fail as u8 == Core::Fail as u8);
    assert!(ReplyCode::Other as u8 == Core::Other as u8);
    assert!(ReplyCode::NoReply as u8 == Core::NoReply as u8);
    assert!(ReplyCode::NotSent as u8 == Core::NotSent as u8);
};

/// A link to the controller.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct LinkInfo {
    /// Its counters.
    pub counters: LinkCounters,
    /// The link's number, such as `RGW_LINK_MODBUS`.
    pub id: u8,
    /// Its state.
    pub health: LinkHealth,
}

/// State and counters of a field port, by its number; `RGW_STATUS_NOT_THERE` if there is no such field port.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `info`
/// points to room for the result.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_port_info(gateway: *const Gateway, port: u8, info: *mut PortInfo) -> Status {
    let ask = || {
        // SAFETY: as promised by the caller.
        let engine = unsafe { &shared(gateway)?.engine };
        let port = PortId(port);
        let counters = engine.port_counters(port).ok_or(Status::NotThere)?.into();
        let health = match engine.port_state(port) {
            Some(PortState::Working) => PortHealth::Working,
            Some(PortState::Silent) => PortHealth::Silent,
            Some(PortState::BusOff) => PortHealth::BusOff,
            _ => PortHealth::Gone,
        };
        let reply_code = engine.reply_code(port).map_or(0, |code| code as u8);
        // SAFETY: as promised by the caller.
        unsafe { give(info, PortInfo { counters, health, reply_code }) }
    };
    ask().into()
}

/// State and counters of the `nth` link, counted from 0; `RGW_STATUS_NOT_THERE` after the last.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `info`
/// points to room for the result.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_link_info(gateway: *const Gateway, nth: usize, info: *mut LinkInfo) -> Status {
    let ask = || {
        // SAFETY: as promised by the caller.
        let engine = unsafe { &shared(gateway)?.engine };
        let link = engine.links().nth(nth).ok_or(Status::NotThere)?;
        let health = match link.state {
            LinkState::Down { .. } => LinkHealth::Down,
            LinkState::Opening { .. } => LinkHealth::Opening,
            LinkState::Up { .. } => LinkHealth::Up,
            LinkState::Shared => LinkHealth::Shared,
        };
        let counters = (link.history, link.counters).into();
        // SAFETY: as promised by the caller.
        unsafe { give(info, LinkInfo { counters, id: link.id.0, health }) }
    };
    ask().into()
}

/// Times the gateway slept: it was not called for more than half a second, and what waited for it was
/// discarded. The number wraps; 0 for a null pointer.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_sleeps(gateway: *const Gateway) -> u32 {
    // SAFETY: as promised by the caller.
    unsafe { shared(gateway) }.map_or(0, |gateway| gateway.engine.sleeps())
}

/// Whether a datagram is a frame of the link's output part. The driver of a listening UDP link asks this
/// before it answers another sender than before. False for null pointers.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `datagram`
/// points to `len` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_is_frame(
    gateway: *const Gateway,
    link: u8,
    datagram: *const u8,
    len: usize,
) -> bool {
    // SAFETY: as promised by the caller.
    match unsafe { (shared(gateway), bytes(datagram, len)) } {
        (Ok(gateway), Ok(datagram)) => gateway.engine.is_frame(LinkId(link), datagram),
        _ => false,
    }
}
