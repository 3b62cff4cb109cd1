//! The association methods of the paper's table, and ours.

use std::time::{Duration, Instant};

use lanemap_core::{
    Params, Preset,
    association::{
        LaneShape, PoseUncertainty, associate_by_chamfer, associate_jointly, clipper::associate_by_clipper,
        lmr::associate_by_lmr, shell::associate_by_shells,
    },
};

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    Shell,
    Clipper,
    /// Bounded Chamfer distance without consistency.
    ChamferXyz,
    ChamferLmr,
    OursLmr,
    /// The paper's method: preset `paper`.
    Ours,
    /// Preset `default`.
    Default,
}

impl Method {
    /// The baselines, then the methods of these presets.
    pub fn all(presets: &[Preset]) -> Vec<Self> {
        let mut methods = vec![Self::Shell, Self::Clipper, Self::ChamferXyz, Self::ChamferLmr];
        if presets.contains(&Preset::Paper) {
            methods.extend([Self::OursLmr, Self::Ours]);
        }
        if presets.contains(&Preset::Default) {
            methods.push(Self::Default);
        }
        methods
    }

    /// Name in tables and JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Shell => "shell",
            Self::Clipper => "clipper",
            Self::ChamferXyz => "cd_xyz",
            Self::ChamferLmr => "cd_lmr",
            Self::OursLmr => "ours_lmr",
            Self::Ours => "ours",
            Self::Default => "default",
        }
    }

    /// For each detection the index of its lane, and how long it took to say so.
    pub fn associate_timed(
        self,
        detections: &[LaneShape],
        lanes: &[LaneShape],
        pose: &PoseUncertainty,
    ) -> (Vec<Option<usize>>, Duration) {
        let params = Params::preset(if self == Self::Default { Preset::Default } else { Preset::Paper }).association;
        let started = Instant::now();
        let lane_of = match self {
            Self::Shell => associate_by_shells(detections, lanes, pose, &params),
            Self::Clipper => associate_by_clipper(detections, lanes),
            Self::ChamferXyz => associate_by_chamfer(detections, lanes, pose, &params, false),
            Self::ChamferLmr => associate_by_lmr(detections, lanes, pose, &params, false),
            Self::OursLmr => associate_by_lmr(detections, lanes, pose, &params, true),
            Self::Ours => associate_by_chamfer(detections, lanes, pose, &params, true),
            Self::Default => associate_jointly(detections, lanes, pose, &params).lane_of,
        };
        (lane_of, started.elapsed())
    }
}
