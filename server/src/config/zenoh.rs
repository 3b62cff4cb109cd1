//! Settings of the zenoh side of ingest.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use thiserror::Error;
use zenoh::config::EndPoint;

/// What the server is in zenoh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ZenohMode {
    /// Nothing: vehicles use gRPC.
    #[default]
    Off,
    /// A router: vehicles connect to the server itself.
    Router,
    /// A client of a router that runs elsewhere.
    Client,
}

impl fmt::Display for ZenohMode {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Off => "off",
            Self::Router => "router",
            Self::Client => "client",
        })
    }
}

/// A mode that is none of `off`, `router`, `client`.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("{mode:?} is no mode: off, router or client")]
pub struct ModeError {
    mode: String,
}

impl FromStr for ZenohMode {
    type Err = ModeError;

    fn from_str(text: &str) -> Result<Self, ModeError> {
        match text {
            "off" => Ok(Self::Off),
            "router" => Ok(Self::Router),
            "client" => Ok(Self::Client),
            _ => Err(ModeError { mode: text.to_owned() }),
        }
    }
}

/// Endpoints of zenoh, e.g. `tcp/127.0.0.1:7447`; several are separated by commas.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Endpoints(Vec<String>);

/// A text that is no endpoint.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("{endpoint:?} is no zenoh endpoint, e.g. tcp/127.0.0.1:7447: {reason}")]
pub struct EndpointError {
    endpoint: String,
    reason: String,
}

impl Endpoints {
    /// Zenoh's usual port, for this machine only.
    #[must_use]
    pub fn loopback() -> Self {
        Self(vec!["tcp/127.0.0.1:7447".to_owned()])
    }

    /// The endpoints.
    #[must_use]
    pub fn as_slice(&self) -> &[String] {
        &self.0
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl FromStr for Endpoints {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        let endpoints = text.split(',').map(str::trim).filter(|endpoint| !endpoint.is_empty());
        endpoints.map(endpoint).collect::<Result<_, _>>().map(Self)
    }
}

fn endpoint(text: &str) -> Result<String, EndpointError> {
    let checked = EndPoint::from_str(text);
    checked.map_err(|error| EndpointError { endpoint: text.to_owned(), reason: error.to_string() })?;
    Ok(text.to_owned())
}

impl fmt::Display for Endpoints {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0.join(","))
    }
}

impl TryFrom<String> for Endpoints {
    type Error = EndpointError;

    fn try_from(text: String) -> Result<Self, EndpointError> {
        text.parse()
    }
}

impl From<Endpoints> for String {
    fn from(endpoints: Endpoints) -> Self {
        endpoints.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_separated_by_commas_and_checked() {
        let endpoints: Endpoints = "tcp/127.0.0.1:7447, tls/[::1]:7448".parse().unwrap();
        assert_eq!(endpoints.as_slice(), ["tcp/127.0.0.1:7447", "tls/[::1]:7448"]);
        assert!("".parse::<Endpoints>().unwrap().is_empty());
        let error = "127.0.0.1:7447".parse::<Endpoints>().unwrap_err().to_string();
        assert!(error.starts_with("\"127.0.0.1:7447\" is no zenoh endpoint"), "{error}");
    }
}
