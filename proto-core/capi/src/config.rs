//! Configurations: reading an image, and what a driver has to set up.

use core::ffi::c_void;

use proto_core::config::{Bus, GatewayConfig, Parity, image};

use crate::Status;
use crate::memory::{bytes, give, place, shared};

/// Newest version of the configuration images that this library reads. Older versions are read too.
pub const RGW_IMAGE_VERSION: u32 = 4;
const _: () = assert!(RGW_IMAGE_VERSION == image::VERSION);

/// Memory for a configuration, in bytes: enough on every machine. It is needed until
/// `rgw_gateway_configure` has returned.
pub const RGW_CONFIG_SIZE: usize = 22_528;
const _: () = assert!(size_of::<Config>() <= RGW_CONFIG_SIZE);

/// Maximum number of exchanges with devices of all ports together.
pub const RGW_MAX_EXCHANGES: usize = 16;

/// A configuration in the caller's memory: at most 6 ports, 6 recipes with 256 fields together, 32
/// commands, 32 safe values and 16 exchanges.
#[derive(Debug)]
pub struct Config(pub(crate) GatewayConfig<6, 6, 256, 32, 32, RGW_MAX_EXCHANGES>);

/// The bus of a port.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PortKind {
    /// A half-duplex serial line.
    Rs485 = 0,
    /// A CAN bus.
    Can = 1,
    /// A TCP port that the controller connects to: a link, not a field port.
    TcpListen = 2,
    /// A UDP port that the controller sends to: a link, not a field port.
    UdpListen = 3,
    /// Devices of Modbus TCP: a field port that has a link and no device of its own.
    ModbusTcp = 4,
}

/// A serial line's parity.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineParity {
    /// No parity bit.
    None = 0,
    /// Even.
    Even = 1,
    /// Odd.
    Odd = 2,
}

/// What a driver sets up for a port.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct PortSettings {
    /// Its bus.
    pub kind: PortKind,
    /// Parity of a serial line.
    pub parity: LineParity,
    /// Stop bits of a serial line, 1 or 2; 0 on other buses.
    pub stop_bits: u8,
    /// Bit/s of a serial line or a CAN bus; 0 on other buses.
    pub bit_rate: u32,
}

/// The board's own address, and its network.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct NetworkSettings {
    /// The address.
    pub address: [u8; 4],
    /// The router; 0.0.0.0 if there is none.
    pub router: [u8; 4],
    /// The name server; 0.0.0.0 if there is none.
    pub dns: [u8; 4],
    /// Prefix length of the network in bits, 1 to 30.
    pub prefix: u8,
}

/// Size of a configuration on this machine, in bytes; at most `RGW_CONFIG_SIZE`.
#[unsafe(no_mangle)]
pub extern "C" fn rgw_config_size() -> usize {
    size_of::<Config>()
}

/// The version of an image, whether this library can read it or not.
///
/// # Safety
/// `image` points to `len` bytes, and `version` to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_image_version(image: *const u8, len: usize, version: *mut u32) -> Status {
    // SAFETY: as promised by the caller.
    let image = match unsafe { bytes(image, len) } {
        Ok(image) => image,
        Err(status) => return status,
    };
    let found = match image::image_len(image) {
        Err(image::ImageError::Version { found }) => found,
        Err(error) => return error.into(),
        // The header is there; the version is its second word.
        Ok(_) => image.as_chunks().0.get(1).map_or(RGW_IMAGE_VERSION, |word| u32::from_le_bytes(*word)),
    };
    // SAFETY: as promised by the caller.
    unsafe { give(version, found) }.into()
}

/// Reads an image into `memory`, checks the configuration in it, and sets `*config` to it. If it is
/// refused, `*config` is not set and the memory is free again.
///
/// # Safety
/// `memory` points to `len` bytes that nothing else uses as long as the configuration is in use; `image`
/// points to `image_len` bytes elsewhere, and `config` to room for a pointer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_config_read(
    memory: *mut c_void,
    len: usize,
    image: *const u8,
    image_len: usize,
    config: *mut *mut Config,
) -> Status {
    let read = || {
        let place = place::<Config>(memory, len)?;
        // SAFETY: as promised by the caller.
        let image = unsafe { bytes(image, image_len) }?;
        // SAFETY: there is room, it is aligned, and nothing else uses it.
        let read = unsafe {
            place.write(const { Config(GatewayConfig::empty()) });
            &mut *place.as_ptr()
        };
        image::decode_into(image, &mut read.0)?;
        // SAFETY: as promised by the caller.
        unsafe { give(config, place.as_ptr()) }
    };
    read().into()
}

/// Number of ports of a configuration, field ports and others; 0 for a null pointer.
///
/// # Safety
/// `config` is from `rgw_config_read`, and its memory has not been used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_config_ports(config: *const Config) -> usize {
    // SAFETY: as promised by the caller.
    unsafe { shared(config) }.map_or(0, |config| config.0.ports.len())
}

/// What a driver sets up for the port with this number, counted from 0.
///
/// # Safety
/// `config` is from `rgw_config_read`, and its memory has not been used for anything else; `settings`
/// points to room for the result.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_config_port(
    config: *const Config,
    port: u8,
    settings: *mut PortSettings,
) -> Status {
    let read = || {
        // SAFETY: as promised by the caller.
        let config = unsafe { shared(config) }?;
        let port = config.0.ports.get(usize::from(port)).ok_or(Status::NotThere)?;
        let other = |kind| PortSettings { kind, parity: LineParity::None, stop_bits: 0, bit_rate: 0 };
        let found = match &port.bus {
            Bus::Rs485(line) => PortSettings {
                kind: PortKind::Rs485,
                parity: match line.parity {
                    Parity::None => LineParity::None,
                    Parity::Even => LineParity::Even,
                    Parity::Odd => LineParity::Odd,
                },
                stop_bits: line.stop_bits,
                bit_rate: line.baud,
            },
            Bus::Can { bitrate } => PortSettings { bit_rate: *bitrate, ..other(PortKind::Can) },
            Bus::ModbusTcp { .. } => other(PortKind::ModbusTcp),
            Bus::TcpListen { .. } => other(PortKind::TcpListen),
            Bus::UdpListen { .. } => other(PortKind::UdpListen),
        };
        // SAFETY: as promised by the caller.
        unsafe { give(settings, found) }
    };
    read().into()
}

/// The board's own address; `RGW_STATUS_NOT_THERE` if it comes from DHCP.
///
/// # Safety
/// `config` is from `rgw_config_read`, and its memory has not been used for anything else; `settings`
/// points to room for the result.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_config_network(config: *const Config, settings: *mut NetworkSettings) -> Status {
    let read = || {
        // SAFETY: as promised by the caller.
        let config = unsafe { shared(config) }?;
        let network = config.0.network.fixed().ok_or(Status::NotThere)?;
        let found = NetworkSettings {
            address: network.address.octets(),
            router: network.router.map_or([0; 4], |router| router.octets()),
            dns: network.dns.map_or([0; 4], |dns| dns.octets()),
            prefix: network.prefix,
        };
        // SAFETY: as promised by the caller.
        unsafe { give(settings, found) }
    };
    read().into()
}
