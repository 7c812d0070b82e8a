//! The API of docs/api.md: real processes, real sockets.

mod changes;
mod described;
mod endpoints;
mod hostile;
mod kept;
mod kit;
mod live;
mod options;
mod pendant;
mod reading;
mod unaffected;
