//! What the system is asked to do for a TCP connection: bounds on what it holds, an end when the peer has
//! vanished, and word of what the peer has got.

use std::io;
use std::os::fd::{AsFd, AsRawFd};
use std::time::Duration;

use rustix::net::sockopt;
use tokio::net::{TcpListener, TcpStream};

/// Bounds what waits in the system for each connection of a listening socket, each way.
pub fn bound(listener: &TcpListener) {
    // Connections take it over. A system that refuses has bounds of its own.
    let _ = sockopt::set_socket_recv_buffer_size(listener, BUFFER);
    let _ = sockopt::set_socket_send_buffer_size(listener, BUFFER);
}

/// Nothing waits for more to come, and a peer that has vanished without a word is found after 20 s.
pub fn watch(stream: &TcpStream) {
    // A stream that refuses works all the same, and a peer that is gone already is found by the next read.
    let _ = stream.set_nodelay(true);
    let fd = stream.as_fd();
    let _ = sockopt::set_tcp_keepidle(fd, PROBE);
    let _ = sockopt::set_tcp_keepintvl(fd, PROBE);
    let _ = sockopt::set_tcp_keepcnt(fd, PROBES);
    let _ = sockopt::set_socket_keepalive(fd, true);
}

/// The connection ends when its peer takes nothing of what waits for it for this long.
///
/// While such a limit stands, the first question of [`watch`] that is lost ends the connection too.
pub fn give_up_after(stream: &TcpStream, patience: Duration) {
    let millis = u32::try_from(patience.as_millis()).unwrap_or(u32::MAX);
    let _ = sockopt::set_tcp_user_timeout(stream, millis);
}

/// Takes the limit of [`give_up_after`] away.
pub fn be_patient(stream: &TcpStream) {
    give_up_after(stream, Duration::ZERO);
}

/// However the connection ends from now on, even with this process, the peer is told by a reset and gets
/// nothing that it had not got by then.
///
/// # Errors
/// When the system refuses the option.
pub fn abandon_at_end(stream: &TcpStream) -> io::Result<()> {
    stream.set_zero_linger()
}

/// How many of the bytes that the system took its peer has not acknowledged (SIOCOUTQ).
///
/// # Errors
/// When the system does not tell.
pub fn unacknowledged(stream: &TcpStream) -> io::Result<usize> {
    let mut count: libc::c_int = 0;
    // SAFETY: the descriptor is open while `stream` is borrowed, and the call writes one int to `count`,
    // which outlives it.
    let done = unsafe { libc::ioctl(stream.as_raw_fd(), libc::TIOCOUTQ, &raw mut count) };
    if done < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(usize::try_from(count).unwrap_or(0))
}

/// Bytes each way.
const BUFFER: usize = 64 * 1_024;
/// Silence before the first question whether a peer is there, and between two.
const PROBE: Duration = Duration::from_secs(5);
/// Questions without an answer.
const PROBES: u32 = 3;
/// Silence until a peer counts as vanished.
#[cfg(test)]
const VANISHED: Duration = Duration::from_secs(20);

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::ErrorKind;

    fn run(test: impl Future<Output = ()>) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(test);
    }

    async fn pair() -> (TcpStream, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        bound(&listener);
        let near = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        (listener.accept().await.unwrap().0, near)
    }

    #[test]
    fn what_the_system_holds_for_a_connection_is_bounded() {
        run(async {
            let (taken, _peer) = pair().await;
            let own = |size: usize| size <= 2 * BUFFER;
            assert!(own(sockopt::socket_recv_buffer_size(&taken).unwrap()));
            assert!(own(sockopt::socket_send_buffer_size(&taken).unwrap()));
        });
    }

    #[test]
    fn a_vanished_peer_is_asked_for() {
        run(async {
            let (taken, _peer) = pair().await;
            watch(&taken);
            assert!(sockopt::socket_keepalive(&taken).unwrap());
            let probe = sockopt::tcp_keepidle(&taken).unwrap();
            let between = sockopt::tcp_keepintvl(&taken).unwrap();
            assert_eq!(probe + between * sockopt::tcp_keepcnt(&taken).unwrap(), VANISHED);
        });
    }

    #[test]
    fn a_peer_that_takes_nothing_is_given_up() {
        run(async {
            let (taken, _peer) = pair().await;
            give_up_after(&taken, Duration::from_millis(300));
            let gone = async {
                loop {
                    match taken.try_write(&[0; 4_096]) {
                        Ok(_) => {}
                        Err(error) if error.kind() == ErrorKind::WouldBlock => {
                            taken.writable().await.unwrap();
                        }
                        Err(error) => return error,
                    }
                }
            };
            let error = tokio::time::timeout(Duration::from_secs(20), gone).await.expect("it is kept");
            assert_eq!(error.kind(), ErrorKind::TimedOut);
        });
    }
}
