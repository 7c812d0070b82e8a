//! Recipes: frames of chosen variables in byte streams, datagrams and CAN frames
//! (docs/wire/recipes.md).
//!
//! In: a recipe part as configured, then received bytes or CAN frames. Out: checked values in the
//! process image, typed values for user-defined recipes, and encoded frames the other way. Knows
//! nothing of ports, time or who owns a variable.
//!
//! A part is checked and compiled once ([`StreamLayout::new`], [`CanLayout::new`]); after that no
//! function here can fail on anything but the received bytes themselves or a buffer that is too
//! short, and none can panic.

mod can;
mod deframer;
mod delimiter;
mod error;
mod fields;
pub mod model;
mod stream;

pub use can::{CanFrameLayout, CanLayout, CanReject};
pub use deframer::{Deframer, DeframerStats, datagram};
pub use error::{DatagramError, EncodeError, FieldPlace, NoSpace, PartError, ValueError};
pub use fields::{Applied, PlacedField, Values};
pub use stream::StreamLayout;
