//! The tasks of a driver.

use proto_core::engine::{Endpoint, OUTPUT_BUFFER, Output, Transport as Way};

use crate::memory::{give, unique};
use crate::{CanFrame, Gateway, Status};

/// Bytes of the buffer for `rgw_poll_output`.
pub const RGW_OUTPUT_BUFFER: usize = 512;
const _: () = assert!(RGW_OUTPUT_BUFFER == OUTPUT_BUFFER);

/// `until_us` of a gateway without a configuration: it never has a task.
pub const RGW_NEVER: u64 = u64::MAX;

/// The kinds of tasks of a driver.
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
    /// the buffer are the controller's address or name as configured, without a terminating zero.
    LinkOpen = 3,
    /// Close the link `id` at once, TCP with a reset, and report nothing more of it.
    LinkClose = 4,
    /// Send `len` bytes of the buffer on the link `id` (UDP: one datagram), then `rgw_link_sent`.
    LinkSend = 5,
}

/// The transport of a link, and the side that opens it.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transport {
    /// Connect by TCP.
    Tcp = 0,
    /// Send UDP datagrams and receive the answers.
    Udp = 1,
    /// Listen, and accept one TCP connection.
    TcpListen = 2,
    /// Receive UDP datagrams, and answer the newest sender.
    UdpListen = 3,
}

/// A task of a driver; fields that its kind does not name are zero.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct Task {
    /// When to call `rgw_tick` at the latest, in microseconds of the driver's clock.
    pub until_us: u64,
    /// Number of bytes, from the beginning of the buffer.
    pub len: usize,
    /// A CAN frame.
    pub frame: CanFrame,
    /// TCP or UDP port.
    pub port: u16,
    /// Its kind.
    pub kind: OutputKind,
    /// The port or the link.
    pub id: u8,
    /// How the link is opened.
    pub transport: Transport,
}

impl Task {
    const fn new(kind: OutputKind, id: u8, len: usize) -> Self {
        let (frame, transport) = (CanFrame::NONE, Transport::Tcp);
        Self { until_us: 0, len, frame, port: 0, kind, id, transport }
    }
}

/// The driver's next task. Call it again until the kind is `RGW_TASK_KIND_SLEEP`. The bytes of a task are
/// in `buffer` and stay there until the next call.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `buffer`
/// points to `len` bytes and `task` to room for a task, both elsewhere.
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
        // SAFETY: as promised by the caller; the buffer is long enough.
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
            // The engine has written the host's name to the beginning of the buffer.
            Task { transport, port, ..Task::new(OutputKind::LinkOpen, link.0, to.host.len()) }
        }
        Output::LinkClose { link } => Task::new(OutputKind::LinkClose, link.0, 0),
        Output::LinkSend { link, bytes } => Task::new(OutputKind::LinkSend, link.0, bytes.len()),
        // The engine has no other outputs.
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
