//! Whole cells in virtual time: the worked examples, what can go wrong on each side, and soaks.

mod controller_faults;
mod examples;
mod field_faults;
mod kit;
mod robot;
mod soak;
mod trouble;
