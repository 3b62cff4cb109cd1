//! The name of a vehicle as certificates, user names and zenoh's keys bear it: `{fleet}/{vehicle}`, each id
//! percent-encoded except for `A-Z a-z 0-9 - _ . ~`.

use std::{fmt, str::FromStr};

use lanemap_proto::zenoh_keys::{decode_id, encode_id};
use thiserror::Error;

/// Longest id of a fleet or a vehicle, characters.
const LONGEST_ID: usize = 128;

/// A vehicle of a fleet. Its `Debug` does not show it: ids of vehicles stay out of logs.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct VehicleName {
    /// Id of the fleet, decoded.
    pub fleet: String,
    /// Id of the vehicle, decoded.
    pub vehicle: String,
}

/// Why a text names no vehicle. It does not repeat the text, which may be the name of one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum VehicleNameError {
    /// There is no `/`, or more than one.
    #[error("not of the form fleet/vehicle")]
    Form,
    /// An id is empty or too long.
    #[error("an id is empty or longer than 128 characters")]
    Length,
    /// A character that must be percent-encoded is not, or an encoding is broken.
    #[error(
        "an id holds a character other than A-Z a-z 0-9 - _ . ~ that is not percent-encoded (UTF-8, capital digits)"
    )]
    Encoding,
}

impl VehicleName {
    /// A vehicle by its ids, not encoded.
    #[must_use]
    pub fn new(fleet: impl Into<String>, vehicle: impl Into<String>) -> Self {
        Self { fleet: fleet.into(), vehicle: vehicle.into() }
    }

    /// `{fleet}/{vehicle}`, each id percent-encoded.
    #[must_use]
    pub fn encoded(&self) -> String {
        format!("{}/{}", encode_id(&self.fleet), encode_id(&self.vehicle))
    }
}

impl FromStr for VehicleName {
    type Err = VehicleNameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (fleet, vehicle) = text.split_once('/').ok_or(VehicleNameError::Form)?;
        if vehicle.contains('/') {
            return Err(VehicleNameError::Form);
        }
        Ok(Self { fleet: id(fleet)?, vehicle: id(vehicle)? })
    }
}

impl fmt::Debug for VehicleName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("VehicleName(..)")
    }
}

fn id(encoded: &str) -> Result<String, VehicleNameError> {
    if encoded.is_empty() {
        return Err(VehicleNameError::Length);
    }
    let decoded = decode_id(encoded).ok_or(VehicleNameError::Encoding)?;
    if decoded.chars().count() <= LONGEST_ID { Ok(decoded) } else { Err(VehicleNameError::Length) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_survives_its_encoding_whatever_its_ids_hold() {
        for (fleet, vehicle) in [("north", "car-1"), ("nord/süd", "a b%2F*"), ("**", "$*"), ("x:y", "@")] {
            let name = VehicleName::new(fleet, vehicle);
            assert_eq!(name.encoded().parse(), Ok(name.clone()), "{}", name.encoded());
        }
    }

    #[test]
    fn a_text_that_is_no_name_is_refused() {
        for (text, error) in [
            ("north", VehicleNameError::Form),
            ("north/car/1", VehicleNameError::Form),
            ("north/", VehicleNameError::Length),
            ("/car-1", VehicleNameError::Length),
            ("north/**", VehicleNameError::Encoding),
            ("north/car%2", VehicleNameError::Encoding),
            ("north/%FF", VehicleNameError::Encoding),
        ] {
            assert_eq!(text.parse::<VehicleName>(), Err(error), "{text}");
        }
    }

    #[test]
    fn a_name_does_not_show_itself_in_a_log() {
        assert_eq!(format!("{:?}", VehicleName::new("north", "car-1")), "VehicleName(..)");
    }
}
