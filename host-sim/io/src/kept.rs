//! Devices between two owners: a gateway that is replaced leaves its pseudoterminals and listening sockets to the next
//! one, so that no client is hung up.
//!
//! In: what the tasks of a port used, once they are gone. Out: the same, for a port of the same name with the same
//! `--bind` and the same kind of bus, in another runtime. What waits in a device meanwhile is dropped by its next owner.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::net::{TcpListener, TcpStream};

use crate::bind::Device;
use crate::can_bus::{Clients, Session};
use crate::exchange::PortTx;
use crate::pty::{ParkedPty, Pty};

/// Devices without an owner, by the names of their ports; a clone is the same shelf. Dropping the last one closes them.
#[derive(Debug, Default, Clone)]
pub struct Shelf(Arc<Mutex<BTreeMap<String, Kept>>>);

impl Shelf {
    /// Keeps a device for the next owner of this port.
    pub fn put(&self, port: &str, kept: Kept) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(port.to_owned(), kept);
    }

    /// The device of this port, if there is one.
    pub fn take(&self, port: &str) -> Option<Kept> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(port)
    }
}

/// An open device that no task uses. Dropping it closes it.
#[derive(Debug)]
pub struct Kept {
    pub(crate) device: Device,
    pub(crate) what: Parked,
}

/// What is open.
#[derive(Debug)]
pub(crate) enum Parked {
    Pty(ParkedPty),
    Listen(std::net::TcpListener, Option<std::net::TcpStream>),
    Bus(ParkedBus),
}

/// A CAN bus in user space without its frames: the ends that clients are at.
#[derive(Debug)]
pub(crate) struct ParkedBus {
    /// Bit/s: the clients' channels are for a bus of this rate.
    pub(crate) bitrate: u32,
    pub(crate) pty: Option<(ParkedPty, Session)>,
    pub(crate) listener: Option<std::net::TcpListener>,
    pub(crate) clients: Vec<(std::net::TcpStream, Session)>,
}

/// What the tasks of a port use. They may be gone without a word; then it can be kept.
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

#[derive(Debug)]
pub(crate) struct HeldBus {
    pub(crate) bitrate: u32,
    pub(crate) pty: Option<(Rc<Pty>, Rc<RefCell<Session>>)>,
    pub(crate) listener: Option<Rc<TcpListener>>,
    pub(crate) clients: Rc<Clients>,
}

impl Hold {
    /// The device, to be kept. `None` if it has failed, or if a task still uses it.
    pub fn release(self) -> Option<Kept> {
        if self.tx.has_failed.get() {
            return None;
        }
        let what = match self.held {
            Held::Pty(pty) => Parked::Pty(parked(pty)?),
            Held::Listen(listener, client) => {
                let client = Rc::into_inner(client)?.into_inner();
                let client = client.and_then(Rc::into_inner).and_then(|stream| stream.into_std().ok());
                Parked::Listen(Rc::into_inner(listener)?.into_std().ok()?, client)
            }
            Held::Bus(HeldBus { bitrate, pty, listener, clients }) => {
                let pty = match pty {
                    Some((pty, session)) => Some((parked(pty)?, Rc::into_inner(session)?.into_inner())),
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
                Parked::Bus(ParkedBus { bitrate, pty, listener, clients: clients.collect() })
            }
        };
        Some(Kept { device: self.device, what })
    }
}

fn parked(pty: Rc<Pty>) -> Option<ParkedPty> {
    Rc::into_inner(pty)?.park()
}

#[cfg(test)]
#[path = "kept_tests.rs"]
mod tests;
