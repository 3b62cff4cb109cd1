//! Hand-made maps for the tests of this folder.

use std::sync::Arc;

use lanemap_core::{
    Category, ControlPoint, EndRule, LaneId, LaneMap, MapLane, Preset, Sequence, TimestampNs,
    geometry::{
        Pose,
        georeference::{Anchor, Georeference, Wgs84},
    },
};
use nalgebra::{Matrix3, Point3, Translation3, UnitQuaternion};

use crate::session::{MapVersion, PublishedMap, SessionId, SessionState, SessionSummary, Way};

/// Control points 3 m apart on a circle that climbs a little.
pub fn bend(radius_m: f64, count: usize) -> Vec<Point3<f64>> {
    (0..count)
        .map(|i| {
            let angle = 3.0 * i as f64 / radius_m;
            Point3::new(radius_m * angle.sin(), radius_m * (1.0 - angle.cos()), 0.005 * i as f64)
        })
        .collect()
}

/// A lane through `points`.
pub fn lane_of(id: u64, points: Vec<Point3<f64>>) -> MapLane {
    let drawn_to = points.len().saturating_sub(1) as f64;
    MapLane {
        id: LaneId(id),
        category: Category::WhiteDashed,
        category_posterior: vec![1.0 / 15.0; 15],
        category_stretches: vec![],
        control_points: points
            .into_iter()
            .map(|position| ControlPoint { position, covariance: Matrix3::identity() * 0.01 })
            .collect(),
        ends: EndRule::Reflected,
        drawn_from: 0.0,
        drawn_to,
        existence: 0.9,
        observations: 12,
        first_seen: TimestampNs(1_700_000_000_000_000_000),
        last_seen: TimestampNs(1_700_000_001_200_000_000),
    }
}

/// The session numbered so, with `lanes` lanes side by side and no place on the earth.
pub fn published(number: u64, lanes: u64) -> PublishedMap {
    let lanes = (1..=lanes)
        .map(|id| {
            let points = bend(200.0, 20).into_iter().map(|p| p + nalgebra::Vector3::new(0.0, 3.5 * id as f64, 0.0));
            lane_of(id, points.collect())
        })
        .collect();
    let summary = SessionSummary {
        session: SessionId::next(None, 0, number),
        version: MapVersion(12),
        state: SessionState::Live,
        preset: Preset::Default,
        lanes: 0,
        extent: None,
        map_from_vehicle: Pose::translation(10.0, 1.0, 0.0),
        last_sequence: Some(Sequence(12)),
        last_time: TimestampNs(1_700_000_001_200_000_000),
        georeference: None,
    };
    PublishedMap::new(summary, Arc::new(LaneMap { lanes }), Way::default())
}

/// The same map at a place on the earth.
pub fn placed(published: PublishedMap, georeference: Georeference) -> PublishedMap {
    let summary = SessionSummary { georeference: Some(georeference), ..published.summary };
    PublishedMap::new(summary, published.map, published.way)
}

/// A map frame at a place, 520 m high, turned by a quarter: its x axis points north.
pub fn georeference(longitude_deg: f64, latitude_deg: f64) -> Georeference {
    let quarter = UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
    Georeference {
        anchor: Anchor::new(Wgs84 { latitude_deg, longitude_deg, height_m: 520.0 }),
        enu_from_map: Pose::from_parts(Translation3::identity(), quarter),
    }
}
