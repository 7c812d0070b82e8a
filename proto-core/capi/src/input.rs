//! A function for each input of the engine.
//!
//! `now_us` is the present in microseconds of the driver's clock, which never goes back. Inputs for a port
//! or a link that the configuration does not have are ignored.

use proto_core::engine::{BusState, Input, LinkId, PortId};
use proto_core::time::Instant;
use proto_core::wire::can::CanFrame as CoreFrame;
use proto_core::wire::can::CanId;

use crate::memory::{bytes, shared, unique};
use crate::{Gateway, Status};

/// A classic CAN frame.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct CanFrame {
    /// Its id of 11 or 29 bits.
    pub id: u32,
    /// Whether the id has 29 bits.
    pub extended: u8,
    /// Whether it is a remote frame, which has no data.
    pub remote: u8,
    /// Data bytes, 0 to 8.
    pub len: u8,
    /// The data; zero after `len`.
    pub data: [u8; 8],
}

impl CanFrame {
    pub(crate) const NONE: Self = Self { id: 0, extended: 0, remote: 0, len: 0, data: [0; 8] };

    fn read(&self) -> Option<CoreFrame> {
        let id = match self.extended {
            0 => CanId::Standard(u16::try_from(self.id).ok()?),
            _ => CanId::Extended(self.id),
        };
        let data = self.data.get(..usize::from(self.len))?;
        match self.remote {
            0 => CoreFrame::new(id, data),
            _ => CoreFrame::remote(id, data.len()),
        }
    }
}

impl From<&CoreFrame> for CanFrame {
    fn from(frame: &CoreFrame) -> Self {
        let (id, extended) = match frame.id() {
            CanId::Standard(id) => (id.into(), 0),
            CanId::Extended(id) => (id, 1),
        };
        let mut data = [0; 8];
        let len = data.iter_mut().zip(frame.data()).map(|(to, from)| *to = *from).count();
        Self { id, extended, remote: frame.is_remote().into(), len: len as u8, data }
    }
}

/// A CAN controller's error state; `rgw_port_bus` takes its number.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CanState {
    /// Error-active, with low error counters.
    Active = 0,
    /// An error counter has reached 96.
    Warning = 1,
    /// Error-passive.
    Passive = 2,
    /// Bus-off: nothing can be sent until the driver recovers it and reports another state.
    BusOff = 3,
}

/// # Safety
/// As for the functions below.
unsafe fn handle(gateway: *mut Gateway, now_us: u64, input: Result<Input<'_>, Status>) -> Status {
    let handle = || {
        // SAFETY: as promised by the caller.
        let gateway = unsafe { unique(gateway) }?;
        gateway.engine.handle(Instant::from_micros(now_us), input?);
        Ok(())
    };
    handle().into()
}

/// Time has passed, and everything that arrived before has been reported: the only input that lets
/// deadlines pass.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_tick(gateway: *mut Gateway, now_us: u64) -> Status {
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, Ok(Input::Tick)) }
}

/// A port's device is there.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_port_up(gateway: *mut Gateway, now_us: u64, port: u8) -> Status {
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, Ok(Input::PortUp { port: PortId(port) })) }
}

/// A port's device is gone; what was handed over is lost, and no `rgw_port_sent` follows for it.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_port_down(gateway: *mut Gateway, now_us: u64, port: u8) -> Status {
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, Ok(Input::PortDown { port: PortId(port) })) }
}

/// Everything that was handed over has left the port.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_port_sent(gateway: *mut Gateway, now_us: u64, port: u8) -> Status {
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, Ok(Input::PortSent { port: PortId(port) })) }
}

/// Bytes from a serial line, in chunks of any size.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `data`
/// points to `len` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_port_bytes(
    gateway: *mut Gateway,
    now_us: u64,
    port: u8,
    data: *const u8,
    len: usize,
) -> Status {
    // SAFETY: as promised by the caller.
    unsafe {
        let input = bytes(data, len).map(|bytes| Input::PortBytes { port: PortId(port), bytes });
        handle(gateway, now_us, input)
    }
}

/// A frame from a CAN bus.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `frame`
/// points to a frame.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_port_can(
    gateway: *mut Gateway,
    now_us: u64,
    port: u8,
    frame: *const CanFrame,
) -> Status {
    // SAFETY: as promised by the caller.
    unsafe {
        let frame = shared(frame).and_then(|frame| frame.read().ok_or(Status::Invalid));
        handle(gateway, now_us, frame.map(|frame| Input::PortCan { port: PortId(port), frame }))
    }
}

/// A CAN controller's error state changed; `state` is one of `rgw_can_state`.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_port_bus(gateway: *mut Gateway, now_us: u64, port: u8, state: u8) -> Status {
    let all = [
        (CanState::Active, BusState::Active),
        (CanState::Warning, BusState::Warning),
        (CanState::Passive, BusState::Passive),
        (CanState::BusOff, BusState::BusOff),
    ];
    let state = all.into_iter().find(|(code, _)| *code as u8 == state).ok_or(Status::Invalid);
    let input = state.map(|(_, state)| Input::PortBus { port: PortId(port), state });
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, input) }
}

/// A link that was to be opened is usable.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_link_up(gateway: *mut Gateway, now_us: u64, link: u8) -> Status {
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, Ok(Input::LinkUp { link: LinkId(link) })) }
}

/// A link could not be opened, or was lost; no `rgw_link_sent` follows for what was handed over to it.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_link_down(gateway: *mut Gateway, now_us: u64, link: u8) -> Status {
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, Ok(Input::LinkDown { link: LinkId(link) })) }
}

/// The transport has taken everything that was handed over, and has room for more.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_link_sent(gateway: *mut Gateway, now_us: u64, link: u8) -> Status {
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, Ok(Input::LinkSent { link: LinkId(link) })) }
}

/// Bytes from a link; of a datagram link one whole datagram a call.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `data`
/// points to `len` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_link_bytes(
    gateway: *mut Gateway,
    now_us: u64,
    link: u8,
    data: *const u8,
    len: usize,
) -> Status {
    // SAFETY: as promised by the caller.
    unsafe {
        let input = bytes(data, len).map(|bytes| Input::LinkBytes { link: LinkId(link), bytes });
        handle(gateway, now_us, input)
    }
}

/// How much of what was handed over to a TCP link, since it came up, the peer's transport has not
/// acknowledged, in bytes. Reported before bytes that arrived, and at least every 20 ms while it changes.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_link_acked(gateway: *mut Gateway, now_us: u64, link: u8, left: u32) -> Status {
    // SAFETY: as promised by the caller.
    unsafe { handle(gateway, now_us, Ok(Input::LinkAcked { link: LinkId(link), left })) }
}
