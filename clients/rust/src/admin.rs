//! What operators ask of a service.

use lanemap_proto::v1;

use crate::{
    error::ClientError,
    link::{ConnectOptions, GrpcLink},
};

/// A client of operators: over gRPC, with a token of scope `admin` where the service asks for one.
#[derive(Clone, Debug)]
pub struct AdminClient {
    link: GrpcLink,
}

impl AdminClient {
    /// A client of the service at `url`, e.g. `https://lanes.example:8080`.
    ///
    /// # Errors
    /// An address that is none, files that cannot be read, or a service that cannot be reached.
    pub async fn connect(url: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        let mut link = GrpcLink::new(url, options).await?;
        link.reach().await?;
        Ok(Self { link })
    }

    /// Has the service delete what it has of a vehicle, or of one drive of it; gives the number of drives once their
    /// data are gone from its disk. May be repeated.
    ///
    /// # Errors
    /// No right to do so, names out of range, or a service that fails: nothing was deleted, or it is not finished.
    pub async fn forget(&self, fleet: &str, vehicle: &str, drive: Option<&str>) -> Result<u64, ClientError> {
        let request = v1::ForgetRequest {
            fleet_id: fleet.to_owned(),
            vehicle_id: vehicle.to_owned(),
            drive_id: drive.map(str::to_owned),
        };
        Ok(self.link.forget(request).await?.drives)
    }
}
