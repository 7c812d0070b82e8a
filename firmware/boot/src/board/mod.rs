//! The boards: access to their registers. Which slot runs is not decided here.

#[cfg(feature = "board-mps2-an500")]
mod mps2_an500;
#[cfg(feature = "board-mps2-an500")]
pub(crate) use mps2_an500::*;

#[cfg(all(feature = "board-nucleo-h743zi", not(feature = "board-mps2-an500")))]
mod nucleo_h743zi;
#[cfg(all(feature = "board-nucleo-h743zi", not(feature = "board-mps2-an500")))]
pub(crate) use nucleo_h743zi::*;

#[cfg(all(feature = "board-mps2-an500", feature = "board-nucleo-h743zi"))]
compile_error!("two boards: --no-default-features --features board-mps2-an500");
#[cfg(not(any(feature = "board-mps2-an500", feature = "board-nucleo-h743zi")))]
compile_error!("choose a board: --features board-nucleo-h743zi, or board-mps2-an500");
