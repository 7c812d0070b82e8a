//! Links to the controller, and Modbus TCP connections to devices.

pub(crate) mod command;
pub(crate) mod command_tables;
pub(crate) mod connection;
pub(crate) mod device;
pub(crate) mod dropped;
pub(crate) mod failed;
pub(crate) mod flight;
pub(crate) mod links;
pub(crate) mod modbus;
pub(crate) mod other_text;
pub(crate) mod outcome;
pub(crate) mod recipe;
pub(crate) mod session;
pub(crate) mod state;
pub(crate) mod stops;
