//! The scorers of `lanemap_core::evaluation` on files, against `score_map.py`.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::path::{Path, PathBuf};

use lanemap_core::evaluation::{Counts, LineError, quantile, score_authors, score_strict};
use lanemap_openlane::Drives;

/// The drives on which the authors' code was run (`drives/peer_baseline.json`).
const PEER_DRIVES: [&str; 20] = [
    "ps-089-real",
    "ps-103-real",
    "ps-021-real",
    "ps-095-real",
    "ps-024-real",
    "av2-3bffdcff-real",
    "av2-7fab2350-real",
    "ps-050-real",
    "ps-019-real",
    "ps-098-real",
    "ps-112-real",
    "ps-001-real",
    "ps-086-real",
    "ps-109-real",
    "ps-008-real",
    "ps-042-real",
    "ps-158-real",
    "ps-005-real",
    "ps-014-real",
    "av2-3bffdcff-drive0",
];

struct Scores {
    authors: Counts,
    strict: Counts,
    errors: Vec<LineError>,
}

impl Scores {
    fn of_detections(root: &Path, only: &[String]) -> Self {
        let mut scores = Self { authors: Counts::default(), strict: Counts::default(), errors: Vec::new() };
        for drive in Drives::list(root, only).unwrap() {
            for frame in drive.frames() {
                let frame = frame.unwrap();
                let (truth, detected) = (frame.truth_ground(), frame.detections_ground());
                scores.authors += score_authors(&truth, &detected);
                let strict = score_strict(&truth, &detected, &frame.annotation.sensor());
                scores.strict += strict.counts;
                scores.errors.extend(strict.errors);
            }
        }
        scores
    }

    fn lateral_m(&self, share: f64) -> f64 {
        quantile(&mut self.errors.iter().map(|error| error.lateral_m).collect::<Vec<_>>(), share)
    }

    fn vertical_m(&self, share: f64) -> f64 {
        quantile(&mut self.errors.iter().map(|error| error.vertical_m).collect::<Vec<_>>(), share)
    }
}

/// Within a micrometre: the mount's rotation has eight decimals in the files, and is made a rotation again when read.
fn assert_close(ours: f64, theirs: f64) {
    assert!((ours - theirs).abs() < 1e-6, "{ours} is not {theirs}");
}

/// The frames are made by `fixtures/scored/make.py`, the numbers by `score_map.py --drives tests/fixtures/scored --json`
/// (numpy 2.4, scipy 1.17).
#[test]
fn both_scorers_agree_with_score_map_py_on_made_frames() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/scored");
    let scores = Scores::of_detections(&root, &[]);
    assert_eq!(scores.authors, Counts { true_positives: 19, truths: 31, predictions: 34 });
    assert_eq!(scores.strict, Counts { true_positives: 16, truths: 31, predictions: 28 });
    assert_close(scores.lateral_m(0.50), 0.121_761_051_824_110_65);
    assert_close(scores.lateral_m(0.95), 0.390_145_523_785_622);
    assert_close(scores.vertical_m(0.50), 0.122_013_666_120_681_93);
    assert_close(scores.vertical_m(0.95), 0.278_955_976_528_933_8);
}

/// The numbers are those of `score_map.py --drives ../shared/drives --only ...`; 0.538 and 0.460 in its own report.
#[test]
fn both_scorers_agree_with_score_map_py_on_the_raw_detections_of_the_shared_drives() {
    let root = ["../../../shared/drives", "../../../../shared/drives"]
        .map(|folder| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(folder))
        .into_iter()
        .find(|path| path.is_dir());
    let Some(root) = root else {
        eprintln!("skipped: ../shared/drives is not here");
        return;
    };
    let scores = Scores::of_detections(&root, &PEER_DRIVES.map(str::to_owned));
    assert_eq!(scores.authors, Counts { true_positives: 3467, truths: 6919, predictions: 5958 });
    assert_eq!(scores.strict, Counts { true_positives: 2953, truths: 6901, predictions: 5949 });
    assert_close(scores.lateral_m(0.50), 0.113_826_464_129_087_12);
    assert_close(scores.lateral_m(0.95), 0.363_508_851_370_377_14);
    assert_close(scores.vertical_m(0.50), 0.103_966_808_004_924_28);
    assert_close(scores.vertical_m(0.95), 0.347_183_202_817_723_4);
}
