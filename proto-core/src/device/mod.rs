//! Frames of field devices, beyond what the controller's own recipes can describe
//! (docs/devices.md): checksums, byte orders, bits, digits, texts, and
//! what tells one frame from the next.

mod checksum;
mod cutter;
mod encoding;
mod escape;
mod framer;

mod layout;
mod order;
mod text;

pub use checksum::{Algorithm, Crc};
pub use cutter::{Boundary, Cutter, Piece};
pub use encoding::{Bits, Digits, Encoding, Kind, MAX_DIGITS, Overflow, Unreadable, Width};
pub use escape::Escape;
pub use framer::{Found, Framer, FramerStats};
pub use layout::{Carrier, Checksum, Element, FrameLayout, LayoutError, Probe};
pub use order::ByteOrder;
pub use text::{Counts, Length, MAX_TEXT, Text, TextWidth};

pub(crate) use encoding::wrap;
