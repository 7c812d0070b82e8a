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
            // An exclusive client, as tokio-serial is, does not lock us out.
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
