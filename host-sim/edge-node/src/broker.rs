//! Connections to an MQTT broker.

use std::io;
use std::net::ToSocketAddrs;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use recipe_io::connect::connect;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio_rustls::TlsConnector;

/// A broker, and how to connect to it.
#[derive(Debug, Clone)]
pub struct Broker {
    host: String,
    port: u16,
    tls: Option<Arc<ClientConfig>>,
}

/// A connection, with or without TLS.
pub(crate) trait BrokerConnection: AsyncRead + AsyncWrite + Unpin {}

impl<T: AsyncRead + AsyncWrite + Unpin> BrokerConnection for T {}

impl Broker {
    /// A broker without TLS.
    pub fn plain(host: impl Into<String>, port: u16) -> Self {
        Self { host: host.into(), port, tls: None }
    }

    /// A broker with TLS 1.2 or 1.3. It must present a certificate for `host` from one of these authorities.
    ///
    /// # Errors
    /// One message, if the file cannot be read or contains no certificates.
    pub fn with_tls(host: impl Into<String>, port: u16, authorities: &Path) -> Result<Self, String> {
        let refused = |why: &dyn std::fmt::Display| format!("{}: {why}", authorities.display());
        let mut roots = RootCertStore::empty();
        for certificate in CertificateDer::pem_file_iter(authorities).map_err(|error| refused(&error))? {
            let certificate = certificate.map_err(|error| refused(&error))?;
            roots.add(certificate).map_err(|error| refused(&error))?;
        }
        if roots.is_empty() {
            return Err(refused(&"no certificate in it; allowed: PEM"));
        }
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let config = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| refused(&error))?
            .with_root_certificates(roots)
            .with_no_client_auth();
        let host = host.into();
        ServerName::try_from(host.as_str()).map_err(|error| format!("{host:?}: {error}"))?;
        Ok(Self { host, port, tls: Some(Arc::new(config)) })
    }

    /// Host and port, for people.
    pub fn address(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    pub(crate) async fn connect(&self) -> io::Result<Box<dyn BrokerConnection>> {
        let (host, port) = (self.host.clone(), self.port);
        let resolve = move || (host.as_str(), port).to_socket_addrs();
        let addresses: Vec<_> =
            tokio::task::spawn_blocking(resolve).await.map_err(io::Error::other)??.collect();
        let stream = connect(&addresses[..]).await?;
        stream.set_nodelay(true)?;
        let Some(config) = &self.tls else { return Ok(Box::new(stream)) };
        let name = ServerName::try_from(self.host.clone()).map_err(io::Error::other)?;
        let stream = TlsConnector::from(Arc::clone(config)).connect(name, stream).await?;
        Ok(Box::new(stream))
    }
}

/// Closes a connection so that all sent data arrives: closing a socket that has unread data would reset it.
pub(crate) async fn close(mut stream: Box<dyn BrokerConnection>) {
    let _ = tokio::time::timeout(CLOSE_TIME, async {
        stream.shutdown().await?;
        let mut rest = [0; 256];
        while stream.read(&mut rest).await? > 0 {}
        io::Result::Ok(())
    })
    .await;
}

/// The longest time that closing a connection may take.
const CLOSE_TIME: Duration = Duration::from_millis(500);
