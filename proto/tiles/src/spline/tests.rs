use std::path::PathBuf;

use lanemap_core::{EndRule, spline::Curve};
use nalgebra::Point3;
use proptest::prelude::*;
use prost::Message;
use serde_json::{Value, json};

use super::*;

/// A line of one drive: control points about 3 m apart on a bend, each some millimetres or centimetres aside.
fn lane(number: u64, radius_m: f64, asides_m: &[f64]) -> v1::FusedLane {
    let points = asides_m.iter().enumerate().map(|(index, aside_m)| {
        let (sin, cos) = (3.0 * index as f64 / radius_m).sin_cos();
        let away_m = radius_m + aside_m;
        [40.0 + away_m * sin, 25.0 + radius_m - away_m * cos, 512.0 + 0.04 * index as f64 + 0.5 * aside_m]
    });
    let mut before = [0_i32; 3];
    let xyz_mm = points.flat_map(|point| {
        let at = point.map(|metres| i32::try_from(rounded(metres * 1e3)).unwrap());
        let step = [0, 1, 2].map(|axis| at[axis] - before[axis]);
        before = at;
        step
    });
    let count = asides_m.len();
    let xyz_mm = xyz_mm.collect();
    v1::FusedLane {
        id: format!("18176e6dfa090000-c4e5a991845893bb-{number:x}-0-0"),
        part: 0,
        category: v1::LaneCategory::WhiteDashed.into(),
        category_posterior_permille: (0..15).map(|index| if index == 1 { 970 } else { 2 }).collect(),
        xyz_mm,
        lateral_sigma_mm: (60..).step_by(3).take(count).collect(),
        height_sigma_mm: vec![75; count],
        existence_permille: vec![940; count],
        drives_at: vec![3; count],
        drives: 3,
        observations: 71,
        first_seen_unix_ns: 1_735_718_401_250_000_000,
        last_seen_unix_ns: 1_735_718_431_900_000_000,
        confirmed_after_s: vec![86_400; count],
        ..v1::FusedLane::default()
    }
}

fn cell() -> CellId {
    CellId::new(8_718, 5_685).unwrap()
}

fn map(lanes: Vec<v1::FusedLane>) -> v1::CellMap {
    v1::CellMap { cell: cell().to_string(), version: 7, anchor: None, lanes }
}

fn whole_tile(map: &v1::CellMap) -> v1::SplineTile {
    let tile = TileId::new(14, cell().x(), cell().y()).unwrap();
    spline_tile(tile, [&FittedCell::new(cell(), map, None)])
}

fn control_points(lane: &v1::FusedLane) -> Vec<Point3<f64>> {
    let mut at = [0_i64; 3];
    let points = lane.xyz_mm.chunks_exact(3).map(|step| {
        at.iter_mut().zip(step).for_each(|(at, step)| *at += i64::from(*step));
        metres(at)
    });
    points.collect()
}

/// Greatest distance of the map's spline from the curve that was read, metres.
fn farthest_m(lane: &v1::FusedLane, read: &SplineLine) -> f64 {
    let points = control_points(lane);
    let spline = Curve::new(points.as_slice(), EndRule::Reflected).unwrap();
    let line: Vec<Point3<f64>> = read.curve.sample(0.05).iter().map(|point| point.position).collect();
    let distance = |point: Point3<f64>| {
        let chords = line.windows(2).filter(|pair| pair[0] != pair[1]).map(|pair| {
            let chord = pair[1] - pair[0];
            let along = ((point - pair[0]).dot(&chord) / chord.norm_squared()).clamp(0.0, 1.0);
            (point - (pair[0] + chord * along)).norm()
        });
        chords.fold(f64::INFINITY, f64::min)
    };
    let steps = 20 * (points.len() - 1);
    (0..=steps).map(|step| distance(spline.point(step as f64 / 20.0))).fold(0.0, f64::max)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn a_curve_stays_within_a_centimetre_of_the_line_of_the_map(
        radius_m in 6.0..2_000.0f64,
        wide in any::<bool>(),
        asides_m in prop::collection::vec(-0.01..0.01f64, 2..60),
    ) {
        let asides_m: Vec<f64> = asides_m.iter().map(|aside_m| if wide { 10.0 * aside_m } else { *aside_m }).collect();
        let lane = lane(5, radius_m, &asides_m);
        let read = read(&whole_tile(&map(vec![lane.clone()]))).unwrap();
        let farthest_m = farthest_m(&lane, &read[0].lines[0]);
        prop_assert!(farthest_m <= 0.01, "{farthest_m}");
    }

    #[test]
    fn damaged_bits_are_refused_or_read_and_never_more(bytes in prop::collection::vec(any::<u8>(), 0..200), count in 0..40_u32) {
        let mut tile = whole_tile(&map(vec![lane(5, 80.0, &[0.0; 20])]));
        tile.cells[0].lines = bytes;
        tile.cells[0].count = count;
        let _ = read(&tile);
    }
}

#[test]
fn a_curve_that_swings_out_between_control_points_stays_within_a_centimetre_too() {
    let asides_m = [0.0736, -0.0953, -0.0442, -0.0912, 0.0327, 0.0694, 0.0867];
    let lane = lane(5, 1_471.028, &asides_m);
    let read = read(&whole_tile(&map(vec![lane.clone()]))).unwrap();
    let farthest_m = farthest_m(&lane, &read[0].lines[0]);
    assert!(farthest_m <= 0.01, "{farthest_m}");
}

#[test]
fn all_that_is_told_of_a_line_comes_back() {
    let place =
        v1::GeodeticPosition { latitude_deg: 48.123_456_789_4, longitude_deg: 11.567_890_123_4, height_m: 512.345_4 };
    let next =
        v1::LaneName { cell: "14-8719-5684".into(), id: "18176e6dfa090000-00000000000000a7-2-1-0".into(), part: 3 };
    let told = v1::FusedLane {
        part: 2,
        begins_at: Some(v1::LaneBorder { place: Some(place), continues_in: Some(next) }),
        ends_at: Some(v1::LaneBorder { place: Some(place), continues_in: None }),
        ..lane(0x4d, 150.0, &[0.0; 30])
    };
    let tile = whole_tile(&map(vec![told.clone(), lane(0x4e, 90.0, &[0.01; 12])]));
    let read = read(&v1::SplineTile::decode(tile.encode_to_vec().as_slice()).unwrap()).unwrap();
    assert_eq!((read[0].cell, read[0].version, read[0].lines.len()), (cell(), 7, 2));
    let line = &read[0].lines[0];
    assert_eq!((line.id_text(), line.part), (told.id.clone(), 2));
    assert_eq!((line.category, line.drives), (v1::LaneCategory::WhiteDashed, 3));
    assert_eq!((line.last_seen_unix_s, line.confirmed_unix_s), (1_735_718_431, 1_735_718_401 + 86_400));
    assert!((line.category_probability - 0.97).abs() < 1e-9 && (line.existence[0] - 0.94).abs() < 1e-9);
    let begins_at = line.begins_at.as_ref().unwrap();
    assert!((begins_at.place.latitude_deg - place.latitude_deg).abs() < 1e-9);
    assert!((begins_at.place.longitude_deg - place.longitude_deg).abs() < 1e-9);
    assert!((begins_at.place.height_m - 512.345).abs() < 1e-9);
    let (cell, id, part) = begins_at.continues_in.unwrap();
    assert_eq!(
        (cell.to_string(), lane_id_text(&id), part),
        ("14-8719-5684".into(), "18176e6dfa090000-00000000000000a7-2-1-0".into(), 3)
    );
    assert_eq!(line.ends_at.as_ref().unwrap().continues_in, None);
    let ends = [0, 29].map(|index| control_points(&told)[index]);
    for (end, at) in ends.iter().zip([0.0, line.curve.last_parameter()]) {
        let point = line.curve.at(at);
        assert!((point.position - end).norm() < 2e-3);
        let exact_m = if at == 0.0 { 0.060 } else { 0.147 };
        assert!((0.8..1.2).contains(&(line.lateral_sigma_m_at(&point) / exact_m)));
    }
}

#[test]
fn both_cells_of_a_border_have_the_same_place() {
    let border = v1::LaneBorder {
        place: Some(v1::GeodeticPosition {
            latitude_deg: 48.129_999_123_45,
            longitude_deg: 11.579_589_843_75,
            height_m: 519.8,
        }),
        continues_in: None,
    };
    let place = |cell: CellId, lane: v1::FusedLane| {
        let map = v1::CellMap { cell: cell.to_string(), version: 1, anchor: None, lanes: vec![lane] };
        let tile = TileId::new(14, cell.x(), cell.y()).unwrap();
        let read = read(&spline_tile(tile, [&FittedCell::new(cell, &map, None)])).unwrap();
        let line = read[0].lines[0].clone();
        line.begins_at.or(line.ends_at).unwrap().place
    };
    let here = place(cell(), v1::FusedLane { ends_at: Some(border.clone()), ..lane(1, 500.0, &[0.0; 9]) });
    let there = place(
        CellId::new(8_719, 5_685).unwrap(),
        v1::FusedLane { begins_at: Some(border), ..lane(1, 500.0, &[0.0; 9]) },
    );
    assert_eq!(here, there);
}

#[test]
fn a_tile_has_the_lines_that_touch_it_and_no_others() {
    let map = map(vec![lane(1, 1e6, &[0.0; 40])]);
    let fitted = FittedCell::new(cell(), &map, None);
    // The line begins in the middle of the cell and leads east.
    let child = |x: u32, y: u32| TileId::new(15, cell().x() * 2 + x, cell().y() * 2 + y).unwrap();
    let lines = |tile| spline_tile(tile, [&fitted]).cells.len();
    assert_eq!([child(1, 0), child(0, 0), child(0, 1), child(1, 1)].map(lines), [1, 0, 0, 0]);
}

#[test]
fn lines_of_an_earlier_version_are_taken_as_they_are() {
    let before = FittedCell::new(cell(), &map(vec![lane(1, 80.0, &[0.0; 40]), lane(2, 90.0, &[0.0; 40])]), None);
    let after = map(vec![lane(1, 80.0, &[0.0; 40]), lane(2, 90.0, &[0.001; 40])]);
    let tile = TileId::new(14, cell().x(), cell().y()).unwrap();
    let [anew, onward] =
        [None, Some(&before)].map(|earlier| spline_tile(tile, [&FittedCell::new(cell(), &after, earlier)]));
    assert_eq!(anew, onward);
}

/// What a reader in any language makes of a tile.
fn as_json(cells: &[CellSplines]) -> Value {
    let triple = |values: [f64; 3]| json!(values);
    let border = |border: &Option<SplineBorder>| {
        border.as_ref().map(|SplineBorder { place, continues_in }| {
            let next = continues_in.map(|(cell, id, part)| json!({"cell": cell.to_string(), "id": lane_id_text(&id), "part": part}));
            json!({"latitude_deg": place.latitude_deg, "longitude_deg": place.longitude_deg, "height_m": place.height_m, "continues_in": next})
        })
    };
    let line = |line: &SplineLine| {
        let at = |share: f64| {
            let parameter = share * line.curve.last_parameter();
            let point = line.curve.at(parameter);
            json!({
                "parameter_m": parameter,
                "position_m": triple(point.position.coords.into()),
                "tangent": triple(point.tangent.into()),
                "lateral_sigma_m": line.lateral_sigma_m_at(&point),
                "height_sigma_m": line.height_sigma_m_at(&point),
                "existence": line.existence_at(&point),
            })
        };
        let samples = [0.0, 0.137, 0.5, 0.861, 1.0].map(at);
        let points: Vec<_> = line
            .curve
            .points()
            .iter()
            .map(|point| [point.x, point.y, point.z].map(|axis| rounded(axis * 1e3)))
            .collect();
        json!({
            "id": line.id_text(),
            "part": line.part,
            "category": line.category.as_str_name(),
            "category_probability": line.category_probability,
            "drives": line.drives,
            "last_seen_unix_s": line.last_seen_unix_s,
            "confirmed_unix_s": line.confirmed_unix_s,
            "begins_at": border(&line.begins_at),
            "ends_at": border(&line.ends_at),
            "control_points_mm": points,
            "samples": samples,
        })
    };
    let cell = |cell: &CellSplines| json!({"cell": cell.cell.to_string(), "version": cell.version, "lines": cell.lines.iter().map(line).collect::<Vec<_>>()});
    json!({"cells": cells.iter().map(cell).collect::<Vec<_>>()})
}

fn golden(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(name)
}

/// Lines of every kind: bends, a border that goes on under another name and one that ends there, a line of two control
/// points, one that turns sharply.
fn every_kind_of_line() -> v1::CellMap {
    let place =
        v1::GeodeticPosition { latitude_deg: 48.123_456_789_4, longitude_deg: 11.567_890_123_4, height_m: 512.345_4 };
    let named = |cell: &str, id: &str, part| Some(v1::LaneName { cell: cell.into(), id: id.into(), part });
    let other = "18176e6dfa090000-00000000000000a7-2-1-0";
    let wavy: Vec<f64> = (0..80_u8).map(|index| 0.3 * (0.4 * f64::from(index)).sin()).collect();
    let lines = vec![
        lane(1, 300.0, &wavy),
        v1::FusedLane {
            ends_at: Some(v1::LaneBorder { place: Some(place), continues_in: named("14-8719-5685", other, 1) }),
            ..lane(0x4d, 60.0, &[0.0; 30])
        },
        v1::FusedLane {
            begins_at: Some(v1::LaneBorder { place: Some(place), continues_in: None }),
            confirmed_after_s: vec![-1; 2],
            ..lane(0x4e, 90.0, &[0.0; 2])
        },
        v1::FusedLane { id: other.into(), category: v1::LaneCategory::RightCurb.into(), ..lane(0, 7.0, &[0.05; 12]) },
    ];
    map(lines)
}

/// Run it where the format changes: `cargo test -p lanemap-tiles -- --ignored writes_the_golden`.
#[test]
#[ignore = "writes the golden files"]
fn this_writes_the_golden_files() {
    let tile = whole_tile(&every_kind_of_line());
    let json = serde_json::to_string_pretty(&as_json(&read(&tile).unwrap())).unwrap();
    std::fs::write(golden("spline_tile.pb"), tile.encode_to_vec()).unwrap();
    std::fs::write(golden("spline_tile.json"), json + "\n").unwrap();
}

/// Whether two documents are the same, numbers to a billionth.
fn agree(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Number(a), Value::Number(b)) => {
            (a.as_f64().unwrap() - b.as_f64().unwrap()).abs() <= 1e-9 * a.as_f64().unwrap().abs().max(1.0)
        }
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| agree(a, b)),
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len() && a.iter().all(|(name, a)| b.get(name).is_some_and(|b| agree(a, b)))
        }
        _ => a == b,
    }
}

#[test]
fn the_golden_tile_is_read_as_every_reader_must() {
    let tile = v1::SplineTile::decode(std::fs::read(golden("spline_tile.pb")).unwrap().as_slice()).unwrap();
    let wanted: Value = serde_json::from_slice(&std::fs::read(golden("spline_tile.json")).unwrap()).unwrap();
    let found = as_json(&read(&tile).unwrap());
    assert!(agree(&found, &wanted), "{found:#}");
}
