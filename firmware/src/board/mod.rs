//! The boards. Only code in here knows pins, clocks and interrupts.
//!
//! A board's module has a type that implements [`firmware::platform::Board`], here `Board`, and `run`, which creates it
//! and runs the tasks that are started with it.

mod slot;
mod stack;

use embassy_executor::{SpawnError, SpawnToken, Spawner};
use firmware::tasks::watchdog::{Pulse, TaskName, TaskWatch};

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
    UserButton, Watchdog, run,
};

#[cfg(all(feature = "board-mps2-an500", feature = "board-nucleo-h743zi"))]
compile_error!("two boards: --no-default-features --features board-mps2-an500");
#[cfg(not(any(feature = "board-mps2-an500", feature = "board-nucleo-h743zi")))]
compile_error!("choose a board: --features board-nucleo-h743zi, or board-mps2-an500");

/// Starts tasks, at most `N`, and registers them with the watchdog.
#[derive(Clone, Copy)]
pub(crate) struct Tasks<const N: usize> {
    spawner: Spawner,
    watch: &'static TaskWatch<N>,
}

impl<const N: usize> Tasks<N> {
    pub(crate) const fn new(spawner: Spawner, watch: &'static TaskWatch<N>) -> Self {
        Self { spawner, watch }
    }

    pub(crate) const fn watch(&self) -> &'static TaskWatch<N> {
        self.watch
    }

    /// Starts a task with its pulse.
    pub(crate) fn spawn<S>(
        &self,
        name: TaskName,
        task: impl FnOnce(&'static Pulse) -> Result<SpawnToken<S>, SpawnError>,
    ) {
        let pulse = self.watch.register(name).expect("there is room for all tasks");
        self.spawner.spawn(task(pulse).expect("its pool is large enough"));
    }
}
