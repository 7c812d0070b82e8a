//! Modbus RTU in virtual time: a master and slaves on one line, with what goes wrong on real ones.

mod faults;
mod line;
mod periods;
mod properties;
mod stray;
