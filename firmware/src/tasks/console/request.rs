//! A request after its head was parsed and its client admitted.

use core::net::Ipv4Addr;

use recipe_api::request::Head;
use recipe_api::route::Operation;

use super::arguments::Arguments;
use crate::tasks::store::StoreLock;

/// A parsed request.
pub(super) struct Request<'a> {
    pub(super) head: Head<'a>,
    pub(super) operation: Operation,
    pub(super) arguments: Arguments,
    /// Length of the body in the image buffer of the store handle, and the lock on it.
    pub(super) image: Option<(usize, StoreLock<'a>)>,
    pub(super) peer: Ipv4Addr,
}
