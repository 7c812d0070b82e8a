//! Rules for single values, and the errors for them.
//!
//! In: a name, a number, a range. Out: nothing, or an error. The reader of files and
//! [`ConfigView::validate`](super::ConfigView::validate) use the same functions.

use core::net::Ipv4Addr;

use heapless::String;

use super::error::{ConfigError, ConfigErrorKind as Kind, Counted, NetworkKey, Place, PortKey};
use super::listen::ipv6;
use super::network::is_unicast;
use super::port::MIN_CYCLE;
use super::{Bus, MAX_ADDRESS, MAX_NAME, Name, Network, Rs485, Span};
use crate::sysvar::{COUNT, SysVar, VarBit};
use crate::time::Duration;

/// Maximum cycle, timeout or staleness.
pub const MAX_TIME: Duration = Duration::from_secs(3_600);
/// Maximum time in which an event may be sent.
pub const LONGEST_TRIGGER: Duration = Duration::from_secs(10);
/// Maximum idle gap and turnaround of a serial line.
pub const MAX_LINE_TIME: Duration = Duration::from_secs(1);

pub(super) type Check = Result<(), ConfigError>;

impl Rs485 {
    /// Checks that the settings are within their ranges (D21).
    ///
    /// # Errors
    /// The key and the error.
    pub fn check(&self) -> Result<(), (PortKey, Kind)> {
        if !Self::BAUD.contains(&self.baud) {
            return Err((PortKey::Baud, Kind::BaudOutOfRange { baud: self.baud }));
        }
        if !Self::STOP_BITS.contains(&self.stop_bits) {
            return Err((PortKey::StopBits, Kind::StopBits { stop_bits: self.stop_bits }));
        }
        if self.idle_gap == Duration::ZERO {
            return Err((PortKey::IdleGap, Kind::ZeroTime));
        }
        for (key, time) in [(PortKey::IdleGap, self.idle_gap), (PortKey::Turnaround, self.turnaround)] {
            if time > MAX_LINE_TIME {
                return Err((key, Kind::TimeTooLong { time, longest: MAX_LINE_TIME }));
            }
        }
        Ok(())
    }
}

impl Network {
    /// Checks the network; `controller` is an address or a name.
    pub(super) fn check(&self, controller: &str) -> Result<(), (NetworkKey, Kind)> {
        if !(1..=30).contains(&self.prefix) {
            return Err((NetworkKey::Address, Kind::Prefix { prefix: self.prefix }));
        }
        let network = *self;
        if !self.is_host(self.address) {
            return Err((NetworkKey::Address, Kind::NoHostAddress { address: self.address, network }));
        }
        if let Some(router) = self.router {
            if !self.is_host(router) {
                return Err((NetworkKey::Router, Kind::NoHostAddress { address: router, network }));
            }
            self.check_other(NetworkKey::Router, router)?;
        }
        let is_reachable = |address| self.contains(address) || self.router.is_some();
        if let Some(dns) = self.dns {
            if !is_unicast(dns) {
                return Err((NetworkKey::Dns, Kind::NoHostAddress { address: dns, network }));
            }
            self.check_other(NetworkKey::Dns, dns)?;
            if !is_reachable(dns) {
                return Err((NetworkKey::Dns, Kind::NeedsRouter { address: dns, network }));
            }
        }
        match controller.parse::<Ipv4Addr>() {
            Ok(address) if !is_reachable(address) => {
                Err((NetworkKey::Address, Kind::NeedsRouter { address, network }))
            }
            Err(_) if self.dns.is_none() && !controller.is_empty() => {
                Err((NetworkKey::Address, Kind::NeedsDns))
            }
            _ => Ok(()),
        }
    }

    fn check_other(&self, key: NetworkKey, address: Ipv4Addr) -> Result<(), (NetworkKey, Kind)> {
        if address == self.address { Err((key, Kind::OwnAddress)) } else { Ok(()) }
    }
}

/// Checks that the variable has the bit; returns the mask of the bit.
///
/// # Errors
/// [`ConfigErrorKind::HasNoBits`](Kind::HasNoBits) or [`ConfigErrorKind::NoSuchBit`](Kind::NoSuchBit).
pub fn check_bit(bit: VarBit) -> Result<u8, Kind> {
    let VarBit { var, bit: nth } = bit;
    match bit.mask() {
        Some(mask) => Ok(mask),
        None if var.is_bits() => Err(Kind::NoSuchBit { var, bit: nth }),
        None => Err(Kind::HasNoBits { var }),
    }
}

/// Checks a bit that triggers.
pub(super) fn check_trigger(place: Place, var: SysVar, bit: u8) -> Check {
    if !var.is_bits() {
        return fail(place, Kind::NotBits { var });
    }
    let is_there = 1_u8.checked_shl(bit.into()).is_some_and(|mask| var.valid_bits() & mask != 0);
    if is_there { Ok(()) } else { fail(place, Kind::NoSuchBit { var, bit }) }
}

/// Checks that a CAN bus can run at `bitrate` bit/s (D21).
///
/// # Errors
/// [`ConfigErrorKind::BitrateOutOfRange`](Kind::BitrateOutOfRange).
pub fn check_bitrate(bitrate: u32) -> Result<(), Kind> {
    if Bus::BITRATES.contains(&bitrate) { Ok(()) } else { Err(Kind::BitrateOutOfRange { bitrate }) }
}

/// Checks the cycle of a port: from 4 ms, the controller's fastest, to an hour.
///
/// # Errors
/// [`ConfigErrorKind::CycleTooShort`](Kind::CycleTooShort) or [`ConfigErrorKind::TimeTooLong`](Kind::TimeTooLong).
pub fn check_cycle(cycle: Duration) -> Result<(), Kind> {
    match cycle {
        _ if cycle < MIN_CYCLE => Err(Kind::CycleTooShort { cycle }),
        _ if cycle > MAX_TIME => Err(Kind::TimeTooLong { time: cycle, longest: MAX_TIME }),
        _ => Ok(()),
    }
}

pub(super) fn fail(place: Place, kind: Kind) -> Check {
    Err(ConfigError { place, kind })
}

/// Checks the name of a recipe or port: 1..=32 bytes without spaces, quotes, `=` and control
/// characters, so that a command line can carry it.
///
/// # Errors
/// [`ConfigErrorKind::NameLength`](Kind::NameLength) or [`ConfigErrorKind::NameCharacter`](Kind::NameCharacter).
pub fn check_name(name: &str) -> Result<(), Kind> {
    if name.is_empty() || name.len() > MAX_NAME {
        return Err(Kind::NameLength { len: name.len() });
    }
    let is_refused = |c: &char| *c == '=' || *c == '"' || c.is_whitespace() || c.is_control();
    match name.chars().find(is_refused) {
        Some(character) => Err(Kind::NameCharacter { character }),
        None => Ok(()),
    }
}

/// Checks the controller's address: an IP address without a port, or a host name of letters,
/// digits, `.`, `-` and `_`; at most 64 bytes.
///
/// # Errors
/// [`ConfigErrorKind::Address`](Kind::Address), or [`ConfigErrorKind::TooLong`](Kind::TooLong).
pub fn check_address(address: &str) -> Result<(), Kind> {
    let is_name_byte = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-' | b'_');
    if address.is_empty() || !(address.bytes().all(is_name_byte) || ipv6(address).is_some()) {
        return Err(Kind::Address);
    }
    if address.len() > MAX_ADDRESS {
        return Err(Kind::TooLong { len: address.len(), longest: MAX_ADDRESS });
    }
    Ok(())
}

/// Checks a name, which no earlier recipe or port may have.
pub(super) fn check_new_name<'a>(
    place: Place,
    name: &str,
    index: u8,
    all: impl Iterator<Item = &'a Name>,
) -> Check {
    check_name(name).map_err(|kind| ConfigError { place, kind })?;
    match (0..index).zip(all).find(|(_, before)| *before == name) {
        Some((other, _)) => fail(place, Kind::DuplicateName { other }),
        None => Ok(()),
    }
}

pub(super) fn check_pool(place: Place, span: Span, len: usize) -> Check {
    let end = u32::from(span.start).saturating_add(u32::from(span.len));
    let len = len as u32;
    if end <= len { Ok(()) } else { fail(place, Kind::OutsidePool { end, len }) }
}

pub(super) fn text<const N: usize>(given: &str) -> Result<String<N>, Kind> {
    String::try_from(given).map_err(|_| Kind::TooLong { len: given.len(), longest: N })
}

pub(super) fn check_time(place: Place, time: Duration, longest: Duration) -> Check {
    if time == Duration::ZERO {
        return fail(place, Kind::ZeroTime);
    }
    if time > longest {
        return fail(place, Kind::TimeTooLong { time, longest });
    }
    Ok(())
}

pub(super) fn mark(set: &mut [bool; COUNT], var: SysVar) {
    if let Some(place) = set.get_mut(var.ordinal()) {
        *place = true;
    }
}

pub(super) fn is_marked(set: &[bool; COUNT], var: SysVar) -> bool {
    set.get(var.ordinal()).copied().unwrap_or(false)
}

/// Checks that this many entries fit.
pub(super) fn check_room(place: Place, what: Counted, needed: usize, room: usize) -> Check {
    if needed <= room { Ok(()) } else { fail(place, Kind::TooMany { what, needed, room }) }
}
