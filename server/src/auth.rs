//! Who a peer is, and what it may do.
//!
//! | who | shows it by | may |
//! |---|---|---|
//! | a vehicle | its certificate, its key or user name over zenoh | stream as itself |
//! | a program | a bearer token (JWT) with claims `fleet`, `vehicle` and `scope` | what its claims say |
//! | an operator | a token of scope `admin` | read, administer |
//! | nobody | | read maps and metrics where `anonymous_read` is set |
//!
//! Health over HTTP and gRPC, gRPC's reflection, and the viewer's page, which holds no map, are for all.
//!
//! A [`certificate_name`] and a [`tokens`] become a [`Peer`]; what a peer does is asked of it where it does it: streams
//! where their session starts, readers and administrators at each request. Where nothing is set by which peers could
//! show who they are, all are trusted, and [`exposure`] keeps the service on the loopback interface.
//!
//! Maps are of all fleets together: whoever may read for one fleet only reads none.
//!
//! Nothing here logs an id of a vehicle, a token, a key or a password.

pub mod authenticator;
pub mod certificate_name;
pub mod exposure;
pub mod keys;
pub mod layer;
pub mod peer;
pub mod reload;
pub mod tls;
pub mod tokens;
pub mod vehicle_name;

pub use authenticator::{AuthenticationError, Authenticator};
pub use layer::peer_of;
pub use peer::{Action, Peer, Role};
pub use vehicle_name::VehicleName;
