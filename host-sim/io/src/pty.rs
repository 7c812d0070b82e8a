//! A pseudoterminal with a symbolic link: a serial line that any program can open.
//!
//! This process keeps the terminal side open too, so the line survives its clients and the reactor never sees a
//! hang-up. Bytes that no client reads are lost, as on a line, and not kept for the next client.

use std::cell::{Cell, RefCell};
use std::io;
use std::os::fd::OwnedFd;
use std::path::Path;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::OFlags;
use rustix::io::{Errno, ioctl_fionread};
use rustix::pty::{OpenptFlags, grantpt, ioctl_tiocgptpeer, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, QueueSelector, ioctl_tiocnxcl, tcflush, tcgetattr, tcsetattr};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::stream::{ByteStream, read_ready};
use super::symlink::Symlink;
use crate::reactor::register;

/// One pseudoterminal. For a current-thread runtime: see [`Pty::has_client`].
#[derive(Debug)]
pub(crate) struct Pty {
    // Dropped first: the link must never lead to a terminal that is gone.
    link: Symlink,
    master: AsyncFd<OwnedFd>,
    // `None` only if a client opened the terminal exclusively during `has_client`.
    terminal: RefCell<Option<OwnedFd>>,
    // Whether something was written that a client may have left unread.
    unread: Cell<bool>,
}

/// An open pseudoterminal with its link, detached from any runtime.
#[derive(Debug)]
pub(crate) struct HandoverPty {
    // Dropped first, as in a `Pty`.
    link: Symlink,
    master: OwnedFd,
    terminal: OwnedFd,
    unread: bool,
}

impl HandoverPty {
    /// Registers the terminal with the current tokio runtime.
    pub(crate) fn attach(self) -> io::Result<Pty> {
        let Self { link, master, terminal, unread } = self;
        let master = register(master, Interest::READABLE)?;
        Ok(Pty { link, master, terminal: RefCell::new(Some(terminal)), unread: Cell::new(unread) })
    }
}

impl Pty {
    /// Detaches the terminal from its runtime; clients notice nothing. Closes it and returns `None` if a client has
    /// opened it exclusively at this moment.
    pub(crate) fn detach(self) -> Option<HandoverPty> {
        self.reopen();
        let Self { link, master, terminal, unread } = self;
        let terminal = terminal.into_inner()?;
        Some(HandoverPty { link, master: master.into_inner(), terminal, unread: unread.get() })
    }

    /// Opens a new pseudoterminal in raw mode, with a symbolic link to it at `link`, in the current tokio runtime.
    ///
    /// An existing link is replaced if it leads to a pseudoterminal of a program that is gone. Anything else stays.
    ///
    /// # Errors
    /// With the path in the message: the link's folder cannot be created, something else is at the path, or the system
    /// has no pseudoterminal left.
    pub(crate) fn open(link: &Path) -> io::Result<Self> {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let master = openpt(flags)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        rustix::fs::fcntl_setfl(&master, OFlags::RDWR | OFlags::NONBLOCK)?;
        let target = ptsname(&master, Vec::new())?.into_string().map_err(io::Error::other)?;
        let terminal = ioctl_tiocgptpeer(&master, flags)?;
        set_raw(&terminal)?;
        let master = register(master, Interest::READABLE)?;
        let link = Symlink::create(link, Path::new(&target))?;
        Ok(Self { link, master, terminal: RefCell::new(Some(terminal)), unread: Cell::new(false) })
    }

    pub(crate) fn link(&self) -> &Path {
        self.link.path()
    }

    /// Waits until a client's bytes can be read. Cancel safe.
    async fn readable(&self) -> io::Result<()> {
        self.master.readable().await?.retain_ready();
        Ok(())
    }

    fn reopen(&self) {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let mut terminal = self.terminal.borrow_mut();
        if terminal.is_none() {
            *terminal = ioctl_tiocgptpeer(self.master.get_ref(), flags).ok();
        }
    }
}

impl ByteStream for Pty {
    const LOSSY: bool = true;
    const LATE: bool = true;

    async fn receive(&self, buf: &mut [u8]) -> io::Result<usize> {
        read_ready(|| self.readable(), || self.try_read(buf)).await
    }

    /// If `buf` is not filled, `receive` waits for more.
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize> {
        // Ignores the reactor's readiness: it has not polled a new descriptor yet.
        let read = rustix::io::read(self.master.get_ref(), &mut *buf);
        if match read {
            // A terminal returns everything that has arrived, and later bytes make it readable again. Another read
            // would wait for the kernel's thread that still passes on these bytes.
            Ok(count) => count > 0 && count < buf.len(),
            Err(error) => error == Errno::AGAIN,
        } {
            let would_block: io::Result<()> = Err(io::ErrorKind::WouldBlock.into());
            let _ = self.master.try_io(Interest::READABLE, |_| would_block);
        }
        // No terminal side is open at the moment: see `has_client`.
        if read == Err(Errno::IO) {
            self.reopen();
            return Err(io::ErrorKind::WouldBlock.into());
        }
        Ok(read?)
    }

    async fn writable(&self) -> io::Result<()> {
        // A separate descriptor for the rare client that does not read: on the other one, each read of a client would
        // wake this thread.
        let master =
            register(rustix::io::fcntl_dupfd_cloexec(self.master.get_ref(), 0)?, Interest::WRITABLE)?;
        master.writable().await?.retain_ready();
        Ok(())
    }

    /// Does not check that there is a client.
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        self.unread.set(true);
        Ok(rustix::io::write(self.master.get_ref(), bytes)?)
    }

    fn has_unread(&self) -> bool {
        ioctl_fionread(self.master.get_ref()) != Ok(0)
    }

    /// Includes bytes that the kernel has not made readable yet.
    fn discard_unread(&self) {
        // Fails only if no client can have written anything.
        let _ = tcflush(self.master.get_ref(), QueueSelector::IFlush);
    }

    /// Whether a client has the terminal open now. If not, drops bytes that the last client left unread and restores
    /// raw mode.
    ///
    /// The only way to find out is to close this process's terminal side for an instant and look for a hang-up. Only
    /// the thread that polls this runtime's reactor may do this; otherwise the reactor would see the hang-up.
    fn has_client(&self) -> bool {
        if let Some(terminal) = self.terminal.take() {
            // A client's exclusive lock would prevent this process from opening it again.
            let _ = ioctl_tiocnxcl(&terminal);
        }
        let mut fds = [PollFd::new(self.master.get_ref(), PollFlags::empty())];
        let polled = poll(&mut fds, Some(&Timespec { tv_sec: 0, tv_nsec: 0 }));
        let has_client = !matches!(polled, Ok(1) if fds[0].revents().contains(PollFlags::HUP));
        self.reopen();
        if !has_client
            && self.unread.take()
            && let Some(terminal) = &*self.terminal.borrow()
        {
            let _ = tcflush(terminal, QueueSelector::IFlush);
            let _ = set_raw(terminal);
        }
        has_client
    }

    fn may_hold_unread(&self) -> bool {
        self.unread.get()
    }
}

fn set_raw(terminal: &OwnedFd) -> io::Result<()> {
    let mut settings = tcgetattr(terminal)?;
    settings.make_raw();
    Ok(tcsetattr(terminal, OptionalActions::Now, &settings)?)
}

#[cfg(test)]
#[path = "pty_tests.rs"]
mod tests;
