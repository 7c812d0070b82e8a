//! Outgoing TCP connections.

use std::io;

use tokio::net::{TcpStream, ToSocketAddrs};

/// Connects, but never to itself. A client that keeps trying a local port without a listener eventually gets that port
/// as its own, and TCP then connects the socket to itself.
///
/// # Errors
/// As [`TcpStream::connect`]; a connection to itself is reported as refused.
pub async fn connect(to: impl ToSocketAddrs) -> io::Result<TcpStream> {
    let stream = TcpStream::connect(to).await?;
    if stream.local_addr()? == stream.peer_addr()? {
        return Err(io::ErrorKind::ConnectionRefused.into());
    }
    Ok(stream)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::net::TcpSocket;

    #[test]
    fn a_socket_can_connect_to_itself_and_others_still_can() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            // On purpose, what the system does by chance.
            let socket = TcpSocket::new_v4().unwrap();
            socket.bind("127.0.0.1:0".parse().unwrap()).unwrap();
            let own = socket.local_addr().unwrap();
            let stream = socket.connect(own).await.unwrap();
            assert_eq!(stream.local_addr().unwrap(), stream.peer_addr().unwrap());
            drop(stream);
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
            connect(listener.local_addr().unwrap()).await.unwrap();
        });
    }
}
