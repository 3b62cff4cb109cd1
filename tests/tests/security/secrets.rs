//! What no log shows.

use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
    thread::JoinHandle,
};

use jsonwebtoken::{Algorithm, EncodingKey, Header, encode};
use lanemap_proto::v1::SessionStart;
use lanemap_tests::{
    authorities::TlsFolder,
    drives,
    endpoints::HeldEndpoint,
    raw_zenoh::{RawZenohStream, configuration, server_is_there},
    tokens::{self, completed},
};
use reqwest::StatusCode;
use serde_json::{Value, json};
use tokio::{
    sync::mpsc::{UnboundedReceiver, unbounded_channel},
    time::timeout,
};
use tonic::Code;

use super::{PATIENCE, assert_code, upload};

/// `lanemap serve` with everything logged that can be.
struct LoggedServer {
    child: Child,
    url: String,
    /// One for each line that says that credentials could not be read anew.
    failed_reloads: UnboundedReceiver<()>,
    log: JoinHandle<String>,
}

impl LoggedServer {
    fn start(arguments: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
            .args(["serve", "--listen", "127.0.0.1:0"])
            .args(arguments)
            .env("RUST_LOG", "trace")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let stderr = BufReader::new(child.stderr.take().unwrap());
        let (failed, failed_reloads) = unbounded_channel();
        // Read from the beginning: a log that nobody reads stops the server.
        let log = std::thread::spawn(move || {
            let mut log = String::new();
            for line in stderr.lines() {
                let line = line.unwrap();
                if line.contains("credentials were not read anew") {
                    let _ = failed.send(());
                }
                log.push_str(&line);
                log.push('\n');
            }
            log
        });
        let mut said = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut said).unwrap();
        let url = said.split([' ', ',']).find(|word| word.starts_with("http"));
        let url = url.unwrap_or_else(|| panic!("no URL in {said:?}")).to_owned();
        Self { child, url, failed_reloads, log }
    }

    /// Kills the server; gives what it logged.
    fn kill(mut self) -> String {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        self.log.join().unwrap()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn no_token_key_or_vehicle_shows_in_a_log_however_much_is_logged() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let secret = "a-shared-secret-that-nobody-must-ever-read";
    let encoded = "YS1zaGFyZWQtc2VjcmV0LXRoYXQtbm9ib2R5LW11c3QtZXZlci1yZWFk";
    let keys = json!({ "keys": [{ "kty": "oct", "kid": "s", "k": encoded }] }).to_string();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    tls.write("keys.json", &keys);
    let arguments: Vec<String> = [
        ("--data-dir", "data"),
        ("--tls-cert-file", "server.crt"),
        ("--tls-key-file", "server.key"),
        ("--tls-client-ca-file", "vehicles-ca.crt"),
        ("--token-keys-file", "keys.json"),
    ]
    .iter()
    .flat_map(|(flag, name)| [(*flag).to_owned(), file(name)])
    .chain(["--token-issuer".to_owned(), tokens::ISSUER.to_owned()])
    .collect();
    let arguments: Vec<_> = arguments.iter().map(String::as_str).collect();
    let mut server = LoggedServer::start(&arguments);
    let header = Header { kid: Some("s".to_owned()), ..Header::new(Algorithm::HS256) };
    let claims = completed(json!({ "fleet": "north", "vehicle": "vehicle-of-secrets", "scope": "ingest read" }));
    let token = encode(&header, &claims, &EncodingKey::from_secret(secret.as_bytes())).unwrap();
    let client = tls.vehicles.vehicle("north", "vehicle-of-secrets", 3);
    let channel = tls.channel(&server.url, Some(&client)).await.unwrap();
    upload(channel.clone(), "north", "vehicle-of-secrets", Some(&token)).await.unwrap();
    upload(channel.clone(), "north", "vehicle-of-secrets", None).await.unwrap();
    assert_code(upload(channel.clone(), "north", "other-of-secrets", Some(&token)).await, Code::PermissionDenied);
    let wrong = format!("{token}x");
    assert_code(upload(channel, "north", "vehicle-of-secrets", Some(&wrong)).await, Code::Unauthenticated);
    let http = reqwest::Client::builder().tls_backend_preconfigured(tls.client_tls(None)).build().unwrap();
    let url = server.url.replace("127.0.0.1", "localhost");
    let read = http.get(format!("{url}/healthz")).bearer_auth(&token).send().await.unwrap();
    assert_eq!(read.status(), StatusCode::OK);
    // What is wrong with a file is logged, what stands in it is not.
    tls.write("keys.json", &keys.replace(']', ""));
    let pid = server.child.id().to_string();
    assert!(Command::new("kill").args(["-HUP", &pid]).status().unwrap().success());
    timeout(PATIENCE, server.failed_reloads.recv()).await.expect("SIGHUP changes nothing");
    let log = server.kill();
    assert!(log.lines().count() > 100, "nothing is logged: {log}");
    let signature = token.rsplit('.').next().unwrap();
    let payload = token.split('.').nth(1).unwrap();
    for secret in [&token, signature, payload, secret, encoded, "of-secrets", tls.servers.server(1).key.as_str()] {
        let shown = log.lines().find(|line| line.contains(secret));
        assert!(shown.is_none(), "{secret} shows in {shown:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn no_password_of_zenoh_shows_in_a_log_and_printed_rules_let_a_server_serve_through_another_router() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let authority = tls.write("servers-ca.crt", &tls.servers.pem());
    let passwords = tls.write("passwords", "map-server:password-of-secrets\nnorth/car-1:first\n");
    let own = tls.write("own-password", "password-of-secrets\n");
    let printed = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
        .args(["zenoh-access", "--server", "map-server", "--passwords"])
        .arg(&passwords)
        .output()
        .unwrap();
    let rules: Value = serde_json::from_slice(&printed.stdout).unwrap();
    assert!(!rules.to_string().contains("of-secrets"));

    let endpoint = HeldEndpoint::tls_by_name();
    let path = |name: &str| folder.path().join(name);
    let mut router = configuration("router", &[&endpoint], &[]);
    let listening = json!({ "listen_certificate": path("server.crt"), "listen_private_key": path("server.key") });
    router.insert_json5("transport/link/tls", &listening.to_string()).unwrap();
    router.insert_json5("transport/auth/usrpwd", &json!({ "dictionary_file": passwords }).to_string()).unwrap();
    router.insert_json5("access_control", &rules["access_control"].to_string()).unwrap();
    let _router = zenoh::open(router).await.unwrap();

    let text = |path: &std::path::Path| path.to_str().unwrap().to_owned();
    let arguments = [
        ("--data-dir", text(&path("data"))),
        ("--zenoh-mode", "client".to_owned()),
        ("--zenoh-connect", endpoint.to_string()),
        ("--zenoh-ca-file", text(&authority)),
        ("--zenoh-user", "map-server".to_owned()),
        ("--zenoh-password-file", text(&own)),
        ("--zenoh-trust-router", "true".to_owned()),
    ];
    let arguments: Vec<_> = arguments.iter().flat_map(|(flag, value)| [*flag, value.as_str()]).collect();
    let server = LoggedServer::start(&arguments);

    let mut car = configuration("client", &[], &[&endpoint]);
    car.insert_json5("transport/link/tls", &json!({ "root_ca_certificate": authority }).to_string()).unwrap();
    let login = json!({ "user": "north/car-1", "password": "first" });
    car.insert_json5("transport/auth/usrpwd", &login.to_string()).unwrap();
    let car = zenoh::open(car).await.unwrap();
    server_is_there(&car, true).await;
    let drive = drives::simulated(1, 20);
    let start = SessionStart { fleet_id: "north".to_owned(), vehicle_id: "car-1".to_owned(), ..drive.wire_start() };
    RawZenohStream::streamed_whatever_breaks(&car, &start, &drive.frames, 10).await;
    let log = server.kill();
    assert!(log.lines().count() > 100, "nothing is logged: {log}");
    let shown = log.lines().find(|line| line.contains("password-of-secrets"));
    assert!(shown.is_none(), "{shown:?}");
}
