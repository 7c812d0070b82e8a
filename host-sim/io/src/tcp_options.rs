//! Socket options of TCP connections: buffer sizes, detection of a lost peer, and how much the peer has acknowledged.

use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsFd, AsRawFd};
use std::time::Duration;

use rustix::net::sockopt;
use tokio::net::{TcpListener, TcpStream};

/// Limits the system's buffers of each connection that a listening socket accepts, in both directions.
pub fn limit_buffers(listener: &TcpListener) {
    // Accepted connections inherit the sizes. A system that refuses them has limits of its own.
    let _ = sockopt::set_socket_recv_buffer_size(listener, BUFFER);
    let _ = sockopt::set_socket_send_buffer_size(listener, BUFFER);
}

/// Accepts one connection. System errors, such as too few descriptors, are reported to `failed` and retried.
pub async fn accept(listener: &TcpListener, mut failed: impl FnMut(&io::Error)) -> (TcpStream, SocketAddr) {
    loop {
        match listener.accept().await {
            Ok(accepted) => return accepted,
            Err(error) => {
                failed(&error);
                tokio::time::sleep(ACCEPT_AGAIN).await;
            }
        }
    }
}

/// Sends small segments at once (TCP_NODELAY), and ends the connection 20 s after its peer was last heard
/// (SO_KEEPALIVE).
pub fn enable_keepalive(stream: &TcpStream) {
    // Without the options the stream still works; if the peer is gone already, the next read fails.
    let _ = stream.set_nodelay(true);
    let fd = stream.as_fd();
    let _ = sockopt::set_tcp_keepidle(fd, PROBE_INTERVAL);
    let _ = sockopt::set_tcp_keepintvl(fd, PROBE_INTERVAL);
    let _ = sockopt::set_tcp_keepcnt(fd, MAX_PROBES);
    let _ = sockopt::set_socket_keepalive(fd, true);
}

/// Ends the connection when sent data stays unacknowledged for this long (TCP_USER_TIMEOUT).
///
/// With this timeout set, the first lost keepalive probe ends the connection too.
pub fn set_user_timeout(stream: &TcpStream, timeout: Duration) {
    let millis = u32::try_from(timeout.as_millis()).unwrap_or(u32::MAX);
    let _ = sockopt::set_tcp_user_timeout(stream, millis);
}

/// Removes the timeout of [`set_user_timeout`].
pub fn clear_user_timeout(stream: &TcpStream) {
    set_user_timeout(stream, Duration::ZERO);
}

/// As [`enable_keepalive`], and sent data arrives within this time or never: the connection ends, and waiting data is
/// dropped.
pub fn deliver_in_time(stream: &TcpStream, timeout: Duration) {
    enable_keepalive(stream);
    // Data that waits in the system becomes old.
    let _ = sockopt::set_socket_send_buffer_size(stream, BUFFER);
    let _ = reset_on_close(stream);
    set_user_timeout(stream, timeout);
}

/// From now on the connection is reset however it ends, even if this process dies: data that the peer has not received
/// by then is dropped.
pub fn reset_on_close(stream: &TcpStream) -> io::Result<()> {
    stream.set_zero_linger()
}

/// Number of written bytes that the peer has not acknowledged (SIOCOUTQ) or, on a terminal, that have not left
/// (TIOCOUTQ).
pub fn unacknowledged(stream: impl AsFd) -> io::Result<usize> {
    let mut count: libc::c_int = 0;
    // SAFETY: the descriptor is open while it is borrowed; the call writes one int to `count`, which outlives it.
    let done = unsafe { libc::ioctl(stream.as_fd().as_raw_fd(), libc::TIOCOUTQ, &raw mut count) };
    if done < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(usize::try_from(count).unwrap_or(0))
}

/// Pause after a failed accept.
const ACCEPT_AGAIN: Duration = Duration::from_millis(50);
/// Buffer size in bytes in each direction.
const BUFFER: usize = 64 * 1_024;
/// Silence before the first keepalive probe, and time between two probes.
const PROBE_INTERVAL: Duration = Duration::from_secs(5);
/// Number of unanswered probes after which the peer is lost.
const MAX_PROBES: u32 = 3;
/// Silence after which a peer is lost.
#[cfg(test)]
const LOST: Duration = Duration::from_secs(20);

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
        limit_buffers(&listener);
        let near = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        (listener.accept().await.unwrap().0, near)
    }

    #[test]
    fn an_accepted_connection_has_limited_buffers() {
        run(async {
            let (accepted, _peer) = pair().await;
            // Linux doubles the size that it is given.
            let is_limited = |size: usize| size <= 2 * BUFFER;
            assert!(is_limited(sockopt::socket_recv_buffer_size(&accepted).unwrap()));
            assert!(is_limited(sockopt::socket_send_buffer_size(&accepted).unwrap()));
        });
    }

    #[test]
    fn keepalive_finds_a_lost_peer_in_time() {
        run(async {
            let (accepted, _peer) = pair().await;
            enable_keepalive(&accepted);
            assert!(sockopt::socket_keepalive(&accepted).unwrap());
            let probe = sockopt::tcp_keepidle(&accepted).unwrap();
            let between = sockopt::tcp_keepintvl(&accepted).unwrap();
            assert_eq!(probe + between * sockopt::tcp_keepcnt(&accepted).unwrap(), LOST);
        });
    }

    #[test]
    fn a_peer_that_acknowledges_nothing_is_given_up() {
        run(async {
            let (accepted, _peer) = pair().await;
            set_user_timeout(&accepted, Duration::from_millis(300));
            let gone = async {
                loop {
                    match accepted.try_write(&[0; 4_096]) {
                        Ok(_) => {}
                        Err(error) if error.kind() == ErrorKind::WouldBlock => {
                            accepted.writable().await.unwrap();
                        }
                        Err(error) => return error,
                    }
                }
            };
            let error = tokio::time::timeout(Duration::from_secs(20), gone).await.expect("it is still open");
            assert_eq!(error.kind(), ErrorKind::TimedOut);
        });
    }
}
