//! A pseudoterminal with a symbolic link: a serial line that any program can open.
//!
//! The terminal side is kept open here too, so that the line survives its clients and the reactor never sees
//! a hang-up. Bytes that no client reads are lost, as on a line, and not kept for the next client.

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

use super::symlink::Symlink;
use crate::reactor::register;

/// One pseudoterminal. For a current-thread runtime: see [`Pty::has_client`].
#[derive(Debug)]
pub struct Pty {
    // Dropped first, so that the link never leads to a terminal that is gone.
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
    /// Registers it with the current tokio runtime.
    pub(crate) fn attach(self) -> io::Result<Pty> {
        let Self { link, master, terminal, unread } = self;
        let master = register(master, Interest::READABLE)?;
        Ok(Pty { link, master, terminal: RefCell::new(Some(terminal)), unread: Cell::new(unread) })
    }
}

impl Pty {
    /// Detaches it from its runtime; clients notice nothing. Closes it and returns `None` if a client has
    /// opened the terminal exclusively at this moment.
    pub(crate) fn detach(self) -> Option<HandoverPty> {
        self.reopen();
        let Self { link, master, terminal, unread } = self;
        let terminal = terminal.into_inner()?;
        Some(HandoverPty { link, master: master.into_inner(), terminal, unread: unread.get() })
    }

    /// Opens a new pseudoterminal in raw mode, with a symbolic link to it at `link`, in the current tokio
    /// runtime.
    ///
    /// An existing link is replaced if it leads to a pseudoterminal and the program that made it is gone.
    /// Anything else there stays.
    ///
    /// # Errors
    /// With the path in the message: the link's folder cannot be created, something else is there, or the
    /// system has no pseudoterminal left.
    pub fn open(link: &Path) -> io::Result<Self> {
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

    /// The path of the link.
    pub fn link(&self) -> &Path {
        self.link.path()
    }

    /// Waits until a client's bytes can be read. Cancel safe.
    ///
    /// # Errors
    /// If the runtime is shutting down.
    pub async fn readable(&self) -> io::Result<()> {
        self.master.readable().await?.retain_ready();
        Ok(())
    }

    /// Reads what clients wrote. After less than `buf` holds, [`Self::readable`] waits for more.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] if there is nothing.
    pub fn try_read(&self, buf: &mut [u8]) -> io::Result<usize> {
        // Whatever readiness the reactor knows: it has not polled a new descriptor yet.
        let read = rustix::io::read(self.master.get_ref(), &mut *buf);
        if match read {
            // A terminal returns all that has arrived; what comes later makes it readable again. Another read would wait
            // for the kernel's thread that still passes on these bytes.
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

    /// Whether bytes of clients can be read; so if the system does not say.
    pub fn has_unread(&self) -> bool {
        ioctl_fionread(self.master.get_ref()) != Ok(0)
    }

    /// Drops unread bytes of clients, also those that the kernel has not made readable yet.
    pub fn discard_unread(&self) {
        // Fails only if no client can have written anything.
        let _ = tcflush(self.master.get_ref(), QueueSelector::IFlush);
    }

    /// Waits until bytes can be written. Cancel safe.
    ///
    /// # Errors
    /// If the runtime is shutting down, or the system has no descriptor left.
    pub async fn writable(&self) -> io::Result<()> {
        // Of its own, for the rare client that does not read: the other one would wake this thread for each read of a
        // client.
        let master =
            register(rustix::io::fcntl_dupfd_cloexec(self.master.get_ref(), 0)?, Interest::WRITABLE)?;
        master.writable().await?.retain_ready();
        Ok(())
    }

    /// Writes as much as fits the buffer, without a check that there is a client.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] if the client has left tens of kilobytes unread.
    pub fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        self.unread.set(true);
        Ok(rustix::io::write(self.master.get_ref(), bytes)?)
    }

    /// Whether a client has the terminal open now. If not, bytes that the last one left unread are dropped
    /// and raw mode is restored.
    ///
    /// The only way to find out is to close our own terminal side for an instant and look for a hang-up. Only
    /// the thread that polls this runtime's reactor may do this, or the reactor would see the hang-up.
    pub fn has_client(&self) -> bool {
        if let Some(terminal) = self.terminal.take() {
            // A client's exclusive lock would prevent us from opening it again.
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

    /// Whether a client may have left bytes unread: then [`Pty::has_client`] must be called at times, because
    /// it drops them.
    pub fn may_hold_unread(&self) -> bool {
        self.unread.get()
    }

    fn reopen(&self) {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let mut terminal = self.terminal.borrow_mut();
        if terminal.is_none() {
            *terminal = ioctl_tiocgptpeer(self.master.get_ref(), flags).ok();
        }
    }
}

fn set_raw(terminal: &OwnedFd) -> io::Result<()> {
    let mut settings = tcgetattr(terminal)?;
    settings.make_raw();
    Ok(tcsetattr(terminal, OptionalActions::Now, &settings)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::io::{Read, Write};
    use std::os::unix::fs::OpenOptionsExt;

    /// A client, as `serial.Serial(link)` would open it.
    fn client(link: &Path) -> fs::File {
        let flags = i32::try_from((OFlags::NOCTTY | OFlags::NONBLOCK).bits()).unwrap();
        fs::OpenOptions::new().read(true).write(true).custom_flags(flags).open(link).unwrap()
    }

    async fn read_from(pty: &Pty, count: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        while bytes.len() < count {
            pty.readable().await.unwrap();
            let mut buf = [0; 64];
            match pty.try_read(&mut buf) {
                Ok(n) => bytes.extend_from_slice(&buf[..n]),
                Err(error) => assert_eq!(error.kind(), io::ErrorKind::WouldBlock),
            }
        }
        bytes
    }

    fn run<T>(test: impl AsyncFnOnce(&Path) -> T) -> T {
        let dir = tempfile::tempdir().unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let limit = std::time::Duration::from_secs(20);
            tokio::time::timeout(limit, test(&dir.path().join("line"))).await.expect("the test hangs")
        })
    }

    #[test]
    fn every_byte_passes_both_ways_unchanged() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            let all: Vec<u8> = (0..=255).collect();
            let mut peer = client(link);
            peer.write_all(&all).unwrap();
            assert_eq!(read_from(&pty, 256).await, all);
            assert!(pty.has_client());
            assert_eq!(pty.try_write(&all).unwrap(), 256);
            let mut got = vec![0; 256];
            peer.read_exact(&mut got).unwrap();
            assert_eq!(got, all);
            assert_eq!(peer.read(&mut got).unwrap_err().kind(), io::ErrorKind::WouldBlock, "no echo");
        });
    }

    #[test]
    fn no_byte_is_left_behind_by_reads_of_any_length() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            let mut peer = client(link);
            // Through the kernel's ring many times, whose end is met at another place each time.
            for round in 0..200_usize {
                let bytes: Vec<u8> = (0..97 * (round % 7 + 1)).map(|nth| (nth + round) as u8).collect();
                peer.write_all(&bytes).unwrap();
                assert_eq!(read_from(&pty, bytes.len()).await, bytes, "round {round}");
            }
        });
    }

    #[test]
    fn a_full_terminal_can_be_written_again_when_its_client_has_read() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            let mut peer = client(link);
            let written = std::iter::from_fn(|| pty.try_write(&[0x5A; 1_024]).ok()).sum::<usize>();
            assert!(written > 4_096, "{written}");
            let mut left = written;
            let read_all = async {
                while left > 0 {
                    left -= peer.read(&mut [0; 4_096]).unwrap_or(0);
                    tokio::task::yield_now().await;
                }
            };
            let (writable, ()) = tokio::join!(pty.writable(), read_all);
            writable.unwrap();
            assert_eq!(pty.try_write(b"again").unwrap(), 5);
        });
    }

    #[test]
    fn bytes_that_a_client_left_unread_are_not_kept_for_the_next_one() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            assert!(!pty.has_client());
            let first = client(link);
            let second = client(link);
            assert!(pty.has_client());
            pty.try_write(b"stale").unwrap();
            drop(first);
            assert!(pty.has_client(), "the second one has it open");
            assert!(pty.may_hold_unread());
            drop(second);
            assert!(!pty.has_client());
            assert!(!pty.may_hold_unread());
            let mut third = client(link);
            assert!(pty.has_client());
            pty.try_write(b"fresh").unwrap();
            let mut got = [0; 16];
            assert_eq!(third.read(&mut got).unwrap(), 5);
            assert_eq!(&got[..5], b"fresh");
        });
    }

    #[test]
    fn clients_come_and_go_without_a_hang_up() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            for round in 0..50_u8 {
                let mut peer = client(link);
                // An exclusive client, as a `Tty` is, does not lock us out.
                rustix::termios::ioctl_tiocexcl(&peer).unwrap();
                assert!(pty.has_client());
                peer.write_all(&[round]).unwrap();
                drop(peer);
                assert_eq!(read_from(&pty, 1).await, [round]);
                assert!(!pty.has_client());
            }
        });
    }

    #[test]
    fn unread_bytes_are_dropped_however_many_there_are() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            let mut peer = client(link);
            let mut waiting = 0;
            while let Ok(count @ 1..) = peer.write(&[0xA5; 512]) {
                waiting += count;
            }
            assert!(waiting > 4_096, "{waiting}");
            pty.discard_unread();
            peer.write_all(b"new").unwrap();
            assert_eq!(read_from(&pty, 3).await, b"new");
        });
    }

    #[test]
    fn bytes_of_a_client_that_has_gone_are_not_lost() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            for round in 0..20 {
                let mut peer = client(link);
                pty.try_write(b"unread").unwrap();
                peer.write_all(&[round, 0xEE]).unwrap();
                drop(peer);
                assert!(!pty.has_client());
                assert_eq!(read_from(&pty, 2).await, [round, 0xEE]);
            }
        });
    }

    #[test]
    fn a_quiet_line_without_a_client_does_not_wake_the_reactor() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            drop(client(link));
            assert!(!pty.has_client());
            let quiet = tokio::time::timeout(std::time::Duration::from_millis(50), async {
                let mut wakes = 0;
                loop {
                    pty.readable().await.unwrap();
                    let error = pty.try_read(&mut [0; 8]).unwrap_err();
                    assert_eq!(error.kind(), io::ErrorKind::WouldBlock);
                    wakes += 1;
                    assert!(wakes < 10, "the reactor spins");
                }
            });
            quiet.await.unwrap_err();
        });
    }

    #[test]
    fn the_links_folder_is_made() {
        run(async |link| {
            let link = link.with_file_name("run").join("line");
            let pty = Pty::open(&link).unwrap();
            drop(client(&link));
            drop(pty);
        });
    }

    #[test]
    fn the_link_is_removed_at_the_end() {
        run(async |link| {
            let pty = Pty::open(link).unwrap();
            assert_eq!(pty.link(), link);
            assert!(fs::read_link(link).unwrap().starts_with("/dev/pts"));
            drop(pty);
            assert!(fs::symlink_metadata(link).is_err());
        });
    }

    #[test]
    fn a_link_in_use_is_not_taken_away() {
        run(async |link| {
            let first = Pty::open(link).unwrap();
            let target = fs::read_link(link).unwrap();
            let message = Pty::open(link).unwrap_err().to_string();
            assert!(message.contains("line: another port uses this path"), "{message}");
            assert_eq!(fs::read_link(link).unwrap(), target);
            assert!(Pty::open(&link.join("deeper")).unwrap_err().to_string().contains("line/deeper: "));
            drop(first);
            Pty::open(link).unwrap();
        });
    }
}
