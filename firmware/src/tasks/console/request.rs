//! A request after its head was parsed and its client admitted.

use core::net::Ipv4Addr;

use recipe_api::route::ApiOperation;

use super::arguments::{Arguments, HeadArguments};
use crate::tasks::store::StoreLock;

pub(super) struct ConsoleRequest<'a> {
    pub(super) head: HeadArguments,
    pub(super) operation: ApiOperation,
    pub(super) arguments: Arguments,
    /// Length of the body in the image buffer of the store handle, and the lock on it.
    pub(super) image: Option<(usize, StoreLock<'a>)>,
    pub(super) peer: Ipv4Addr,
}
