//! Who may do what in zenoh: TLS, passwords, and zenoh's access control, made from the server's own settings.
//!
//! Zenoh authenticates links, not messages: a link is who its certificate's common name or its user name says, both of
//! the form `{fleet}/{vehicle}` (see [`VehicleName`]). The access control that is made here lets it put on that vehicle's
//! `observations`, hear that vehicle's `acks` and `pose`, and nothing else; what no rule allows is denied. Hence the key
//! of a message proves whose it is, wherever these rules are in force: in the server where it is the router, in another
//! router that was given them ([`AccessRules::for_router`]).
//!
//! Readers, by names of their own (`zenoh_readers_file`), may hear and query the shared map, and say nothing.
//!
//! A bearer token may travel besides, in the attachment of message 0 of a stream. It is asked for where the key proves
//! nothing, and binds the stream to its roles and its expiry where it is there. It does not replace these rules: without
//! them whoever reaches the router could read it, or put messages into the stream that it opened.

use std::{collections::BTreeSet, path::Path};

use lanemap_proto::zenoh_keys::{EVERY_ALIVE, EVERY_CELL, EVERY_EVENT, EVERY_OBSERVATIONS, PREFIX, SERVER};
use serde_json::{Value, json};

use crate::{
    auth::{
        VehicleName,
        reload::{CredentialError, read},
    },
    config::ServerConfig,
};

/// How a link shows who it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Proofs {
    /// By the common name of its certificate.
    pub certificate: bool,
    /// By its user name and password.
    pub password: bool,
}

/// The rules of one router.
#[derive(Clone, Debug)]
pub struct AccessRules {
    proofs: Proofs,
    vehicles: BTreeSet<VehicleName>,
    /// Names of links that may use every key below `lanemap/v1`: servers that are clients of the router.
    servers: Vec<String>,
    /// Names of links that may read the shared map.
    readers: BTreeSet<String>,
}

impl AccessRules {
    /// The rules of this server as the router; `None` where no file names vehicles.
    ///
    /// # Errors
    /// A file that cannot be read, or a line that names no vehicle.
    pub fn of_server(settings: &ServerConfig) -> Result<Option<Self>, CredentialError> {
        let (listed, passwords) = (&settings.zenoh_vehicles_file, &settings.zenoh_passwords_file);
        if listed.is_none() && passwords.is_none() {
            return Ok(None);
        }
        Self::for_router(listed.as_deref(), passwords.as_deref(), settings.zenoh_readers_file.as_deref(), Vec::new())
            .map(Some)
    }

    /// The rules of a router for the vehicles that have a certificate (`listed`), a password, or, where both are given,
    /// both; for `readers` of the shared map, one name on a line; and for `servers`, by the names with which they connect.
    ///
    /// # Errors
    /// A file that cannot be read, or a line that names no vehicle.
    pub fn for_router(
        listed: Option<&Path>,
        passwords: Option<&Path>,
        readers: Option<&Path>,
        servers: Vec<String>,
    ) -> Result<Self, CredentialError> {
        let proofs = Proofs { certificate: listed.is_some(), password: passwords.is_some() };
        let readers = readers.map(|path| lines("zenoh_readers_file", path)).transpose()?.unwrap_or_default();
        let readers: BTreeSet<String> = readers.into_iter().map(|(_, name)| name).collect();
        let others: Vec<String> = servers.iter().chain(&readers).cloned().collect();
        let listed = listed.map(|path| names("zenoh_vehicles_file", path, |line| line, &others)).transpose()?;
        let with_password =
            passwords.map(|path| names("zenoh_passwords_file", path, before_colon, &others)).transpose()?;
        let vehicles = match (listed, with_password) {
            (Some(listed), Some(with_password)) => listed.intersection(&with_password).cloned().collect(),
            (listed, with_password) => listed.or(with_password).unwrap_or_default(),
        };
        Ok(Self { proofs, vehicles, servers, readers })
    }

    /// How links show who they are.
    #[must_use]
    pub fn proofs(&self) -> Proofs {
        self.proofs
    }

    /// The rules as zenoh's configuration has them, its section `access_control`.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let mut rules = vec![rule("asked", "egress", &ASKS, &asked_keys())];
        let mut subjects = Vec::new();
        let mut policies = Vec::new();
        // Rules go by number: zenoh logs their names.
        for (number, vehicle) in self.vehicles.iter().enumerate() {
            let [speaks, listens, hears] = ["speaks", "listens", "hears"].map(|verb| format!("{verb} {number}"));
            let keys = Keys::of(vehicle);
            rules.push(rule(&speaks, "ingress", &SAYS, &keys.speaks));
            rules.push(rule(&listens, "ingress", &ASKS, &keys.hears));
            rules.push(rule(&hears, "egress", &SAYS, &keys.hears));
            subjects.push(self.subject(&number.to_string(), &vehicle.encoded()));
            policies.push(json!({ "rules": ["asked", speaks, listens, hears], "subjects": [number.to_string()] }));
        }
        let map = [EVERY_CELL.to_owned(), EVERY_EVENT.to_owned(), SERVER.to_owned()];
        if !self.readers.is_empty() {
            rules.push(rule("reads", "ingress", &ASKS, &map));
            rules.push(rule("told", "egress", &SAYS, &map));
        }
        for (number, reader) in self.readers.iter().enumerate() {
            let id = format!("reader {number}");
            subjects.push(self.subject(&id, reader));
            policies.push(json!({ "rules": ["reads", "told"], "subjects": [id] }));
        }
        for (number, server) in self.servers.iter().enumerate() {
            let id = format!("server {number}");
            rules.push(rule(&id, "ingress", &[SAYS, ASKS].concat(), &every_key()));
            let out = format!("to {id}");
            rules.push(rule(&out, "egress", &[SAYS, ASKS].concat(), &every_key()));
            subjects.push(self.subject(&id, server));
            policies.push(json!({ "rules": [id, out], "subjects": [id] }));
        }
        json!({
            "enabled": true,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        })
    }

    fn subject(&self, id: &str, name: &str) -> Value {
        let mut subject = json!({ "id": id });
        if self.proofs.certificate {
            subject["cert_common_names"] = json!([name]);
        }
        if self.proofs.password {
            subject["usernames"] = json!([name]);
        }
        subject
    }
}

/// Messages by which somebody says something.
const SAYS: [&str; 4] = ["put", "reply", "declare_queryable", "liveliness_token"];
/// Messages by which somebody asks to hear something.
const ASKS: [&str; 4] = ["declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"];

/// The keys of one vehicle, by direction.
struct Keys {
    speaks: Vec<String>,
    hears: Vec<String>,
}

impl Keys {
    fn of(vehicle: &VehicleName) -> Self {
        let root = format!("{PREFIX}/{}", vehicle.encoded());
        let (observations, acks, pose) =
            (format!("{root}/observations"), format!("{root}/acks"), format!("{root}/pose"));
        let alive = format!("{root}/@alive/*");
        // zenoh-ext's caches, heartbeats and recoveries live under @adv, which no wildcard of a key above matches.
        let speaks = vec![format!("{observations}/@adv/**"), observations, alive.clone()];
        let hears = vec![format!("{acks}/@adv/**"), acks, format!("{pose}/@adv/**"), pose, alive, SERVER.to_owned()];
        Self { speaks, hears }
    }
}

/// What the server asks of all vehicles: it says so to each of them.
fn asked_keys() -> Vec<String> {
    vec![EVERY_OBSERVATIONS.to_owned(), format!("{EVERY_OBSERVATIONS}/@adv/**"), EVERY_ALIVE.to_owned()]
}

/// Every key of lanemap: `**` does not match parts that begin with `@`.
fn every_key() -> Vec<String> {
    vec![format!("{PREFIX}/**"), format!("{PREFIX}/**/@adv/**"), EVERY_ALIVE.to_owned(), SERVER.to_owned()]
}

fn rule(id: &str, flow: &str, messages: &[&str], keys: &[String]) -> Value {
    json!({ "id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys })
}

fn before_colon(line: &str) -> &str {
    line.split_once(':').map_or(line, |(name, _)| name.trim())
}

/// The lines of a file and their numbers, from 0; empty lines and lines that begin with `#` are passed over.
fn lines(setting: &'static str, path: &Path) -> Result<Vec<(usize, String)>, CredentialError> {
    let bytes = read(setting, path)?;
    let text = str::from_utf8(&bytes).map_err(|error| CredentialError::new(setting, path, error))?;
    let lines = text.lines().map(str::trim).enumerate();
    let lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    Ok(lines.map(|(index, line)| (index, line.to_owned())).collect())
}

/// The vehicles that a file names, one on a line; `others`, which are none, are passed over.
fn names(
    setting: &'static str,
    path: &Path,
    name: impl Fn(&str) -> &str,
    others: &[String],
) -> Result<BTreeSet<VehicleName>, CredentialError> {
    let lines = lines(setting, path)?;
    let named = lines.iter().map(|(index, line)| (*index, name(line)));
    let vehicle = |(index, name): (usize, &str)| {
        name.parse::<VehicleName>().map_err(|error| {
            // The line itself may hold a password.
            CredentialError::new(setting, path, format!("line {}: {error}", index + 1))
        })
    };
    named.filter(|(_, name)| !others.iter().any(|other| other == name)).map(vehicle).collect()
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use zenoh::key_expr::KeyExpr;

    use super::*;

    fn file(text: &str) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        file
    }

    /// Whether the rules let the subject `id` send or hear (`flow`) a message about `key`.
    fn allows(rules: &Value, id: &str, flow: &str, message: &str, key: &str) -> bool {
        let of = |list: &Value| list.as_array().unwrap().clone();
        let policies = of(&rules["policies"]).into_iter().filter(|policy| of(&policy["subjects"]).contains(&json!(id)));
        let ids: Vec<Value> = policies.flat_map(|policy| of(&policy["rules"])).collect();
        let key = KeyExpr::try_from(key).unwrap();
        of(&rules["rules"]).iter().any(|rule| {
            ids.contains(&rule["id"])
                && of(&rule["flows"]).contains(&json!(flow))
                && of(&rule["messages"]).contains(&json!(message))
                && of(&rule["key_exprs"])
                    .iter()
                    .any(|it| KeyExpr::try_from(it.as_str().unwrap()).unwrap().includes(&key))
        })
    }

    fn rules() -> Value {
        let listed = file("# cars\nnorth/car-1\n\n north/car%2F2 \n");
        let readers = file("# planners\nplanner\n");
        let servers = vec!["server".to_owned()];
        AccessRules::for_router(Some(listed.path()), None, Some(readers.path()), servers).unwrap().to_json()
    }

    #[test]
    fn a_vehicle_may_do_on_its_keys_what_clients_do() {
        let rules = rules();
        // Subjects are in the order of their names: car-1, then car/2.
        let car =
            |flow, message, rest: &str| allows(&rules, "0", flow, message, &format!("lanemap/v1/north/car-1/{rest}"));
        for (message, rest) in [
            ("put", "observations"),
            ("put", "observations/@adv/pub/0a/1/_"),
            ("declare_queryable", "observations/@adv/pub/0a/1/_"),
            ("reply", "observations"),
            ("liveliness_token", "@alive/0000000000000001"),
            ("declare_subscriber", "acks"),
            ("declare_subscriber", "acks/@adv/pub/**"),
            ("declare_subscriber", "pose"),
            ("query", "acks/@adv/*/0a/1/**"),
        ] {
            assert!(car("ingress", message, rest), "{message} on {rest}");
        }
        for (message, rest) in [("put", "acks"), ("put", "pose"), ("put", "acks/@adv/pub/0a/1/_"), ("reply", "acks")] {
            assert!(car("egress", message, rest), "{message} on {rest}");
        }
        assert!(allows(&rules, "0", "egress", "declare_subscriber", EVERY_OBSERVATIONS));
        assert!(allows(&rules, "0", "egress", "query", "lanemap/v1/*/*/observations/@adv/*/0a/1/**"));
        assert!(allows(&rules, "0", "ingress", "liveliness_query", SERVER));
        assert!(allows(&rules, "1", "ingress", "put", "lanemap/v1/north/car%2F2/observations"));
    }

    #[test]
    fn a_vehicle_may_do_nothing_else() {
        let rules = rules();
        let denied = [
            ("ingress", "put", "lanemap/v1/north/car%2F2/observations"),
            ("ingress", "put", "lanemap/v1/north/car-1/acks"),
            ("ingress", "put", "lanemap/v1/*/*/observations"),
            ("ingress", "delete", "lanemap/v1/north/car-1/observations"),
            ("ingress", "declare_subscriber", "lanemap/v1/north/car-1/observations"),
            ("ingress", "declare_subscriber", "lanemap/v1/north/car-1/**"),
            ("ingress", "declare_subscriber", "lanemap/v1/**"),
            ("ingress", "declare_liveliness_subscriber", EVERY_ALIVE),
            ("ingress", "query", "lanemap/v1/north/car%2F2/acks/@adv/**"),
            ("ingress", "liveliness_token", SERVER),
            ("egress", "put", "lanemap/v1/north/car%2F2/acks"),
            ("egress", "put", "lanemap/v1/north/car-1/observations"),
            ("ingress", "put", "other/key"),
        ];
        for (flow, message, key) in denied {
            assert!(!allows(&rules, "0", flow, message, key), "{flow} {message} {key}");
        }
        for (flow, message, key) in denied.iter().take(12) {
            let server = allows(&rules, "server 0", flow, message, key);
            assert_eq!(server, *message != "delete", "{flow} {message} {key}");
        }
    }

    #[test]
    fn a_reader_may_hear_and_query_the_map_and_say_nothing() {
        let rules = rules();
        let cell = "lanemap/v1/map/14-8718-5685";
        for (flow, message, key) in [
            ("ingress", "declare_subscriber", EVERY_CELL),
            ("ingress", "query", cell),
            ("ingress", "liveliness_query", SERVER),
            ("ingress", "declare_subscriber", EVERY_EVENT),
            ("egress", "put", cell),
            ("egress", "put", "lanemap/v1/map/14-8718-5685/events/7"),
            ("egress", "reply", cell),
        ] {
            assert!(allows(&rules, "reader 0", flow, message, key), "{flow} {message} {key}");
        }
        for (subject, flow, message, key) in [
            ("reader 0", "ingress", "put", cell),
            ("reader 0", "ingress", "delete", cell),
            ("reader 0", "ingress", "declare_queryable", EVERY_CELL),
            ("reader 0", "ingress", "reply", cell),
            ("reader 0", "ingress", "declare_subscriber", "lanemap/v1/**"),
            ("reader 0", "ingress", "declare_subscriber", EVERY_OBSERVATIONS),
            ("reader 0", "ingress", "put", "lanemap/v1/north/car-1/observations"),
            ("reader 0", "egress", "put", "lanemap/v1/north/car-1/acks"),
            ("0", "ingress", "query", cell),
            ("0", "ingress", "put", cell),
            ("0", "egress", "put", cell),
        ] {
            assert!(!allows(&rules, subject, flow, message, key), "{subject} {flow} {message} {key}");
        }
        assert!(allows(&rules, "server 0", "ingress", "put", cell));
    }

    #[test]
    fn both_proofs_are_asked_for_where_both_are_given() {
        let (listed, passwords) =
            (file("north/car-1\nnorth/car-2\n"), file("north/car-2: second\nnorth/car-3:third\n"));
        let rules = AccessRules::for_router(Some(listed.path()), Some(passwords.path()), None, Vec::new());
        let rules = rules.unwrap().to_json();
        let subject = json!({ "id": "0", "cert_common_names": ["north/car-2"], "usernames": ["north/car-2"] });
        assert_eq!(rules["subjects"], json!([subject]));
        assert!(!rules.to_string().contains("second"));
    }

    #[test]
    fn a_line_that_names_no_vehicle_is_refused_by_its_number_and_not_repeated() {
        let passwords = file("north/car-1:first\ncar-2:hidden\n");
        let error = AccessRules::for_router(None, Some(passwords.path()), None, Vec::new()).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("fleet/vehicle") && !error.contains("hidden"), "{error}");
    }
}
