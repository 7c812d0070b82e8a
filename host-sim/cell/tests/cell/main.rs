//! Whole cells in virtual time: the worked examples, faults on each side, random faults, and soak runs.

mod commands;
mod controller_faults;
mod examples;
mod field_faults;
mod kit;
mod modbus_tcp;
mod random_faults;
mod robot;
mod soak;
mod sources;
mod templates;
