//! The API of docs/api.md: real processes, real sockets.

mod changes;
mod described;
mod endpoints;
mod hostile;
mod kit;
mod options;
mod pendant;
