//! HTTP as any client speaks it.

/// A client of its own connections.
#[must_use]
pub fn client() -> reqwest::Client {
    // `reqwest` is built without a cryptography of its own; the first one named in a process counts.
    let _ = rustls::crypto::ring::default_provider().install_default();
    reqwest::Client::new()
}

/// Gets a page.
///
/// # Errors
/// Nobody answers.
pub async fn get(url: impl reqwest::IntoUrl) -> reqwest::Result<reqwest::Response> {
    client().get(url).send().await
}
