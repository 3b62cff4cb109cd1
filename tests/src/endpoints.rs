//! Endpoints of zenoh on this machine, each held for the length of a test.

use std::{net::SocketAddr, ops::Deref};

use tokio::net::TcpSocket;

/// An endpoint whose port is given to nobody else: not while nobody listens there yet, nor between two that do.
///
/// A socket holds it that is bound and never listens. Who asks for any free port does not get it, who asks for this one
/// does.
#[derive(Debug)]
pub struct HeldEndpoint {
    endpoint: String,
    _held: TcpSocket,
}

impl HeldEndpoint {
    /// An endpoint over TCP.
    #[must_use]
    pub fn tcp() -> Self {
        Self::new(|address| format!("tcp/{address}"))
    }

    /// An endpoint over TLS, by the machine's address.
    #[must_use]
    pub fn tls() -> Self {
        Self::new(|address| format!("tls/{address}"))
    }

    /// An endpoint over TLS, by the machine's name.
    #[must_use]
    pub fn tls_by_name() -> Self {
        Self::new(|address| format!("tls/localhost:{}", address.port()))
    }

    fn new(endpoint: impl FnOnce(SocketAddr) -> String) -> Self {
        let held = TcpSocket::new_v4().unwrap();
        held.set_reuseaddr(true).unwrap();
        held.bind(([127, 0, 0, 1], 0).into()).unwrap();
        Self { endpoint: endpoint(held.local_addr().unwrap()), _held: held }
    }
}

impl Deref for HeldEndpoint {
    type Target = str;

    fn deref(&self) -> &str {
        &self.endpoint
    }
}
