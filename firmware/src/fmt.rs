//! The log: [`trace!`](crate::trace) to [`error!`](crate::error), for the library and the binary.
//!
//! On a microcontroller with the feature `defmt` they are defmt's macros, otherwise those of the crate `log`.
//! Messages below the chosen level are not in the image: the level is chosen at build time by `DEFMT_LOG`, or
//! by the features `log-off`, `log-error` and `log-warn`.
//!
//! Messages from [`info!`](crate::info) on are also stored as text ([`crate::journal`]).
//!
//! Messages use only `{}` with arguments after the text, which has the same meaning in both crates.

use core::fmt;

/// Logs details for developers of the firmware.
#[macro_export]
macro_rules! trace {
    ($($text_and_values:tt)*) => { $crate::log_at!(trace, $($text_and_values)*) };
}

/// Logs details that help to find a fault.
#[macro_export]
macro_rules! debug {
    ($($text_and_values:tt)*) => { $crate::log_at!(debug, $($text_and_values)*) };
}

/// Logs a normal event.
#[macro_export]
macro_rules! info {
    ($($text_and_values:tt)*) => {{
        $crate::log_at!(info, $($text_and_values)*);
        $crate::journal::note($crate::journal::Level::Info, ::core::format_args!($($text_and_values)*));
    }};
}

/// Logs a fault that the firmware handles.
#[macro_export]
macro_rules! warn {
    ($($text_and_values:tt)*) => {{
        $crate::log_at!(warn, $($text_and_values)*);
        $crate::journal::note($crate::journal::Level::Warn, ::core::format_args!($($text_and_values)*));
    }};
}

/// Logs why something cannot be done.
#[macro_export]
macro_rules! error {
    ($($text_and_values:tt)*) => {{
        $crate::log_at!(error, $($text_and_values)*);
        $crate::journal::note($crate::journal::Level::Error, ::core::format_args!($($text_and_values)*));
    }};
}

/// Logs messages so frequent that they would push everything else out of the journal.
#[macro_export]
macro_rules! traffic {
    ($($text_and_values:tt)*) => { $crate::log_at!(info, $($text_and_values)*) };
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

/// Logs the `Display` text of a value, with both crates. Used for errors, so that their texts exist only once.
#[derive(Debug, Clone, Copy)]
pub struct DisplayText<'a, T>(pub &'a T);

impl<T: fmt::Display> fmt::Display for DisplayText<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

#[cfg(feature = "defmt")]
impl<T: fmt::Display> defmt::Format for DisplayText<'_, T> {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::Format::format(&defmt::Display2Format(self.0), f);
    }
}
