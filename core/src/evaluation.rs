//! The three measures of the paper's tables: map quality, pose error, association.
//!
//! Map quality has two scorers, [`score_authors`] (the paper's) and [`score_strict`] (one-to-one, both ways, within the
//! image); both take lanes in OpenLane's [`GroundFrame`] and give [`Counts`] that are summed over frames.

pub mod association_score;
pub mod authors_scorer;
mod chain;
pub mod change_score;
pub mod counts;
pub mod fleet_score;
pub mod ground_frame;
mod polynomial;
pub mod pose_error;
pub mod quantile;
pub mod score_box;
mod shown_heading;
pub mod strict_scorer;

pub use association_score::{AssociationMean, AssociationScore};
pub use authors_scorer::score_authors;
pub use change_score::{ChangeScore, TrueChange, score_changes};
pub use counts::Counts;
pub use fleet_score::{FleetScore, score_fleet};
pub use ground_frame::GroundFrame;
pub use pose_error::{RelativePoseError, relative_pose_error};
pub use quantile::quantile;
pub use score_box::ScoreBox;
pub use shown_heading::shown_heading;
pub use strict_scorer::{LineError, StrictScore, score_strict};
