//! The models of `chip` as a driver's registers: the same that the firmware's binary is tested on
//! (docs/chip.md). The test advances time, and each access a little. A refused access fails the test.

use core::cell::{Cell, RefCell};
use std::rc::Rc;

use recipe_chip_model::device::{Clocks, Context, Functions, Peripheral, Picos, Pin, Refusal};

/// A peripheral with its clocks and pins.
pub(crate) struct TestDevice<P> {
    model: RefCell<P>,
    now: Cell<Picos>,
    clocks: Clocks,
    functions: Functions,
}

impl<P: Peripheral> TestDevice<P> {
    /// A peripheral after a reset, with its pins configured.
    pub(crate) fn new(model: P, clocks: Clocks, pins: &[Pin], function: u8) -> Rc<Self> {
        let mut functions = Functions::default();
        for pin in pins {
            functions[pin.port()][usize::from(pin.1)] = Some(function);
        }
        Rc::new(Self { model: RefCell::new(model), now: Cell::new(0), clocks, functions })
    }

    pub(crate) fn now(&self) -> Picos {
        self.now.get()
    }

    pub(crate) fn interrupt_line(&self) -> bool {
        self.with(|model| model.interrupt_line())
    }

    /// Direct access to the model.
    pub(crate) fn with<T>(&self, f: impl FnOnce(&mut P) -> T) -> T {
        f(&mut self.model.borrow_mut())
    }

    #[track_caller]
    pub(crate) fn read(&self, offset: u32) -> u32 {
        let read = self.access(|model, at| model.read(offset, at));
        read.unwrap_or_else(|refusal| panic!("{} is read: {refusal}", self.name(offset)))
    }

    #[track_caller]
    pub(crate) fn write(&self, offset: u32, value: u32) {
        let written = self.access(|model, at| model.write(offset, value, at));
        written.unwrap_or_else(|refusal| panic!("{} <- {value:08X}: {refusal}", self.name(offset)));
    }

    /// Another access by the driver.
    pub(crate) fn access<T>(
        &self,
        f: impl FnOnce(&mut P, &Context<'_>) -> Result<T, Refusal>,
    ) -> Result<T, Refusal> {
        self.now.set(self.now() + ACCESS);
        let mut model = self.model.borrow_mut();
        model.advance(&self.context())?;
        f(&mut model, &self.context())
    }

    /// Advances time to the peripheral's next event, or to `end`, and then returns `false`.
    #[track_caller]
    pub(crate) fn hop(&self, end: Picos) -> bool {
        self.advance();
        let due = self.with(|model| model.deadline(&self.context())).filter(|due| *due < end);
        assert!(due.is_none_or(|due| due > self.now()), "an event was due and not handled");
        self.now.set(due.unwrap_or(end).max(self.now()));
        self.advance();
        due.is_some()
    }

    #[track_caller]
    pub(crate) fn pass(&self, span: Picos) {
        let end = self.now() + span;
        while self.hop(end) {}
    }

    #[track_caller]
    fn advance(&self) {
        let done = self.with(|model| model.advance(&self.context()));
        done.unwrap_or_else(|refusal| panic!("an event of the peripheral: {refusal}"));
    }

    fn context(&self) -> Context<'_> {
        Context { now: self.now(), clocks: self.clocks, functions: &self.functions, is_rmii: false }
    }

    fn name(&self, offset: u32) -> std::string::String {
        let registers = self.with(|model| model.registers());
        let found = registers.iter().find(|register| register.offset == offset);
        found.map_or_else(|| std::format!("+{offset:03X}"), |register| register.name.into())
    }
}

/// Duration of an access: one cycle of a bus at 100 MHz.
const ACCESS: Picos = 10_000;
