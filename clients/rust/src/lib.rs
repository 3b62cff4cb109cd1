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
//! what was not acked. At most [`SessionStart::max_unacked`] frames are kept for that.

mod connection;
mod error;
mod event;
mod maps;
mod session;
mod start;

pub use error::ClientError;
pub use event::{Event, Events, LocalMap, VehiclePose};
pub use lanemap_proto::v1::{Refusal, RefusalReason};
pub use maps::MapClient;
pub use session::{IngestClient, Session, SessionSummary};
pub use start::{Reconnect, SessionStart};
