//! The program as a person or a script meets it.

mod command_line;
mod output;
mod processes;
mod soak;
