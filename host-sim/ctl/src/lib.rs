//! A client of the API of gateways, on hosts and on boards (docs/api.md): what `host-sim ctl` does.
//!
//! In: the address of a gateway, or an inventory of many; a command. Out: answers as text, as JSON, or as files. Does
//! not need an async runtime: each gateway is asked by one thread. Answers of gateways are untrusted input: they are
//! limited, and never reach a terminal unescaped.

#![forbid(unsafe_code)]

mod address;
mod answer;
mod bundle;
mod capture;
mod changing;
mod claim;
mod client;
mod digits;
mod doctor;
pub mod edge;
mod failure;
mod firmware;
mod fleet;
mod frames;
mod http;
pub mod key_file;
mod reading;
pub mod rollout;
pub mod shown;
pub mod signing_key;
mod stop;
mod table;
mod trace;
pub mod update;
mod watch;

pub use address::Address;
pub use answer::Answer;
pub use bundle::{bundle, bundled};
pub use capture::capture;
pub use changing::{
    Configuration, Stored, TrialOptions, WithoutTrial, apply, config, confirm, identify, push, rollback,
    stored,
};
pub use claim::claim;
pub use client::Client;
pub use doctor::doctor;
pub use failure::{Failure, Verdict};
pub use firmware::{Firmware, Update, public_of, sign};
pub use fleet::{MAX_AT_ONCE, Member, Outcomes, Rollout, ask, members};
pub use reading::{info, log, metrics, revisions, status, values};
pub use recipe_update::Slot;
pub use stop::Stop;
pub use table::TableView;
pub use trace::{Names, trace};
pub use watch::{Watched, clear, watch};
