//! The boards. Only they know pins, clocks and interrupts.
//!
//! A board's module has a type that implements [`firmware::platform::Board`], here `Board`, and `main`, which creates it and
//! starts the tasks.

mod slot;
mod stack;

#[cfg(feature = "board-mps2-an500")]
mod mps2_an500;
#[cfg(feature = "board-mps2-an500")]
use mps2_an500 as chosen;
#[cfg(feature = "board-mps2-an500")]
pub(crate) use mps2_an500::Mps2An500 as Board;

#[cfg(all(feature = "board-nucleo-h743zi", not(feature = "board-mps2-an500")))]
mod nucleo_h743zi;
#[cfg(all(feature = "board-nucleo-h743zi", not(feature = "board-mps2-an500")))]
use nucleo_h743zi as chosen;
#[cfg(all(feature = "board-nucleo-h743zi", not(feature = "board-mps2-an500")))]
pub(crate) use nucleo_h743zi::NucleoH743zi as Board;

pub(crate) use chosen::{
    BoardLed, CanDevice, Ethernet, EthernetError, SerialDevice, SlotArea, StorageError, StoreArea,
    UserButton, Watchdog,
};

#[cfg(all(feature = "board-mps2-an500", feature = "board-nucleo-h743zi"))]
compile_error!("two boards: --no-default-features --features board-mps2-an500");
#[cfg(not(any(feature = "board-mps2-an500", feature = "board-nucleo-h743zi")))]
compile_error!("choose a board: --features board-nucleo-h743zi, or board-mps2-an500");
