//! The three measures of the paper's tables: map quality, pose error, association.
