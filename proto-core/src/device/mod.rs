//! Frames of field devices, beyond what the controller's own recipes can describe
//! (docs/devices.md): checksums, byte orders, bits, digits.

mod checksum;
mod encoding;
mod framer;

mod layout;
mod order;

pub use checksum::{Algorithm, Crc};
pub use encoding::{Bits, Digits, Encoding, Kind, MAX_DIGITS, Overflow, Unreadable, Width};
pub use framer::{Found, Framer, FramerStats};
pub use layout::{Carrier, Checksum, Element, FrameLayout, LayoutError, Probe};
pub use order::ByteOrder;

pub(crate) use encoding::wrap;
