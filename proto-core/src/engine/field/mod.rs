//! Field ports: frames in, frames out, and exchanges with devices.

pub(crate) mod bindings;
pub(crate) mod codec;
pub(crate) mod device;
pub(crate) mod device_frame;
pub(crate) mod event;
pub(crate) mod events;
pub(crate) mod exchange;
pub(crate) mod exchanges;
pub(crate) mod format;
pub(crate) mod frames;
pub(crate) mod health;
pub(crate) mod line;
pub(crate) mod line_timing;
pub(crate) mod modbus_tcp;
pub(crate) mod outgoing;
pub(crate) mod output;
pub(crate) mod peer_counters;
pub(crate) mod pending;
pub(crate) mod port;
pub(crate) mod requests;
pub(crate) mod rules;
pub(crate) mod sender;
pub(crate) mod served;
pub(crate) mod texts;
pub(crate) mod turns;
