//! A classic CAN frame and its id.
//!
//! A frame always has an id that fits its kind, and at most [`MAX_CAN_DATA`] bytes of data. A recipe decides which
//! frames are used ([`crate::recipe::CanLayout`]).

use core::fmt;

use embedded_can::Frame;

/// Most data bytes of a classic CAN frame.
pub const MAX_CAN_DATA: usize = 8;

/// A CAN frame's id (D17).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum CanId {
    /// 11 bits.
    Standard(u16),
    /// 29 bits.
    Extended(u32),
}

/// A classic CAN frame: data or remote, standard or extended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CanFrame {
    key: CanKey,
    remote: bool,
    /// The data length code; for a remote frame, the requested length.
    dlc: u8,
    /// Bytes of data; none in a remote frame.
    len: u8,
    data: [u8; MAX_CAN_DATA],
}

/// An id with its kind in one word, for comparison and lookup.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct CanKey(u32);

/// Marks an extended id in a key.
const EXTENDED: u32 = 1 << 31;

impl CanKey {
    /// Not a valid id.
    pub(crate) const NONE: Self = Self(u32::MAX);

    pub(crate) const fn of(id: CanId) -> Self {
        match id {
            CanId::Standard(id) => Self(id as u32),
            CanId::Extended(id) => Self(id | EXTENDED),
        }
    }

    pub(crate) const fn id(self) -> CanId {
        if self.0 & EXTENDED == 0 {
            CanId::Standard(self.0 as u16)
        } else {
            CanId::Extended(self.0 & !EXTENDED)
        }
    }

    pub(crate) const fn number(self) -> u32 {
        self.0
    }
}

impl fmt::Debug for CanKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.id().fmt(f)
    }
}

#[cfg(feature = "defmt")]
impl defmt::Format for CanKey {
    fn format(&self, to: defmt::Formatter<'_>) {
        self.id().format(to);
    }
}

impl CanId {
    /// Whether the number fits its kind: 11 or 29 bits.
    pub const fn is_valid(self) -> bool {
        match self {
            Self::Standard(id) => id <= 0x7FF,
            Self::Extended(id) => id <= 0x1FFF_FFFF,
        }
    }
}

impl fmt::Display for CanId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Standard(id) => write!(f, "{id:#05x}"),
            Self::Extended(id) => write!(f, "{id:#010x} (extended)"),
        }
    }
}

impl From<embedded_can::Id> for CanId {
    fn from(id: embedded_can::Id) -> Self {
        match id {
            embedded_can::Id::Standard(id) => Self::Standard(id.as_raw()),
            embedded_can::Id::Extended(id) => Self::Extended(id.as_raw()),
        }
    }
}

impl CanFrame {
    /// A data frame; `None` if the id is too large for its kind or `data` has more than 8 bytes.
    pub fn new(id: CanId, data: &[u8]) -> Option<Self> {
        let len = data.len() as u8;
        let key = CanKey::of(id);
        let mut frame = Self { key, remote: false, dlc: len, len, data: [0; MAX_CAN_DATA] };
        frame.data.get_mut(..data.len())?.copy_from_slice(data);
        id.is_valid().then_some(frame)
    }

    /// A remote frame that requests `len` bytes; `None` if the id is too large for its kind or `len` is more than 8.
    pub fn remote(id: CanId, len: usize) -> Option<Self> {
        let (key, fits) = (CanKey::of(id), id.is_valid() && len <= MAX_CAN_DATA);
        fits.then_some(Self { key, remote: true, dlc: len as u8, len: 0, data: [0; MAX_CAN_DATA] })
    }

    /// A data frame of `len` bytes written by `fill`. The caller has checked that the id is valid and `len` at most
    /// [`MAX_CAN_DATA`].
    pub(crate) fn filled(id: CanId, len: u8, fill: impl FnOnce(&mut [u8])) -> Self {
        let mut data = [0; MAX_CAN_DATA];
        if let Some(used) = data.get_mut(..usize::from(len)) {
            fill(used);
        }
        Self { key: CanKey::of(id), remote: false, dlc: len, len, data }
    }

    /// A data frame of the first [`MAX_CAN_DATA`] bytes of `bytes`. The caller has checked that the id is valid.
    pub(crate) fn cut(id: CanId, bytes: &[u8]) -> Self {
        Self::filled(id, bytes.len().min(MAX_CAN_DATA) as u8, |data| {
            for (slot, &byte) in data.iter_mut().zip(bytes) {
                *slot = byte;
            }
        })
    }

    /// The frame's id.
    pub const fn id(&self) -> CanId {
        self.key.id()
    }

    pub(crate) const fn key(&self) -> CanKey {
        self.key
    }

    /// Whether it is a remote frame.
    pub const fn is_remote(&self) -> bool {
        self.remote
    }

    /// Number of bytes of data; 0 in a remote frame.
    pub(crate) fn len(&self) -> usize {
        self.len as usize
    }

    /// The data; empty in a remote frame.
    pub fn data(&self) -> &[u8] {
        // `len` never exceeds the maximum, but the compiler does not know this.
        self.data.get(..self.len().min(MAX_CAN_DATA)).unwrap_or(&[])
    }
}

impl Frame for CanFrame {
    fn new(id: impl Into<embedded_can::Id>, data: &[u8]) -> Option<Self> {
        Self::new(id.into().into(), data)
    }

    fn new_remote(id: impl Into<embedded_can::Id>, dlc: usize) -> Option<Self> {
        Self::remote(id.into().into(), dlc)
    }

    fn is_extended(&self) -> bool {
        matches!(CanFrame::id(self), CanId::Extended(_))
    }

    fn is_remote_frame(&self) -> bool {
        self.remote
    }

    fn id(&self) -> embedded_can::Id {
        // The constructors accept only ids that fit, so the fallbacks are never reached.
        match CanFrame::id(self) {
            CanId::Standard(id) => {
                embedded_can::StandardId::new(id).unwrap_or(embedded_can::StandardId::ZERO).into()
            }
            CanId::Extended(id) => {
                embedded_can::ExtendedId::new(id).unwrap_or(embedded_can::ExtendedId::ZERO).into()
            }
        }
    }

    fn dlc(&self) -> usize {
        usize::from(self.dlc)
    }

    fn data(&self) -> &[u8] {
        CanFrame::data(self)
    }
}
