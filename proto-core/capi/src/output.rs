//! What a driver has to do.

use proto_core::engine::{Endpoint, OUTPUT_BUFFER, Output, Transport as Way};

use crate::memory::{give, unique};
use crate::{CanFrame, Gateway, Status};

/// Bytes of the buffer for `rgw_poll_output`.
pub const RGW_OUTPUT_BUFFER: usize = 512;
const _: () = assert!(RGW_OUTPUT_BUFFER == OUTPUT_BUFFER);

/// `until_us` of a gateway without a configuration: nothing will ever have to be done.
pub const RGW_NEVER: u64 = u64::MAX;

/// What a driver has to do.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputKind {
    /// Nothing before `until_us`; then `rgw_tick` at the latest.
    Sleep = 0,
    /// Send `len` bytes of the buffer on the serial line `id`, then `rgw_port_sent`.
    PortSend = 1,
    /// Queue `frame` on the CAN bus `id`; `rgw_port_sent` when the queue has become empty.
    PortSendCan = 2,
    /// Open the link `id` by `transport` at `port`, then `rgw_link_up` or `rgw_link_down`. `len` bytes of
    /// the buffer are the controller's address or name as configured, without a zero behind.
    LinkOpen = 3,
    /// Close the link `id` at once and report nothing more of it; of TCP, with a reset.
    LinkClose = 4,
    /// Send `len` bytes of the buffer on the link `id` (by UDP: one datagram), then `rgw_link_sent`.
    LinkSend = 5,
}

/// How a link is opened.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transport {
    /// Connect by TCP.
    Tcp = 0,
    /// Send UDP datagrams, and receive the answers.
    Udp = 1,
    /// Listen, and take one TCP connection.
    TcpListen = 2,
    /// Receive UDP datagrams, and answer whoever sent last.
    UdpListen = 3,
}

/// What a driver has to do; what its kind does not name is zero.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct Task {
    /// When to call `rgw_tick` at the latest, in microseconds of the driver's clock.
    pub until_us: u64,
    /// Bytes of the buffer, from its beginning.
    pub len: usize,
    /// A CAN frame.
    pub frame: CanFrame,
    /// TCP or UDP port.
    pub port: u16,
    /// What to do.
    pub kind: OutputKind,
    /// The port or the link.
    pub id: u8,
    /// How a link is opened.
    pub transport: Transport,
}

impl Task {
    const fn new(kind: OutputKind, id: u8, len: usize) -> Self {
        let (frame, transport) = (CanFrame::NONE, Transport::Tcp);
        Self { until_us: 0, len, frame, port: 0, kind, id, transport }
    }
}

/// What the driver has to do next; called again until it is `RGW_TASK_KIND_SLEEP`. The bytes are in
/// `buffer` and stay there until the next call.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; there are
/// `len` bytes at `buffer` and room at `task`, elsewhere.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_poll_output(
    gateway: *mut Gateway,
    now_us: u64,
    buffer: *mut u8,
    len: usize,
    task: *mut Task,
) -> Status {
    let poll = || {
        if task.is_null() {
            return Err(Status::Null);
        }
        if len < OUTPUT_BUFFER {
            return Err(Status::TooSmall);
        }
        // SAFETY: as promised by the caller; there are that many bytes.
        let (gateway, buffer) = unsafe { (unique(gateway)?, unique(buffer.cast::<[u8; OUTPUT_BUFFER]>())?) };
        let next = next(gateway, now_us, buffer);
        // SAFETY: as promised by the caller.
        unsafe { give(task, next) }
    };
    poll().into()
}

fn next(gateway: &mut Gateway, now_us: u64, buffer: &mut [u8; OUTPUT_BUFFER]) -> Task {
    let now = proto_core::time::Instant::from_micros(now_us);
    match gateway.engine.poll_output(now, buffer) {
        Output::Sleep { until } => Task { until_us: until.as_micros(), ..Task::new(OutputKind::Sleep, 0, 0) },
        Output::PortSend { port, bytes } => Task::new(OutputKind::PortSend, port.0, bytes.len()),
        Output::PortSendCan { port, frame } => {
            Task { frame: (&frame).into(), ..Task::new(OutputKind::PortSendCan, port.0, 0) }
        }
        Output::LinkOpen { link, to } => {
            let (transport, port) = way(to);
            // The engine has put the host where a text of it is wanted: at the buffer's beginning.
            Task { transport, port, ..Task::new(OutputKind::LinkOpen, link.0, to.host.len()) }
        }
        Output::LinkClose { link } => Task::new(OutputKind::LinkClose, link.0, 0),
        Output::LinkSend { link, bytes } => Task::new(OutputKind::LinkSend, link.0, bytes.len()),
        // This library is built with all outputs that its engine has.
        _ => Task::new(OutputKind::Sleep, 0, 0),
    }
}

fn way(to: Endpoint<'_>) -> (Transport, u16) {
    match to.transport {
        Way::Tcp { port } => (Transport::Tcp, port),
        Way::Udp { port } => (Transport::Udp, port),
        Way::TcpListen { local } => (Transport::TcpListen, local.port()),
        Way::UdpListen { local } => (Transport::UdpListen, local.port()),
        _ => (Transport::Udp, 0),
    }
}
