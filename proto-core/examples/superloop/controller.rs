//! As much of the controller as this takes: its coils, by Modbus.

use heapless::Vec;
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::server::{RegisterBank, Server};
use proto_core::modbus::{Coils, Exception, Registers};

/// Longest answer to what this gateway asks.
pub(crate) const MAX_ANSWER: usize = 16;

pub(crate) struct Controller {
    server: Server,
    coils: CoilMap,
}

impl Controller {
    pub(crate) fn new() -> Self {
        Self { server: Server::new(), coils: CoilMap([false; 256]) }
    }

    /// The answer to a request.
    pub(crate) fn answer(&mut self, mut request: &[u8]) -> Option<Vec<u8, MAX_ANSWER>> {
        let mut answer = [0; MAX_ADU];
        let len = self.server.receive(&mut request, &mut self.coils, &mut answer)?.ok()?;
        Vec::from_slice(answer.get(..len)?).ok()
    }
}

struct CoilMap([bool; 256]);

impl RegisterBank for CoilMap {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let first = usize::from(address);
        let coils = self.0.get(first..first + usize::from(count)).ok_or(Exception::IllegalDataAddress)?;
        for (nth, &on) in coils.iter().enumerate() {
            packed[nth / 8] |= u8::from(on) << (nth % 8);
        }
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let first = usize::from(address);
        let place = self.0.get_mut(first..first + usize::from(coils.count()));
        let place = place.ok_or(Exception::IllegalDataAddress)?;
        for (coil, on) in place.iter_mut().zip(coils.iter()) {
            *coil = on;
        }
        Ok(())
    }

    fn read_holding(&self, _: u16, _: &mut [[u8; 2]]) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }

    fn write_holding(&mut self, _: u16, _: Registers<'_>) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }
}
