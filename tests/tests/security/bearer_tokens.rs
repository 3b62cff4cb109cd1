//! What tokens open, and which are none.

use futures::StreamExt;
use jsonwebtoken::{Algorithm, EncodingKey, Header, encode};
use lanemap_proto::v1::{self, ingest_service_client::IngestServiceClient, stream_observations_request::Message};
use lanemap_server::ServerConfig;
use lanemap_tests::tokens::{self, TokenIssuer, completed};
use serde_json::{Value, json};
use tokio::time::timeout;
use tonic::Code;

use super::{PATIENCE, Secured, assert_code, car, eventually, upload_request, with_token};

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
        message: upload_request("north", "car-1").start.map(Message::Start),
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
