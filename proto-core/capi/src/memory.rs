//! Raw pointers of the caller as references, after what can be checked of them has been.

use core::ffi::c_void;
use core::ptr::NonNull;

use crate::Status;

/// Alignment of all memory that is given to this library, in bytes.
pub const RGW_ALIGN: usize = 16;

/// A place for a `T` in the caller's memory, not yet written.
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

/// What a pointer points to.
///
/// # Safety
/// Unless it is null, it points to a `T` that nobody changes during the call.
pub(crate) unsafe fn shared<'a, T>(pointer: *const T) -> Result<&'a T, Status> {
    // SAFETY: as promised by the caller; null is none.
    unsafe { pointer.as_ref() }.ok_or(Status::Null)
}

/// What a pointer points to, to be changed.
///
/// # Safety
/// Unless it is null, it points to a `T` that nobody else uses during the call.
pub(crate) unsafe fn unique<'a, T>(pointer: *mut T) -> Result<&'a mut T, Status> {
    // SAFETY: as promised by the caller; null is none.
    unsafe { pointer.as_mut() }.ok_or(Status::Null)
}

/// Writes a result where a caller wants it, whatever was there.
///
/// # Safety
/// Unless it is null, there is room for a `T` at `pointer`.
pub(crate) unsafe fn give<T>(pointer: *mut T, value: T) -> Result<(), Status> {
    let pointer = NonNull::new(pointer).ok_or(Status::Null)?;
    // SAFETY: there is room, as promised by the caller, and it is not null.
    unsafe { pointer.write(value) };
    Ok(())
}

/// The caller's bytes; null stands for none when there are none.
///
/// # Safety
/// Unless it is null, there are `len` bytes at `pointer` that nobody changes during the call.
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
    // SAFETY: that many bytes are there, as promised by the caller; it is not null, and not longer than
    // anything can be.
    Ok(unsafe { core::slice::from_raw_parts(pointer, len) })
}
