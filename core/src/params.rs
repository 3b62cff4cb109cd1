//! Parameters of the mapper: two presets, every number with its unit and its source.

use serde::{Deserialize, Serialize};

/// Which mapper to run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Preset {
    /// The paper's method as it is meant, misprints corrected, so that its tables can be reproduced.
    Paper,
    /// What a user gets: the paper's weaknesses mended.
    #[default]
    Default,
}

/// Parameters of the mapper. Start from [`Params::preset`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Params {
    /// The preset that these parameters came from.
    pub preset: Preset,
}

impl Params {
    /// The parameters of a preset.
    #[must_use]
    pub fn preset(preset: Preset) -> Self {
        Self { preset }
    }
}
