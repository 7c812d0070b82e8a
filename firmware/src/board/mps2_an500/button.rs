//! The button, which QEMU does not have: it is pressed while the file of the fifth semihosting argument exists.

use firmware::platform;
use semihosting::fs::File;

use super::arguments::FileName;

pub(crate) struct UserButton {
    /// `None` if no file is named: no button.
    name: Option<FileName>,
}

impl UserButton {
    pub(super) fn new() -> Self {
        Self { name: FileName::argument(4) }
    }
}

impl platform::Button for UserButton {
    fn is_pressed(&mut self) -> bool {
        self.name.as_ref().is_some_and(|name| File::open(name.as_c_str()).is_ok())
    }
}
