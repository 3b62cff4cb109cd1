//! Files of an OpenLane folder.

use std::path::Path;

use lanemap_openlane::{Annotation, DetectionFile, timestamp_from_stem, timestamp_stem};

/// Reads `bytes` as an annotation, as a result file, and as the name of one.
pub fn openlane(bytes: &[u8]) {
    let path = Path::new("fuzzed.json");
    if let Ok(annotation) = Annotation::from_json(path, bytes) {
        let ground = annotation.ground_frame();
        for lane in &annotation.lanes {
            for point in lane.points_vehicle(&annotation.vehicle_from_camera) {
                let _ = ground.ground_from_vehicle(&point);
            }
        }
        let _ = annotation.sensor();
    }
    let _ = DetectionFile::from_json(path, bytes);
    if let Some(time) = std::str::from_utf8(bytes).ok().and_then(timestamp_from_stem) {
        assert_eq!(timestamp_stem(time).as_bytes(), bytes);
    }
}
