//! Promise: nothing that readers, operators or thieves of the store see names a vehicle, and what is to be forgotten is
//! gone from the disk.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    io::{BufRead, BufReader, Read},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::{Arc, Mutex},
    thread,
    time::Duration,
};

use lanemap_proto::{
    encode,
    v1::{
        self, admin_service_client::AdminServiceClient, ingest_service_client::IngestServiceClient,
        map_service_client::MapServiceClient, stream_observations_request::Message,
    },
};
use lanemap_server::{Server, ServerConfig};
use lanemap_tests::{
    drives::{self, Drive},
    http,
    raw_stream::RawStream,
    servers::{self, ServerProcess},
};
use tonic::{Code, Status};

/// Longest wait for what takes a second or two.
const PATIENCE: Duration = Duration::from_mins(1);

const FLEET: &str = "fleet-q7x4m2";
const VEHICLE: &str = "vehicle-z9k3w8";

/// The start of a drive of a vehicle whose names are found nowhere else.
fn start(drive: &Drive, vehicle: &str, name: &str) -> v1::SessionStart {
    let (fleet_id, vehicle_id, drive_id) = (FLEET.to_owned(), vehicle.to_owned(), name.to_owned());
    v1::SessionStart { fleet_id, vehicle_id, drive_id, ..drive.wire_start() }
}

/// Uploads frames of a drive; gives the session's id.
async fn upload(url: &str, start: v1::SessionStart, frames: Vec<v1::Frame>, end: bool) -> Result<String, Status> {
    let mut client = IngestServiceClient::connect(url.to_owned()).await.unwrap();
    let request = v1::UploadObservationsRequest { start: Some(start), frames, end };
    Ok(client.upload_observations(request).await?.into_inner().accepted.unwrap().session_id)
}

fn wire(drive: &Drive) -> Vec<v1::Frame> {
    drive.frames.iter().map(encode::frame).collect()
}

async fn forget(url: &str, vehicle: &str, drive: Option<&str>) -> Result<u64, Status> {
    let mut client = AdminServiceClient::connect(url.to_owned()).await.unwrap();
    let drive_id = drive.map(str::to_owned);
    let request = v1::ForgetRequest { fleet_id: FLEET.to_owned(), vehicle_id: vehicle.to_owned(), drive_id };
    Ok(client.forget(request).await?.into_inner().drives)
}

/// Whether a file of the store holds `pattern`.
fn on_disk(folder: &Path, pattern: &[u8]) -> bool {
    std::fs::read_dir(folder).into_iter().flatten().any(|entry| {
        let path = entry.unwrap().path();
        // A file may go while this looks: the store is at work.
        if path.is_dir() {
            on_disk(&path, pattern)
        } else {
            std::fs::read(path).is_ok_and(|bytes| contains(&bytes, pattern))
        }
    })
}

/// Names of the store's write-ahead logs.
fn logs(folder: &Path) -> Vec<PathBuf> {
    let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    paths.filter(|path| path.extension().is_some_and(|extension| extension == "jnl")).collect()
}

fn contains(bytes: &[u8], pattern: &[u8]) -> bool {
    memchr::memmem::find(bytes, pattern).is_some()
}

/// What a frame of the drive leaves in the store: a coordinate, bit by bit.
fn trace_of(drive: &Drive) -> Vec<u8> {
    drive.frames[drive.frames.len() / 2].detections()[0].points_vehicle[1].y.to_le_bytes().to_vec()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_that_is_forgotten_is_gone_from_maps_and_disk_and_others_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let url = server.url();
    let (ended, live, other) = (drives::simulated(5, 60), drives::simulated(6, 40), drives::simulated(7, 30));
    let first = upload(&url, start(&ended, VEHICLE, "one"), wire(&ended), true).await.unwrap();
    let kept = upload(&url, start(&other, "another", "one"), wire(&other), false).await.unwrap();
    let (mut stream, accepted) = RawStream::started(&url, start(&live, VEHICLE, "two")).await;
    for frame in &live.frames {
        stream.send_frame(encode::frame(frame)).await;
    }
    stream.acked(40).await;
    // A reader has looked at all of them before.
    let listed = http::get(format!("{url}/sessions")).await.unwrap().text().await.unwrap();
    assert!(listed.contains(&first));
    assert!(on_disk(folder.path(), &trace_of(&live)) && on_disk(folder.path(), &trace_of(&other)));

    assert_eq!(forget(&url, VEHICLE, None).await.unwrap(), 2);

    assert_eq!(stream.end().await.unwrap_err().code(), Code::FailedPrecondition);
    assert!(!on_disk(folder.path(), &trace_of(&live)), "the live drive is still on the disk");
    assert!(!on_disk(folder.path(), &trace_of(&ended)), "the drive that was over is still on the disk");
    assert!(on_disk(folder.path(), &trace_of(&other)));
    let sessions = http::get(format!("{url}/sessions")).await.unwrap().text().await.unwrap();
    assert!(sessions.contains(&kept) && !sessions.contains(&first) && !sessions.contains(&accepted.session_id));
    let gone = http::get(format!("{url}/sessions/{first}/lanes.pb")).await.unwrap();
    assert_eq!(gone.status(), 404);
    let again = upload(&url, start(&ended, VEHICLE, "one"), wire(&ended), true).await.unwrap_err();
    assert_eq!(again.code(), Code::FailedPrecondition, "{again}");
    let new = upload(&url, start(&ended, VEHICLE, "three"), wire(&ended), true).await.unwrap();
    assert_eq!(forget(&url, VEHICLE, None).await.unwrap(), 1, "{new}");
    assert_eq!(forget(&url, VEHICLE, None).await.unwrap(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn one_drive_is_forgotten_and_the_others_of_its_vehicle_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let drive = drives::simulated(5, 30);
    let server = servers::start(folder.path()).await;
    let kept = upload(&server.url(), start(&drive, VEHICLE, "kept"), wire(&drive), true).await.unwrap();
    let gone = upload(&server.url(), start(&drive, VEHICLE, "gone"), wire(&drive), true).await.unwrap();
    assert_eq!(forget(&server.url(), VEHICLE, Some("gone")).await.unwrap(), 1);
    assert_eq!(forget(&server.url(), VEHICLE, Some("never heard of")).await.unwrap(), 0);
    server.shutdown().await;

    let server = servers::start(folder.path()).await;
    let sessions = http::get(format!("{}/sessions", server.url())).await.unwrap().text().await.unwrap();
    assert!(sessions.contains(&kept) && !sessions.contains(&gone));
    for name in ["gone", "never heard of"] {
        let refused = upload(&server.url(), start(&drive, VEHICLE, name), wire(&drive), true).await.unwrap_err();
        assert_eq!(refused.code(), Code::FailedPrecondition, "{refused}");
    }
    let request = v1::ForgetRequest { fleet_id: FLEET.to_owned(), ..v1::ForgetRequest::default() };
    let mut client = AdminServiceClient::connect(server.url()).await.unwrap();
    let refused = client.forget(request).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert!(refused.message().contains("vehicle_id"), "{refused}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deletion_that_a_kill_interrupts_is_finished_by_the_next_start() {
    let binary = env!("CARGO_BIN_EXE_killable-server");
    let folder = tempfile::tempdir().unwrap();
    let drive = drives::simulated(5, 60);
    let mut server = ServerProcess::start(binary, folder.path());
    upload(&server.url, start(&drive, VEHICLE, "one"), wire(&drive), false).await.unwrap();
    let before = logs(folder.path());
    let forgetting = tokio::spawn({
        let url = server.url.clone();
        async move { forget(&url, VEHICLE, None).await }
    });
    // The first thing to be seen of an erasure is a new log. The drive is still in the one before.
    wait_until("a new log", || logs(folder.path()).iter().any(|log| !before.contains(log)));
    server.kill();
    assert!(forgetting.await.unwrap().is_err());

    let server = ServerProcess::start(binary, folder.path());
    wait_until("the drive to be gone", || !on_disk(folder.path(), &trace_of(&drive)));
    let sessions = http::get(format!("{}/sessions", server.url)).await.unwrap().text().await.unwrap();
    assert!(sessions.contains("\"total\":0"), "{sessions}");
    let refused = upload(&server.url, start(&drive, VEHICLE, "one"), wire(&drive), false).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
}

/// Looks again and again until it is so.
#[track_caller]
fn wait_until(what: &str, is_so: impl Fn() -> bool) {
    let started = std::time::Instant::now();
    while !is_so() {
        assert!(started.elapsed() < PATIENCE, "waited in vain for {what}");
        thread::yield_now();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_without_its_key_is_refused_with_the_file_that_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    servers::start(folder.path()).await.shutdown().await;
    std::fs::remove_file(folder.path().join("privacy.key")).unwrap();
    let error = Server::start(servers::config(folder.path())).await.unwrap_err().to_string();
    assert!(error.contains("privacy.key") && error.contains("missing"), "{error}");
    let config = ServerConfig { privacy_key_file: "other.key".into(), ..servers::config(folder.path()) };
    assert!(Server::start(config).await.unwrap_err().to_string().contains("other.key"));
}

/// The command, told to log all that it can.
struct LoggingServer {
    child: Child,
    url: String,
    log: Arc<Mutex<Vec<u8>>>,
    reader: Option<thread::JoinHandle<()>>,
}

impl LoggingServer {
    fn start(folder: &Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
            .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
            .arg(folder)
            .env("RUST_LOG", "trace")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let log = Arc::<Mutex<Vec<u8>>>::default();
        let (mut stderr, into) = (child.stderr.take().unwrap(), Arc::clone(&log));
        let reader = thread::spawn(move || {
            let mut piece = [0; 4096];
            while let Ok(count @ 1..) = stderr.read(&mut piece) {
                into.lock().unwrap().extend_from_slice(&piece[..count]);
            }
        });
        let mut said = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut said).unwrap();
        let url = said.split([' ', ',']).find(|word| word.starts_with("http")).expect("no URL").to_owned();
        Self { child, url, log, reader: Some(reader) }
    }

    /// Kills it; gives everything that it logged.
    fn stop(mut self) -> Vec<u8> {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        self.reader.take().unwrap().join().unwrap();
        std::mem::take(&mut *self.log.lock().unwrap())
    }
}

impl Drop for LoggingServer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Every HTTP answer there is, headers and all, as text.
async fn all_answers(url: &str, session: &str) -> Vec<(String, String)> {
    let paths = [
        "/sessions".to_owned(),
        format!("/sessions/{session}/lanes.geojson"),
        format!("/sessions/{session}/lanes.geojson?crs=local"),
        format!("/sessions/{session}/lanes.pb"),
        "/collections/lanes/items".to_owned(),
        "/collections/lanes/items?bbox=1,2".to_owned(),
        "/viewer".to_owned(),
        "/healthz".to_owned(),
        "/readyz".to_owned(),
        "/metrics".to_owned(),
        "/nothing".to_owned(),
    ];
    let mut answers = Vec::new();
    for path in paths {
        let answer = http::get(format!("{url}{path}")).await.unwrap();
        let head = format!("{:?} {:?}", answer.status(), answer.headers());
        let body = answer.bytes().await.unwrap();
        answers.push((path, head + &String::from_utf8_lossy(&body)));
    }
    answers
}

#[tokio::test(flavor = "multi_thread")]
async fn no_answer_metric_log_line_or_file_of_the_store_names_a_vehicle_its_fleet_or_its_drive() {
    const DRIVE: &str = "drive-h5v1t6";
    let folder = tempfile::tempdir().unwrap();
    let server = LoggingServer::start(folder.path());
    let url = server.url.clone();
    let drive = drives::simulated(5, 30);
    let begin = || start(&drive, VEHICLE, DRIVE);

    // A stream that succeeds, with a frame that is refused and one that comes twice, taken over by a second one.
    let (mut first, accepted) = RawStream::started(&url, begin()).await;
    first.send_frame(encode::frame(&drive.frames[0])).await;
    first.send_frame(encode::frame(&drive.frames[0])).await;
    first.send_frame(v1::Frame { odometry: None, ..encode::frame(&drive.frames[1]) }).await;
    first.refusal().await;
    first.send(Message::Start(begin())).await;
    first.refusal().await;
    let (mut second, _) = RawStream::started(&url, begin()).await;
    assert_eq!(first.end().await.unwrap_err().code(), Code::Aborted);
    for frame in &drive.frames[1..] {
        second.send_frame(encode::frame(frame)).await;
    }
    second.acked(30).await;
    second.send(Message::End(v1::SessionEnd {})).await;
    second.end().await.unwrap();
    // Starts that are refused, the second time for what the first one said; and an upload after the end.
    let mut refused = RawStream::open(&url).await;
    refused.send(Message::Start(v1::SessionStart { sensor: None, ..begin() })).await;
    refused.refusal().await;
    let paper = v1::MapperPreset::Paper.into();
    upload(&url, v1::SessionStart { preset: paper, ..begin() }, vec![], false).await.unwrap_err();
    upload(&url, begin(), wire(&drive)[..2].to_vec(), false).await.unwrap();
    let mut maps = MapServiceClient::connect(url.clone()).await.unwrap();
    let told = maps.list_sessions(v1::ListSessionsRequest::default()).await.unwrap();
    let answers = all_answers(&url, &accepted.session_id).await;
    forget(&url, VEHICLE, Some("drive-that-never-was")).await.unwrap();
    let log = server.stop();

    assert!(log.len() > 10_000, "little was logged");
    for name in [FLEET, VEHICLE, DRIVE, "drive-that-never-was"] {
        for (path, answer) in &answers {
            assert!(!answer.contains(name), "{path} names {name}");
        }
        assert!(!format!("{told:?}").contains(name), "the map service names {name}");
        let line = log.split(|byte| *byte == b'\n').find(|line| contains(line, name.as_bytes()));
        assert!(line.is_none(), "the log names {name}: {}", String::from_utf8_lossy(line.unwrap()));
        assert!(!on_disk(folder.path(), name.as_bytes()), "the store names {name}");
    }
}
