//! Authentication of requests of gRPC and HTTP alike, and the guards of the HTTP side.

use std::sync::Arc;

use axum::{
    extract::{Request, State},
    http::{Extensions, header},
    middleware::Next,
    response::Response,
};

use super::{AuthenticationError, Authenticator, Peer, authenticator::Identity};
use crate::{error::Error, serve::problem::Problem, telemetry};

/// What a connection's TLS handshake showed; an extension of every request on it.
#[derive(Clone, Debug)]
pub(crate) struct Connection {
    /// `None`: no TLS, or no certificate.
    pub(crate) identity: Option<Arc<Identity>>,
}

/// Who sent a request; an extension of every request that came through [`authenticate`].
#[derive(Clone, Debug)]
struct Sender(Result<Peer, AuthenticationError>);

/// Finds out who sends a request, and passes it on: what it may do is asked where it is done.
///
/// The header `authorization` goes no further.
pub(crate) async fn authenticate(
    State(authenticator): State<Arc<Authenticator>>,
    mut request: Request,
    next: Next,
) -> Response {
    let authorization = request.headers_mut().remove(header::AUTHORIZATION);
    let connection = request.extensions().get::<Connection>();
    let identity = connection.and_then(|connection| connection.identity.as_deref());
    let sender = authenticator.peer(identity, authorization.as_ref());
    if let Err(error) = &sender {
        tracing::debug!(%error, "a request came with credentials that are not taken");
        metrics::counter!(telemetry::CREDENTIALS_REFUSED).increment(1);
    }
    request.extensions_mut().insert(Sender(sender));
    next.run(request).await
}

/// Who sent a request.
///
/// # Errors
/// [`Error::Unauthenticated`] where its credentials are not taken, or nobody asked for them.
pub fn peer_of(extensions: &Extensions) -> Result<Peer, Error> {
    let sender = extensions.get::<Sender>().map_or(Err(AuthenticationError::Missing), |sender| sender.0.clone());
    sender.map_err(Error::Unauthenticated)
}

/// Lets those pass who may read every fleet's maps.
pub(crate) async fn require_read(request: Request, next: Next) -> Result<Response, Problem> {
    peer_of(request.extensions()).and_then(|peer| peer.may_read(None))?;
    Ok(next.run(request).await)
}
