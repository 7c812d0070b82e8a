//! The board's own address, if it does not use DHCP.

use core::net::Ipv4Addr;

/// A static IPv4 address and its network. Ignored on a host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Network {
    /// The board's address.
    pub address: Ipv4Addr,
    /// Prefix length in bits, 1..=30.
    pub prefix: u8,
    /// The router for packets to other networks.
    pub router: Option<Ipv4Addr>,
    /// The name server that resolves the controller's name.
    pub dns: Option<Ipv4Addr>,
}

/// The source of the board's address. An explicit enum represents DHCP as all zeros, so an empty configuration takes no
/// flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[repr(u8)]
pub enum BoardAddress {
    /// From DHCP.
    #[default]
    Dhcp,
    /// From the configuration.
    Static(Network),
}

impl BoardAddress {
    /// The address in the configuration; `None` with DHCP.
    pub const fn fixed(&self) -> Option<&Network> {
        match self {
            Self::Dhcp => None,
            Self::Static(network) => Some(network),
        }
    }
}

impl From<Option<Network>> for BoardAddress {
    fn from(network: Option<Network>) -> Self {
        network.map_or(Self::Dhcp, Self::Static)
    }
}

impl Network {
    /// Whether an address is in the board's own network.
    pub(super) fn contains(&self, other: Ipv4Addr) -> bool {
        (self.address.to_bits() ^ other.to_bits()) & self.mask() == 0
    }

    fn mask(&self) -> u32 {
        u32::MAX.checked_shl(32_u32.saturating_sub(self.prefix.into())).unwrap_or(0)
    }

    /// Whether the address can be a host's in this network.
    pub(super) fn is_host(&self, address: Ipv4Addr) -> bool {
        let host = address.to_bits() & !self.mask();
        is_unicast(address) && self.contains(address) && host != 0 && host != !self.mask()
    }
}

impl core::fmt::Display for Network {
    /// `192.168.12.20/24`
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}/{}", self.address, self.prefix)
    }
}

pub(super) fn is_unicast(address: Ipv4Addr) -> bool {
    !(address.is_unspecified()
        || address.is_loopback()
        || address.is_multicast()
        || address.octets()[0] == 0
        || address.octets()[0] >= 0xF0)
}
