//! Who a peer is, and what it may do.

use crate::error::Error;

/// Who sends: asked once per stream, where its session starts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Peer {
    /// The only vehicle that it may stream as; `None`: any.
    vehicle: Option<Vehicle>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Vehicle {
    fleet: String,
    vehicle: String,
}

impl Peer {
    /// A peer that nobody asked who it is: it may stream as any vehicle.
    #[must_use]
    pub fn unauthenticated() -> Self {
        Self { vehicle: None }
    }

    /// A peer that speaks for one vehicle, e.g. because the key on which it publishes names it.
    #[must_use]
    pub fn of_vehicle(fleet: impl Into<String>, vehicle: impl Into<String>) -> Self {
        Self { vehicle: Some(Vehicle { fleet: fleet.into(), vehicle: vehicle.into() }) }
    }

    /// Whether the peer may stream as this vehicle.
    ///
    /// # Errors
    /// [`Error::NotPermitted`] where it may not.
    pub fn may_stream(&self, fleet: &str, vehicle: &str) -> Result<(), Error> {
        match &self.vehicle {
            Some(only) if only.fleet != fleet || only.vehicle != vehicle => Err(Error::NotPermitted),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peer_of_one_vehicle_streams_as_no_other() {
        let peer = Peer::of_vehicle("north", "car-1");
        assert!(peer.may_stream("north", "car-1").is_ok());
        assert!(matches!(peer.may_stream("north", "car-2"), Err(Error::NotPermitted)));
        assert!(matches!(peer.may_stream("south", "car-1"), Err(Error::NotPermitted)));
        assert!(Peer::unauthenticated().may_stream("south", "car-1").is_ok());
    }
}
