//! `association_pairs.json`: pairs of frames with a wrong pose between them.

use std::{fs, path::Path};

use anyhow::Context;
use lanemap_core::{Pose, TimestampNs, geometry::pose::pose_from_matrix};
use lanemap_openlane::timestamp_from_stem;
use nalgebra::Matrix4;
use serde::Deserialize;

/// A pair of frames of one drive.
#[derive(Clone, Debug, PartialEq)]
pub struct FramePair {
    pub drive: String,
    pub frame_a: TimestampNs,
    pub frame_b: TimestampNs,
    /// The wrong pose.
    pub camera_a_from_b: Pose,
    /// Track ids of the lanes in both frames.
    pub in_both: Vec<i64>,
}

#[derive(Deserialize)]
struct PairsJson {
    pairs: Vec<PairJson>,
}

#[derive(Deserialize)]
struct PairJson {
    drive: String,
    frame_a: String,
    frame_b: String,
    #[serde(rename = "T_ab_noisy")]
    camera_a_from_b: [[f64; 4]; 4],
    true_track_ids: Vec<i64>,
}

/// Reads the pairs.
pub fn read_pairs(path: &Path) -> anyhow::Result<Vec<FramePair>> {
    let text = fs::read(path).with_context(|| format!("{} cannot be read", path.display()))?;
    let file: PairsJson = serde_json::from_slice(&text).with_context(|| format!("{} is not right", path.display()))?;
    let parse = |(index, pair): (usize, PairJson)| {
        FramePair::parse(pair).with_context(|| format!("{}: pairs[{index}]", path.display()))
    };
    file.pairs.into_iter().enumerate().map(parse).collect()
}

impl FramePair {
    fn parse(json: PairJson) -> anyhow::Result<Self> {
        let time = |stem: &str| timestamp_from_stem(stem).with_context(|| format!("{stem:?} is not 18 digits"));
        let matrix = Matrix4::from_fn(|row, column| json.camera_a_from_b[row][column]);
        Ok(Self {
            frame_a: time(&json.frame_a)?,
            frame_b: time(&json.frame_b)?,
            camera_a_from_b: pose_from_matrix(&matrix).context("T_ab_noisy")?,
            in_both: json.true_track_ids,
            drive: json.drive,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pair_that_is_not_right_is_refused_by_its_number_and_field() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("association_pairs.json");
        let pair = |entry: &str| {
            format!(
                r#"{{"pairs": [{{"drive": "segment-a", "frame_a": "160000000000000000", "frame_b": "160000000010000000",
                "T_ab_noisy": [[{entry}, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 0], [0, 0, 0, 1]], "true_track_ids": [4]}}]}}"#
            )
        };
        fs::write(&path, pair("1.0")).unwrap();
        let read = read_pairs(&path).unwrap();
        assert_eq!((read.len(), read[0].camera_a_from_b), (1, Pose::translation(1.0, 2.0, 0.0)));
        fs::write(&path, pair("2.0")).unwrap();
        let message = format!("{:#}", read_pairs(&path).unwrap_err());
        assert!(message.contains("pairs[0]: T_ab_noisy: is not a rotation"), "{message}");
    }
}
