//! The library's callbacks, which call the handler of the current run.

use std::ffi::{c_int, c_void};

use super::library::Uc;
use super::{Emulator, Exit, Flow, Handler, HookState};

/// Calls the handler of the current run.
fn with<T>(
    uc: Uc,
    user: *mut c_void,
    call: impl FnOnce(&mut dyn Handler, Emulator, &HookState) -> T,
) -> Option<T> {
    // SAFETY: `user` is the core's `shared`, which lives as long as the engine.
    let shared = unsafe { &*user.cast::<HookState>() };
    let handler = shared.handler.get()?;
    // SAFETY: it is borrowed by `run`, which has not returned; callbacks do not nest.
    let handler = unsafe { &mut *handler };
    Some(call(handler, Emulator { api: shared.api, uc }, shared))
}

fn follow(engine: Emulator, flow: Flow) {
    if flow == Flow::Stop {
        engine.stop();
    }
}

pub(super) extern "C" fn on_read<const BASE: u32>(uc: Uc, offset: u64, size: u32, user: *mut c_void) -> u64 {
    let value = with(uc, user, |handler, engine, _| handler.read(engine, BASE + offset as u32, size));
    u64::from(value.unwrap_or(0))
}

pub(super) extern "C" fn on_write<const BASE: u32>(
    uc: Uc,
    offset: u64,
    size: u32,
    value: u64,
    user: *mut c_void,
) {
    with(uc, user, |handler, engine, _| {
        handler.write(engine, BASE + offset as u32, value as u32, size);
    });
}

pub(super) extern "C" fn on_block(uc: Uc, address: u64, size: u32, user: *mut c_void) {
    with(uc, user, |handler, engine, _| {
        let flow = handler.block(engine, address as u32, size);
        follow(engine, flow);
    });
}

pub(super) extern "C" fn on_watched(uc: Uc, address: u64, _size: u32, user: *mut c_void) {
    with(uc, user, |handler, engine, _| {
        let flow = handler.watched(engine, address as u32);
        follow(engine, flow);
    });
}

pub(super) extern "C" fn on_exception(uc: Uc, number: u32, user: *mut c_void) {
    with(uc, user, |_, engine, shared| {
        shared.exit.set(Some(Exit::Exception(number)));
        engine.stop();
    });
}

pub(super) extern "C" fn on_bad_memory(
    uc: Uc,
    access: c_int,
    address: u64,
    size: c_int,
    value: i64,
    user: *mut c_void,
) -> bool {
    const FETCHES: [c_int; 2] = [21, 24];
    const WRITES: [c_int; 2] = [20, 22];
    with(uc, user, |_, _, shared| {
        let is_fetch = FETCHES.contains(&access);
        let written = WRITES.contains(&access).then_some((value as u32, size as u32));
        shared.exit.set(Some(Exit::Memory { address: address as u32, is_fetch, written }));
    });
    false
}
