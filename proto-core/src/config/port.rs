//! Ports in the configuration: bus, recipe, times, safe values.
//!
//! Plain data: nothing here is checked.

use core::ops::RangeInclusive;

use heapless::String;

use super::{MAX_ADDRESS, MAX_LISTEN, Name, PortHealth, Span};
use crate::modbus::rtu::Timing;
use crate::time::Duration;

/// One port.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub struct Port {
    /// The name, which `--bind` and `--stats` use.
    pub name: Name,
    /// The bus.
    pub bus: Bus,
    /// Index into [`GatewayConfig::recipes`](super::GatewayConfig::recipes).
    pub recipe: u8,
    /// Cycle in which the output part is sent; at least 4 ms.
    pub cycle: Duration,
    /// After this time without an accepted frame the port's inputs take their safe values. [`Port::NEVER`] for a device
    /// that sends only on events.
    pub timeout: Duration,
    /// The safe values that inputs take after the timeout; inputs without a safe value hold.
    pub on_timeout: Span,
    /// Outputs whose source is older than this are stale.
    pub stale_after: Duration,
    /// The variables that report the port's health to the robot.
    pub health: PortHealth,
    /// Whether inputs have their safe values from the start until the device sends a frame.
    pub safe_at_start: bool,
    /// A recipe that is sent on change is also sent after this time without a change.
    pub refresh: Option<Duration>,
    /// A peer of the recipe's exchanges counts as restarted if it is heard after this time without a frame.
    pub absent: Duration,
}

impl Port {
    /// The timeout of a port that is never overdue: it works from the start, and its values hold. It is a hundred
    /// years, so that sums with it differ from [`Instant::NEVER`](crate::time::Instant::NEVER).
    pub const NEVER: Duration = Duration::from_secs(100 * 365 * 86_400);

    /// The default of [`Self::timeout`].
    pub const TIMEOUT: Duration = Duration::from_millis(100);

    /// The default of [`Self::stale_after`].
    pub const STALE_AFTER: Duration = Duration::from_millis(500);

    /// The default of [`Self::absent`].
    pub const ABSENT: Duration = Duration::from_secs(3);

    /// A port with the defaults of files: a cycle of 4 ms, a timeout of 100 ms, stale after 500 ms; inputs hold, also
    /// at the start.
    pub const fn new(name: Name, bus: Bus, recipe: u8) -> Self {
        Self {
            name,
            bus,
            recipe,
            cycle: MIN_CYCLE,
            timeout: Self::TIMEOUT,
            on_timeout: Span { start: 0, len: 0 },
            stale_after: Self::STALE_AFTER,
            health: PortHealth::NONE,
            safe_at_start: false,
            refresh: None,
            absent: Self::ABSENT,
        }
    }
}

/// The bus of a port.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Bus {
    /// Half-duplex serial line with field devices.
    Rs485(Rs485),
    /// CAN bus with field devices.
    Can {
        /// Bit/s, 10_000..=1_000_000; the default in files is [`Bus::BITRATE`].
        bitrate: u32,
    },
    /// The controller's TCP client connects here: a route to the controller, like the recipe link.
    TcpListen {
        /// Address and port, such as `0.0.0.0:50000`.
        listen: String<MAX_LISTEN>,
    },
    /// The controller's UDP client sends here: a route to the controller, like the recipe link.
    UdpListen {
        /// Address and port.
        listen: String<MAX_LISTEN>,
    },
    /// Field devices, with the gateway as Modbus TCP client on one connection.
    ModbusTcp {
        /// IP address or host name.
        host: String<MAX_ADDRESS>,
        /// TCP port; the default in files is [`Bus::MODBUS_TCP`].
        port: u16,
    },
}

impl Bus {
    /// Default bit rate of a CAN bus, in bit/s.
    pub const BITRATE: u32 = 500_000;
    /// Allowed bit rates of a CAN bus.
    pub const BITRATES: RangeInclusive<u32> = 10_000..=1_000_000;
    /// Default TCP port for Modbus.
    pub const MODBUS_TCP: u16 = 502;

    /// Whether field devices (not the controller) are connected.
    pub const fn is_field(&self) -> bool {
        match self {
            Self::Rs485(_) | Self::Can { .. } | Self::ModbusTcp { .. } => true,
            Self::TcpListen { .. } | Self::UdpListen { .. } => false,
        }
    }

    /// Whether it carries CAN frames, and nodes send whenever the bus is free.
    pub const fn is_can(&self) -> bool {
        match self {
            Self::Can { .. } => true,
            Self::Rs485(_) | Self::ModbusTcp { .. } | Self::TcpListen { .. } | Self::UdpListen { .. } => {
                false
            }
        }
    }

    /// Whether it is an outgoing connection, on which transaction ids tell replies apart.
    pub const fn is_modbus_tcp(&self) -> bool {
        match self {
            Self::ModbusTcp { .. } => true,
            Self::Rs485(_) | Self::Can { .. } | Self::TcpListen { .. } | Self::UdpListen { .. } => false,
        }
    }
}

/// A serial line's settings (D19, D20, D21).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Rs485 {
    /// Bit/s, 1200..=4_000_000.
    pub baud: u32,
    /// Parity bit.
    pub parity: Parity,
    /// 1 or 2.
    pub stop_bits: u8,
    /// A partial frame is discarded after this silence.
    pub idle_gap: Duration,
    /// Minimum silence before a frame is sent.
    pub turnaround: Duration,
    /// Whether sent bytes are also received. Only with a recipe of exchanges.
    pub echo: Echo,
}

/// Whether a line echoes sent bytes, like a 2-wire adapter whose receiver is always on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Echo {
    /// No echo.
    No,
    /// Each sent byte is received.
    Yes,
    /// Learned from an exchange whose reply differs from its request, each time the line is opened. Until then a reply
    /// that equals its request confirms nothing.
    #[default]
    Auto,
}

impl Echo {
    /// The setting, unless it is learned.
    pub(crate) const fn known(self) -> Option<bool> {
        match self {
            Self::No => Some(false),
            Self::Yes => Some(true),
            Self::Auto => None,
        }
    }
}

impl Default for Rs485 {
    /// The defaults of files: 115 200 bit/s, no parity, 1 stop bit, an idle gap of 50 ms, a turnaround of 100 µs, an
    /// echo that is learned.
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl Rs485 {
    /// Allowed bit rates in bit/s.
    pub const BAUD: RangeInclusive<u32> = 1_200..=4_000_000;
    /// Allowed numbers of stop bits.
    pub const STOP_BITS: RangeInclusive<u8> = 1..=2;
    /// The default settings.
    pub const DEFAULT: Self = Self {
        baud: 115_200,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: Duration::from_millis(50),
        turnaround: Duration::from_micros(100),
        echo: Echo::Auto,
    };

    /// Sets the turnaround to the silence of Modbus RTU: 3.5 characters, or 1750 µs above 19 200 bit/s
    /// (docs/wire/modbus-rtu.md section 2). For a master, which knows the length of a reply: the idle gap is unchanged,
    /// because systems and adapters deliver a reply in pieces.
    #[must_use]
    pub fn with_rtu_turnaround(self) -> Self {
        Self { turnaround: self.with_rtu_silence().turnaround, ..self }
    }

    /// Sets idle gap and turnaround to the silence of Modbus RTU. For a slave, which recognises the end of a request
    /// only by silence.
    #[must_use]
    pub fn with_rtu_silence(self) -> Self {
        let silence = Timing::new(self.baud, self.bits_per_character() as u8).silence();
        Self { idle_gap: silence, turnaround: silence, ..self }
    }
}

/// A serial line's parity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Parity {
    /// No parity bit.
    #[default]
    None,
    /// Even parity.
    Even,
    /// Odd parity.
    Odd,
}

/// The shortest cycle of the controller and of ports.
pub const MIN_CYCLE: Duration = Duration::from_millis(4);
