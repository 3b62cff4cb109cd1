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

use lanemap_core::{Frame, FrameLimits, FrameParts, GnssFix};
use lanemap_proto::{
    encode,
    v1::{
        self, admin_service_client::AdminServiceClient, ingest_service_client::IngestServiceClient,
        map_service_client::MapServiceClient, stream_observations_request::Message,
    },
};
use lanemap_server::{
    Server, ServerConfig,
    config::ZenohMode,
    privacy::{
        TripCut,
        trip_cut::{Passage, TripEnds},
    },
};
use lanemap_tests::{
    drives::{self, Drive, assert_same_map},
    endpoints::HeldEndpoint,
    http,
    raw_stream::RawStream,
    raw_zenoh::{self, RawZenohStream},
    servers::{self, ServerProcess, map_bytes},
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
    trace_of_frame(&drive.frames[drive.frames.len() / 2])
}

fn trace_of_frame(frame: &Frame) -> Vec<u8> {
    frame.detections()[0].points_vehicle[1].y.to_le_bytes().to_vec()
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
        // A look reads the whole store: it must not starve the server that it watches.
        thread::sleep(Duration::from_millis(50));
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
    fn start(folder: &Path, arguments: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
            .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
            .arg(folder)
            .args(arguments)
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
        "/collections/drives/items".to_owned(),
        "/cells".to_owned(),
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
    const DRIVE_OVER_ZENOH: &str = "drive-n2b8y4";
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let server = LoggingServer::start(folder.path(), &["--zenoh-mode", "router", "--zenoh-listen", &endpoint]);
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
    // Over zenoh, whose keys name the vehicle: a drive, and bytes that are no message.
    let session = raw_zenoh::connect(&endpoint).await;
    let begin_over_zenoh = start(&drive, VEHICLE, DRIVE_OVER_ZENOH);
    let (mut zenoh, _) = RawZenohStream::started(&session, begin_over_zenoh).await;
    zenoh.stream(&drive.frames, 16).await;
    zenoh.end_drive().await;
    let mut wrong = RawZenohStream::open(&session, FLEET, VEHICLE).await;
    wrong.send_bytes(b"no message".to_vec()).await;
    wrong.answer().await;
    session.close().await.unwrap();
    let mut maps = MapServiceClient::connect(url.clone()).await.unwrap();
    let told = maps.list_sessions(v1::ListSessionsRequest::default()).await.unwrap();
    let answers = all_answers(&url, &accepted.session_id).await;
    forget(&url, VEHICLE, Some("drive-that-never-was")).await.unwrap();
    let log = server.stop();

    assert!(log.len() > 10_000, "little was logged");
    for name in [FLEET, VEHICLE, DRIVE, DRIVE_OVER_ZENOH, "drive-that-never-was"] {
        for (path, answer) in &answers {
            assert!(!answer.contains(name), "{path} names {name}");
        }
        assert!(!format!("{told:?}").contains(name), "the map service names {name}");
        let line = log.split(|byte| *byte == b'\n').find(|line| contains(line, name.as_bytes()));
        assert!(line.is_none(), "the log names {name}: {}", String::from_utf8_lossy(line.unwrap()));
        assert!(!on_disk(folder.path(), name.as_bytes()), "the store names {name}");
    }
}

/// The cut of the tests below: short, as their drives are.
const CUT: TripCut = TripCut { distance_m: 40.0, time_s: 2.0, stop_s: 1800.0 };
const CUT_ARGUMENTS: [&str; 6] = ["--trip-cut-m", "40", "--trip-cut-s", "2", "--snapshot-every-frames", "20"];

fn cutting(folder: &Path) -> ServerConfig {
    ServerConfig { trip_cut_m: CUT.distance_m, trip_cut_s: CUT.time_s, ..servers::config(folder) }
}

/// A drive whose every frame has a fix, so that its map has a place on the earth.
fn with_fixes(drive: &Drive) -> Drive {
    let frames = drive.frames.iter().enumerate().map(|(index, frame)| {
        let latitude_deg = 48.0 + index as f64 * 1e-5;
        let (longitude_deg, height_m) = (11.0 + (index % 7) as f64 * 1e-6, 500.0);
        let (horizontal_sigma_m, vertical_sigma_m) = (0.7, 1.5);
        let gnss = Some(GnssFix {
            latitude_deg,
            longitude_deg,
            height_m,
            horizontal_sigma_m,
            vertical_sigma_m,
            yaw_enu_rad: None,
        });
        let parts = FrameParts {
            sequence: frame.sequence(),
            time: frame.time(),
            odometry: frame.odometry().clone(),
            gnss,
            detections: frame.detections().to_vec(),
            occlusions: frame.occlusions().to_vec(),
        };
        Frame::new(parts, &FrameLimits::default()).unwrap()
    });
    Drive { frames: frames.collect(), ..drive.clone() }
}

/// The part of a drive that lies beyond both of its ends.
fn middle(drive: &Drive) -> Drive {
    let (mut ends, mut first, mut last) = (TripEnds::default(), None, None);
    for frame in &drive.frames {
        match ends.arrive(&CUT, frame) {
            Passage::Cut => assert_eq!(first, None, "the drive does not stop"),
            Passage::Held { mapped_through } => {
                first.get_or_insert(frame.sequence());
                last = mapped_through.or(last);
            }
        }
    }
    let within = |frame: &&Frame| Some(frame.sequence()) >= first && Some(frame.sequence()) <= last;
    let frames: Vec<_> = drive.frames.iter().filter(within).cloned().collect();
    assert!(frames.len() >= 40 && drive.frames.len() - frames.len() >= 40, "{} of the drive are left", frames.len());
    Drive { frames, ..drive.clone() }
}

#[tokio::test(flavor = "multi_thread")]
async fn where_a_trip_sets_out_and_arrives_is_in_no_map_and_every_frame_is_acked() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(cutting(folder.path())).await.unwrap();
    let drive = with_fixes(&drives::simulated(5, 160));
    let (mut stream, accepted) = RawStream::started(&server.url(), drive.wire_start()).await;
    let list = async || http::get(format!("{}/sessions", server.url())).await.unwrap().text().await.unwrap();
    for frame in &drive.frames[..10] {
        stream.send_frame(encode::frame(frame)).await;
    }
    stream.acked(10).await;
    assert!(list().await.contains("\"total\":0"), "readers know that a vehicle sets out");
    assert!(!on_disk(folder.path(), &trace_of_frame(&drive.frames[5])), "a frame that was cut was kept");
    for frame in &drive.frames[10..] {
        stream.send_frame(encode::frame(frame)).await;
    }
    stream.acked(160).await;
    stream.send(Message::End(v1::SessionEnd {})).await;
    stream.end().await.unwrap();
    assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &middle(&drive));
    assert!(list().await.contains("\"georeferenced\":true"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cut_drive_that_kills_interrupt_anywhere_gives_the_same_map_and_its_ends_leave_the_disk() {
    let folder = tempfile::tempdir().unwrap();
    let drive = with_fixes(&drives::simulated(5, 160));
    let arguments = [&CUT_ARGUMENTS[..], &["--trip-erase-s", "1"]].concat();
    let mut session = String::new();
    let mut sent = 0;
    // Into the start, beyond it, into the part that is held, and through snapshots.
    for until in [1, 7, 31, 33, 60, 61, 99, 140, 160] {
        let server = LoggingServer::start(folder.path(), &arguments);
        let mut stream = RawStream::open(&server.url).await;
        let accepted = stream.start(drive.wire_start()).await;
        assert_eq!(accepted.resume_after_sequence.unwrap_or(0), sent as u64, "what was acked is had");
        // One that the server knows comes again.
        for frame in &drive.frames[usize::saturating_sub(sent, 1)..until] {
            stream.send_frame(encode::frame(frame)).await;
        }
        stream.acked(until as u64).await;
        sent = until;
        session = accepted.session_id;
        server.stop();
    }
    let server = LoggingServer::start(folder.path(), &arguments);
    upload(&server.url, drive.wire_start(), vec![], true).await.unwrap();
    assert_same_map(&map_bytes(&server.url, &session).await, &middle(&drive));
    for frame in [&drive.frames[2], &drive.frames[158]] {
        wait_until("an end to be erased", || !on_disk(folder.path(), &trace_of_frame(frame)));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cut_drive_gives_the_same_map_over_zenoh() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let zenoh_listen = endpoint.parse().unwrap();
    let config = ServerConfig { zenoh_mode: ZenohMode::Router, zenoh_listen, ..cutting(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let drive = with_fixes(&drives::simulated(5, 160));
    let vehicle = raw_zenoh::connect(&endpoint).await;
    let (mut stream, accepted) = RawZenohStream::started(&vehicle, drive.wire_start()).await;
    stream.stream(&drive.frames, 16).await;
    stream.end_drive().await;
    assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &middle(&drive));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_end_of_a_trip_that_is_never_ended_is_erased_all_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { trip_stop_s: 1.0, trip_erase_s: 1, unload_after_s: 0, ..cutting(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let drive = drives::simulated(5, 160);
    upload(&server.url(), drive.wire_start(), wire(&drive), false).await.unwrap();
    assert!(on_disk(folder.path(), &trace_of_frame(&drive.frames[158])));
    wait_until("the end to be erased", || !on_disk(folder.path(), &trace_of_frame(&drive.frames[158])));
}
