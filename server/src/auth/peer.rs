//! A peer: what whoever is at the other end may do.

use std::{
    fmt,
    time::{Duration, SystemTime},
};

use super::VehicleName;
use crate::error::Error;

/// Longest time for which an expiry is waited for without a look at the clock.
const LONGEST_SLEEP: Duration = Duration::from_mins(1);

/// What somebody may be let do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Stream observations, as the vehicles that are named beside it.
    Ingest,
    /// Read maps and metrics.
    Read,
    /// Read, and administer: delete, see settings.
    Admin,
}

/// What was asked for and may not be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Stream observations as a vehicle.
    Stream,
    /// Read maps.
    Read,
    /// Administer the service.
    Administer,
}

/// Which fleets, or which vehicles, a grant is for.
#[derive(Clone, PartialEq, Eq)]
pub enum Extent {
    /// None.
    None,
    /// This one.
    Only(String),
    /// Any.
    Any,
}

/// What a credential grants.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Grants {
    /// The roles.
    pub roles: Vec<Role>,
    /// The fleets for which they hold.
    pub fleet: Extent,
    /// The vehicles of those fleets as which the peer may stream.
    pub vehicle: Extent,
}

/// Who is at the other end, as far as what it may do goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Peer {
    standing: Standing,
    /// The vehicle that the connection's certificate or the key of its messages names: it streams as no other.
    bound_to: Option<VehicleName>,
    expires_at: Option<SystemTime>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Standing {
    /// Nobody is asked who they are.
    Trusted,
    /// Whoever shows nothing where others show who they are.
    Anonymous {
        may_read: bool,
    },
    Granted(Grants),
}

impl Peer {
    /// A peer that nobody asked who it is: it may do everything.
    #[must_use]
    pub fn unauthenticated() -> Self {
        Self { standing: Standing::Trusted, bound_to: None, expires_at: None }
    }

    /// A peer that showed nothing where others show who they are.
    #[must_use]
    pub fn anonymous(may_read: bool) -> Self {
        Self { standing: Standing::Anonymous { may_read }, bound_to: None, expires_at: None }
    }

    /// A vehicle: it streams as itself and reads the maps of its fleet.
    #[must_use]
    pub fn of_vehicle(fleet: impl Into<String>, vehicle: impl Into<String>) -> Self {
        let name = VehicleName::new(fleet, vehicle);
        let grants = Grants {
            roles: vec![Role::Ingest, Role::Read],
            fleet: Extent::Only(name.fleet.clone()),
            vehicle: Extent::Only(name.vehicle.clone()),
        };
        Self { standing: Standing::Granted(grants), bound_to: Some(name), expires_at: None }
    }

    /// Whoever holds a credential with these grants.
    #[must_use]
    pub fn with_grants(grants: Grants) -> Self {
        Self { standing: Standing::Granted(grants), bound_to: None, expires_at: None }
    }

    /// The same peer, which streams as no vehicle but this one.
    #[must_use]
    pub fn bound_to(mut self, vehicle: Option<VehicleName>) -> Self {
        self.bound_to = vehicle.or(self.bound_to);
        self
    }

    /// The same peer, until `time` or until it expires anyway.
    #[must_use]
    pub fn until(mut self, time: Option<SystemTime>) -> Self {
        self.expires_at = match (self.expires_at, time) {
            (Some(mine), Some(other)) => Some(mine.min(other)),
            (mine, other) => mine.or(other),
        };
        self
    }

    /// When what the peer showed runs out; `None`: never.
    #[must_use]
    pub fn expires_at(&self) -> Option<SystemTime> {
        self.expires_at
    }

    /// Waits until what the peer showed has run out.
    pub async fn expired(&self) {
        let Some(time) = self.expires_at else { return std::future::pending().await };
        // The clock may be set meanwhile: it is looked at again now and then.
        while let Ok(left) = time.duration_since(SystemTime::now()) {
            tokio::time::sleep(left.min(LONGEST_SLEEP)).await;
        }
    }

    /// Whether the peer may stream as this vehicle: every credential that names a vehicle must name this one.
    ///
    /// # Errors
    /// [`Error::NotPermitted`] where it may not, [`Error::Unauthenticated`] where it has not said who it is.
    pub fn may_stream(&self, fleet: &str, vehicle: &str) -> Result<(), Error> {
        let bound_to_another =
            self.bound_to.as_ref().is_some_and(|bound| bound.fleet != fleet || bound.vehicle != vehicle);
        let granted = |grants: &Grants| {
            grants.roles.contains(&Role::Ingest) && grants.fleet.includes(fleet) && grants.vehicle.includes(vehicle)
        };
        self.permit(Action::Stream, !bound_to_another, granted)
    }

    /// Whether the peer may read the maps of `fleet`, or, for `None`, of all fleets.
    ///
    /// # Errors
    /// [`Error::NotPermitted`] where it may not, [`Error::Unauthenticated`] where it has not said who it is.
    pub fn may_read(&self, fleet: Option<&str>) -> Result<(), Error> {
        let granted = |grants: &Grants| {
            let reads = grants.roles.contains(&Role::Read) || grants.roles.contains(&Role::Admin);
            reads && fleet.map_or(grants.fleet == Extent::Any, |fleet| grants.fleet.includes(fleet))
        };
        self.permit(Action::Read, true, granted)
    }

    /// Whether the peer may administer the service.
    ///
    /// # Errors
    /// [`Error::NotPermitted`] where it may not, [`Error::Unauthenticated`] where it has not said who it is.
    pub fn may_administer(&self) -> Result<(), Error> {
        let granted = |grants: &Grants| grants.roles.contains(&Role::Admin) && grants.fleet == Extent::Any;
        self.permit(Action::Administer, true, granted)
    }

    fn permit(&self, action: Action, not_bound: bool, granted: impl Fn(&Grants) -> bool) -> Result<(), Error> {
        match &self.standing {
            Standing::Anonymous { may_read: true } if action == Action::Read => Ok(()),
            Standing::Anonymous { .. } => Err(Error::Unauthenticated(super::AuthenticationError::Missing)),
            Standing::Trusted if not_bound => Ok(()),
            Standing::Granted(grants) if not_bound && granted(grants) => Ok(()),
            Standing::Trusted | Standing::Granted(_) => Err(Error::NotPermitted(action)),
        }
    }
}

impl Extent {
    fn includes(&self, id: &str) -> bool {
        match self {
            Self::None => false,
            Self::Only(only) => only == id,
            Self::Any => true,
        }
    }
}

impl fmt::Debug for Extent {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::None => "None",
            Self::Only(_) => "Only(..)",
            Self::Any => "Any",
        })
    }
}

impl Action {
    /// The scope of a token that would permit it.
    #[must_use]
    pub fn scope(self) -> &'static str {
        match self {
            Self::Stream => "ingest",
            Self::Read => "read",
            Self::Administer => "admin",
        }
    }
}

impl fmt::Display for Action {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Stream => "stream as this vehicle",
            Self::Read => "read these maps",
            Self::Administer => "administer the service",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn token(roles: &[Role], fleet: Extent, vehicle: Extent) -> Peer {
        Peer::with_grants(Grants { roles: roles.to_vec(), fleet, vehicle })
    }

    fn only(id: &str) -> Extent {
        Extent::Only(id.to_owned())
    }

    fn refused(result: &Result<(), Error>) -> bool {
        matches!(result, Err(Error::NotPermitted(_)))
    }

    #[test]
    fn a_peer_of_one_vehicle_streams_as_no_other_and_reads_its_fleet() {
        let peer = Peer::of_vehicle("north", "car-1");
        assert!(peer.may_stream("north", "car-1").is_ok());
        assert!(refused(&peer.may_stream("north", "car-2")));
        assert!(refused(&peer.may_stream("south", "car-1")));
        assert!(peer.may_read(Some("north")).is_ok());
        assert!(refused(&peer.may_read(None)));
        assert!(refused(&peer.may_administer()));
    }

    #[test]
    fn nobody_may_do_nothing_but_read_where_that_is_set() {
        let missing = |result: Result<(), Error>| matches!(result, Err(Error::Unauthenticated(_)));
        assert!(missing(Peer::anonymous(true).may_stream("north", "car-1")));
        assert!(missing(Peer::anonymous(true).may_administer()));
        assert!(Peer::anonymous(true).may_read(None).is_ok());
        assert!(missing(Peer::anonymous(false).may_read(None)));
    }

    #[test]
    fn a_token_streams_as_the_vehicles_that_it_names_only() {
        let gateway = token(&[Role::Ingest], only("north"), Extent::Any);
        assert!(gateway.may_stream("north", "car-1").is_ok());
        assert!(refused(&gateway.may_stream("south", "car-1")));
        assert!(refused(&gateway.may_read(Some("north"))));
        assert!(refused(&token(&[Role::Ingest], only("north"), Extent::None).may_stream("north", "car-1")));
        assert!(refused(&token(&[Role::Admin], Extent::Any, Extent::Any).may_stream("north", "car-1")));
    }

    #[test]
    fn a_token_of_one_fleet_reads_that_fleet_and_not_all() {
        let reader = token(&[Role::Read], only("north"), Extent::None);
        assert!(reader.may_read(Some("north")).is_ok());
        assert!(refused(&reader.may_read(Some("south"))));
        assert!(refused(&reader.may_read(None)));
        assert!(refused(&token(&[Role::Admin], only("north"), Extent::None).may_administer()));
    }

    #[test]
    fn a_token_on_a_connection_of_a_vehicle_streams_as_that_vehicle_only() {
        let fleet = token(&[Role::Ingest], Extent::Any, Extent::Any);
        let bound = fleet.bound_to(Some(VehicleName::new("north", "car-1")));
        assert!(bound.may_stream("north", "car-1").is_ok());
        assert!(refused(&bound.may_stream("north", "car-2")));
    }

    #[test]
    fn of_two_times_of_expiry_the_earlier_holds() {
        let (soon, late) = (SystemTime::UNIX_EPOCH, SystemTime::now());
        let peer = Peer::unauthenticated().until(Some(late)).until(Some(soon)).until(None);
        assert_eq!(peer.expires_at(), Some(soon));
    }
}
