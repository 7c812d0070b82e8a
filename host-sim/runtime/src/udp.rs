//! UDP sockets that report peers that cannot be reached.

use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::os::fd::AsRawFd;

use rustix::net::{RecvAncillaryBuffer, RecvFlags, recvmsg};
use tokio::net::UdpSocket;

/// Enables reports of ICMP errors on an unconnected socket (D24): after one, the next call on the socket
/// fails, and [`unreachable_peers`] returns the peers.
pub(super) fn keep_errors(socket: &UdpSocket) -> io::Result<()> {
    let on: libc::c_int = 1;
    let (level, name) = match socket.local_addr()? {
        SocketAddr::V4(_) => (libc::SOL_IP, libc::IP_RECVERR),
        SocketAddr::V6(_) => (libc::SOL_IPV6, libc::IPV6_RECVERR),
    };
    // SAFETY: the descriptor is open while `socket` is borrowed; the option's value is an int that outlives the call.
    let done = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            level,
            name,
            (&raw const on).cast(),
            size_of_val(&on) as libc::socklen_t,
        )
    };
    if done == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// Peers for which ICMP errors arrived since the last call.
pub(super) fn unreachable_peers(socket: &UdpSocket) -> Vec<SocketAddr> {
    let mut peers = Vec::new();
    while peers.len() < MAX_AT_ONCE {
        let mut none = [0; 1];
        let mut slices = [IoSliceMut::new(&mut none)];
        let flags = RecvFlags::ERRQUEUE | RecvFlags::DONTWAIT;
        let Ok(message) = recvmsg(socket, &mut slices, &mut RecvAncillaryBuffer::default(), flags) else {
            break;
        };
        peers.extend(message.address.and_then(|address| SocketAddr::try_from(address).ok()));
    }
    peers
}

/// Maximum number of errors per call; the rest remains for the next one.
const MAX_AT_ONCE: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_undeliverable_datagram_names_its_peer() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
            keep_errors(&socket).unwrap();
            let gone = UdpSocket::bind("127.0.0.1:0").await.unwrap();
            let peer = gone.local_addr().unwrap();
            let here = UdpSocket::bind("127.0.0.1:0").await.unwrap();
            drop(gone);
            assert_eq!(unreachable_peers(&socket), []);
            socket.send_to(b"x", peer).await.unwrap();
            let error = socket.recv_from(&mut [0; 8]).await.unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::ConnectionRefused);
            assert_eq!(unreachable_peers(&socket), [peer]);
            socket.send_to(b"x", here.local_addr().unwrap()).await.unwrap();
            assert_eq!(unreachable_peers(&socket), []);
        });
    }
}
