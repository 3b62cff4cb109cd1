//! Who connects, by certificates, and how.

use lanemap_proto::v1::{self, stream_observations_request::Message};
use lanemap_server::{Server, ServerConfig};
use lanemap_tests::{
    authorities::{Authority, Certified, TlsFolder, named_by_uri},
    raw_stream::RawStream,
};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    time::timeout,
};
use tonic::{Code, Status, transport::Channel};

use super::{PATIENCE, Secured, assert_code, upload, upload_request};

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_streams_by_its_certificate_as_itself_and_as_no_other() {
    let service = Secured::start(|config| config).await;
    let car = service.tls.vehicles.vehicle("north", "car-1", 2);
    let acked = service.upload_as("car-1", Some(&car), None).await.unwrap();
    assert_eq!(acked.acked_sequence_inclusive, Some(2));
    assert_code(service.upload_as("car-2", Some(&car), None).await, Code::PermissionDenied);

    let mut stream = RawStream::open_on(service.channel(Some(&car)).await).await;
    let other = upload_request("north", "car-2").start.unwrap();
    stream.send(Message::Start(other)).await;
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
