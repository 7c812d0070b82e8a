//! A Modbus RTU slave in virtual time, with what goes wrong on real lines.

mod bank;
mod properties;
mod stray;
