//! A serial device of this host: opened exclusively and raw, with the rate and the format of a line.
//!
//! In and out: bytes. Does not know when a byte has left the line, only whether the system still holds it.

use std::io;
use std::os::fd::OwnedFd;

use proto_core::config::{Parity, Rs485};
use rustix::fs::{FlockOperation, Mode, OFlags, flock, open};
use rustix::io::{Errno, ioctl_fionread};
use rustix::termios::{
    ControlModes, InputModes, OptionalActions, QueueSelector, Termios, ioctl_tiocexcl, ioctl_tiocnxcl,
    tcflush, tcgetattr, tcsetattr,
};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tracing::warn;

use crate::reactor::register;
use crate::tcp_options::unacknowledged;

/// An open serial device.
#[derive(Debug)]
pub(crate) struct Tty {
    fd: AsyncFd<OwnedFd>,
}

impl Tty {
    /// Opens the device in the current tokio runtime.
    ///
    /// # Errors
    /// If the device does not exist, another program has it, or it refuses the settings.
    pub(crate) fn open(path: &str, settings: Rs485) -> io::Result<Self> {
        match Self::open_with(path, settings) {
            // A pseudoterminal has no parity bit; some systems refuse one instead of ignoring it.
            Err(_) if settings.parity != Parity::None => {
                let device = Self::open_with(path, Rs485 { parity: Parity::None, ..settings })?;
                warn!(path, "the device does not support parity; used without");
                Ok(device)
            }
            opened => opened,
        }
    }

    fn open_with(path: &str, settings: Rs485) -> io::Result<Self> {
        // Non-blocking also because a blocking open would wait for a carrier.
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let fd = open(path, flags, Mode::empty())?;
        // TIOCEXCL keeps out everybody but root; the lock keeps out programs that check for it.
        ioctl_tiocexcl(&fd)?;
        let device = Self { fd: register(fd, Interest::READABLE)? };
        flock(device.fd.get_ref(), FlockOperation::NonBlockingLockExclusive).map_err(
            |error| match error {
                Errno::AGAIN => {
                    io::Error::new(io::ErrorKind::NotFound, "Unable to acquire exclusive lock on serial port")
                }
                other => other.into(),
            },
        )?;
        device.configure(settings)?;
        Ok(device)
    }

    fn configure(&self, settings: Rs485) -> io::Result<()> {
        let fd = self.fd.get_ref();
        let mut termios = tcgetattr(fd)?;
        termios.control_modes |= ControlModes::CREAD | ControlModes::CLOCAL;
        termios.make_raw();
        tcsetattr(fd, OptionalActions::Now, &termios)?;
        // tcsetattr succeeds if at least one of the settings is applied.
        let applied = tcgetattr(fd)?;
        let modes = |termios: &Termios| {
            (termios.input_modes, termios.output_modes, termios.control_modes, termios.local_modes)
        };
        if modes(&applied) != modes(&termios) {
            return Err(io::Error::other("Settings did not apply correctly"));
        }
        let mut termios = applied;
        termios.input_modes.set(InputModes::INPCK, settings.parity != Parity::None);
        termios.input_modes.set(InputModes::IGNPAR, settings.parity == Parity::None);
        termios.input_modes.remove(InputModes::IXON | InputModes::IXOFF);
        termios.control_modes.remove(ControlModes::CRTSCTS);
        termios.control_modes.set(ControlModes::PARENB, settings.parity != Parity::None);
        termios.control_modes.set(ControlModes::PARODD, settings.parity == Parity::Odd);
        termios.control_modes.set(ControlModes::CSTOPB, settings.stop_bits == 2);
        termios.set_speed(settings.baud)?;
        Ok(tcsetattr(fd, OptionalActions::Now, &termios)?)
    }

    /// Waits for bytes. Cancel safe.
    ///
    /// # Errors
    /// If the device is gone.
    pub(crate) async fn receive(&self, buf: &mut [u8]) -> io::Result<usize> {
        loop {
            let mut ready = self.fd.readable().await?;
            if let Ok(read) = ready.try_io(|fd| Ok(rustix::io::read(fd, &mut *buf)?)) {
                return read;
            }
        }
    }

    /// Reads what has arrived.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] if there is nothing.
    pub(crate) fn try_read(&self, buf: &mut [u8]) -> io::Result<usize> {
        Ok(rustix::io::read(&self.fd, buf)?)
    }

    /// Writes as much as the system accepts.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] if its buffer is full.
    pub(crate) fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        Ok(rustix::io::write(&self.fd, bytes)?)
    }

    /// Whether bytes can be read; `true` if the system does not say.
    pub(crate) fn has_unread(&self) -> bool {
        ioctl_fionread(&self.fd) != Ok(0)
    }

    /// Drops bytes that were not read.
    pub(crate) fn discard_unread(&self) {
        // Fails only if the device is gone.
        let _ = tcflush(&self.fd, QueueSelector::IFlush);
    }

    /// Whether written bytes have not left yet; `false` if the system does not say.
    pub(crate) fn is_draining(&self) -> bool {
        unacknowledged(&self.fd).is_ok_and(|left| left > 0)
    }
}

impl Drop for Tty {
    fn drop(&mut self) {
        // Otherwise a terminal that others have open would stay locked.
        let _ = ioctl_tiocnxcl(&self.fd);
    }
}

#[cfg(test)]
mod tests {
    use rustix::termios::{LocalModes, OutputModes};

    use super::*;
    use crate::port::BusSettings;
    use crate::test_kit::{PortTask, run, serial};

    #[test]
    fn it_is_raw_with_the_settings_of_its_line_and_of_one_program() {
        run(async |dir| {
            // A pseudoterminal replaces the device.
            let path = dir.join("device").display().to_string();
            let _line = PortTask::start(&format!("pty:{path}"), serial(9_600)).await;
            let BusSettings::Serial(settings) = serial(250_001) else { unreachable!() };
            let device = Tty::open(&path, Rs485 { stop_bits: 2, ..settings }).unwrap();
            let termios = tcgetattr(&device.fd).unwrap();
            assert_eq!((termios.input_speed(), termios.output_speed()), (250_001, 250_001));
            assert_eq!(termios.input_modes, InputModes::IGNPAR);
            assert!(!termios.output_modes.contains(OutputModes::OPOST));
            let cooked = LocalModes::ICANON | LocalModes::ECHO | LocalModes::ISIG | LocalModes::IEXTEN;
            assert!(!termios.local_modes.intersects(cooked));
            let format =
                ControlModes::CSIZE | ControlModes::CSTOPB | ControlModes::PARENB | ControlModes::CRTSCTS;
            assert_eq!(termios.control_modes & format, ControlModes::CS8 | ControlModes::CSTOPB);
            assert!(termios.control_modes.contains(ControlModes::CREAD | ControlModes::CLOCAL));
            // Root passes the first lock, and not the second.
            let error = Tty::open(&path, settings).unwrap_err();
            assert!(matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::ResourceBusy), "{error}");
            drop(device);
            Tty::open(&path, settings).unwrap();
        });
    }
}
