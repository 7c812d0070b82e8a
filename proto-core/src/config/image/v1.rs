//! Version 1: like version 2 without a board's own address, because every board used DHCP.
//!
//! Images could have up to 64 KiB then. One of more than 16 KiB is too long today, and so is its
//! configuration.

use super::{ConfigMut, ImageError, item, v2};
use crate::config::BoardAddress;

pub(super) fn read_head(rest: &mut &[u8], config: &mut ConfigMut<'_>) -> Result<(), ImageError> {
    *config.controller = item::<v2::ControllerLink>(rest)?.into();
    *config.network = BoardAddress::Dhcp;
    Ok(())
}
