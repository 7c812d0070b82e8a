//! The gateway in the caller's memory: making it, and giving it a configuration.

use core::ffi::c_void;

use proto_core::engine::Engine;

use crate::config::RGW_MAX_EXCHANGES;
use crate::memory::{give, place, shared, unique};
use crate::{Config, RGW_ABI_VERSION, Status};

/// Field ports that a gateway has room for.
pub const RGW_MAX_PORTS: usize = 4;
/// Recipe links that a gateway has room for.
pub const RGW_MAX_RECIPE_LINKS: usize = 2;
/// User-defined fields on all ports together that a gateway has room for, in each direction.
pub const RGW_MAX_FIELDS: usize = 128;

/// Memory for a gateway, in bytes: enough on every machine.
pub const RGW_GATEWAY_SIZE: usize = 61_440;
const _: () = assert!(size_of::<Gateway>() <= RGW_GATEWAY_SIZE);

/// A gateway in the caller's memory; it must not be moved.
#[derive(Debug)]
pub struct Gateway {
    pub(crate) engine: Engine<RGW_MAX_PORTS, RGW_MAX_RECIPE_LINKS, RGW_MAX_FIELDS, 0, RGW_MAX_EXCHANGES>,
}

/// Size of a gateway on this machine, in bytes; at most `RGW_GATEWAY_SIZE`.
#[unsafe(no_mangle)]
pub extern "C" fn rgw_gateway_size() -> usize {
    size_of::<Gateway>()
}

/// Makes a gateway without a configuration in `memory`, and sets `*gateway` to it. `abi_version` is
/// `RGW_ABI_VERSION` of the header that the program was compiled with. Nothing has to be freed: the
/// gateway ends when its memory is used for something else.
///
/// # Safety
/// `memory` points to `len` bytes that nothing else uses as long as the gateway is in use; `gateway`
/// points to room for a pointer.
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
        // SAFETY: there is room, it is aligned, and nothing else uses it.
        unsafe { place.write(const { Gateway { engine: Engine::idle() } }) };
        // SAFETY: as promised by the caller.
        unsafe { give(gateway, place.as_ptr()) }
    };
    make().into()
}

/// Gives a gateway its configuration, and drops the previous one: all ports and links are down then. If
/// the configuration is refused, the gateway has none and does nothing.
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
