//! The command line of `host-sim`: what a person types, and the demo.

pub mod cli;
pub mod demo;
