//! The button, which QEMU does not have: it is pressed while the file of the fifth semihosting argument exists.

use core::ffi::CStr;

use firmware::platform;
use semihosting::fs::File;

use super::storage::{MAX_ARGUMENTS, argument};

/// The button.
pub(crate) struct Button {
    /// Without one there is no button.
    name: Option<[u8; MAX_ARGUMENTS]>,
}

impl Button {
    pub(super) fn new() -> Self {
        let name = argument(4, |path| {
            let mut name = [0; MAX_ARGUMENTS];
            name.get_mut(..path.len()).map(|room| room.copy_from_slice(path.as_bytes())).map(|()| name)
        });
        Self { name: name.flatten() }
    }
}

impl platform::Button for Button {
    fn is_pressed(&mut self) -> bool {
        let name = self.name.as_ref().and_then(|name| CStr::from_bytes_until_nul(name).ok());
        name.is_some_and(|name| File::open(name).is_ok())
    }
}
