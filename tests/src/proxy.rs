//! A TCP proxy between a client and a server that does to their connection what tunnels, cells and routers do: it cuts,
//! it delays, and it stalls, so that a connection is open and carries nothing.
//!
//! What it does depends on the bytes that it has carried towards the server, on nothing else: no clock, no chance.

use std::{
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::{
        TcpListener, TcpStream,
        tcp::{OwnedReadHalf, OwnedWriteHalf},
    },
    task::JoinHandle,
    time::sleep,
};

/// Bytes taken at once.
const CHUNK: usize = 4096;

/// What is done to the connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Both ends are told that it is over, in the middle of whatever was sent.
    Cut,
    /// It goes on, every chunk so late, in both directions, until the next fault.
    Delay(Duration),
    /// Nothing is carried any more, and nobody is told. Ends when the client gives the connection up.
    Stall,
}

/// A running proxy; it ends when it is dropped.
#[derive(Debug)]
pub struct Proxy {
    address: SocketAddr,
    log: Arc<Log>,
    accepting: JoinHandle<()>,
}

/// What has happened so far.
#[derive(Debug)]
struct Log {
    /// Done one after the other, each after so many bytes more towards the server.
    faults: Vec<Fault>,
    every_bytes: u64,
    carried: AtomicU64,
    /// How many faults have begun.
    begun: AtomicU64,
    connections: AtomicU64,
}

impl Proxy {
    /// A proxy to `server` that begins the next of `faults` after every `every_bytes` towards the server.
    pub async fn start(server: SocketAddr, every_bytes: u64, faults: &[Fault]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let log = Arc::new(Log {
            faults: faults.to_vec(),
            every_bytes,
            carried: AtomicU64::new(0),
            begun: AtomicU64::new(0),
            connections: AtomicU64::new(0),
        });
        let accepting = tokio::spawn(accept(listener, server, Arc::clone(&log)));
        Self { address, log, accepting }
    }

    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// How many of the faults have begun.
    #[must_use]
    pub fn faults_begun(&self) -> u64 {
        self.log.begun.load(Ordering::SeqCst)
    }

    /// Connections that clients have made.
    #[must_use]
    pub fn connections(&self) -> u64 {
        self.log.connections.load(Ordering::SeqCst)
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.accepting.abort();
    }
}

async fn accept(listener: TcpListener, server: SocketAddr, log: Arc<Log>) {
    while let Ok((client, _)) = listener.accept().await {
        log.connections.fetch_add(1, Ordering::SeqCst);
        tokio::spawn(carry(client, server, Arc::clone(&log)));
    }
}

/// Carries one connection to its end, whoever ends it.
async fn carry(client: TcpStream, server: SocketAddr, log: Arc<Log>) {
    let Ok(server) = TcpStream::connect(server).await else { return };
    let _ = (client.set_nodelay(true), server.set_nodelay(true));
    let ((from_client, to_client), (from_server, to_server)) = (client.into_split(), server.into_split());
    let stalled = AtomicBool::new(false);
    tokio::select! {
        () = upstream(from_client, to_server, &log, &stalled) => {}
        () = downstream(from_server, to_client, &log, &stalled) => {}
    }
}

async fn upstream(mut client: OwnedReadHalf, mut server: OwnedWriteHalf, log: &Log, stalled: &AtomicBool) {
    let mut chunk = vec![0; CHUNK];
    while let Ok(length @ 1..) = client.read(&mut chunk).await {
        log.carried.fetch_add(length as u64, Ordering::SeqCst);
        match log.begin_next_fault() {
            Some(Fault::Cut) => return,
            Some(Fault::Stall) => {
                stalled.store(true, Ordering::SeqCst);
                return swallow(client).await;
            }
            Some(Fault::Delay(_)) | None => {}
        }
        log.delay().await;
        if server.write_all(&chunk[..length]).await.is_err() {
            return;
        }
    }
}

async fn downstream(mut server: OwnedReadHalf, mut client: OwnedWriteHalf, log: &Log, stalled: &AtomicBool) {
    let mut chunk = vec![0; CHUNK];
    while let Ok(length @ 1..) = server.read(&mut chunk).await {
        log.delay().await;
        if stalled.load(Ordering::SeqCst) {
            // The other direction ends the connection; this one carries nothing meanwhile.
            return std::future::pending().await;
        }
        if client.write_all(&chunk[..length]).await.is_err() {
            return;
        }
    }
}

/// Takes what the client sends and carries it nowhere, until the client gives up.
async fn swallow(mut client: OwnedReadHalf) {
    let mut chunk = vec![0; CHUNK];
    while let Ok(1..) = client.read(&mut chunk).await {}
}

impl Log {
    /// The fault that is due now, if one is.
    fn begin_next_fault(&self) -> Option<Fault> {
        let begun = self.begun.load(Ordering::SeqCst);
        let due = self.carried.load(Ordering::SeqCst) >= (begun + 1) * self.every_bytes;
        let fault = *self.faults.get(usize::try_from(begun).unwrap()).filter(|_| due)?;
        self.begun.fetch_add(1, Ordering::SeqCst);
        Some(fault)
    }

    async fn delay(&self) {
        let begun = usize::try_from(self.begun.load(Ordering::SeqCst)).unwrap();
        if let Some(Fault::Delay(late)) = begun.checked_sub(1).map(|newest| self.faults[newest]) {
            sleep(late).await;
        }
    }
}
