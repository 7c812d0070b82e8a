//! A simulated DUCO CORE controller and the recipe gateway on this host.

pub mod bus;
pub mod cell;
pub mod cli;
pub mod config;
pub mod controller;
pub mod demo;
mod files;
mod out;
pub mod shell;
pub mod soak;
