//! Version 1: as version 2, but boards asked DHCP, always. Its images could have 64 KiB; one of more than 16 KiB is
//! too long today, as its configuration is.

use super::{ConfigMut, ImageError, item, v2};

pub(super) fn read(rest: &mut &[u8], config: &mut ConfigMut<'_>) -> Result<(), ImageError> {
    *config.controller = item::<v2::ControllerLink>(rest)?;
    *config.network = v2::BoardAddress::Dhcp;
    v2::read_lists(rest, config)
}
