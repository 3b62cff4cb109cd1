//! Who reads maps, and what is for all.

use lanemap_proto::v1::{self, map_service_client::MapServiceClient};
use lanemap_server::ServerConfig;
use reqwest::{Method, StatusCode, header};
use serde_json::{Value, json};
use tonic::Code;

use super::{Secured, assert_code, car, with_token};

#[tokio::test(flavor = "multi_thread")]
async fn maps_and_metrics_are_for_readers_and_health_is_for_all() {
    let service = Secured::start(|config| config).await;
    let reader = service.issuer.token(json!({ "scope": "read" }));
    let vehicle = car(&service.issuer, "car-1");
    for path in [
        "/sessions",
        "/collections/lanes/items",
        "/cells",
        "/splines/14/0/0",
        "/metrics",
        "/sessions/0123456789abcdef/lanes.pb",
    ] {
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
    for path in ["/sessions", "/metrics", "/collections/lanes/items", "/cells", "/splines/14/0/0"] {
        // A tile without lines has no content.
        assert!(service.get(path, Some(&reader)).await.status().is_success(), "{path}");
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
async fn a_page_of_another_origin_may_ask_with_a_token() {
    let service = Secured::start(|config| config).await;
    let url = format!("https://localhost:{}/sessions", service.server.address().port());
    let preflight = service.http(None).request(Method::OPTIONS, &url);
    let preflight = preflight.header(header::ORIGIN, "https://maps.test");
    let preflight = preflight.header(header::ACCESS_CONTROL_REQUEST_METHOD, "GET");
    let preflight = preflight.header(header::ACCESS_CONTROL_REQUEST_HEADERS, "authorization");
    let allowed = preflight.send().await.unwrap();
    assert_eq!(allowed.status(), StatusCode::OK);
    assert_eq!(allowed.headers()[header::ACCESS_CONTROL_ALLOW_HEADERS], "authorization");
    let refused = service.http(None).get(&url).header(header::ORIGIN, "https://maps.test").send().await.unwrap();
    assert_eq!(refused.status(), StatusCode::UNAUTHORIZED);
    assert_eq!(refused.headers()[header::ACCESS_CONTROL_ALLOW_ORIGIN], "*", "the page must see why");
}

#[tokio::test(flavor = "multi_thread")]
async fn anybody_reads_where_that_is_set_and_streams_all_the_same_not() {
    let service = Secured::start(|config| ServerConfig { anonymous_read: true, ..config }).await;
    assert_eq!(service.get("/sessions", None).await.status(), StatusCode::OK);
    assert_eq!(service.get("/metrics", None).await.status(), StatusCode::OK);
    assert_code(service.upload_as("car-1", None, None).await, Code::Unauthenticated);
}
