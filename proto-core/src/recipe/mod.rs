//! Recipes: frames of chosen variables in byte streams, datagrams and CAN frames.

pub mod model;
