//! Handover of open devices: a gateway that is replaced passes its pseudoterminals and listening sockets to its
//! successor, so that clients stay connected.
//!
//! In: the open descriptors of a port whose tasks have ended. Out: the same device in another runtime, for a port with
//! the same name, `--bind` and kind of bus. The new owner drops input that arrived in between.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::net::{TcpListener, TcpStream};

use crate::bind::Device;
use crate::can_bus::{HandoverBus, HeldBus};
use crate::exchange::PortTx;
use crate::pty::{HandoverPty, Pty};

/// Open devices without an owner, by port name. Clones share them; dropping the last clone closes them.
#[derive(Debug, Default, Clone)]
pub struct Handover(Arc<Mutex<BTreeMap<String, HandoverDevice>>>);

impl Handover {
    /// Stores the device of a port for its next owner.
    pub fn put(&self, port: &str, device: HandoverDevice) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(port.to_owned(), device);
    }

    /// Removes and returns the device of a port.
    pub fn take(&self, port: &str) -> Option<HandoverDevice> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(port)
    }
}

/// An open device that no task uses; closed when dropped.
#[derive(Debug)]
pub struct HandoverDevice {
    pub(crate) device: Device,
    pub(crate) what: HandoverState,
}

/// The open descriptors of a device.
#[derive(Debug)]
pub(crate) enum HandoverState {
    Pty(HandoverPty),
    Listen(std::net::TcpListener, Option<std::net::TcpStream>),
    Bus(HandoverBus),
}

/// Shares the device of a running port, to release it after the port's tasks were dropped.
#[derive(Debug)]
pub struct Hold {
    pub(crate) device: Device,
    pub(crate) held: Held,
    pub(crate) tx: Rc<PortTx>,
}

#[derive(Debug)]
pub(crate) enum Held {
    Pty(Rc<Pty>),
    Listen(Rc<TcpListener>, Rc<RefCell<Option<Rc<TcpStream>>>>),
    Bus(HeldBus),
}

impl Hold {
    /// Returns the device; `None` if it has failed or a task still uses it.
    pub fn release(self) -> Option<HandoverDevice> {
        if self.tx.has_failed.get() {
            return None;
        }
        let what = match self.held {
            Held::Pty(pty) => HandoverState::Pty(detach(pty)?),
            Held::Listen(listener, client) => {
                let client = Rc::into_inner(client)?.into_inner();
                let client = client.and_then(Rc::into_inner).and_then(|stream| stream.into_std().ok());
                HandoverState::Listen(Rc::into_inner(listener)?.into_std().ok()?, client)
            }
            Held::Bus(HeldBus { bitrate, pty, listener, clients }) => {
                let pty = match pty {
                    Some((pty, session)) => Some((detach(pty)?, Rc::into_inner(session)?.into_inner())),
                    None => None,
                };
                let listener = match listener {
                    Some(listener) => Some(Rc::into_inner(listener)?.into_std().ok()?),
                    None => None,
                };
                let clients = Rc::into_inner(clients)?.into_inner().into_iter();
                let clients = clients.filter_map(Rc::into_inner).filter_map(|client| {
                    let stream = client.stream.into_std().ok()?;
                    Some((stream, client.session.into_inner()))
                });
                HandoverState::Bus(HandoverBus { bitrate, pty, listener, clients: clients.collect() })
            }
        };
        Some(HandoverDevice { device: self.device, what })
    }
}

fn detach(pty: Rc<Pty>) -> Option<HandoverPty> {
    Rc::into_inner(pty)?.detach()
}

#[cfg(test)]
#[path = "handover_tests.rs"]
mod tests;
