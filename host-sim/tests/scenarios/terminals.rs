//! How late the kernel passes on what is written to a pseudoterminal. A thread of the kernel moves the bytes. On a machine
//! with much more to do than it can, it has come six seconds late while all programs went on: no line does that, and a
//! device behind one looks as if it had no power.

use std::io;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use rustix::pty::{OpenptFlags, grantpt, ioctl_tiocgptpeer, openpt, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

/// Devices of scenarios are waited for at least this long.
const LATE: Duration = Duration::from_millis(250);
/// How often is looked.
const INTERVAL: Duration = Duration::from_millis(50);

struct Seen {
    /// When the byte was written that has not come yet.
    waits_since: Option<Instant>,
    /// When the newest one came that was late.
    late: Option<Instant>,
}

static SEEN: Mutex<Seen> = Mutex::new(Seen { waits_since: None, late: None });

/// Looks from now on.
pub(crate) fn watch() {
    std::thread::spawn(|| {
        if let Err(error) = look() {
            eprintln!("scenarios: nobody sees whether terminals are late: {error}");
        }
    });
}

/// Whether one was late since then, or is.
pub(crate) fn were_late_since(begin: Instant) -> bool {
    let seen = SEEN.lock().unwrap();
    seen.late.is_some_and(|late| late > begin) || seen.waits_since.is_some_and(|since| since.elapsed() > LATE)
}

/// Writes a byte again and again, and waits until it comes.
fn look() -> io::Result<()> {
    let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
    let master = openpt(flags)?;
    grantpt(&master)?;
    unlockpt(&master)?;
    let terminal = ioctl_tiocgptpeer(&master, flags)?;
    let mut settings = tcgetattr(&terminal)?;
    settings.make_raw();
    tcsetattr(&terminal, OptionalActions::Now, &settings)?;
    loop {
        let begin = Instant::now();
        SEEN.lock().unwrap().waits_since = Some(begin);
        rustix::io::write(&master, &[0])?;
        rustix::io::read(&terminal, &mut [0])?;
        let mut seen = SEEN.lock().unwrap();
        seen.waits_since = None;
        if begin.elapsed() > LATE {
            seen.late = Some(Instant::now());
        }
        drop(seen);
        std::thread::sleep(INTERVAL);
    }
}
