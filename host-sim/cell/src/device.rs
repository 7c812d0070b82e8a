//! Devices at the far end of a line or bus.

use proto_core::time::{Duration, Instant};

/// A device: `M` is `Vec<u8>` on an RS-485 line and a CAN frame on a bus.
///
/// Returned messages are sent in order, each as soon as the device's previous message was sent.
pub trait Device<M> {
    /// A message arrived: a chunk of bytes as the line delivers it, or a CAN frame.
    fn receive(&mut self, now: Instant, message: &M) -> Vec<M> {
        let _ = (now, message);
        Vec::new()
    }

    /// When to call [`Self::poll`]. Only [`Self::poll`] and [`Self::receive`] change it.
    fn deadline(&self) -> Instant {
        Instant::NEVER
    }

    /// The deadline has come; the next one must be later than `now`.
    fn poll(&mut self, now: Instant) -> Vec<M> {
        let _ = now;
        Vec::new()
    }

    /// What the devices that answer requests did since the last call, in order. The model compares the gateway's values
    /// with it.
    fn take_done(&mut self) -> Vec<SlaveDone> {
        Vec::new()
    }
}

/// A device that is a TCP server, such as a Modbus TCP server. It has one connection at a time: a new connection
/// replaces the previous one.
pub trait Server {
    /// A connection was opened.
    fn opened(&mut self, now: Instant);

    /// The connection is gone; data that was not sent yet is lost.
    fn closed(&mut self, now: Instant);

    /// Bytes arrived on the connection, in pieces of any size.
    fn receive(&mut self, now: Instant, bytes: &[u8]);

    /// When to call [`Self::poll`].
    fn deadline(&self) -> Instant;

    /// The deadline has come; the next one must be later than `now`.
    fn poll(&mut self, now: Instant) -> Vec<Served>;

    /// What the device did since the last call, in order.
    fn take_done(&mut self) -> Vec<SlaveDone>;
}

/// An entry in a device's own log of what it did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Act {
    /// The device received a complete request: an order, or a query (`None`).
    Heard(Option<Order>),
    /// The device executed an order with these values.
    Did(Order, Vec<u32>),
    /// The device refused an order with a code.
    Refused(Order, u8),
    /// A reply was sent, or was not sent although it was due.
    Replied {
        /// The order that is replied to, if it is a reply to an order.
        order: Option<Order>,
        /// The reply differs from the request, so it cannot be taken for an echo.
        tells: bool,
        /// The reply was sent without changes.
        is_whole: bool,
        /// The reply also certainly arrived at the gateway in time.
        in_time: bool,
    },
    /// The gateway received something from the device that is no reply to the request. It may or may not count as a
    /// sign that the device is up.
    Garbled,
    /// From now on, the value with this number is this.
    Holds(usize, u16),
    /// The device lost its power, and with it everything it was told.
    PowerOff,
    /// The device has power again.
    PowerOn,
}

/// What a device can be ordered to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Order {
    /// Move: an event.
    Move,
    /// The second step of an exchange that began with [`Self::Move`].
    Step,
    /// Stop.
    Stop,
    /// What is sent at the start of the device and also makes it move: homing, a mode.
    Start,
    /// A value that the device stores.
    Keep,
}

/// An action of a TCP server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Served {
    /// Sends bytes. The act is logged once the last of them has arrived.
    Bytes(Vec<u8>, Option<Act>),
    /// Closes the connection, in both directions.
    Close,
    /// Sends nothing more on the connection, but still receives.
    HalfClose,
    /// Resets the connection.
    Reset,
    /// Loses power: the connection is gone, and no end is told.
    PowerOff,
    /// Has power again.
    PowerOn,
}

/// An action of a device that answers requests: a slave on a Modbus line, or a peer with frames of its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SlaveDone {
    /// Address or number of the device.
    pub slave: u8,
    /// The action.
    pub what: Done,
}

/// An action of a slave.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Done {
    /// The slave made a reply, which may be changed or lost before it is sent.
    Answered {
        /// The first register or coil that was read or written.
        address: u16,
        /// The number of registers or coils.
        count: u16,
        /// The whole frame.
        reply: Vec<u8>,
    },
    /// The slave accepted values, from a request to itself or a broadcast.
    Wrote {
        /// Whether they are coils; otherwise they are holding registers.
        coils: bool,
        /// The first register or coil.
        address: u16,
        /// The registers, or 0 and 1 for coils.
        values: Vec<u16>,
    },
    /// The peer made a frame of its own, which may be changed or lost before it is sent: a reply, or an unsolicited
    /// frame.
    Replied {
        /// The exchange, counted from 0 on the port.
        exchange: usize,
        /// The whole frame.
        frame: Vec<u8>,
    },
    /// The peer accepted a request with a frame of its own.
    Took {
        /// The exchange, counted from 0 on the port.
        exchange: usize,
        /// The whole frame.
        request: Vec<u8>,
    },
    /// The slave lost its power, and with it everything that was written.
    Forgot,
    /// An entry in the log of the device in a judged cell.
    Acted(Act),
}

/// Sends at a rate: the n-th message is `make(n)` and leaves at `start + n * 1 s / rate`, rounded down
/// to the microsecond. No rounding errors accumulate.
#[derive(Debug, Clone)]
pub struct PeriodicSender<F> {
    start: Instant,
    per_second: u64,
    sent: u64,
    count: u64,
    make: F,
}

impl<F> PeriodicSender<F> {
    /// `per_second` messages per second from `start` on, `count` in total.
    ///
    /// The rate must be from 1 to 1 000 000.
    pub fn new(start: Instant, per_second: u64, count: u64, make: F) -> Self {
        assert!((1..=1_000_000).contains(&per_second), "{per_second} messages a second");
        Self { start, per_second, sent: 0, count, make }
    }
}

impl<M, F: FnMut(u64) -> M> Device<M> for PeriodicSender<F> {
    fn deadline(&self) -> Instant {
        if self.sent >= self.count {
            return Instant::NEVER;
        }
        let micros = u128::from(self.sent) * 1_000_000 / u128::from(self.per_second);
        self.start + Duration::from_micros(u64::try_from(micros).unwrap_or(u64::MAX))
    }

    fn poll(&mut self, now: Instant) -> Vec<M> {
        let mut messages = Vec::new();
        while Device::<M>::deadline(self) <= now {
            messages.push((self.make)(self.sent));
            self.sent += 1;
        }
        messages
    }
}

/// Answers what it receives.
#[derive(Debug, Clone)]
pub struct Responder<F>(pub F);

impl<M, F: FnMut(Instant, &M) -> Vec<M>> Device<M> for Responder<F> {
    fn receive(&mut self, now: Instant, message: &M) -> Vec<M> {
        (self.0)(now, message)
    }
}
