//! The log: [`trace!`](crate::trace) to [`error!`](crate::error), for the library and the binary.
//!
//! With the feature `defmt`, and not on a host, they are defmt's macros, otherwise those of the crate
//! `log`. What a level below the chosen one would say is not in the image at all: defmt's levels are
//! chosen by `DEFMT_LOG` when it is built, `log`'s by the features `log-off`, `log-error` and
//! `log-warn`.
//!
//! Both take `{}` and arguments behind the text, and nothing else that is the same in both.

use core::fmt;

/// Says something that only a developer of the firmware wants to know.
#[macro_export]
macro_rules! trace {
    ($($text_and_values:tt)*) => { $crate::log_at!(trace, $($text_and_values)*) };
}

/// Says something that helps to find a mistake.
#[macro_export]
macro_rules! debug {
    ($($text_and_values:tt)*) => { $crate::log_at!(debug, $($text_and_values)*) };
}

/// Says something that happened and should have.
#[macro_export]
macro_rules! info {
    ($($text_and_values:tt)*) => { $crate::log_at!(info, $($text_and_values)*) };
}

/// Says something that should not have happened, and what is done about it is known.
#[macro_export]
macro_rules! warn {
    ($($text_and_values:tt)*) => { $crate::log_at!(warn, $($text_and_values)*) };
}

/// Says why something cannot be done.
#[macro_export]
macro_rules! error {
    ($($text_and_values:tt)*) => { $crate::log_at!(error, $($text_and_values)*) };
}

#[doc(hidden)]
#[macro_export]
#[cfg(all(feature = "defmt", target_os = "none"))]
macro_rules! log_at {
    ($level:ident, $($text_and_values:tt)*) => { ::defmt::$level!($($text_and_values)*) };
}

#[doc(hidden)]
#[macro_export]
#[cfg(not(all(feature = "defmt", target_os = "none")))]
macro_rules! log_at {
    ($level:ident, $($text_and_values:tt)*) => { ::log::$level!($($text_and_values)*) };
}

/// A value that is logged as the text it displays, by both: for errors, whose words are for people and
/// exist once.
#[derive(Debug, Clone, Copy)]
pub struct Text<'a, T>(pub &'a T);

impl<T: fmt::Display> fmt::Display for Text<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

#[cfg(feature = "defmt")]
impl<T: fmt::Display> defmt::Format for Text<'_, T> {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::Format::format(&defmt::Display2Format(self.0), f);
    }
}
