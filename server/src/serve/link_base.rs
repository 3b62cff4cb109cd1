//! What links begin with: scheme, host and base path of the service, as the reader of an answer reaches it.
//!
//! The host is that of the request (RFC 9110, 7.2), the scheme that of the port, the path the setting `base_path`. Behind a
//! proxy that is trusted, `Forwarded` (RFC 7239) goes before, else `X-Forwarded-Proto`, `-Host` and `-Prefix`; of several
//! proxies the first to take the request counts. Where no host is told, or it is none, links begin with their path.

use std::{convert::Infallible, sync::Arc};

use axum::{
    Router,
    extract::{FromRef, FromRequestParts, Request},
    http::{
        HeaderMap, Uri, header,
        request::Parts,
        uri::{Authority, PathAndQuery},
    },
};
use tower::ServiceBuilder;

use crate::config::{BasePath, ServerConfig};

/// How links are made.
#[derive(Clone, Debug, Default)]
pub struct LinkSettings {
    base_path: BasePath,
    trust_forwarded_headers: bool,
    is_tls: bool,
}

/// What links of one answer begin with, e.g. `https://maps.example.org/lanes`. Part of what the answer's entity tag is
/// made of.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct LinkBase(Arc<str>);

impl LinkSettings {
    /// Those of a service.
    #[must_use]
    pub fn of(config: &ServerConfig) -> Self {
        Self {
            base_path: config.base_path.clone(),
            trust_forwarded_headers: config.trust_forwarded_headers,
            is_tls: config.tls_cert_file.is_some(),
        }
    }

    fn base(&self, uri: &Uri, headers: &HeaderMap) -> LinkBase {
        let asked = uri.authority().map(Authority::as_str).or_else(|| text(headers, "host"));
        let told = if self.trust_forwarded_headers { Forwarded::read(headers) } else { Forwarded::default() };
        let path = told.prefix.as_ref().unwrap_or(&self.base_path);
        let scheme = told.scheme.unwrap_or(if self.is_tls { "https" } else { "http" });
        let host = told.host.or_else(|| asked.and_then(host));
        LinkBase(host.map_or_else(|| path.to_string(), |host| format!("{scheme}://{host}{path}")).into())
    }
}

impl LinkBase {
    /// The link to a path of the service, which begins with a slash.
    #[must_use]
    pub fn link(&self, path: &str) -> String {
        format!("{}{path}", self.0)
    }

    /// What links begin with; empty where that is nothing.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    #[cfg(test)]
    pub(crate) fn of_path(path: &str) -> Self {
        Self(path.into())
    }
}

impl<S> FromRequestParts<S> for LinkBase
where
    LinkSettings: FromRef<S>,
    S: Send + Sync,
{
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Infallible> {
        Ok(LinkSettings::from_ref(state).base(&parts.uri, &parts.headers))
    }
}

/// What a proxy says of the request that it passes on.
#[derive(Debug, Default, PartialEq)]
struct Forwarded {
    scheme: Option<&'static str>,
    host: Option<String>,
    prefix: Option<BasePath>,
}

impl Forwarded {
    fn read(headers: &HeaderMap) -> Self {
        let first = |name| text(headers, name).and_then(|value| value.split(',').next()).map(str::trim);
        let of_standard = |wanted: &str| {
            let pairs = first("forwarded")?.split(';').filter_map(|pair| pair.trim().split_once('='));
            let value = pairs.into_iter().find(|(name, _)| name.eq_ignore_ascii_case(wanted))?.1;
            Some(value.trim_matches('"'))
        };
        Self {
            scheme: of_standard("proto").or_else(|| first("x-forwarded-proto")).and_then(scheme),
            host: of_standard("host").or_else(|| first("x-forwarded-host")).and_then(host),
            prefix: first("x-forwarded-prefix").and_then(|prefix| prefix.parse().ok()),
        }
    }
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}

fn scheme(text: &str) -> Option<&'static str> {
    ["https", "http"].into_iter().find(|scheme| text.eq_ignore_ascii_case(scheme))
}

/// A host and, maybe, a port, and nothing that could lead out of a link.
fn host(text: &str) -> Option<String> {
    let authority: Authority = text.parse().ok()?;
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || ".-_:[]".contains(letter);
    (!authority.host().is_empty() && authority.as_str().chars().all(is_plain)).then(|| authority.to_string())
}

/// The routes under a base path, too: a request that comes with it is taken as one without.
pub(crate) fn mounted(router: Router, base_path: &BasePath) -> Router {
    if base_path.as_str().is_empty() {
        return router;
    }
    let base_path = base_path.clone();
    let strip = move |mut request: Request| {
        if let Some(uri) = stripped(request.uri(), &base_path) {
            *request.uri_mut() = uri;
        }
        request
    };
    Router::new().fallback_service(ServiceBuilder::new().map_request(strip).service(router))
}

fn stripped(uri: &Uri, base_path: &BasePath) -> Option<Uri> {
    let rest = base_path.stripped(uri.path())?;
    let rest = uri.query().map_or_else(|| rest.to_owned(), |query| format!("{rest}?{query}"));
    let mut parts = uri.clone().into_parts();
    parts.path_and_query = Some(rest.parse::<PathAndQuery>().ok()?);
    Uri::from_parts(parts).ok()
}

/// The header `Link` of an answer (RFC 8288): relation and target of each link.
pub(super) fn link_header<'a>(
    links: impl IntoIterator<Item = (&'a str, &'a str)>,
) -> Option<(header::HeaderName, header::HeaderValue)> {
    let links: Vec<String> = links.into_iter().map(|(rel, href)| format!("<{href}>; rel=\"{rel}\"")).collect();
    let value = header::HeaderValue::from_str(&links.join(", ")).ok()?;
    (!links.is_empty()).then_some((header::LINK, value))
}

#[cfg(test)]
mod tests {
    use axum::http::{HeaderName, HeaderValue};

    use super::*;

    fn base(settings: &LinkSettings, headers: &[(&'static str, &'static str)]) -> String {
        let headers = headers
            .iter()
            .map(|(name, value)| (HeaderName::from_static(name), HeaderValue::from_static(value)))
            .collect();
        settings.base(&Uri::from_static("/cells"), &headers).link("/cells")
    }

    fn trusting() -> LinkSettings {
        LinkSettings { trust_forwarded_headers: true, base_path: "/maps".parse().unwrap(), is_tls: false }
    }

    #[test]
    fn a_link_has_the_host_of_the_request_and_the_base_path() {
        let settings = LinkSettings { is_tls: true, trust_forwarded_headers: false, ..trusting() };
        assert_eq!(base(&settings, &[("host", "example.org:8443")]), "https://example.org:8443/maps/cells");
        assert_eq!(base(&settings, &[]), "/maps/cells");
    }

    #[test]
    fn what_proxies_say_counts_only_where_they_are_trusted() {
        let told = [
            ("host", "10.0.0.7:8080"),
            ("x-forwarded-proto", "https"),
            ("x-forwarded-host", "a.example, b.example"),
            ("x-forwarded-prefix", "/lanes/"),
        ];
        assert_eq!(base(&trusting(), &told), "https://a.example/lanes/cells");
        assert_eq!(base(&LinkSettings::default(), &told), "http://10.0.0.7:8080/cells");
        let standard = [("host", "x"), ("forwarded", "for=1.2.3.4;proto=https;host=\"c.example:8443\", for=5.6.7.8")];
        assert_eq!(base(&trusting(), &standard), "https://c.example:8443/maps/cells");
    }

    #[test]
    fn a_host_or_prefix_that_would_lead_elsewhere_is_passed_over() {
        for evil in ["user@evil.example", "evil.example/path", "a b", "\"><script>"] {
            assert_eq!(
                base(&trusting(), &[("host", "x"), ("x-forwarded-host", evil)]),
                "http://x/maps/cells",
                "{evil}"
            );
        }
        assert_eq!(
            base(&trusting(), &[("host", "x"), ("x-forwarded-prefix", "//evil.example")]),
            "http://x/maps/cells"
        );
    }

    #[test]
    fn a_request_under_the_base_path_loses_it_and_keeps_its_query() {
        let base_path: BasePath = "/maps".parse().unwrap();
        assert_eq!(stripped(&Uri::from_static("/maps/cells?limit=1"), &base_path).unwrap(), "/cells?limit=1");
        assert_eq!(stripped(&Uri::from_static("http://host/maps"), &base_path).unwrap(), "http://host/");
        assert_eq!(stripped(&Uri::from_static("/cells"), &base_path), None);
    }
}
