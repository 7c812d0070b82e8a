//! The gateway in the caller's memory: made, and given its configuration.

use core::ffi::c_void;

use proto_core::engine::Engine;

use crate::memory::{give, place, shared, unique};
use crate::{Config, RGW_ABI_VERSION, Status};

/// Field ports that a gateway has room for.
pub const RGW_MAX_PORTS: usize = 4;
/// Recipe links that a gateway has room for.
pub const RGW_MAX_RECIPE_LINKS: usize = 2;
/// User-defined fields over all ports that a gateway has room for, in each direction.
pub const RGW_MAX_FIELDS: usize = 128;

/// Memory that a gateway takes, in bytes: as much as on any machine.
pub const RGW_GATEWAY_SIZE: usize = 37_888;
const _: () = assert!(size_of::<Gateway>() <= RGW_GATEWAY_SIZE);

/// A gateway in the caller's memory; it has to stay where it is.
#[derive(Debug)]
pub struct Gateway {
    pub(crate) engine: Engine<RGW_MAX_PORTS, RGW_MAX_RECIPE_LINKS, RGW_MAX_FIELDS>,
}

/// Size of a gateway here, in bytes; at most `RGW_GATEWAY_SIZE`.
#[unsafe(no_mangle)]
pub extern "C" fn rgw_gateway_size() -> usize {
    size_of::<Gateway>()
}

/// Makes a gateway without a configuration in the caller's memory. `*gateway` is in `memory` then.
/// `abi_version` is `RGW_ABI_VERSION`, as the program's header has it. There is nothing to be freed:
/// memory that is used for something else ends the gateway.
///
/// # Safety
/// There are `len` bytes at `memory`, which nobody else uses as long as the gateway is used; there is room
/// for a pointer at `gateway`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_gateway_init(
    abi_version: u32,
    memory: *mut c_void,
    len: usize,
    gateway: *mut *mut Gateway,
) -> Status {
    let make = || {
        if abi_version != RGW_ABI_VERSION {
            return Err(Status::AbiVersion);
        }
        let place = place::<Gateway>(memory, len)?;
        // SAFETY: there is room, it is aligned and the caller leaves it to us.
        unsafe { place.write(const { Gateway { engine: Engine::idle() } }) };
        // SAFETY: as promised by the caller.
        unsafe { give(gateway, place.as_ptr()) }
    };
    make().into()
}

/// Gives a gateway its configuration, instead of one that it may have had: all ports and links are down
/// then. When it is refused, the gateway has none and does nothing.
///
/// # Safety
/// `gateway` is from `rgw_gateway_init` and `config` from `rgw_config_read`; their memory has not been
/// used for anything else.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rgw_gateway_configure(gateway: *mut Gateway, config: *const Config) -> Status {
    let configure = || {
        // SAFETY: as promised by the caller.
        let (gateway, config) = unsafe { (unique(gateway)?, shared(config)?) };
        gateway.engine.configure(&config.0)?;
        Ok(())
    };
    configure().into()
}
