//! Who the client is and whom it trusts: TLS certificates and bearer tokens, from files.

use std::{fmt, path::PathBuf};

use crate::error::ClientError;

/// TLS and token options of a client; the default is neither. A token's file is read for every stream, so that a token
/// that another process renews is used; certificates are read once.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Credentials {
    /// Certificates that sign the service's, PEM. Needed for `https` and `tls/`.
    pub ca: Option<PathBuf>,
    /// The client's own certificate and key, PEM, for a service that asks for one (mTLS).
    pub identity: Option<IdentityFiles>,
    /// Name in the service's certificate, where it is not the address's host; for gRPC.
    pub server_name: Option<String>,
    /// A bearer token: sent as `authorization: Bearer`, and over zenoh with a stream's first message.
    pub token: Option<Token>,
    /// User and password, for zenoh.
    pub login: Option<Login>,
}

/// A user of a zenoh router.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Login {
    /// The user.
    pub user: String,
    /// A file that holds the password.
    pub password_file: PathBuf,
}

/// A certificate and its key, PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IdentityFiles {
    /// The certificate, with those that lead to the one that the service knows.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

/// A bearer token. Never shown, not by `Debug` either.
#[derive(Clone, PartialEq, Eq)]
pub enum Token {
    /// The token.
    Text(String),
    /// A file that holds it.
    File(PathBuf),
}

impl fmt::Debug for Token {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Text(_) => formatter.write_str("Token::Text(..)"),
            Self::File(path) => write!(formatter, "Token::File({path:?})"),
        }
    }
}

/// What the files of [`Credentials`] hold about TLS.
#[derive(Clone)]
pub(crate) struct Tls {
    pub(crate) ca: Vec<u8>,
    pub(crate) identity: Option<(Vec<u8>, Vec<u8>)>,
    pub(crate) server_name: Option<String>,
}

impl Credentials {
    /// The token as it is now.
    pub(crate) async fn bearer(&self) -> Result<Option<String>, ClientError> {
        let token = match &self.token {
            None => return Ok(None),
            Some(Token::Text(token)) => token.clone(),
            Some(Token::File(path)) => {
                let bytes = read(path.clone(), "token").await?;
                String::from_utf8(bytes).map_err(|_| credentials(path, "the token is not text"))?
            }
        };
        Ok(Some(token.trim().to_owned()))
    }

    /// User and password as they are now.
    pub(crate) async fn login(&self) -> Result<Option<(String, String)>, ClientError> {
        let Some(Login { user, password_file }) = &self.login else { return Ok(None) };
        let bytes = read(password_file.clone(), "password").await?;
        let text = String::from_utf8(bytes).map_err(|_| credentials(password_file, "the password is not text"))?;
        Ok(Some((user.clone(), text.trim_end_matches(['\r', '\n']).to_owned())))
    }

    /// Whether the token may be another one at the next connection.
    pub(crate) fn may_renew(&self) -> bool {
        matches!(self.token, Some(Token::File(_)))
    }

    /// Reads the certificates; `url` is the address that needs them.
    pub(crate) async fn tls(&self, url: &str) -> Result<Tls, ClientError> {
        let missing =
            || ClientError::Credentials(format!("{url} needs TLS: no certificate of its signer (ca) is given"));
        let ca = read(self.ca.clone().ok_or_else(missing)?, "ca").await?;
        let identity = match &self.identity {
            Some(IdentityFiles { cert, key }) => {
                Some((read(cert.clone(), "cert").await?, read(key.clone(), "key").await?))
            }
            None => None,
        };
        Ok(Tls { ca, identity, server_name: self.server_name.clone() })
    }
}

async fn read(path: PathBuf, what: &str) -> Result<Vec<u8>, ClientError> {
    let read = crate::backlog::on_blocking_thread({
        let path = path.clone();
        move || std::fs::read(path)
    });
    read.await.map_err(|error| credentials(&path, format_args!("{what} cannot be read: {error}")))
}

fn credentials(path: &std::path::Path, what: impl fmt::Display) -> ClientError {
    ClientError::Credentials(format!("{}: {what}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_not_shown() {
        let credentials = Credentials { token: Some(Token::Text("secret".into())), ..Credentials::default() };
        assert!(!format!("{credentials:?}").contains("secret"));
    }

    #[tokio::test]
    async fn a_renewed_token_is_the_one_that_is_sent() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        let credentials = Credentials { token: Some(Token::File(path.clone())), ..Credentials::default() };
        let error = credentials.bearer().await.unwrap_err().to_string();
        assert!(error.contains(path.to_str().unwrap()), "{error}");
        for token in ["first", "second"] {
            std::fs::write(&path, format!("{token}\n")).unwrap();
            assert_eq!(credentials.bearer().await.unwrap().as_deref(), Some(token));
        }
    }
}
