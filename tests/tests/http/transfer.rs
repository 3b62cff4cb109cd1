//! How answers travel: encodings, HEAD, other origins, limits, time-outs, and a proxy in front.

use std::time::Duration;

use lanemap_tests::http;
use reqwest::{Method, StatusCode, header};
use serde_json::Value;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    time::timeout,
};

use super::Service;

/// Longest wait for what takes a second or two.
const PATIENCE: Duration = Duration::from_secs(30);

#[tokio::test]
async fn an_answer_comes_in_the_encoding_that_its_reader_likes_best() {
    let service = Service::start().await;
    let id = service.drive("encodings", true).await;
    let path = format!("/sessions/{id}/lanes.geojson");
    let plain = service.get(&path).await.bytes().await.unwrap();
    for (accepted, encoding, magic) in [
        ("gzip", "gzip", &[0x1f, 0x8b][..]),
        ("zstd", "zstd", &[0x28, 0xb5, 0x2f, 0xfd]),
        ("br", "br", &[]),
        ("gzip;q=0.2, br;q=0.9, zstd;q=0.1", "br", &[]),
        ("gzip, br;q=0, zstd;q=0", "gzip", &[0x1f, 0x8b]),
    ] {
        let answer = service.request(Method::GET, &path, &[(header::ACCEPT_ENCODING, accepted)]).await;
        assert_eq!(answer.headers()[header::CONTENT_ENCODING], encoding, "{accepted}");
        assert_eq!(answer.headers()[header::VARY], "accept-encoding");
        let tag = answer.headers()[header::ETAG].to_str().unwrap().to_owned();
        assert!(tag.ends_with(&format!("-{encoding}\"")), "{tag}");
        let body = answer.bytes().await.unwrap();
        assert!(body.len() < plain.len() / 2 && body.starts_with(magic), "{accepted}");

        let held = [(header::ACCEPT_ENCODING, accepted), (header::IF_NONE_MATCH, tag.as_str())];
        let again = service.request(Method::GET, &path, &held).await;
        assert_eq!((again.status(), &again.headers()[header::ETAG]), (StatusCode::NOT_MODIFIED, &tag.parse().unwrap()));
    }
    for accepted in ["identity", "gzip;q=0", "deflate", ""] {
        let answer = service.request(Method::GET, &path, &[(header::ACCEPT_ENCODING, accepted)]).await;
        assert!(answer.headers().get(header::CONTENT_ENCODING).is_none(), "{accepted}");
        assert_eq!(answer.bytes().await.unwrap(), plain, "{accepted}");
    }
}

#[tokio::test]
async fn a_reader_that_declines_every_encoding_is_told_so_and_a_tiny_answer_is_not_compressed() {
    let service = Service::start().await;
    let none = [(header::ACCEPT_ENCODING, "identity;q=0, *;q=0")];
    let answer = service.request(Method::GET, "/sessions", &none).await;
    assert_eq!(answer.status(), StatusCode::NOT_ACCEPTABLE);
    let problem: Value = answer.json().await.unwrap();
    assert_eq!(problem["type"], "urn:lanemap:problem:not-acceptable");
    let tiny = service.request(Method::GET, "/sessions", &[(header::ACCEPT_ENCODING, "gzip")]).await;
    assert!(tiny.headers().get(header::CONTENT_ENCODING).is_none());
}

#[tokio::test]
async fn a_head_request_negotiates_as_its_get_does() {
    let service = Service::start().await;
    let id = service.drive("head", true).await;
    let path = format!("/sessions/{id}/lanes.geojson");
    for accepted in ["identity", "gzip", "br", "zstd"] {
        let accept = [(header::ACCEPT_ENCODING, accepted)];
        let get = service.request(Method::GET, &path, &accept).await;
        let head = service.request(Method::HEAD, &path, &accept).await;
        assert_eq!(head.status(), StatusCode::OK);
        for name in [header::CONTENT_TYPE, header::CONTENT_ENCODING, header::CONTENT_LENGTH, header::ETAG, header::VARY]
        {
            assert_eq!(head.headers().get(&name), get.headers().get(&name), "{accepted}: {name}");
        }
        assert_eq!(head.bytes().await.unwrap().len(), 0);
    }
    let missing = service.request(Method::HEAD, "/sessions/x/lanes.pb", &[]).await;
    assert_eq!(missing.status(), StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn a_page_of_another_origin_may_ask_with_a_token_and_read_tags_and_links() {
    let service = Service::start().await;
    let asked = [
        (header::ORIGIN, "https://example.org"),
        (header::ACCESS_CONTROL_REQUEST_METHOD, "GET"),
        (header::ACCESS_CONTROL_REQUEST_HEADERS, "authorization,if-none-match"),
    ];
    let preflight = service.request(Method::OPTIONS, "/sessions", &asked).await;
    assert_eq!(preflight.status(), StatusCode::OK);
    assert_eq!(preflight.headers()[header::ACCESS_CONTROL_ALLOW_HEADERS], "authorization,if-none-match");
    assert_eq!(preflight.headers()[header::ACCESS_CONTROL_MAX_AGE], "86400");
    for path in ["/sessions", "/nothing"] {
        let answer = service.request(Method::GET, path, &asked[..1]).await;
        assert_eq!(answer.headers()[header::ACCESS_CONTROL_ALLOW_ORIGIN], "*", "{path}");
        let exposed = answer.headers()[header::ACCESS_CONTROL_EXPOSE_HEADERS].to_str().unwrap();
        assert!(exposed.contains("etag") && exposed.contains("link"), "{exposed}");
    }
}

#[tokio::test]
async fn a_request_that_is_too_large_is_refused_with_its_limit() {
    let service = Service::start_with(|config| {
        config.max_url_bytes = 512;
        config.max_header_bytes = 2048;
    })
    .await;
    let problem = service.problem(&format!("/sessions?limit={}", "1".repeat(600)), StatusCode::URI_TOO_LONG).await;
    assert_eq!(problem["detail"], "path and query have 616 bytes, and may have 512");
    let long = "x".repeat(3000);
    let answer = service.request(Method::GET, "/sessions", &[(header::COOKIE, &long)]).await;
    assert_eq!(answer.status(), StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE);
    assert_eq!(answer.headers()[header::CONTENT_TYPE], "application/problem+json");

    let mut connection = TcpStream::connect(service.server.address()).await.unwrap();
    connection.write_all(b"GET /sessions HTTP/1.1\r\nhost: x\r\ncontent-length: 9999999\r\n\r\n").await.unwrap();
    let mut status = [0; 12];
    timeout(PATIENCE, connection.read_exact(&mut status)).await.unwrap().unwrap();
    assert_eq!(&status, b"HTTP/1.1 413");
}

#[tokio::test]
async fn a_connection_whose_headers_do_not_come_is_closed() {
    let service = Service::start_with(|config| config.header_timeout_s = 1).await;
    for beginning in [&b"GET /sessions HTTP/1.1\r\nhost: "[..], b"", b"PRI * HTTP/2.0\r\n"] {
        let mut connection = TcpStream::connect(service.server.address()).await.unwrap();
        connection.write_all(beginning).await.unwrap();
        let mut rest = Vec::new();
        // Whether it is closed in order or reset is all the same.
        let _ = timeout(PATIENCE, connection.read_to_end(&mut rest)).await.expect("it is closed");
    }
    assert_eq!(service.get("/sessions").await.status(), StatusCode::OK);
}

/// All links of a document.
fn links(document: &Value) -> Vec<String> {
    match document {
        Value::Object(members) => members
            .iter()
            .flat_map(|(name, member)| match member.as_str() {
                Some(href) if name == "href" => vec![href.to_owned()],
                _ => links(member),
            })
            .collect(),
        Value::Array(members) => members.iter().flat_map(links).collect(),
        _ => vec![],
    }
}

#[tokio::test]
async fn behind_a_proxy_links_lead_through_it_where_it_is_trusted() {
    let told =
        [("x-forwarded-proto", "https"), ("x-forwarded-host", "maps.example.org"), ("x-forwarded-prefix", "/v1")];
    for (trusted, beginning) in [(true, "https://maps.example.org/v1/".to_owned()), (false, String::new())] {
        let service = Service::start_with(|config| config.trust_forwarded_headers = trusted).await;
        service.drive("proxied", true).await;
        let beginning = if trusted { beginning } else { format!("{}/", service.server.url()) };
        let mut request = service.client.get(format!("{}/sessions", service.server.url()));
        for (name, value) in told {
            request = request.header(name, value);
        }
        let sessions: Value = request.send().await.unwrap().json().await.unwrap();
        let links = links(&sessions);
        assert!(links.len() >= 4 && links.iter().all(|link| link.starts_with(&beginning)), "{links:?}");
    }
}

#[tokio::test]
async fn under_a_base_path_every_link_and_the_viewer_work_and_paths_without_it_do_too() {
    let service = Service::start_with(|config| config.base_path = "/maps/v1".parse().unwrap()).await;
    let id = service.drive("based", true).await;
    let base = format!("{}/maps/v1", service.server.url());
    for path in ["/maps/v1/sessions", "/sessions"] {
        let answer = service.json(path).await;
        let links = links(&answer);
        assert!(links.len() >= 4, "{answer}");
        for link in links {
            assert!(link.starts_with(&base), "{link}");
            assert_eq!(http::get(&link).await.unwrap().status(), StatusCode::OK, "{link}");
        }
    }
    let page = service.get("/maps/v1/viewer").await.text().await.unwrap();
    let file = page.split('"').find(|text| text.starts_with("viewer/")).unwrap();
    assert_eq!(http::get(format!("{base}/{file}")).await.unwrap().status(), StatusCode::OK);
    let redirected = http::get(format!("{base}/viewer/")).await.unwrap();
    assert_eq!(redirected.url().as_str(), format!("{base}/viewer"));
    assert_eq!(service.get("/mapsv1/sessions").await.status(), StatusCode::NOT_FOUND);
    // gRPC, too: a client may be given the same address.
    assert!(!lanemap_tests::servers::map_bytes(&base, &id).await.is_empty());
}
