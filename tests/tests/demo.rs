//! `lanemap demo` and `lanemap serve`, as processes: they answer where they say, and stop when told to.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test fails where it fails

use std::{
    io::{BufRead, BufReader, Lines},
    path::Path,
    process::{Child, ChildStdout, Command, ExitStatus, Stdio},
    time::Duration,
};

use lanemap_tests::http;
use serde_json::Value;
use tokio::time::{interval, timeout};

/// Longest wait for something that takes a second or two on an idle machine.
const PATIENCE: Duration = Duration::from_mins(1);
/// Longest that a shutdown may take.
const SHUTDOWN: Duration = Duration::from_secs(10);

/// The command as a process of its own; killed where a test fails.
struct Running {
    child: Child,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Running {
    fn start(command: &str, data_dir: &Path, options: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
            .arg(command)
            .args(["--listen", "127.0.0.1:0", "--data-dir"])
            .arg(data_dir)
            .args(options)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines }
    }

    /// The first address on the next line of stdout.
    fn address(&mut self) -> String {
        let line = self.lines.next().expect("the command says where it listens").unwrap();
        let address = line.split_whitespace().find(|word| word.starts_with("http://"));
        address.unwrap_or_else(|| panic!("no address in {line:?}")).trim_end_matches(',').to_owned()
    }

    /// Sends SIGINT, as Ctrl-C does, and waits for the end.
    async fn interrupt(mut self) -> ExitStatus {
        let sent = Command::new("kill").args(["-INT", &self.child.id().to_string()]).status().unwrap();
        assert!(sent.success());
        let waited = tokio::task::spawn_blocking(move || self.child.wait().unwrap());
        timeout(SHUTDOWN, waited).await.expect("it stops within ten seconds").unwrap()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It has ended already where the test went well.
        let _ = self.child.kill();
    }
}

async fn sessions(base: &str) -> Vec<Value> {
    let answer: Value = http::get(format!("{base}/sessions")).await.unwrap().json().await.unwrap();
    answer["sessions"].as_array().unwrap().clone()
}

fn frames_of(sessions: &[Value]) -> Vec<u64> {
    sessions.iter().map(|session| session["frames"].as_u64().unwrap()).collect()
}

/// Asks for the lines of the shared map until there are some.
async fn shared_lanes(base: &str) -> Value {
    let mut ticks = interval(Duration::from_millis(50));
    let asking = async {
        loop {
            ticks.tick().await;
            let answer = http::get(format!("{base}/collections/lanes/items")).await.unwrap();
            let lanes: Value = answer.json().await.unwrap();
            if lanes["features"].as_array().is_some_and(|lanes| !lanes.is_empty()) {
                return lanes;
            }
        }
    };
    timeout(PATIENCE, asking).await.expect("the fleet shares a map")
}

/// Asks for the sessions until `enough` says so.
async fn sessions_until(base: &str, enough: impl Fn(&[Value]) -> bool) -> Vec<Value> {
    let mut ticks = interval(Duration::from_millis(50));
    timeout(PATIENCE, async {
        loop {
            ticks.tick().await;
            let sessions = sessions(base).await;
            if enough(&sessions) {
                return sessions;
            }
        }
    })
    .await
    .expect("the fleet maps")
}

#[tokio::test(flavor = "multi_thread")]
async fn the_demo_answers_at_its_address_its_maps_grow_on_the_earth_and_ctrl_c_ends_it() {
    let store = tempfile::tempdir().unwrap();
    let mut demo = Running::start("demo", store.path(), &["--vehicles", "3"]);
    let viewer = demo.address();
    let base = viewer.strip_suffix("/viewer").unwrap().to_owned();
    let page = http::get(&viewer).await.unwrap().error_for_status().unwrap().text().await.unwrap();
    assert!(page.contains("<html"), "{page}");

    let early = sessions_until(&base, |all| all.len() == 3 && frames_of(all).iter().all(|frames| *frames >= 1)).await;
    let all_grew = |all: &[Value]| all.len() == 3 && frames_of(all).iter().min() > frames_of(&early).iter().max();
    sessions_until(&base, all_grew).await;
    let has_lanes = |all: &[Value]| all.iter().any(|session| session["lanes"].as_u64() > Some(0));
    sessions_until(&base, has_lanes).await;

    let lanes = shared_lanes(&base).await;
    let place = &lanes["features"][0]["geometry"]["coordinates"][0];
    assert!((place[0].as_f64().unwrap() - 7.68).abs() < 0.05, "in Turin: {place}");
    assert!((place[1].as_f64().unwrap() - 45.07).abs() < 0.05, "in Turin: {place}");
    assert!(demo.interrupt().await.success());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_of_the_demo_starts_anew_when_its_drive_ends() {
    let store = tempfile::tempdir().unwrap();
    let mut demo = Running::start("demo", store.path(), &["--vehicles", "1", "--drive-km", "0.02"]);
    let base = demo.address().strip_suffix("/viewer").unwrap().to_owned();
    let in_state =
        |state: &'static str| move |session: &Value| session["state"] == state && session["frames"].as_u64() > Some(0);
    sessions_until(&base, |all| all.iter().any(in_state("closed")) && all.iter().any(in_state("live"))).await;
    assert!(demo.interrupt().await.success());
}

#[tokio::test(flavor = "multi_thread")]
async fn serve_says_where_it_listens_and_ctrl_c_ends_it() {
    let store = tempfile::tempdir().unwrap();
    let mut server = Running::start("serve", store.path(), &[]);
    let base = server.address();
    let ready = http::get(format!("{base}/readyz")).await.unwrap();
    assert!(ready.status().is_success());
    assert!(server.interrupt().await.success());
}

#[test]
fn a_setting_of_the_file_that_is_none_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("lanemap.yaml");
    std::fs::write(&file, "listen: 127.0.0.1:0\npublish_intervall_ms: 5\n").unwrap();
    let output =
        Command::new(env!("CARGO_BIN_EXE_lanemap-under-test")).args(["serve", "--config"]).arg(&file).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("publish_intervall_ms"));
}

#[test]
fn a_port_that_is_taken_is_an_error_that_names_it() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let store = tempfile::tempdir().unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
        .args(["demo", "--listen", &address, "--data-dir"])
        .arg(store.path())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains(&address) && said.contains("--listen"), "{said}");
}
