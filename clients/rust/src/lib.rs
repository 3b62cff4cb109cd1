//! Rust client of the lanemap service: stream a drive, read maps.
//!
//! ```no_run
//! use lanemap_client::{IngestClient, SessionStart};
//! # async fn example(frames: Vec<lanemap_core::Frame>) -> Result<(), lanemap_client::ClientError> {
//! let client = IngestClient::connect("http://127.0.0.1:8080").await?;
//! let (mut session, _events) = client.start_session(SessionStart::new("fleet", "vehicle", "drive-1")).await?;
//! for frame in &frames {
//!     session.send(frame).await?; // waits where too many frames are unacked
//! }
//! let summary = session.finish().await?; // everything is durable and in the map
//! println!("{} frames refused", summary.refused);
//! # Ok(())
//! # }
//! ```
//!
//! A session outlives its connection: where that breaks, the client connects anew, resumes the drive, and sends again
//! what was not acked. At most [`SessionStart::max_unacked`] frames are kept in memory for that. With a spool
//! ([`SessionStart::spool`]) frames wait on disk, outlive the process, and may be taken before the service can be reached:
//!
//! ```no_run
//! use lanemap_client::{ConnectOptions, IngestClient, Reconnect, SessionStart, SpoolOptions};
//! # async fn example(frame: lanemap_core::Frame) -> Result<(), lanemap_client::ClientError> {
//! let spool = SpoolOptions::new("/var/lib/vehicle/spool");
//! let client = IngestClient::offline("http://lanemap.example:8080", ConnectOptions::default()).await?;
//! let drive = SessionStart {
//!     spool: Some(spool.clone()),
//!     reconnect: Reconnect::forever(),
//!     ..SessionStart::new("fleet", "vehicle", "drive-2")
//! };
//! let (mut session, _events) = client.begin_session(drive).await?;
//! session.send(&frame).await?; // survives `kill -9` from here on
//! client.deliver_spooled(&spool).await?; // what is left of earlier drives
//! # Ok(())
//! # }
//! ```
//!
//! The shared map is read tile by tile, as curves to compute with:
//!
//! ```no_run
//! use lanemap_client::{MapClient, SplineTiles};
//! # async fn example() -> Result<(), lanemap_client::ClientError> {
//! let tiles = SplineTiles::new(MapClient::new("http://127.0.0.1:8080"), 256);
//! for cell in tiles.at(48.1374, 11.5755, 16).await?.iter() {
//!     for line in &cell.lines {
//!         for point in line.curve.sample(1.0) {
//!             let place = cell.anchor.wgs84_from_enu(&point.position);
//!             let (sigma_m, existence) = (line.lateral_sigma_m_at(&point), line.existence_at(&point));
//!             println!("{} {} {sigma_m} {existence}", place.latitude_deg, place.longitude_deg);
//!         }
//!     }
//! }
//! # Ok(())
//! # }
//! ```
//!
//! The map is followed with a copy that is the service's map, byte for byte, at every revision that it comes to:
//!
//! ```no_run
//! use lanemap_client::{MapNews, MapWatch, WatchOptions};
//! # async fn example() -> Result<(), lanemap_client::ClientError> {
//! let mut watch = MapWatch::new("http://127.0.0.1:8080", WatchOptions::default()).await?;
//! loop {
//!     match watch.next().await? {
//!         MapNews::Cell { cell, to_version, .. } => println!("{cell} is at version {to_version}"),
//!         MapNews::Event(event) => println!("{:?} in {}: {}", event.kind(), event.cell, event.lane),
//!         MapNews::Reset | MapNews::Disconnected { .. } => {}
//!     }
//!     println!("{} cells, revision {:?}", watch.copy().cells().len(), watch.copy().revision());
//! }
//! # }
//! ```

mod admin;
mod backlog;
mod connection;
mod credentials;
mod error;
mod event;
mod link;
mod map_copy;
mod map_watch;
mod maps;
mod reconnect;
mod session;
mod spline_tiles;
mod spool;
mod start;

pub use admin::AdminClient;
pub use credentials::{Credentials, IdentityFiles, Login, Token};
pub use error::ClientError;
pub use event::{Event, Events, LocalMap, VehiclePose};
pub use lanemap_proto::v1::{Refusal, RefusalReason};
pub use link::ConnectOptions;
pub use map_copy::MapCopy;
pub use map_watch::{Area, MapNews, MapWatch, WatchOptions};
pub use maps::MapClient;
pub use reconnect::Reconnect;
pub use session::{IngestClient, Session, SessionSummary};
pub use spline_tiles::SplineTiles;
pub use spool::{SpoolError, SpoolOptions, SpoolRecovery, SpoolSync, SpooledDrive, WhenFull};
pub use start::SessionStart;
