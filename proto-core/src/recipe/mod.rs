//! Recipes: frames of chosen variables in byte streams, datagrams and CAN frames (docs/wire/recipes.md).
//!
//! In: a recipe part as configured, then received bytes or CAN frames. Out: checked values in the process image, typed
//! values for user-defined recipes, and encoded frames. Does not know ports, time or the owners of variables.
//!
//! A part is checked and compiled once ([`StreamLayout::new`], [`CanLayout::new`]). After that, functions here fail
//! only because of received bytes or a buffer that is too short; none can panic.

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
