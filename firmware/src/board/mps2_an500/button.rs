//! The button. QEMU has none, so a file stands for it: the button is pressed while the file that the fifth semihosting
//! argument names exists.

use firmware::platform;
use semihosting::fs::File;

use super::arguments::FileName;

pub(crate) struct UserButton {
    /// Name of the file; `None` if none was given, then there is no button.
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
