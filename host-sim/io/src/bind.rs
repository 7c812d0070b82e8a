//! `--bind NAME=DEVICE`: the device that a configured port is bound to.
//!
//! In: text. Out: a [`Bind`], or one error message. Opens nothing and does not know the configuration: the
//! runtimes check that the port exists and can have such a device.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// One `--bind NAME=DEVICE`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bind {
    /// The configured port's name.
    pub port: String,
    /// The device it is bound to.
    pub device: Device,
}

/// A device that a port can be bound to.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Device {
    /// `pty:PATH` or `pty-paced:PATH`: a new pseudoterminal with a link at `link`.
    Pty {
        /// Where the link to the pseudoterminal appears.
        link: PathBuf,
        /// Whether sent bytes appear at the baud rate.
        pace: Pace,
    },
    /// `serial:PATH`: an existing serial device.
    Serial {
        /// The device, such as `/dev/ttyUSB0`.
        path: PathBuf,
    },
    /// `socketcan:INTERFACE`: a CAN interface of the kernel.
    SocketCan {
        /// The interface, such as `vcan0`.
        interface: String,
    },
    /// `slcan-pty:PATH` or `slcan-pty-unpaced:PATH`: a CAN bus in this process, with an slcan client on a
    /// new pseudoterminal.
    SlcanPty {
        /// Where the link to the pseudoterminal appears.
        link: PathBuf,
        /// Whether frames take as long as on a real bus.
        pace: Pace,
    },
    /// `slcan-tcp:HOST:PORT[,PATH]` or `slcan-tcp-unpaced:HOST:PORT[,PATH]`: a CAN bus in this process, whose
    /// slcan clients connect over TCP.
    SlcanTcp {
        /// The address to listen on; port 0 is any free port.
        listen: HostPort,
        /// Where the link to a pseudoterminal for one more client appears.
        link: Option<PathBuf>,
        /// Whether frames take as long as on a real bus.
        pace: Pace,
    },
    /// `tcp:HOST:PORT`: a raw byte stream to a TCP server.
    Tcp {
        /// The server's address.
        to: HostPort,
    },
    /// `tcp-listen:HOST:PORT`, also `tcp:HOST:0`: a raw byte stream of one TCP client at a time.
    TcpListen {
        /// The address to listen on; port 0 is any free port.
        listen: HostPort,
    },
}

/// The speed at which sent data appears.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pace {
    /// At once. On a serial line, the next frame still waits until this frame would have been sent at the baud rate.
    #[default]
    AtOnce,
    /// At the bit rate: byte by byte on a serial line, as a UART delivers them; frame by frame on a CAN bus.
    BitRate,
}

impl Device {
    /// Whether a serial port of the configuration can be bound to the device.
    pub fn is_serial(&self) -> bool {
        !self.is_can()
    }

    /// Whether a CAN port of the configuration can be bound to the device.
    pub fn is_can(&self) -> bool {
        matches!(self, Self::SocketCan { .. } | Self::SlcanPty { .. } | Self::SlcanTcp { .. })
    }
}

/// The forms of `DEVICE`, for messages.
pub const DEVICE_FORMS: &str = "pty:PATH, pty-paced:PATH, serial:PATH, socketcan:INTERFACE, slcan-pty:PATH, \
                                slcan-pty-unpaced:PATH, slcan-tcp:HOST:PORT[,PATH], \
                                slcan-tcp-unpaced:HOST:PORT[,PATH], tcp:HOST:PORT or tcp-listen:HOST:PORT";

impl FromStr for Bind {
    type Err = BindError;

    fn from_str(text: &str) -> Result<Self, BindError> {
        let (port, device) =
            text.split_once('=').ok_or_else(|| BindError::NoEquals { text: text.to_owned() })?;
        if port.is_empty() {
            return Err(BindError::NoName { text: text.to_owned() });
        }
        Ok(Self { port: port.to_owned(), device: device.parse()? })
    }
}

impl FromStr for Device {
    type Err = BindError;

    fn from_str(text: &str) -> Result<Self, BindError> {
        let unknown = || BindError::UnknownDevice { text: text.to_owned() };
        let (kind, rest) = text.split_once(':').ok_or_else(unknown)?;
        let path = || -> Result<PathBuf, BindError> {
            if rest.is_empty() { Err(BindError::Empty { kind: kind.to_owned() }) } else { Ok(rest.into()) }
        };
        let address_in = |text: &str| -> Result<HostPort, BindError> {
            text.parse().map_err(|why| BindError::Address { kind: kind.to_owned(), why })
        };
        let address = || address_in(rest);
        let slcan_tcp = |pace: Pace| -> Result<Self, BindError> {
            let (listen, link) = match rest.split_once(',') {
                Some((_, "")) => return Err(BindError::NoPath { kind: kind.to_owned() }),
                Some((listen, link)) => (listen, Some(link.into())),
                None => (rest, None),
            };
            Ok(Self::SlcanTcp { listen: address_in(listen)?, link, pace })
        };
        Ok(match kind {
            "pty" => Self::Pty { link: path()?, pace: Pace::AtOnce },
            "pty-paced" => Self::Pty { link: path()?, pace: Pace::BitRate },
            "serial" => Self::Serial { path: path()? },
            "socketcan" if rest.is_empty() => return Err(BindError::Empty { kind: kind.to_owned() }),
            "socketcan" => Self::SocketCan { interface: rest.to_owned() },
            "slcan-pty" => Self::SlcanPty { link: path()?, pace: Pace::BitRate },
            "slcan-pty-unpaced" => Self::SlcanPty { link: path()?, pace: Pace::AtOnce },
            "slcan-tcp" => slcan_tcp(Pace::BitRate)?,
            "slcan-tcp-unpaced" => slcan_tcp(Pace::AtOnce)?,
            "tcp" => match address()? {
                listen @ HostPort { port: 0, .. } => Self::TcpListen { listen },
                to => Self::Tcp { to },
            },
            "tcp-listen" => Self::TcpListen { listen: address()? },
            _ => return Err(unknown()),
        })
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pty { link, pace: Pace::AtOnce } => write!(f, "pty:{}", link.display()),
            Self::Pty { link, pace: Pace::BitRate } => write!(f, "pty-paced:{}", link.display()),
            Self::Serial { path } => write!(f, "serial:{}", path.display()),
            Self::SocketCan { interface } => write!(f, "socketcan:{interface}"),
            Self::SlcanPty { link, pace } => write!(f, "slcan-pty{}:{}", unpaced(*pace), link.display()),
            Self::SlcanTcp { listen, link, pace } => {
                write!(f, "slcan-tcp{}:{listen}", unpaced(*pace))?;
                link.as_ref().map_or(Ok(()), |link| write!(f, ",{}", link.display()))
            }
            Self::Tcp { to } => write!(f, "tcp:{to}"),
            Self::TcpListen { listen } => write!(f, "tcp-listen:{listen}"),
        }
    }
}

fn unpaced(pace: Pace) -> &'static str {
    match pace {
        Pace::AtOnce => "-unpaced",
        Pace::BitRate => "",
    }
}

impl fmt::Display for Bind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.port, self.device)
    }
}

/// A host name or address with a port, as `HOST:PORT`, with an IPv6 address in brackets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostPort {
    /// Name or address, without brackets.
    pub host: String,
    /// TCP or UDP port.
    pub port: u16,
}

impl FromStr for HostPort {
    type Err = HostPortError;

    fn from_str(text: &str) -> Result<Self, HostPortError> {
        let (host, port) = text.rsplit_once(':').ok_or(HostPortError::NoPort)?;
        let host = match host.strip_prefix('[') {
            Some(inner) => inner.strip_suffix(']').ok_or(HostPortError::Brackets)?,
            None if host.contains(':') => return Err(HostPortError::Brackets),
            None => host,
        };
        if host.is_empty() {
            return Err(HostPortError::NoHost);
        }
        let port = port.parse().map_err(|_| HostPortError::BadPort)?;
        Ok(Self { host: host.to_owned(), port })
    }
}

impl fmt::Display for HostPort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.host.contains(':') {
            write!(f, "[{}]:{}", self.host, self.port)
        } else {
            write!(f, "{}:{}", self.host, self.port)
        }
    }
}

/// Why a `--bind` was refused.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum BindError {
    /// No `=` between name and device.
    NoEquals {
        /// What was given.
        text: String,
    },
    /// Nothing before the `=`.
    NoName {
        /// What was given.
        text: String,
    },
    /// Not a known form.
    UnknownDevice {
        /// The device as given.
        text: String,
    },
    /// Nothing after the device's colon.
    Empty {
        /// The device's kind.
        kind: String,
    },
    /// Nothing after the comma that follows an address.
    NoPath {
        /// The device's kind.
        kind: String,
    },
    /// The address is malformed.
    Address {
        /// The device's kind.
        kind: String,
        /// What is wrong with it.
        why: HostPortError,
    },
}

impl fmt::Display for BindError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoEquals { text } => {
                write!(f, "`{text}` has no `=`; write NAME=DEVICE, where DEVICE is {DEVICE_FORMS}")
            }
            Self::NoName { text } => write!(f, "`{text}` has no port name before `=`; write NAME=DEVICE"),
            Self::UnknownDevice { text } => {
                let kind = if text.starts_with('/') { "serial" } else { "socketcan" };
                match text.contains([':', ' ']) || text.is_empty() {
                    true => write!(f, "`{text}` is not a device; allowed are {DEVICE_FORMS}"),
                    false => write!(
                        f,
                        "`{text}` is not a device; is `{kind}:{text}` meant? Allowed are {DEVICE_FORMS}"
                    ),
                }
            }
            Self::Empty { kind } => write!(f, "`{kind}:` needs an argument; allowed are {DEVICE_FORMS}"),
            Self::NoPath { kind } => write!(f, "`{kind}:` has no PATH after its comma"),
            Self::Address { kind, why } => write!(f, "`{kind}:` needs HOST:PORT, but {why}"),
        }
    }
}

impl std::error::Error for BindError {}

/// Why a text is not `HOST:PORT`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum HostPortError {
    /// No colon.
    NoPort,
    /// Nothing before the colon.
    NoHost,
    /// The port is not a number of 0..=65535.
    BadPort,
    /// An IPv6 address without brackets, or with only one.
    Brackets,
}

impl fmt::Display for HostPortError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NoPort => "there is no `:PORT`",
            Self::NoHost => "there is no host before the colon",
            Self::BadPort => "the port is not a number from 0 to 65535",
            Self::Brackets => "an IPv6 address needs brackets, as in [::1]:50000",
        })
    }
}

impl std::error::Error for HostPortError {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_form_is_written_as_it_was_read() {
        for text in [
            "rs485-1=pty:run/rs485-1",
            "rs485-1=pty-paced:run/rs485-1",
            "rs485-1=serial:/dev/ttyUSB0",
            "can=socketcan:vcan0",
            "can=slcan-pty:run/can",
            "can=slcan-pty-unpaced:run/can",
            "can=slcan-tcp:127.0.0.1:0",
            "can=slcan-tcp-unpaced:[::1]:0",
            "can=slcan-tcp:127.0.0.1:0,run/can,1",
            "can=slcan-tcp-unpaced:127.0.0.1:3333,run/can",
            "a=tcp:sensor.local:4001",
            "a=tcp-listen:[::1]:0",
            "name=pty:with=sign",
        ] {
            let bind: Bind = text.parse().unwrap();
            assert_eq!(bind.to_string(), text);
            assert_ne!(bind.device.is_can(), bind.device.is_serial());
        }
    }

    #[test]
    fn tcp_to_port_zero_listens() {
        let bind: Bind = "a=tcp:127.0.0.1:0".parse().unwrap();
        let listen = HostPort { host: "127.0.0.1".into(), port: 0 };
        assert_eq!(bind.device, Device::TcpListen { listen });
    }

    #[test]
    fn each_mistake_has_its_own_message() {
        let message = |text: &str| text.parse::<Bind>().unwrap_err().to_string();
        for (text, begins) in [
            ("rs485", "`rs485` has no `=`"),
            ("=pty:x", "`=pty:x` has no port name"),
            ("a=can0", "`can0` is not a device; is `socketcan:can0` meant? Allowed are pty:PATH"),
            ("a=/dev/ttyUSB0", "`/dev/ttyUSB0` is not a device; is `serial:/dev/ttyUSB0` meant?"),
            ("a=", "`` is not a device; allowed are pty:PATH"),
            ("a=usb:x", "`usb:x` is not a device"),
            ("a=pty:", "`pty:` needs an argument"),
            ("a=socketcan:", "`socketcan:` needs an argument"),
            ("a=slcan-tcp:h:1,", "`slcan-tcp:` has no PATH"),
            ("a=slcan-tcp:h,p", "`slcan-tcp:` needs HOST:PORT, but there is no `:PORT`"),
            ("a=tcp:host", "`tcp:` needs HOST:PORT, but there is no `:PORT`"),
            ("a=tcp::5", "`tcp:` needs HOST:PORT, but there is no host"),
            ("a=tcp:h:65536", "`tcp:` needs HOST:PORT, but the port is not a number"),
            ("a=tcp:::1:5", "`tcp:` needs HOST:PORT, but an IPv6 address needs brackets"),
            ("a=tcp:[::1:5", "`tcp:` needs HOST:PORT, but an IPv6 address needs brackets"),
        ] {
            assert!(message(text).starts_with(begins), "{text}: {}", message(text));
        }
    }
}
