//! Who may use which keys in zenoh, asked of a real router: the server.

use std::time::Duration;

use super::PATIENCE;
use lanemap_proto::{
    encode as wire,
    v1::{self, stream_observations_request::Message, stream_observations_response::Message as Answer},
    zenoh_keys::{Attachment, EVERY_CELL, REQUEST_ENCODING, SERVER, attachment_with_token},
};
use lanemap_server::{RunningServer, Server, ServerConfig, config::ZenohMode};
use lanemap_tests::{
    authorities::{Authority, Certified, TlsFolder},
    drives,
    endpoints::HeldEndpoint,
    fleets::{along_a_road, settled},
    raw_zenoh::{RawZenohStream, configuration},
    servers,
    tokens::{self, TokenIssuer},
};
use prost::Message as _;
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::time::timeout;
use zenoh::{Config, Session, handlers::FifoChannelHandler, pubsub::Subscriber, query::ReplyKeyExpr, sample::Sample};

/// Time after which an answer that is not allowed is given up.
const NO_ANSWER: Duration = Duration::from_secs(1);

/// A server that is a zenoh router.
struct Router {
    server: RunningServer,
    endpoint: HeldEndpoint,
    tls: TlsFolder,
    _folder: TempDir,
}

impl Router {
    /// A router; `adjust` says who may use it.
    async fn start(endpoint: HeldEndpoint, adjust: impl FnOnce(&TlsFolder, ServerConfig) -> ServerConfig) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let tls = TlsFolder::new(folder.path());
        let config =
            ServerConfig { zenoh_mode: ZenohMode::Router, zenoh_listen: endpoint.parse().unwrap(), ..tls.config() };
        let server = Server::start(adjust(&tls, config)).await.unwrap();
        Self { server, endpoint, tls, _folder: folder }
    }

    /// A router for the vehicles `north/car-1` and `north/car-2` with certificates.
    async fn with_certificates() -> Self {
        Self::start(HeldEndpoint::tls_by_name(), |tls, config| {
            let listed = tls.write("vehicles", "# two cars\nnorth/car-1\n\nnorth/car-2\n");
            ServerConfig { zenoh_vehicles_file: Some(listed), ..config }
        })
        .await
    }

    /// A router for the same vehicles with passwords, and nothing encrypted.
    async fn with_passwords() -> Self {
        Self::start(HeldEndpoint::tcp(), |tls, config| {
            let passwords = tls.write("passwords", "north/car-1:first\nnorth/car-2:second\n");
            ServerConfig { zenoh_passwords_file: Some(passwords), tls_client_ca_file: None, ..config }
        })
        .await
    }

    fn client(&self, tls: &Value, login: Option<(&str, &str)>) -> Config {
        let mut config = configuration("client", &[], &[&self.endpoint]);
        let authority = self.tls.write("servers-ca.crt", &self.tls.servers.pem());
        let mut all = json!({ "root_ca_certificate": authority });
        all.as_object_mut().unwrap().extend(tls.as_object().unwrap().clone());
        config.insert_json5("transport/link/tls", &all.to_string()).unwrap();
        if let Some((user, password)) = login {
            let login = json!({ "user": user, "password": password });
            config.insert_json5("transport/auth/usrpwd", &login.to_string()).unwrap();
        }
        config.insert_json5("connect/timeout_ms", "3000").unwrap();
        config
    }

    async fn connect_with(&self, client: &Certified) -> zenoh::Result<Session> {
        let name = format!("client-{}", client.serial);
        let certificate = self.tls.write(&format!("{name}.crt"), &client.certificate);
        let key = self.tls.write(&format!("{name}.key"), &client.key);
        let tls = json!({ "enable_mtls": true, "connect_certificate": certificate, "connect_private_key": key });
        zenoh::open(self.client(&tls, None)).await
    }

    async fn connect_as(&self, user: &str, password: &str) -> zenoh::Result<Session> {
        zenoh::open(self.client(&json!({}), Some((user, password)))).await
    }

    /// The session of a vehicle with a certificate.
    async fn vehicle(&self, vehicle: &str, serial: u64) -> Session {
        let certified = self.tls.vehicles.vehicle_by_common_name("north", vehicle, serial);
        self.connect_with(&certified).await.unwrap()
    }
}

/// Number of cells that a query of the map is answered with.
async fn cells_queried(session: &Session) -> usize {
    let replies = session.get(EVERY_CELL).timeout(NO_ANSWER).await.unwrap();
    let mut cells = 0;
    while let Ok(reply) = replies.recv_async().await {
        cells += usize::from(reply.into_result().is_ok());
    }
    cells
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_may_read_the_shared_map_and_publish_nothing_in_it_and_a_vehicle_not_even_that() {
    let router = Router::start(HeldEndpoint::tcp(), |tls, config| {
        let passwords = tls.write("passwords", "north/car-1:first\nplanner:second\n");
        let readers = tls.write("readers", "planner\n");
        let config = ServerConfig { zenoh_passwords_file: Some(passwords), tls_client_ca_file: None, ..config };
        ServerConfig { zenoh_readers_file: Some(readers), tls_cert_file: None, tls_key_file: None, ..config }
    })
    .await;
    let reader = router.connect_as("planner", "second").await.unwrap();
    let vehicle = router.connect_as("north/car-1", "first").await.unwrap();
    let of_reader = reader.declare_subscriber(EVERY_CELL).await.unwrap();
    let of_vehicle = vehicle.declare_subscriber(EVERY_CELL).await.unwrap();
    // Nobody but the server gets a word to another.
    let forger = router.connect_as("planner", "second").await.unwrap();
    for session in [&forger, &vehicle] {
        session.put("lanemap/v1/map/14-1-1", "forged").await.unwrap();
    }

    let drives = along_a_road(31, 1, 120.0, false);
    drives[0].upload_whole(&router.server.url()).await;
    settled(&router.server).await;
    let heard = timeout(PATIENCE, of_reader.recv_async()).await.unwrap().unwrap();
    assert!(heard.key_expr().as_str().starts_with("lanemap/v1/map/14-"), "{heard:?}");
    assert_ne!(heard.key_expr().as_str(), "lanemap/v1/map/14-1-1");
    assert_eq!(cells_queried(&reader).await, 1);
    assert_eq!(cells_queried(&vehicle).await, 0);
    // Its own words come back to it within its session.
    let overheard = std::iter::from_fn(|| of_vehicle.try_recv().ok().flatten());
    let overheard: Vec<_> = overheard.filter(|sample| sample.payload().to_bytes().as_ref() != b"forged").collect();
    assert!(overheard.is_empty(), "a vehicle hears nothing of the map");
    router.server.shutdown().await;
}

fn start(vehicle: &str) -> v1::SessionStart {
    let drive = drives::simulated(1, 20);
    v1::SessionStart { fleet_id: "north".to_owned(), vehicle_id: vehicle.to_owned(), ..drive.wire_start() }
}

/// Streams some frames as `vehicle` and waits for their acks.
async fn stream_as(session: &Session, vehicle: &str) -> RawZenohStream {
    RawZenohStream::streamed_whatever_breaks(session, &start(vehicle), &drives::simulated(1, 20).frames, 10).await
}

/// Everything that a session may try to overhear of `vehicle`.
async fn listen_in(session: &Session, vehicle: &str) -> Vec<Subscriber<FifoChannelHandler<Sample>>> {
    let mut listening = Vec::new();
    for keys in ["**", "*/*/*", "*/*/observations", "*/*/acks", "*/*/observations/@adv/**"] {
        listening.push(session.declare_subscriber(format!("lanemap/v1/{keys}")).await.unwrap());
    }
    for key in ["**", "observations", "acks", "pose", "acks/@adv/**"] {
        listening.push(session.declare_subscriber(format!("lanemap/v1/north/{vehicle}/{key}")).await.unwrap());
    }
    for tokens in ["lanemap/v1/*/*/@alive/*".to_owned(), format!("lanemap/v1/north/{vehicle}/@alive/*")] {
        listening.push(session.liveliness().declare_subscriber(tokens).await.unwrap());
    }
    listening
}

/// What was overheard of `vehicle`.
fn overheard(listening: &[Subscriber<FifoChannelHandler<Sample>>], vehicle: &str) -> Vec<String> {
    let of_vehicle = format!("lanemap/v1/north/{vehicle}/");
    let heard = listening.iter().flat_map(|keys| std::iter::from_fn(|| keys.try_recv().ok().flatten()));
    heard.map(|sample| sample.key_expr().to_string()).filter(|key| key.starts_with(&of_vehicle)).collect()
}

/// Whether a session sees the server's liveliness token.
async fn sees_server(session: &Session) -> bool {
    let tokens = session.liveliness().get(SERVER).timeout(NO_ANSWER).await.unwrap();
    tokens.recv_async().await.is_ok_and(|reply| reply.result().is_ok())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_streams_over_zenoh_by_its_certificate_and_another_cannot_listen_in() {
    let router = Router::with_certificates().await;
    let (car, other) = (router.vehicle("car-1", 2).await, router.vehicle("car-2", 3).await);
    let listening = listen_in(&other, "car-1").await;
    let _open = stream_as(&car, "car-1").await;
    // Whatever went to the other vehicle went before the acks of its own stream.
    stream_as(&other, "car-2").await;
    assert_eq!(overheard(&listening, "car-1"), Vec::<String>::new());
    for key in ["lanemap/v1/north/car-1/acks/@adv/**", "lanemap/v1/north/car-1/**", "lanemap/v1/**"] {
        let replies = other.get(key).accept_replies(ReplyKeyExpr::Any).timeout(NO_ANSWER).await.unwrap();
        while let Ok(reply) = replies.recv_async().await {
            let foreign = reply.result().is_ok_and(|sample| sample.key_expr().as_str().contains("car-1"));
            assert!(!foreign, "{reply:?}");
        }
    }
    // Its own acks it may fetch once more: they are in the server's cache.
    let again = car
        .get("lanemap/v1/north/car-1/acks/@adv/**")
        .accept_replies(ReplyKeyExpr::Any)
        .timeout(PATIENCE)
        .await
        .unwrap();
    assert!(again.recv_async().await.unwrap().result().is_ok());
    assert_eq!(router.server.sessions().list().len(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn where_no_rule_forbids_it_another_does_listen_in() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let config = ServerConfig {
        zenoh_mode: ZenohMode::Router,
        zenoh_listen: endpoint.parse().unwrap(),
        ..servers::config(folder.path())
    };
    let _server = Server::start(config).await.unwrap();
    let open = async || zenoh::open(configuration("client", &[], &[&endpoint])).await.unwrap();
    let (car, other) = (open().await, open().await);
    let listening = listen_in(&other, "car-1").await;
    stream_as(&car, "car-1").await;
    stream_as(&other, "car-2").await;
    let overheard = overheard(&listening, "car-1");
    for key in ["observations", "acks", "pose"] {
        assert!(overheard.iter().any(|heard| heard.ends_with(key)), "{key} is not in {overheard:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_cannot_put_on_the_keys_of_another_nor_into_its_stream() {
    let router = Router::with_passwords().await;
    let car = router.connect_as("north/car-1", "first").await.unwrap();
    let thief = router.connect_as("north/car-2", "second").await.unwrap();
    let (mut stream, accepted) = RawZenohStream::started(&car, start("car-1")).await;
    let frames = drives::simulated(1, 20).frames;
    stream.stream(&frames[..10], 10).await;

    // A message of car-1's own stream, a forged answer, and a stream of its own in car-1's name.
    let next = Attachment { nonce: stream.nonce, number: stream.next_number }.to_string();
    let end = v1::StreamObservationsRequest { message: Some(Message::End(v1::SessionEnd {})) }.encode_to_vec();
    let forged_ack =
        v1::StreamObservationsResponse { message: Some(Answer::Ack(v1::Ack { acked_sequence_inclusive: 1_000 })) };
    let acks = "lanemap/v1/north/car-1/acks";
    thief
        .put("lanemap/v1/north/car-1/observations", end)
        .attachment(next.clone())
        .encoding(REQUEST_ENCODING)
        .await
        .unwrap();
    thief.put(acks, forged_ack.encode_to_vec()).attachment(next).await.unwrap();
    let forged = RawZenohStream::open(&thief, "north", "car-1").await;
    let another_drive = v1::SessionStart { drive_id: "forged".to_owned(), ..start("car-1") };
    let message = v1::StreamObservationsRequest { message: Some(Message::Start(another_drive)) };
    let attachment = Attachment { nonce: forged.nonce, number: 0 }.to_string();
    forged.put(message.encode_to_vec(), Some(&attachment)).await;
    // All that is on the thief's link is through once its own stream is acked.
    stream_as(&thief, "car-2").await;

    for frame in &frames[10..] {
        stream.send_frame(wire::frame(frame)).await;
    }
    loop {
        match stream.answer().await {
            Answer::Ack(ack) if ack.acked_sequence_inclusive == 20 => break,
            Answer::Ack(ack) => assert!(ack.acked_sequence_inclusive <= 20, "a forged ack"),
            other => panic!("{other:?}"),
        }
    }
    let sessions = router.server.sessions().list();
    assert_eq!(sessions.len(), 2, "the forged drive began");
    assert!(sessions.iter().any(|map| map.session.to_string() == accepted.session_id));
}

#[tokio::test(flavor = "multi_thread")]
async fn who_has_no_certificate_or_a_strangers_does_not_connect_and_who_is_not_listed_is_heard_by_none() {
    let router = Router::with_certificates().await;
    let stranger = Authority::new("vehicles").vehicle_by_common_name("north", "car-1", 5);
    assert!(router.connect_with(&stranger).await.is_err());
    assert!(zenoh::open(router.client(&json!({}), None)).await.is_err());

    let listed = router.vehicle("car-1", 6).await;
    assert!(sees_server(&listed).await);
    let unlisted = router.vehicle("car-9", 7).await;
    assert!(!sees_server(&unlisted).await);
    let stream = RawZenohStream::open(&unlisted, "north", "car-9").await;
    let message = v1::StreamObservationsRequest { message: Some(Message::Start(start("car-9"))) };
    let attachment = Attachment { nonce: stream.nonce, number: 0 }.to_string();
    stream.put(message.encode_to_vec(), Some(&attachment)).await;
    assert!(!sees_server(&unlisted).await);
    assert_eq!(router.server.sessions().list().len(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_password_opens_the_keys_of_its_vehicle_only_and_a_wrong_one_none() {
    let router = Router::with_passwords().await;
    assert!(router.connect_as("north/car-1", "wrong").await.is_err());
    assert!(router.connect_as("north/car-1", "second").await.is_err());
    assert!(router.connect_as("north/car-9", "first").await.is_err());
    assert!(zenoh::open(router.client(&json!({}), None)).await.is_err());

    let car = router.connect_as("north/car-1", "first").await.unwrap();
    let other = router.connect_as("north/car-2", "second").await.unwrap();
    let listening = listen_in(&other, "car-1").await;
    stream_as(&car, "car-1").await;
    stream_as(&other, "car-2").await;
    assert_eq!(overheard(&listening, "car-1"), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_over_zenoh_is_checked_like_one_over_grpc() {
    let issuer = TokenIssuer::new("key-1");
    let router = Router::start(HeldEndpoint::tcp(), |tls, config| {
        let passwords = tls.write("passwords", "north/car-1:first\n");
        let keys = tls.write("keys.json", &TokenIssuer::jwks(&[&issuer]));
        ServerConfig {
            zenoh_passwords_file: Some(passwords),
            tls_client_ca_file: None,
            token_keys_file: Some(keys),
            token_issuer: Some(tokens::ISSUER.to_owned()),
            ..config
        }
    })
    .await;
    let car = router.connect_as("north/car-1", "first").await.unwrap();
    let answer_to = async |token: &str| {
        let mut stream = RawZenohStream::open(&car, "north", "car-1").await;
        let message = v1::StreamObservationsRequest { message: Some(Message::Start(start("car-1"))) };
        let attachment = attachment_with_token(Attachment { nonce: stream.nonce, number: 0 }, token);
        stream.put(message.encode_to_vec(), Some(&attachment)).await;
        match stream.answer().await {
            Answer::Accepted(_) => 0,
            Answer::Closed(closed) => closed.code,
            other => panic!("{other:?}"),
        }
    };
    let of = |vehicle: &str, exp: u64| {
        issuer.token(json!({ "fleet": "north", "vehicle": vehicle, "scope": "ingest", "exp": exp }))
    };
    let soon = tokens::unix_s() + 600;
    assert_eq!(answer_to(&of("car-1", soon)).await, 0);
    assert_eq!(answer_to(&of("car-2", soon)).await, 7, "a token of another vehicle");
    assert_eq!(answer_to(&of("car-1", tokens::unix_s() - 120)).await, 16, "an expired token");
    assert_eq!(answer_to("no.token.atall").await, 16);
    stream_as(&car, "car-1").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn where_a_key_proves_nothing_a_token_must() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let issuer = TokenIssuer::new("key-1");
    let endpoint = HeldEndpoint::tcp();
    let config = ServerConfig {
        zenoh_mode: ZenohMode::Router,
        zenoh_listen: endpoint.parse().unwrap(),
        token_keys_file: Some(tls.write("keys.json", &TokenIssuer::jwks(&[&issuer]))),
        token_issuer: Some(tokens::ISSUER.to_owned()),
        ..servers::config(&folder.path().join("data"))
    };
    let _server = Server::start(config).await.unwrap();
    let session = zenoh::open(configuration("client", &[], &[&endpoint])).await.unwrap();
    let mut stream = RawZenohStream::open(&session, "north", "car-1").await;
    stream.send(Message::Start(start("car-1"))).await;
    assert_eq!(stream.closed().await.code, 16);
}

#[test]
fn zenoh_listens_beyond_the_machine_only_with_tls_and_access_control() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let router = |endpoint: &str, config: ServerConfig| ServerConfig {
        zenoh_mode: ZenohMode::Router,
        zenoh_listen: endpoint.parse().unwrap(),
        ..config
    };
    let bare = || servers::config(folder.path());
    let listed = || ServerConfig { zenoh_vehicles_file: Some("vehicles".into()), ..tls.config() };
    for local in ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:7447"] {
        router(local, bare()).check().unwrap();
    }
    router("tls/0.0.0.0:7447", listed()).check().unwrap();
    let refused = |config: ServerConfig| config.check().unwrap_err().to_string();
    for open in ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.1:7447", "tcp/example.org:7447"] {
        let said = refused(router(open, bare()));
        assert!(said.contains("zenoh_listen") && said.contains("TLS") && said.contains("access control"), "{said}");
        assert!(refused(router(open, listed())).contains("needs TLS"));
        router(open, ServerConfig { insecure_listen_anywhere: true, ..bare() }).check().unwrap();
    }
    assert!(refused(router("tls/0.0.0.0:7447", tls.config())).contains("zenoh_mode needs"));
    let client =
        ServerConfig { zenoh_mode: ZenohMode::Client, zenoh_connect: "tcp/router:7447".parse().unwrap(), ..bare() };
    assert!(refused(client).contains("zenoh_connect"));
}
