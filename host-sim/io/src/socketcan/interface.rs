//! The state of a CAN interface, queried from the kernel by rtnetlink, as `ip -details link show` does.
//!
//! In: an interface's name, or the kernel's answer as bytes. Out: whether it has a carrier, and the bit rate
//! and the error state that its driver knows. Does not know error frames. No privileges are needed.
//!
//! Bus-off needs both carrier and state: some drivers switch the carrier off and report no state; `gs_usb` keeps the
//! carrier and reports the last state of its adapter.

use std::io;

use proto_core::engine::BusState;
use rustix::net::{AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, recv, send, socket_with};

/// An interface, as the kernel sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Interface {
    /// Whether it has a carrier; `true` if the kernel does not say.
    pub(super) has_carrier: bool,
    /// Bit/s; `None` for an interface without a controller, or if the driver does not know it.
    pub(super) bitrate: Option<u32>,
    /// The controller's error state; `None` if there is no controller or the driver does not know it.
    state: Option<BusState>,
}

impl Interface {
    /// Queries the kernel, which answers at once.
    pub(super) fn query(interface: &str) -> io::Result<Self> {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        // Protocol 0 is NETLINK_ROUTE.
        let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
        send(&socket, &request(interface), SendFlags::empty())?;
        let mut answer = [0; MAX_ANSWER];
        let (_, length) = recv(&socket, &mut answer, RecvFlags::empty())?;
        Self::parse(answer.get(..length).unwrap_or(&answer))
            .ok_or_else(|| io::Error::other("not told of the interface"))
    }

    /// As [`Self::query`]; an interface without errors if the query fails.
    pub(super) fn of(interface: &str) -> Self {
        Self::query(interface).unwrap_or(Self { has_carrier: true, bitrate: None, state: None })
    }

    pub(super) fn bus(self) -> BusState {
        if self.has_carrier { self.state.unwrap_or(BusState::Active) } else { BusState::BusOff }
    }

    pub(super) fn is_off(self) -> bool {
        self.bus() == BusState::BusOff
    }

    /// Parses a message of the kernel; `None` if it does not describe an interface.
    fn parse(message: &[u8]) -> Option<Self> {
        let length = usize::try_from(word(message)?).ok()?;
        let kind = half(message.get(4..)?)?;
        if kind != libc::RTM_NEWLINK {
            return None;
        }
        let attributes = message.get(NLMSGHDR + IFINFOMSG..length)?;
        let carrier = find(attributes, libc::IFLA_CARRIER).and_then(<[u8]>::first);
        let info = find(attributes, libc::IFLA_LINKINFO).unwrap_or_default();
        let is_can = find(info, libc::IFLA_INFO_KIND).is_some_and(|kind| kind.starts_with(b"can\0"));
        let data = find(info, libc::IFLA_INFO_DATA).filter(|_| is_can).unwrap_or_default();
        let bitrate = find(data, CAN_BIT_TIMING).and_then(word).filter(|&bitrate| bitrate != 0);
        let state = find(data, CAN_STATE).and_then(word).and_then(|state| match state {
            0 => Some(BusState::Active),
            1 => Some(BusState::Warning),
            2 => Some(BusState::Passive),
            3 => Some(BusState::BusOff),
            // Stopped or sleeping: the interface is down.
            _ => None,
        });
        Some(Self { has_carrier: carrier != Some(&0), bitrate, state })
    }
}

/// An RTM_GETLINK request for the interface with this name.
fn request(interface: &str) -> Vec<u8> {
    let mut bytes = vec![0; NLMSGHDR + IFINFOMSG];
    let value = interface.len() + 1;
    bytes.extend(u16::try_from(RTATTR + value).unwrap_or(u16::MAX).to_ne_bytes());
    bytes.extend(libc::IFLA_IFNAME.to_ne_bytes());
    bytes.extend(interface.as_bytes());
    bytes.push(0);
    bytes.resize(bytes.len().next_multiple_of(RTA_ALIGNTO), 0);
    let length = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
    bytes[..4].copy_from_slice(&length.to_ne_bytes());
    bytes[4..6].copy_from_slice(&libc::RTM_GETLINK.to_ne_bytes());
    bytes[6..8].copy_from_slice(&NLM_F_REQUEST.to_ne_bytes());
    bytes
}

/// The value of the first attribute of this kind.
fn find(mut attributes: &[u8], kind: u16) -> Option<&[u8]> {
    loop {
        let length = usize::from(half(attributes)?);
        let found = half(attributes.get(2..)?)? & !FLAGS;
        let value = attributes.get(RTATTR..length)?;
        if found == kind {
            return Some(value);
        }
        attributes = attributes.get(length.next_multiple_of(RTA_ALIGNTO)..)?;
    }
}

fn half(bytes: &[u8]) -> Option<u16> {
    bytes.first_chunk().map(|bytes| u16::from_ne_bytes(*bytes))
}

fn word(bytes: &[u8]) -> Option<u32> {
    bytes.first_chunk().map(|bytes| u32::from_ne_bytes(*bytes))
}

/// Length of `struct nlmsghdr`: length, kind, flags, and two unused words.
const NLMSGHDR: usize = 16;
/// Length of `struct ifinfomsg`, which is zero in a request.
const IFINFOMSG: usize = 16;
/// Length of `struct rtattr`: length, kind.
const RTATTR: usize = 4;
const RTA_ALIGNTO: usize = 4;
const NLM_F_REQUEST: u16 = 1;
/// In an attribute's kind: nested, network byte order.
const FLAGS: u16 = 0xC000;
/// IFLA_CAN_BITTIMING: a structure that begins with the bit rate.
const CAN_BIT_TIMING: u16 = 1;
const CAN_STATE: u16 = 4;
/// Maximum length of a reply; a reply about an interface has about 2 KiB.
const MAX_ANSWER: usize = 16 * 1_024;

#[cfg(test)]
mod tests {
    use super::*;

    fn attribute(kind: u16, value: &[u8]) -> Vec<u8> {
        let mut bytes = u16::try_from(RTATTR + value.len()).unwrap().to_ne_bytes().to_vec();
        bytes.extend(kind.to_ne_bytes());
        bytes.extend(value);
        bytes.resize(bytes.len().next_multiple_of(RTA_ALIGNTO), 0xA5);
        bytes
    }

    fn answer(kind: u16, attributes: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = vec![0xA5; NLMSGHDR + IFINFOMSG];
        bytes.extend(attributes.concat());
        let length = u32::try_from(bytes.len()).unwrap();
        bytes[..4].copy_from_slice(&length.to_ne_bytes());
        bytes[4..6].copy_from_slice(&kind.to_ne_bytes());
        bytes
    }

    fn can(carrier: u8, kind: &[u8], state: u32) -> Vec<u8> {
        let timing = [500_000_u32.to_ne_bytes(), 7_u32.to_ne_bytes()].concat();
        let data = [attribute(CAN_BIT_TIMING, &timing), attribute(CAN_STATE, &state.to_ne_bytes())].concat();
        let info = [attribute(libc::IFLA_INFO_KIND, kind), attribute(libc::IFLA_INFO_DATA, &data)].concat();
        answer(
            libc::RTM_NEWLINK,
            &[
                attribute(libc::IFLA_IFNAME, b"can0\0"),
                attribute(libc::IFLA_CARRIER, &[carrier]),
                attribute(0x8000 | libc::IFLA_LINKINFO, &info),
            ],
        )
    }

    #[test]
    fn bus_off_is_found_by_carrier_or_state() {
        let bus = |carrier, state| Interface::parse(&can(carrier, b"can\0", state)).unwrap().bus();
        for (state, expected) in
            [BusState::Active, BusState::Warning, BusState::Passive, BusState::BusOff].into_iter().enumerate()
        {
            let state = u32::try_from(state).unwrap();
            assert_eq!((bus(1, state), bus(0, state)), (expected, BusState::BusOff));
        }
        assert_eq!(bus(1, 4), BusState::Active, "stopped");
        assert_eq!(Interface::parse(&can(1, b"can\0", 0)).unwrap().bitrate, Some(500_000));
    }

    #[test]
    fn an_interface_without_a_controller_has_only_its_carrier() {
        let virtual_one = Interface::parse(&can(1, b"vcan\0", 3)).unwrap();
        assert_eq!(virtual_one, Interface { has_carrier: true, bitrate: None, state: None });
        let bare = Interface::parse(&answer(libc::RTM_NEWLINK, &[])).unwrap();
        assert_eq!(bare.bus(), BusState::Active);
    }

    #[test]
    fn a_truncated_answer_or_one_of_another_kind_is_none() {
        let whole = can(1, b"can\0", 3);
        assert_eq!(Interface::parse(&whole).map(Interface::bus), Some(BusState::BusOff));
        for length in 0..whole.len() {
            assert_eq!(Interface::parse(&whole[..length]), None, "{length}");
        }
        assert_eq!(Interface::parse(&answer(2, &[])), None, "an error");
        // An attribute with an impossible length ends the search.
        for length in [0_u16, 3, 200] {
            let mut broken = whole.clone();
            broken[NLMSGHDR + IFINFOMSG..][..2].copy_from_slice(&length.to_ne_bytes());
            assert_eq!(Interface::parse(&broken).map(Interface::bus), Some(BusState::Active), "{length}");
        }
    }

    #[test]
    fn the_kernel_answers() {
        assert_eq!(
            Interface::query("lo").unwrap(),
            Interface { has_carrier: true, bitrate: None, state: None }
        );
        assert!(Interface::query("no-such-one").is_err());
        assert!(Interface::query(&"x".repeat(70_000)).is_err());
    }
}
