//! The command line of `host-sim`, and the demo.

pub mod cli;
pub mod demo;
