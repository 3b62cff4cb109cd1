//! Promise: a Rust client, a Python client over gRPC and a Python client over zenoh stream at the same time, through TLS;
//! whatever happens to their connections and to themselves leaves no trace in the maps.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    io::{BufRead, BufReader},
    net::SocketAddr,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Duration,
};

use lanemap_client::{
    ClientError, ConnectOptions, Credentials, Event, IdentityFiles, IngestClient, MapClient, Reconnect, Session,
    SessionStart, SpoolError, SpoolOptions, SpooledDrive, Token, WhenFull,
};
use lanemap_server::{RunningServer, Server, ServerConfig, config::ZenohMode};
use lanemap_tests::{
    authorities::TlsFolder,
    drives::{self, Drive, assert_same_map},
    endpoints::HeldEndpoint,
    proxy::{Fault, Proxy},
    python::{self, PythonClient, PythonRun},
    servers,
    tokens::{self, TokenIssuer},
};
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::time::timeout;

/// Longest wait for what takes seconds on an idle machine.
const PATIENCE: Duration = Duration::from_mins(3);
/// A connection that says nothing for so long, twice, is given up.
const KEEP_ALIVE: Duration = Duration::from_millis(700);
/// Bytes towards the server between two faults: a connection comes some tens of frames far.
const FAULT_EVERY_BYTES: u64 = 20_000;
/// Every fault, and each again on the connection that the one before has made new.
const FAULTS: [Fault; 6] =
    [Fault::Cut, Fault::Stall, Fault::Delay(Duration::from_millis(20)), Fault::Cut, Fault::Cut, Fault::Stall];

/// A server that is a zenoh router too, and a folder of its own.
struct Service {
    server: RunningServer,
    zenoh: HeldEndpoint,
    folder: TempDir,
    tls: Option<VehicleTls>,
}

/// What a vehicle needs to know where everything is encrypted, and who is who is known by certificates.
struct VehicleTls {
    files: TlsFolder,
    ca: PathBuf,
    identity: IdentityFiles,
    issuer: TokenIssuer,
}

impl VehicleTls {
    /// Certificates for the vehicle that streams [`Drive::start`].
    fn new(folder: &Path) -> Self {
        let files = TlsFolder::new(folder);
        let vehicle = files.vehicles.vehicle_by_common_name("test-fleet", "vehicle-under-test", 7);
        let identity = IdentityFiles {
            cert: files.write("vehicle.crt", &vehicle.certificate),
            key: files.write("vehicle.key", &vehicle.key),
        };
        let ca = files.write("servers-ca.crt", &files.servers.pem());
        Self { files, ca, identity, issuer: TokenIssuer::new("readers") }
    }

    fn credentials(&self) -> Credentials {
        Credentials { ca: Some(self.ca.clone()), identity: Some(self.identity.clone()), ..Credentials::default() }
    }

    /// A reader of maps, who is known by a token.
    fn reader(&self) -> Credentials {
        let token = self.issuer.token(json!({ "scope": "read" }));
        Credentials { ca: Some(self.ca.clone()), token: Some(Token::Text(token)), ..Credentials::default() }
    }

    fn python_options(&self) -> Vec<String> {
        let files = [("--ca", &self.ca), ("--cert", &self.identity.cert), ("--key", &self.identity.key)];
        files.into_iter().flat_map(|(option, path)| [option.to_owned(), path.display().to_string()]).collect()
    }

    /// Settings of a server that knows the vehicle and the reader.
    fn config(&self) -> ServerConfig {
        ServerConfig {
            zenoh_vehicles_file: Some(self.files.write("vehicles", "test-fleet/vehicle-under-test\n")),
            token_keys_file: Some(self.files.write("keys.json", &TokenIssuer::jwks(&[&self.issuer]))),
            token_issuer: Some(tokens::ISSUER.to_owned()),
            ..self.files.config()
        }
    }
}

/// A client, and the way that it takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Vehicle {
    RustOverGrpc,
    PythonOverGrpc,
    PythonOverZenoh,
}

impl Service {
    async fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let config = servers::config(&folder.path().join("data"));
        Self::start_with(config, HeldEndpoint::tcp(), folder, None).await
    }

    /// With TLS and client certificates, and nothing without.
    async fn start_secured() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let tls = VehicleTls::new(folder.path());
        let zenoh = HeldEndpoint::tls();
        Self::start_with(tls.config(), zenoh, folder, Some(tls)).await
    }

    async fn start_with(config: ServerConfig, zenoh: HeldEndpoint, folder: TempDir, tls: Option<VehicleTls>) -> Self {
        let config = ServerConfig { zenoh_mode: ZenohMode::Router, zenoh_listen: zenoh.parse().unwrap(), ..config };
        Self { server: Server::start(config).await.unwrap(), zenoh, folder, tls }
    }

    fn credentials(&self) -> Credentials {
        self.tls.as_ref().map(VehicleTls::credentials).unwrap_or_default()
    }

    /// `address` for gRPC and HTTP.
    fn http_url(&self, address: SocketAddr) -> String {
        format!("{}://{address}", if self.tls.is_some() { "https" } else { "http" })
    }

    /// `address` for zenoh.
    fn zenoh_url(&self, address: SocketAddr) -> String {
        format!("{}/{address}", if self.tls.is_some() { "tls" } else { "tcp" })
    }

    /// Where a vehicle's way ends.
    fn address_for(&self, vehicle: Vehicle) -> SocketAddr {
        match vehicle {
            Vehicle::RustOverGrpc | Vehicle::PythonOverGrpc => self.address(),
            Vehicle::PythonOverZenoh => self.zenoh.split_once('/').unwrap().1.parse().unwrap(),
        }
    }

    /// Streams a drive as a vehicle does, to `address`; the bytes of its map.
    async fn map_streamed_by(&self, vehicle: Vehicle, address: SocketAddr, drive: &Drive) -> Vec<u8> {
        let folder = self.path(&drive.name);
        std::fs::create_dir(&folder).unwrap();
        let python_options = self.tls.as_ref().map(VehicleTls::python_options).unwrap_or_default();
        let session = match vehicle {
            Vehicle::RustOverGrpc => stream_by_rust(self.http_url(address), self.credentials(), drive, &folder).await,
            Vehicle::PythonOverGrpc => stream_by_python(&self.http_url(address), &python_options, drive, &folder).await,
            Vehicle::PythonOverZenoh => {
                stream_by_python(&self.zenoh_url(address), &python_options, drive, &folder).await
            }
        };
        self.map(&session).await
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn address(&self) -> SocketAddr {
        self.server.address()
    }

    /// The bytes of `/sessions/{id}/lanes.pb`.
    async fn map(&self, session: &str) -> Vec<u8> {
        let reader = self.tls.as_ref().map(VehicleTls::reader).unwrap_or_default();
        let maps = MapClient::with(self.http_url(self.address()), &reader).await.unwrap();
        maps.lane_map_bytes(session).await.unwrap()
    }
}

/// A client that survives what the proxy does.
fn connect_options(credentials: Credentials) -> ConnectOptions {
    ConnectOptions { credentials, keep_alive: KEEP_ALIVE, open_timeout: 4 * KEEP_ALIVE }
}

/// A client of a service that is not there.
async fn client_of_nobody() -> IngestClient {
    IngestClient::offline("http://127.0.0.1:1", connect_options(Credentials::default())).await.unwrap()
}

fn spooled(drive: &Drive, folder: &Path) -> SessionStart {
    let spool = SpoolOptions { max_bytes: 4 * 1024 * 1024, ..SpoolOptions::new(folder) };
    let reconnect = Reconnect { longest_pause: Duration::from_millis(500), ..Reconnect::forever() };
    SessionStart { spool: Some(spool), reconnect, ..drive.start() }
}

/// Streams a drive by the Rust client; the session's name.
async fn stream_by_rust(url: String, credentials: Credentials, drive: &Drive, spool: &Path) -> String {
    let client = IngestClient::offline(url, connect_options(credentials)).await.unwrap();
    let (mut session, _events) = client.begin_session(spooled(drive, spool)).await.unwrap();
    send_rest(&mut session, drive).await;
    session.wait_opened().await.unwrap();
    let id = session.id().to_owned();
    let summary = session.finish().await.unwrap();
    assert_eq!((summary.acked, summary.refused), (drive.frames.last().map(lanemap_core::Frame::sequence), 0));
    id
}

/// Sends the frames that the spool has not had yet.
async fn send_rest(session: &mut Session, drive: &Drive) {
    let last = session.last_spooled();
    for frame in drive.frames.iter().filter(|frame| Some(frame.sequence()) > last) {
        session.send(frame).await.unwrap();
    }
}

/// Streams a drive by the Python client; the session's name.
async fn stream_by_python(url: &str, options: &[String], drive: &Drive, folder: &Path) -> String {
    let file = python::write_drive(drive, folder);
    let keep_alive = ["--keep-alive-s".to_owned(), KEEP_ALIVE.as_secs_f64().to_string()];
    let options = [options, &keep_alive].concat();
    let run = PythonRun { url, drive: &file, spool: &folder.join("spool"), options: &options };
    python_report(PythonClient::start(&run), drive).await
}

/// The numbers that no frame of a drive has, each run of them by its first and its last.
fn gaps_in(drive: &Drive) -> Vec<(u64, u64)> {
    let numbers = drive.frames.windows(2).map(|pair| (pair[0].sequence().0, pair[1].sequence().0));
    numbers.filter(|(before, after)| before + 1 < *after).map(|(before, after)| (before + 1, after - 1)).collect()
}

async fn python_report(client: PythonClient, drive: &Drive) -> String {
    let report: Value = serde_json::from_str(&client.finish().await).unwrap();
    let last = drive.frames.last().unwrap().sequence().0;
    let gaps = json!(gaps_in(drive));
    assert_eq!((&report["acked"], &report["refused"], &report["gaps"]), (&last.into(), &0.into(), &gaps), "{report}");
    report["session"].as_str().unwrap().to_owned()
}

/// Streams three drives at once through TLS; their maps. One vehicle's way leads through a proxy that does everything it can.
async fn maps_of_three(drives: &[Drive; 3], disturbed: Option<Vehicle>) -> [Vec<u8>; 3] {
    let service = Service::start_secured().await;
    let proxy = match disturbed {
        Some(vehicle) => Some(Proxy::start(service.address_for(vehicle), FAULT_EVERY_BYTES, &FAULTS).await),
        None => None,
    };
    let stream = |vehicle, drive| {
        let through = proxy.as_ref().filter(|_| disturbed == Some(vehicle));
        let address = through.map_or_else(|| service.address_for(vehicle), Proxy::address);
        service.map_streamed_by(vehicle, address, drive)
    };
    let (rust, python, zenoh) = tokio::join!(
        timeout(PATIENCE, stream(Vehicle::RustOverGrpc, &drives[0])),
        timeout(PATIENCE, stream(Vehicle::PythonOverGrpc, &drives[1])),
        timeout(PATIENCE, stream(Vehicle::PythonOverZenoh, &drives[2])),
    );
    if let Some(proxy) = proxy {
        assert_eq!(proxy.faults_begun(), FAULTS.len() as u64, "the proxy has not done all that it can");
    }
    [rust.unwrap(), python.unwrap(), zenoh.unwrap()]
}

/// Promises that what happens to one vehicle's connection shows in no map.
async fn assert_maps_bear_no_trace_of_what_happens_to(disturbed: Vehicle) {
    let drives = [drives::simulated(41, 200), drives::simulated(42, 200), drives::simulated(43, 200)];
    let (undisturbed, maps) = (maps_of_three(&drives, None).await, maps_of_three(&drives, Some(disturbed)).await);
    for ((drive, undisturbed), map) in drives.iter().zip(&undisturbed).zip(&maps) {
        assert_same_map(undisturbed, drive);
        assert!(map == undisturbed, "{}: another map than that of an undisturbed run", drive.name);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn three_clients_at_once_and_the_rust_ones_network_breaks_without_a_trace_in_their_maps() {
    assert_maps_bear_no_trace_of_what_happens_to(Vehicle::RustOverGrpc).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn three_clients_at_once_and_the_python_ones_network_breaks_without_a_trace_in_their_maps() {
    assert_maps_bear_no_trace_of_what_happens_to(Vehicle::PythonOverGrpc).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn three_clients_at_once_and_the_zenoh_ones_network_breaks_without_a_trace_in_their_maps() {
    assert_maps_bear_no_trace_of_what_happens_to(Vehicle::PythonOverZenoh).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_rust_client_over_zenoh_behind_a_proxy_that_cuts_delays_and_stalls_delivers_every_frame_once() {
    let service = Service::start().await;
    let drive = drives::simulated(39, 200);
    let proxy = Proxy::start(service.address_for(Vehicle::PythonOverZenoh), FAULT_EVERY_BYTES, &FAULTS).await;
    let (url, spool) = (format!("tcp/{}", proxy.address()), service.path("spool"));
    let id = timeout(PATIENCE, stream_by_rust(url, Credentials::default(), &drive, &spool)).await.unwrap();
    assert_eq!(proxy.faults_begun(), FAULTS.len() as u64);
    assert_same_map(&service.map(&id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_python_client_killed_again_and_again_leaves_what_it_took_to_its_successors() {
    let service = Service::start().await;
    let drive = drives::simulated(33, 120);
    let file = python::write_drive(&drive, service.folder.path());
    let (url, spool) = (service.server.url(), service.path("spool"));
    for last_taken in [1, 20, 21, 50, 90] {
        let options = ["--pause-after".to_owned(), last_taken.to_string()];
        let run = PythonRun { url: &url, drive: &file, spool: &spool, options: &options };
        let mut client = PythonClient::start(&run);
        assert_eq!(timeout(PATIENCE, client.line()).await.unwrap(), Some(format!("taken {last_taken}")));
        client.kill();
    }
    let run = PythonRun { url: &url, drive: &file, spool: &spool, options: &[] };
    let id = timeout(PATIENCE, python_report(PythonClient::start(&run), &drive)).await.unwrap();
    assert_same_map(&service.map(&id).await, &drive);
    assert!(!spool.exists() || spool.read_dir().unwrap().next().is_none(), "the spool keeps a drive that is delivered");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_rust_client_killed_again_and_again_leaves_what_it_took_to_its_successors() {
    let service = Service::start().await;
    let (seed, frames) = (38, 120);
    let drive = drives::simulated(seed, frames);
    let (url, spool) = (service.server.url(), service.path("spool"));
    let start = |pause_after: u64| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_killable-client"));
        let numbers = [seed.to_string(), frames.to_string(), pause_after.to_string()];
        command.arg(&url).arg(&spool).args(numbers).stdout(Stdio::piped()).spawn().unwrap()
    };
    for last_taken in [1, 20, 21, 50, 90] {
        let mut client = start(last_taken);
        let mut line = String::new();
        BufReader::new(client.stdout.take().unwrap()).read_line(&mut line).unwrap();
        client.kill().unwrap();
        client.wait().unwrap();
        assert_eq!(line.trim(), format!("taken {last_taken}"));
    }
    let output = start(0).wait_with_output().unwrap();
    assert!(output.status.success());
    let id = String::from_utf8(output.stdout).unwrap();
    assert_same_map(&service.map(id.trim()).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_spool_that_one_language_has_left_is_delivered_by_the_other() {
    let service = Service::start().await;
    let drive = drives::simulated(34, 80);
    let spool = service.path("spool");
    // Nobody listens there: the Rust client can only spool.
    let nowhere = client_of_nobody().await;
    let (mut session, _events) = nowhere.begin_session(spooled(&drive, &spool)).await.unwrap();
    for frame in &drive.frames[..40] {
        session.send(frame).await.unwrap();
    }
    session.abort().await;
    let id =
        timeout(PATIENCE, stream_by_python(&service.server.url(), &[], &drive, service.folder.path())).await.unwrap();
    assert_same_map(&service.map(&id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn drives_that_earlier_processes_left_are_delivered_and_ended_as_they_were() {
    let service = Service::start().await;
    let folder = service.path("spool");
    let nowhere = client_of_nobody().await;
    let drives = [drives::simulated(35, 40), drives::simulated(36, 40)];
    for drive in &drives {
        let (mut session, _events) = nowhere.begin_session(spooled(drive, &folder)).await.unwrap();
        send_rest(&mut session, drive).await;
        session.abort().await;
    }
    let left = SpooledDrive::list(&folder).unwrap();
    assert_eq!(left.iter().map(|drive| (drive.frames, drive.ended)).collect::<Vec<_>>(), [(40, false), (40, false)]);

    let client = IngestClient::connect(service.server.url()).await.unwrap();
    let delivered = client.deliver_spooled(&SpoolOptions::new(&folder)).await.unwrap();
    assert_eq!(delivered.len(), 2);
    for drive in &drives {
        let (session, _events) = client.start_session(drive.start()).await.unwrap();
        assert_eq!(session.resume_after(), drive.frames.last().map(lanemap_core::Frame::sequence));
        assert_same_map(&service.map(session.id()).await, drive);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_spool_refuses_the_newest_frame_and_the_session_goes_on() {
    let service = Service::start().await;
    let drive = drives::simulated(37, 150);
    let spool = SpoolOptions {
        max_bytes: SpoolOptions::MIN_BYTES,
        when_full: WhenFull::Refuse,
        ..SpoolOptions::new(service.path("spool"))
    };
    let start = SessionStart { spool: Some(spool.clone()), ..spooled(&drive, &spool.folder) };
    let nowhere = client_of_nobody().await;
    let (mut session, _events) = nowhere.begin_session(start.clone()).await.unwrap();
    let mut taken = 0;
    let error = loop {
        match session.send(&drive.frames[taken]).await {
            Ok(()) => taken += 1,
            Err(error) => break error,
        }
    };
    assert!(matches!(error, ClientError::Spool(SpoolError::Full { .. })), "{error}");
    assert!(session.send(&drive.frames[taken]).await.is_err(), "full is full");
    session.abort().await;

    // Once a service is there, acks make room for the rest.
    let client = IngestClient::connect(service.server.url()).await.unwrap();
    let (mut session, _events) = client.start_session(start).await.unwrap();
    session.wait_acked(drive.frames[taken - 1].sequence()).await.unwrap();
    for frame in &drive.frames[taken..] {
        session.send(frame).await.unwrap();
        session.wait_acked(frame.sequence()).await.unwrap();
    }
    let id = session.id().to_owned();
    session.finish().await.unwrap();
    assert_same_map(&service.map(&id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn numbers_that_no_frame_has_are_told_as_gaps_whatever_the_way() {
    let service = Service::start().await;
    let whole = drives::simulated(40, 60);
    let frames = [&whole.frames[..20], &whole.frames[25..40], &whole.frames[41..]].concat();
    let drive = Drive { frames, ..whole };
    let expected = vec![(21, 25), (41, 41)];
    assert_eq!(gaps_in(&drive), expected);
    let zenoh = service.zenoh.to_string();
    for (url, vehicle) in [(service.server.url(), "over gRPC"), (zenoh.clone(), "over zenoh")] {
        let client = IngestClient::offline(url, ConnectOptions::default()).await.unwrap();
        let start = SessionStart { vehicle: vehicle.to_owned(), ..drive.start() };
        let (mut session, mut events) = client.begin_session(start).await.unwrap();
        for frame in &drive.frames {
            session.send(frame).await.unwrap();
        }
        session.finish().await.unwrap();
        let mut gaps = Vec::new();
        while let Some(event) = events.next().await {
            if let Event::Gap { first, last } = event {
                gaps.push((first.0, last.0));
            }
        }
        assert_eq!(gaps, expected, "{vehicle}");
    }
    for (name, url) in [("python over gRPC", service.server.url()), ("python over zenoh", zenoh)] {
        let folder = service.path(name);
        std::fs::create_dir(&folder).unwrap();
        let options = ["--vehicle".to_owned(), name.to_owned()];
        // What it prints at the end is compared with the gaps of the drive.
        timeout(PATIENCE, stream_by_python(&url, &options, &drive, &folder)).await.unwrap();
    }
}
