//! The address of a gateway: `--to ADDRESS[:PORT]`.
//!
//! The default port is that of a board, 80. On this machine, where no board is, it is 8480.

use std::fmt;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::str::FromStr;

/// The port of a board.
const BOARD: u16 = 80;
/// The port of a gateway on this machine, as in the examples.
const HERE: u16 = 8480;

/// An address as given by a person.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    host: String,
    port: Option<u16>,
}

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let refused =
            |why: &str| Err(format!("{text:?} {why}; write ADDRESS or ADDRESS:PORT, such as 192.168.0.20"));
        if text.contains("://") {
            return refused("is not an address but a link");
        }
        // An IPv6 address has colons of its own.
        let (host, port) = if let Some(rest) = text.strip_prefix('[') {
            match rest.split_once(']') {
                Some((host, "")) => (host, None),
                Some((host, port)) if port.starts_with(':') => (host, Some(&port[1..])),
                _ => return refused("is not an address"),
            }
        } else if text.parse::<IpAddr>().is_ok() {
            (text, None)
        } else {
            match text.rsplit_once(':') {
                Some((host, port)) => (host, Some(port)),
                None => (text, None),
            }
        };
        let is_host = |c: char| c.is_alphanumeric() || ".-_:%".contains(c);
        if host.is_empty() || !host.chars().all(is_host) {
            return refused("is not an address");
        }
        let port = match port.map(str::parse::<u16>) {
            None => None,
            Some(Ok(port)) if port > 0 => Some(port),
            Some(_) => return refused("has a port that is not within 1..=65535"),
        };
        Ok(Self { host: host.to_owned(), port })
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let is_v6 = self.host.contains(':');
        match (is_v6, self.port) {
            (true, Some(port)) => write!(f, "[{}]:{port}", self.host),
            (false, Some(port)) => write!(f, "{}:{port}", self.host),
            (_, None) => f.write_str(&self.host),
        }
    }
}

impl Address {
    /// The socket addresses of this address.
    ///
    /// # Errors
    /// The system's message, if the name cannot be resolved.
    pub fn resolve(&self) -> Result<Vec<SocketAddr>, String> {
        let found = (self.host.as_str(), self.port.unwrap_or(BOARD)).to_socket_addrs();
        let found: Vec<_> = found.map_err(|error| error.to_string())?.collect();
        if found.is_empty() {
            return Err("the name has no address".into());
        }
        let place = |mut place: SocketAddr| {
            if self.port.is_none() && place.ip().to_canonical().is_loopback() {
                place.set_port(HERE);
            }
            place
        };
        Ok(found.into_iter().map(place).collect())
    }

    /// A hint for an unreachable gateway.
    pub(crate) fn hint(&self, place: SocketAddr) -> &'static str {
        match self.port {
            None if place.port() == HERE => "; without a port it is 8480 on this machine",
            None => {
                "; without a port it is 80, where a board is: write that of --console for another machine"
            }
            Some(_) => "",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn place(text: &str) -> String {
        text.parse::<Address>().unwrap().resolve().unwrap()[0].to_string()
    }

    #[test]
    fn without_a_port_it_is_a_boards_or_on_this_machine_the_examples() {
        assert_eq!(place("192.168.0.20"), "192.168.0.20:80");
        assert_eq!(place("192.168.0.20:8480"), "192.168.0.20:8480");
        assert_eq!(place("127.0.0.1"), "127.0.0.1:8480");
        assert_eq!(place("127.0.0.1:81"), "127.0.0.1:81");
        assert_eq!(place("::1"), "[::1]:8480");
        assert_eq!(place("[::1]:80"), "[::1]:80");
        assert_eq!(place("[fd00::2]"), "[fd00::2]:80");
        for shown in ["gateway-3", "gateway-3:81", "[fd00::2]:81"] {
            assert_eq!(shown.parse::<Address>().unwrap().to_string(), shown);
        }
    }

    #[test]
    fn what_is_no_address_is_refused_with_an_example() {
        for wrong in
            ["", ":80", "a:0", "a:65536", "a:b", "http://a", "a/b", "a b", "[::1", "[::1]80", "a\n", "a:"]
        {
            let error = wrong.parse::<Address>().unwrap_err();
            assert!(error.contains("such as 192.168.0.20"), "{wrong:?}: {error}");
            assert!(!error.contains('\n'));
        }
    }
}
