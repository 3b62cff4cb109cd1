//! The configuration of the server's zenoh session, made from the server's own settings.

use serde_json::Value;
use zenoh::Config;

use super::{ZenohError, access::AccessRules, link_security::link_security};
use crate::config::{ServerConfig, ZenohMode};

/// Room for key, attachment and headers of the largest message.
const MESSAGE_OVERHEAD_BYTES: usize = 64 * 1024;
/// Bytes that travel together at most. Each connection holds several such buffers.
const BATCH_BYTES: usize = 16 * 1024;
/// How long a publication waits for a vehicle that does not read before its connection is cut, microseconds.
const WAIT_BEFORE_CLOSE_US: u64 = 1_000_000;
/// How long a server that starts as a client waits for its router, milliseconds. Later it waits for ever.
const WAIT_FOR_ROUTER_MS: u64 = 10_000;

/// Zenoh's configuration.
///
/// # Errors
/// An endpoint or another setting that zenoh does not take.
pub(super) fn transport_config(settings: &ServerConfig) -> Result<Config, ZenohError> {
    let mut config = Config::default();
    secure(&mut config, settings)?;
    let mut set = |name: &'static str, value: String| {
        let set = config.insert_json5(name, &value);
        set.map_err(|error| ZenohError::Config { name, value, reason: error.to_string() })
    };
    let endpoints = |endpoints: &[String]| Value::from(endpoints).to_string();
    let router = settings.zenoh_mode == ZenohMode::Router;
    set("mode", if router { "\"router\"" } else { "\"client\"" }.to_owned())?;
    set("listen/endpoints", if router { endpoints(settings.zenoh_listen.as_slice()) } else { "[]".to_owned() })?;
    set("connect/endpoints", endpoints(settings.zenoh_connect.as_slice()))?;
    // Vehicles are told where the server is; nobody is looked for.
    set("scouting/multicast/enabled", "false".to_owned())?;
    set("scouting/gossip/enabled", "false".to_owned())?;
    set("scouting/delay", "0".to_owned())?;
    // Frames bear their own times. With zenoh's stamps, zenoh-ext would put publishers without numbers in an order that
    // two links can break, and drop what comes late.
    set("timestamping/enabled", "false".to_owned())?;
    set("transport/unicast/max_sessions", settings.max_connections.to_string())?;
    set("transport/link/rx/max_message_size", (settings.max_message_bytes + MESSAGE_OVERHEAD_BYTES).to_string())?;
    if router {
        set("transport/link/tx/batch_size", BATCH_BYTES.to_string())?;
        // A router's links lead to one vehicle each: one that stops reading is cut soon. A client's only link leads to
        // the router that all share, and keeps zenoh's patience.
        let wait = "transport/link/tx/queue/congestion_control/block/wait_before_close";
        set(wait, WAIT_BEFORE_CLOSE_US.to_string())?;
    } else {
        set("connect/timeout_ms", WAIT_FOR_ROUTER_MS.to_string())?;
    }
    Ok(config)
}

/// TLS, passwords and access control.
fn secure(config: &mut Config, settings: &ServerConfig) -> Result<(), ZenohError> {
    let rules = AccessRules::of_server(settings)?;
    let mut set = |name: &'static str, value: &Value| {
        // Neither value nor reason is repeated: a password may stand in either.
        config.insert_json5(name, &value.to_string()).map_err(|_| ZenohError::Config {
            name,
            value: "(not shown)".to_owned(),
            reason: "zenoh does not take it".to_owned(),
        })
    };
    for (name, value) in link_security(settings, rules.as_ref())? {
        set(name, &value)?;
    }
    rules.map_or(Ok(()), |rules| set("access_control", &rules.to_json()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Endpoints;

    #[test]
    fn a_routers_settings_reach_zenoh() {
        let settings = ServerConfig {
            zenoh_mode: ZenohMode::Router,
            zenoh_listen: "tcp/127.0.0.1:17447, tcp/[::1]:17447".parse().unwrap(),
            max_message_bytes: 1024 * 1024,
            ..ServerConfig::default()
        };
        let config = transport_config(&settings).unwrap();
        let value = |name| config.get_json(name).unwrap();
        assert_eq!(value("mode"), "\"router\"");
        assert_eq!(value("listen/endpoints"), r#"["tcp/127.0.0.1:17447","tcp/[::1]:17447"]"#);
        assert_eq!(value("scouting/multicast/enabled"), "false");
        assert_eq!(value("transport/link/rx/max_message_size"), (1024 * 1024 + MESSAGE_OVERHEAD_BYTES).to_string());
    }

    #[test]
    fn a_client_listens_nowhere() {
        let settings = ServerConfig {
            zenoh_mode: ZenohMode::Client,
            zenoh_connect: "tcp/127.0.0.1:17447".parse::<Endpoints>().unwrap(),
            ..ServerConfig::default()
        };
        let config = transport_config(&settings).unwrap();
        assert_eq!(config.get_json("listen/endpoints").unwrap(), "[]");
        assert_eq!(config.get_json("connect/endpoints").unwrap(), r#"["tcp/127.0.0.1:17447"]"#);
    }
}
