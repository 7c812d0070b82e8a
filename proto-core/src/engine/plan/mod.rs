//! What is decided once, from a configuration: routes, sources, ports, links and their layouts.

pub(crate) mod build;
pub(crate) mod codecs;
pub(crate) mod exchanges;
pub(crate) mod health;
pub(crate) mod routes;
