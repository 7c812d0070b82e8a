//! Raw pointers of the caller become references, after everything that can be checked was checked.

use core::ffi::c_void;
use core::ptr::NonNull;

use crate::Status;

/// Alignment of all memory that a program gives to this library, in bytes.
pub const RGW_ALIGN: usize = 16;

/// A place for a `T` in the caller's memory, not written yet.
pub(crate) fn place<T>(memory: *mut c_void, len: usize) -> Result<NonNull<T>, Status> {
    const { assert!(align_of::<T>() <= RGW_ALIGN) };
    let place = NonNull::new(memory.cast::<T>()).ok_or(Status::Null)?;
    if len < size_of::<T>() {
        return Err(Status::TooSmall);
    }
    if !memory.addr().is_multiple_of(RGW_ALIGN) {
        return Err(Status::Misaligned);
    }
    Ok(place)
}

/// The value behind a pointer.
///
/// # Safety
/// Unless it is null, it points to a `T` that nothing changes during the call.
pub(crate) unsafe fn shared<'a, T>(pointer: *const T) -> Result<&'a T, Status> {
    // SAFETY: as promised by the caller; null becomes `None`.
    unsafe { pointer.as_ref() }.ok_or(Status::Null)
}

/// The value behind a pointer, to be changed.
///
/// # Safety
/// Unless it is null, it points to a `T` that nothing else uses during the call.
pub(crate) unsafe fn unique<'a, T>(pointer: *mut T) -> Result<&'a mut T, Status> {
    // SAFETY: as promised by the caller; null becomes `None`.
    unsafe { pointer.as_mut() }.ok_or(Status::Null)
}

/// Writes a result to the caller's memory, whatever was there before.
///
/// # Safety
/// Unless it is null, there is room for a `T` at `pointer`.
pub(crate) unsafe fn give<T>(pointer: *mut T, value: T) -> Result<(), Status> {
    let pointer = NonNull::new(pointer).ok_or(Status::Null)?;
    // SAFETY: it is not null, and there is room, as promised by the caller.
    unsafe { pointer.write(value) };
    Ok(())
}

/// The caller's bytes; with a length of 0 the pointer may be null.
///
/// # Safety
/// Unless it is null, `pointer` points to `len` bytes that nothing changes during the call.
pub(crate) unsafe fn bytes<'a>(pointer: *const u8, len: usize) -> Result<&'a [u8], Status> {
    if len == 0 {
        return Ok(&[]);
    }
    if pointer.is_null() {
        return Err(Status::Null);
    }
    if isize::try_from(len).is_err() {
        return Err(Status::Invalid);
    }
    // SAFETY: the bytes are there, as promised by the caller; the pointer is not null, and the length
    // fits an `isize`.
    Ok(unsafe { core::slice::from_raw_parts(pointer, len) })
}
