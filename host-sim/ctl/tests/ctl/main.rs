//! `ctl` against servers that are scripted, good and hostile ones.

mod board;
mod edge;
mod firmware;
mod fleet;
mod hostile;
mod keys;
mod rollback;
mod rollout;
mod server;
mod text;
mod updating;
