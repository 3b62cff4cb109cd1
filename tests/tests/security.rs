//! Promise: nobody streams as another's vehicle, reads or administers without a right to, or listens in; who may is
//! told by certificates, tokens and settings alone; and no secret shows in a log.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::{
    io::{BufRead, BufReader, Read},
    process::{Command, Stdio},
    time::Duration,
};

use futures::StreamExt;
use jsonwebtoken::{Algorithm, EncodingKey, Header, encode};
use lanemap_proto::{
    encode as wire,
    v1::{self, ingest_service_client::IngestServiceClient, map_service_client::MapServiceClient},
};
use lanemap_server::{ConfigOverrides, RunningServer, Server, ServerConfig};
use lanemap_tests::{
    authorities::{Authority, Certified, TlsFolder, named_by_uri},
    drives,
    raw_stream::RawStream,
    servers,
    tokens::{self, TokenIssuer, completed},
};
use reqwest::{StatusCode, header};
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    time::timeout,
};
use tonic::{Code, Request, Status, transport::Channel};

/// Longest wait for something that takes milliseconds, or, for files that change, two seconds.
const PATIENCE: Duration = Duration::from_secs(20);

/// A server with mTLS and tokens, everything of it in one folder.
struct Secured {
    server: RunningServer,
    tls: TlsFolder,
    issuer: TokenIssuer,
    _folder: TempDir,
}

impl Secured {
    async fn start(adjust: impl FnOnce(ServerConfig) -> ServerConfig) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let tls = TlsFolder::new(folder.path());
        let issuer = TokenIssuer::new("key-1");
        let keys = tls.write("keys.json", &TokenIssuer::jwks(&[&issuer]));
        let config =
            ServerConfig { token_keys_file: Some(keys), token_issuer: Some(tokens::ISSUER.to_owned()), ..tls.config() };
        let server = Server::start(adjust(config)).await.unwrap();
        Self { server, tls, issuer, _folder: folder }
    }

    async fn channel(&self, client: Option<&Certified>) -> Channel {
        self.tls.channel(&self.server.url(), client).await.unwrap()
    }

    /// Uploads a frame as `vehicle`, on a connection with a certificate, or a token, or both, or neither.
    async fn upload_as(
        &self,
        vehicle: &str,
        client: Option<&Certified>,
        token: Option<&str>,
    ) -> Result<v1::UploadObservationsResponse, Status> {
        upload(self.channel(client).await, "north", vehicle, token).await
    }

    fn http(&self, client: Option<&Certified>) -> reqwest::Client {
        let tls = self.tls.client_tls(client);
        reqwest::Client::builder().tls_backend_preconfigured(tls).build().unwrap()
    }

    /// What `path` answers.
    async fn get(&self, path: &str, token: Option<&str>) -> reqwest::Response {
        let url = format!("https://localhost:{}{path}", self.server.address().port());
        let request = self.http(None).get(url);
        let request = token.iter().fold(request, reqwest::RequestBuilder::bearer_auth);
        request.send().await.unwrap()
    }
}

fn upload_request(fleet: &str, vehicle: &str) -> v1::UploadObservationsRequest {
    let drive = drives::simulated(1, 2);
    let start = v1::SessionStart { fleet_id: fleet.to_owned(), vehicle_id: vehicle.to_owned(), ..drive.wire_start() };
    let frames = drive.frames.iter().map(wire::frame).collect();
    v1::UploadObservationsRequest { start: Some(start), frames, end: false }
}

fn with_token<T>(message: T, token: Option<&str>) -> Request<T> {
    let mut request = Request::new(message);
    if let Some(token) = token {
        request.metadata_mut().insert("authorization", format!("Bearer {token}").parse().unwrap());
    }
    request
}

async fn upload(
    channel: Channel,
    fleet: &str,
    vehicle: &str,
    token: Option<&str>,
) -> Result<v1::UploadObservationsResponse, Status> {
    let request = with_token(upload_request(fleet, vehicle), token);
    let answer = timeout(PATIENCE, IngestServiceClient::new(channel).upload_observations(request)).await;
    answer.expect("no answer").map(tonic::Response::into_inner)
}

fn car(token: &TokenIssuer, vehicle: &str) -> String {
    token.token(json!({ "fleet": "north", "vehicle": vehicle, "scope": "ingest" }))
}

#[track_caller]
fn assert_code<T: std::fmt::Debug>(answer: Result<T, Status>, code: Code) {
    assert_eq!(answer.unwrap_err().code(), code);
}

/// Waits until `holds` does; it takes a file's change to be seen.
async fn eventually<F: Future<Output = bool>>(holds: impl Fn() -> F) {
    let waiting = async {
        while !holds().await {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    timeout(PATIENCE, waiting).await.expect("it never came about");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_streams_by_its_certificate_as_itself_and_as_no_other() {
    let service = Secured::start(|config| config).await;
    let car = service.tls.vehicles.vehicle("north", "car-1", 2);
    let acked = service.upload_as("car-1", Some(&car), None).await.unwrap();
    assert_eq!(acked.acked_sequence_inclusive, Some(2));
    assert_code(service.upload_as("car-2", Some(&car), None).await, Code::PermissionDenied);

    let mut stream = RawStream::open_on(service.channel(Some(&car)).await).await;
    let other = upload_request("north", "car-2").start.unwrap();
    stream.send(v1::stream_observations_request::Message::Start(other)).await;
    assert_code(stream.end().await, Code::PermissionDenied);

    let by_common_name = service.tls.vehicles.vehicle_by_common_name("north", "car-3", 3);
    service.upload_as("car-3", Some(&by_common_name), None).await.unwrap();
    assert_code(service.upload_as("car-1", Some(&by_common_name), None).await, Code::PermissionDenied);
}

#[tokio::test(flavor = "multi_thread")]
async fn certificates_that_are_foreign_expired_or_revoked_do_not_connect() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let config = ServerConfig {
        tls_require_client_certificate: true,
        tls_client_crl_file: Some(tls.write("revoked.crl", &tls.vehicles.revocation_list(&[7]))),
        ..tls.config()
    };
    let server = Server::start(config).await.unwrap();
    let upload_with = async |client: Option<Certified>| {
        let channel = tls.channel(&server.url(), client.as_ref()).await.map_err(|error| error.to_string())?;
        upload(channel, "north", "car-1", None).await.map_err(|status| status.to_string())
    };
    upload_with(Some(tls.vehicles.vehicle("north", "car-1", 6))).await.unwrap();
    upload_with(Some(Authority::new("vehicles").vehicle("north", "car-1", 6))).await.unwrap_err();
    upload_with(Some(tls.vehicles.expired_vehicle("north", "car-1", 8))).await.unwrap_err();
    upload_with(Some(tls.vehicles.vehicle("north", "car-1", 7))).await.unwrap_err();
    upload_with(None).await.unwrap_err();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_certificate_with_two_names_or_a_broken_one_is_nobodys() {
    let service = Secured::start(|config| config).await;
    let mut two_names = named_by_uri("lanemap://north/car-1");
    two_names.distinguished_name.push(rcgen::DnType::CommonName, "north/car-2");
    for params in [two_names, named_by_uri("lanemap://north/car-1/x"), named_by_uri("lanemap://north/**")] {
        let client = service.tls.vehicles.sign(params, 9);
        assert_code(service.upload_as("car-1", Some(&client), None).await, Code::Unauthenticated);
    }
    // A machine's name is none of a vehicle: it is asked for a token.
    let machine = service.tls.vehicles.server(10);
    assert_code(service.upload_as("car-1", Some(&machine), None).await, Code::Unauthenticated);
}

#[tokio::test(flavor = "multi_thread")]
async fn plain_text_gets_no_answer_on_a_port_with_tls() {
    let service = Secured::start(|config| config).await;
    let mut plain = TcpStream::connect(service.server.address()).await.unwrap();
    plain.write_all(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n").await.unwrap();
    let mut answer = Vec::new();
    // A reset is as good as an end.
    let _ = timeout(PATIENCE, plain.read_to_end(&mut answer)).await.expect("the connection stays open");
    assert!(!answer.windows(4).any(|window| window == b"HTTP"), "{answer:?}");
    let url = format!("http://{}", service.server.address());
    assert_code(upload_plain(&url).await, Code::Unavailable);
}

async fn upload_plain(url: &str) -> Result<v1::UploadObservationsResponse, Status> {
    let channel = Channel::from_shared(url.to_owned()).unwrap().connect().await;
    upload(channel.map_err(|error| Status::unavailable(error.to_string()))?, "north", "car-1", None)
        .await
        .map_err(|status| Status::unavailable(status.to_string()))
}

#[tokio::test(flavor = "multi_thread")]
async fn handshakes_that_take_their_time_block_nobody_and_are_cut() {
    let service = Secured::start(|config| ServerConfig { tls_handshake_timeout_s: 1, ..config }).await;
    let mut silent = Vec::new();
    for _ in 0..100 {
        let mut connection = TcpStream::connect(service.server.address()).await.unwrap();
        connection.write_all(&[0x16]).await.unwrap();
        silent.push(connection);
    }
    let car = service.tls.vehicles.vehicle("north", "car-1", 2);
    service.upload_as("car-1", Some(&car), None).await.unwrap();
    for mut connection in silent {
        let cut = timeout(PATIENCE, connection.read(&mut [0; 16])).await.expect("a silent connection stays open");
        assert!(matches!(cut, Ok(0) | Err(_)), "{cut:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_opens_what_it_names_and_nothing_else() {
    let service = Secured::start(|config| config).await;
    let issuer = &service.issuer;
    service.upload_as("car-1", None, Some(&car(issuer, "car-1"))).await.unwrap();
    let denied = [
        json!({ "fleet": "south", "vehicle": "car-1", "scope": "ingest" }),
        json!({ "fleet": "north", "vehicle": "car-2", "scope": "ingest" }),
        json!({ "fleet": "north", "vehicle": "car-1", "scope": "read admin" }),
        json!({ "fleet": "north", "scope": "ingest" }),
        json!({ "vehicle": "car-1", "scope": "ingest" }),
    ];
    for claims in denied {
        let answer = service.upload_as("car-1", None, Some(&issuer.token(claims.clone()))).await;
        assert_eq!(answer.unwrap_err().code(), Code::PermissionDenied, "{claims}");
    }
    let gateway = issuer.token(json!({ "fleet": "north", "vehicle": "*", "roles": ["ingest"] }));
    service.upload_as("car-5", None, Some(&gateway)).await.unwrap();

    // A token on the connection of a vehicle is that vehicle's only.
    let other = service.tls.vehicles.vehicle("north", "car-2", 2);
    assert_code(service.upload_as("car-1", Some(&other), Some(&gateway)).await, Code::PermissionDenied);
    service.upload_as("car-2", Some(&other), Some(&gateway)).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_that_is_not_as_it_must_be_opens_nothing() {
    let service = Secured::start(|config| config).await;
    let issuer = &service.issuer;
    let of = |claims: Value| {
        let mut all = json!({ "fleet": "north", "vehicle": "car-1", "scope": "ingest" });
        all.as_object_mut().unwrap().extend(claims.as_object().unwrap().clone());
        completed(all)
    };
    let now = tokens::unix_s();
    let mut bad = vec![
        ("expired", issuer.token(of(json!({ "exp": now - 120 })))),
        ("not yet valid", issuer.token(of(json!({ "nbf": now + 600 })))),
        ("of another issuer", issuer.token(of(json!({ "iss": "https://elsewhere.test" })))),
        ("for another audience", issuer.token(of(json!({ "aud": ["other", "another"] })))),
        ("without expiry", issuer.token(of(json!({ "exp": null })))),
        ("of an unknown key", TokenIssuer::new("key-9").token(of(json!({})))),
        ("of a stranger who knows the key's name", TokenIssuer::new("key-1").token(of(json!({})))),
        ("no token", "no.token.atall".to_owned()),
        ("empty", String::new()),
        ("too long", "x".repeat(10_000)),
    ];
    // Confusion of algorithms: the public key, which anybody may know, taken for a shared secret.
    for secret in [issuer.public_pem().into_bytes(), issuer.public_point()] {
        for kid in [Some("key-1".to_owned()), None] {
            let header = Header { kid, ..Header::new(Algorithm::HS256) };
            let forged = encode(&header, &of(json!({})), &EncodingKey::from_secret(&secret)).unwrap();
            bad.push(("signed by the public key", forged));
        }
    }
    // `alg: none`, in three spellings, with and without a signature.
    let good = issuer.token(of(json!({})));
    let [_, payload, signature] = good.split('.').collect::<Vec<_>>()[..] else { panic!("{good}") };
    for header in ["eyJhbGciOiJub25lIn0", "eyJhbGciOiJOb25lIn0", "eyJhbGciOiIifQ"] {
        bad.push(("unsigned", format!("{header}.{payload}.")));
        bad.push(("unsigned, with a signature", format!("{header}.{payload}.{signature}")));
    }
    // Altered after signing.
    let stolen = issuer.token(of(json!({ "vehicle": "car-9" })));
    let [header, _, signature_of_another] = stolen.split('.').collect::<Vec<_>>()[..] else { panic!("{stolen}") };
    bad.push(("altered", format!("{header}.{payload}.{signature_of_another}")));

    for (what, token) in bad {
        let answer = service.upload_as("car-1", None, Some(&token)).await;
        assert_eq!(answer.unwrap_err().code(), Code::Unauthenticated, "a token {what}");
    }
    assert_code(service.upload_as("car-1", None, None).await, Code::Unauthenticated);
    service.upload_as("car-1", None, Some(&good)).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_ends_when_its_token_does() {
    let service = Secured::start(|config| config).await;
    // 30 s are forgiven.
    let claims = json!({ "fleet": "north", "vehicle": "car-1", "scope": "ingest", "exp": tokens::unix_s() - 27 });
    let messages = futures::stream::iter([v1::StreamObservationsRequest {
        message: upload_request("north", "car-1").start.map(v1::stream_observations_request::Message::Start),
    }])
    .chain(futures::stream::pending());
    let mut client = IngestServiceClient::new(service.channel(None).await);
    let request = with_token(messages, Some(&service.issuer.token(claims)));
    let mut answers = client.stream_observations(request).await.unwrap().into_inner();
    assert!(answers.message().await.unwrap().is_some());
    let ended = timeout(PATIENCE, answers.message()).await.expect("the stream goes on");
    assert_code(ended, Code::Unauthenticated);
}

#[tokio::test(flavor = "multi_thread")]
async fn keys_of_tokens_in_pem_verify_them_too() {
    let service = Secured::start(|config| {
        let path = config.token_keys_file.as_ref().unwrap().with_extension("pem");
        let issuer = TokenIssuer::new("unused");
        std::fs::write(&path, issuer.public_pem()).unwrap();
        ServerConfig { token_keys_file: Some(path), ..config }
    })
    .await;
    assert_code(service.upload_as("car-1", None, Some(&car(&service.issuer, "car-1"))).await, Code::Unauthenticated);
    let pem = TokenIssuer::new("key-2");
    service.tls.write("keys.pem", &pem.public_pem());
    service.server.credentials().reload();
    service.upload_as("car-1", None, Some(&car(&pem, "car-1"))).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn keys_of_tokens_are_replaced_while_the_service_runs() {
    let service = Secured::start(|config| config).await;
    let (old, new) = (&service.issuer, TokenIssuer::new("key-2"));
    let accepts =
        async |issuer: &TokenIssuer| service.upload_as("car-1", None, Some(&car(issuer, "car-1"))).await.is_ok();
    assert!(accepts(old).await && !accepts(&new).await);
    service.tls.write("keys.json", &TokenIssuer::jwks(&[old, &new]));
    eventually(|| accepts(&new)).await;
    assert!(accepts(old).await);
    // A file that cannot be read leaves the keys as they were.
    service.tls.write("keys.json", "{ \"keys\": [");
    service.server.credentials().reload();
    assert!(accepts(old).await && accepts(&new).await);
    service.tls.write("keys.json", &TokenIssuer::jwks(&[&new]));
    eventually(async || !accepts(old).await).await;
    assert!(accepts(&new).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn certificates_of_the_server_are_replaced_while_connections_stay() {
    let service = Secured::start(|config| config).await;
    let car = service.tls.vehicles.vehicle("north", "car-1", 2);
    let before = service.channel(Some(&car)).await;
    let other_authority = Authority::new("servers");
    service.tls.write_server(&other_authority.server(5));
    service.server.credentials().reload();
    service.tls.channel(&service.server.url(), Some(&car)).await.unwrap_err();
    upload(before, "north", "car-1", None).await.unwrap();
    service.tls.write_server(&service.tls.servers.server(6));
    service.server.credentials().reload();
    service.upload_as("car-1", Some(&car), None).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn maps_and_metrics_are_for_readers_and_health_is_for_all() {
    let service = Secured::start(|config| config).await;
    let reader = service.issuer.token(json!({ "scope": "read" }));
    let vehicle = car(&service.issuer, "car-1");
    for path in ["/sessions", "/collections/lanes/items", "/metrics", "/sessions/0123456789abcdef/lanes.pb"] {
        let refused = service.get(path, None).await;
        assert_eq!(refused.status(), StatusCode::UNAUTHORIZED, "{path}");
        assert_eq!(refused.headers()[header::WWW_AUTHENTICATE], "Bearer realm=\"lanemap\"");
        assert_eq!(refused.headers()[header::CONTENT_TYPE], "application/problem+json");
        let problem: Value = refused.json().await.unwrap();
        assert_eq!(
            (&problem["status"], &problem["type"]),
            (&json!(401), &json!("urn:lanemap:problem:unauthenticated"))
        );

        let refused = service.get(path, Some("not.a.token")).await;
        assert_eq!(refused.status(), StatusCode::UNAUTHORIZED, "{path}");
        let challenge = refused.headers()[header::WWW_AUTHENTICATE].to_str().unwrap().to_owned();
        assert!(challenge.contains("error=\"invalid_token\""), "{challenge}");

        let refused = service.get(path, Some(&vehicle)).await;
        assert_eq!(refused.status(), StatusCode::FORBIDDEN, "{path}");
        let challenge = refused.headers()[header::WWW_AUTHENTICATE].to_str().unwrap().to_owned();
        assert!(challenge.contains("insufficient_scope") && challenge.contains("scope=\"read\""), "{challenge}");
        assert_eq!(refused.json::<Value>().await.unwrap()["type"], "urn:lanemap:problem:not-permitted");
    }
    for path in ["/sessions", "/metrics", "/collections/lanes/items"] {
        assert_eq!(service.get(path, Some(&reader)).await.status(), StatusCode::OK, "{path}");
    }
    for path in ["/healthz", "/readyz", "/viewer"] {
        assert_eq!(service.get(path, None).await.status(), StatusCode::OK, "{path}");
    }
    let mut maps = MapServiceClient::new(service.channel(None).await);
    let list = v1::ListSessionsRequest::default;
    assert_code(maps.list_sessions(with_token(list(), None)).await, Code::Unauthenticated);
    assert_code(maps.list_sessions(with_token(list(), Some(&vehicle))).await, Code::PermissionDenied);
    maps.list_sessions(with_token(list(), Some(&reader))).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn anybody_reads_where_that_is_set_and_streams_all_the_same_not() {
    let service = Secured::start(|config| ServerConfig { anonymous_read: true, ..config }).await;
    assert_eq!(service.get("/sessions", None).await.status(), StatusCode::OK);
    assert_eq!(service.get("/metrics", None).await.status(), StatusCode::OK);
    assert_code(service.upload_as("car-1", None, None).await, Code::Unauthenticated);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_service_listens_beyond_the_machine_only_with_tls_and_authentication() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let anywhere = "0.0.0.0:0".parse().unwrap();
    let bare = ServerConfig { listen: anywhere, ..servers::config(folder.path()) };
    let refused = |config: &ServerConfig| config.check().unwrap_err().to_string();
    let everything = refused(&bare);
    assert!(everything.contains("TLS") && everything.contains("authentication"), "{everything}");
    assert!(everything.contains("insecure_listen_anywhere"), "{everything}");
    let no_authentication = ServerConfig { listen: anywhere, tls_client_ca_file: None, ..tls.config() };
    assert!(refused(&no_authentication).contains("authentication"));
    let no_tls = ServerConfig {
        token_keys_file: Some("keys.json".into()),
        token_issuer: Some("https://issuer.test".to_owned()),
        ..bare.clone()
    };
    assert!(refused(&no_tls).contains("needs TLS"));
    assert!(Server::start(bare.clone()).await.is_err());

    ServerConfig { listen: "[::1]:0".parse().unwrap(), ..bare.clone() }.check().unwrap();
    Server::start(ServerConfig { listen: anywhere, ..tls.config() }).await.unwrap().shutdown().await;
    let told = ServerConfig { insecure_listen_anywhere: true, ..bare };
    Server::start(told).await.unwrap().shutdown().await;
}

#[test]
fn the_command_says_what_is_missing_where_it_would_be_open_to_a_network() {
    let folder = tempfile::tempdir().unwrap();
    let refused = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
        .args(["serve", "--listen", "0.0.0.0:0", "--data-dir"])
        .arg(folder.path())
        .output()
        .unwrap();
    assert!(!refused.status.success());
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("tls_cert_file") && said.contains("insecure_listen_anywhere"), "{said}");
}

#[test]
fn settings_of_tls_and_tokens_stand_together_or_are_refused_by_name() {
    let path = || Some("file".into());
    let alone = [
        ConfigOverrides { tls_cert_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { tls_key_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { tls_client_ca_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { tls_client_crl_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { tls_require_client_certificate: Some(true), ..ConfigOverrides::default() },
        ConfigOverrides { token_keys_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { token_issuer: Some("me".to_owned()), ..ConfigOverrides::default() },
    ];
    for overrides in alone {
        let error = ServerConfig::load(None, overrides.clone()).unwrap_err().to_string();
        assert!(error.contains(" needs "), "{overrides:?}: {error}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn files_that_hold_no_certificate_or_weak_keys_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let start = async |config: ServerConfig| Server::start(config).await.unwrap_err().to_string();
    let missing = ServerConfig { tls_cert_file: Some(folder.path().join("nothing.crt")), ..tls.config() };
    let error = start(missing).await;
    assert!(error.contains("tls_cert_file") && error.contains("nothing.crt"), "{error}");
    let text = tls.write("text.crt", "a secret that must not be repeated");
    let error = start(ServerConfig { tls_key_file: Some(text), ..tls.config() }).await;
    assert!(error.contains("tls_key_file") && !error.contains("secret"), "{error}");

    let tokens = |name: &str, keys: &str| ServerConfig {
        token_keys_file: Some(tls.write(name, keys)),
        token_issuer: Some(tokens::ISSUER.to_owned()),
        ..servers::config(&folder.path().join("data"))
    };
    let weak = json!({ "keys": [{ "kty": "oct", "kid": "a", "k": "c2hvcnQtc2VjcmV0" }] }).to_string();
    let error = start(tokens("weak.json", &weak)).await;
    assert!(error.contains("key 1") && error.contains("too short") && !error.contains("c2hvcnQ"), "{error}");
    let private = tls.write("private.pem", &tls.servers.server(3).key);
    let private = std::fs::read_to_string(private).unwrap();
    let error = start(tokens("private.pem", &private)).await;
    assert!(error.contains("public keys verify tokens"), "{error}");
    let error = start(tokens("empty.json", "{\"keys\": []}")).await;
    assert!(error.contains("token_keys_file"), "{error}");
}

/// `lanemap serve` with everything logged that can be.
struct LoggedServer {
    child: std::process::Child,
    url: String,
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
        let mut said = String::new();
        let mut byte = [0];
        let stdout = child.stdout.as_mut().unwrap();
        while !said.ends_with('\n') && stdout.read(&mut byte).unwrap() == 1 {
            said.push(char::from(byte[0]));
        }
        let url = said.split([' ', ',']).find(|word| word.starts_with("http")).expect("no URL").to_owned();
        Self { child, url }
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
    let stderr = BufReader::new(server.child.stderr.take().unwrap());
    let (reloaded, mut reloads) = tokio::sync::mpsc::unbounded_channel();
    let log = std::thread::spawn(move || {
        let mut log = String::new();
        for line in stderr.lines() {
            let line = line.unwrap();
            if line.contains("credentials were not read anew") {
                let _ = reloaded.send(());
            }
            log.push_str(&line);
            log.push('\n');
        }
        log
    });

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
    timeout(PATIENCE, reloads.recv()).await.expect("SIGHUP changes nothing");
    server.child.kill().unwrap();
    server.child.wait().unwrap();

    let log = log.join().unwrap();
    assert!(log.lines().count() > 100, "nothing is logged: {log}");
    let signature = token.rsplit('.').next().unwrap();
    let payload = token.split('.').nth(1).unwrap();
    for secret in [&token, signature, payload, secret, encoded, "of-secrets", tls.servers.server(1).key.as_str()] {
        let shown = log.lines().find(|line| line.contains(secret));
        assert!(shown.is_none(), "{secret} shows in {shown:?}");
    }
}
