//! Frames of field devices, beyond what the controller's own recipes can describe (docs/devices.md): checksums, byte
//! orders, bits, digits, texts, and the boundaries between frames.
//!
//! A recipe with such fields is for a field port. This one is a gripper's status, read by Modbus RTU: slave 9, function
//! 3, six bytes, a CRC.
//!
//! ```
//! use proto_core::config::{GatewayConfig, InputField, Port, Recipe};
//! use proto_core::device::{Algorithm, Encoding};
//! use proto_core::engine::{Engine, Input, PortId};
//! use proto_core::time::Instant;
//! use proto_core::wire::scalar::ScalarType::{Byte, Word};
//!
//! let config: GatewayConfig<1, 1, 9, 0, 0> = GatewayConfig::builder()
//!     .controller("192.168.12.138")
//!     .recipe(Recipe::user("gripper").stream_input(
//!         &[],
//!         &[],
//!         &[
//!             InputField::constant(Byte, 9),
//!             InputField::constant(Byte, 3),
//!             InputField::constant(Byte, 6),
//!             // Bit 0 says whether it is active, bits 6 and 7 whether it holds something.
//!             InputField::variable(Encoding::bit(Byte, 0), "WordInputReg[1]"),
//!             InputField::variable(Encoding::bits(Byte, 6..=7).shared(), "WordInputReg[2]"),
//!             InputField::padding(3),
//!             InputField::variable(Encoding::from(Word).big_endian(), "WordInputReg[3]"),
//!             InputField::checksum("crc16-modbus"),
//!         ],
//!     ))
//!     .port(Port::rs485("line", "gripper"))
//!     .build()?;
//! let mut engine = Engine::<1, 0, 16>::new(&config)?;
//! let port = PortId(0);
//! engine.handle(Instant::ZERO, Input::PortUp { port });
//!
//! let mut reply = vec![9, 3, 6, 0x81, 0, 0, 0, 0x01, 0x42];
//! let crc = Algorithm::named("crc16-modbus").ok_or("it is known")?.of([reply.as_slice()]);
//! reply.extend((crc as u16).to_le_bytes());
//! engine.handle(Instant::ZERO, Input::PortBytes { port, bytes: &reply });
//! let var = "WordInputReg[3]".parse()?;
//! assert_eq!(engine.image().value(var).as_f64(), 322.0);
//!
//! // One wrong bit, and nothing of the reply is taken.
//! reply[8] ^= 1;
//! engine.handle(Instant::ZERO, Input::PortBytes { port, bytes: &reply });
//! assert_eq!(engine.image().value(var).as_f64(), 322.0);
//! let counters = engine.port_counters(port).ok_or("it is configured")?;
//! assert_eq!((counters.frames_in, counters.rejected_checksum), (1, 1));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod checksum;
mod cutter;
mod encoding;
mod escape;
mod framer;
mod ignored;
mod layout;
mod order;
mod text;

pub use checksum::{Algorithm, Crc};
pub use cutter::{Boundary, Cutter, Piece};
pub use encoding::{Bits, Digits, Encoding, Kind, MAX_DIGITS, Overflow, Unreadable, Width};
pub use escape::Escape;
pub use framer::{Found, Framer, FramerStats};
pub use ignored::{Ignored, MAX_IGNORED};
pub use layout::{
    Carrier, Checksum, DataId, Element, FrameLayout, LayoutError, MAX_CHECKSUM, MAX_DATA_ID, Part, Place,
    Probe,
};
pub use order::ByteOrder;
pub use text::{Counts, Length, MAX_TEXT, Text, TextWidth};

pub(crate) use encoding::wrap;
