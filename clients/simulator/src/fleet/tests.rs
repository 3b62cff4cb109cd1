//! Promises of fleets.

use lanemap_core::Frame;
use nalgebra::Vector3;

use super::*;
use crate::road::LinkKind;

fn road(drives: u32) -> FleetScenario {
    let routes = FleetRoutes::Shared { length_m: 250.0, both_directions: true };
    FleetScenario { drives, routes, ..FleetScenario::winding_road() }
}

fn bytes(fleet: &Fleet) -> Vec<Vec<u8>> {
    let frames = |drive: FleetDrive<'_>| drive.frames().map(|frame| frame.to_bytes().unwrap()).collect::<Vec<_>>();
    fleet.drives().flat_map(frames).collect()
}

#[test]
fn one_seed_gives_the_same_bytes_and_another_seed_others() {
    assert_eq!(bytes(&road(2).fleet(Seed(1))), bytes(&road(2).fleet(Seed(1))));
    assert_ne!(bytes(&road(2).fleet(Seed(1))), bytes(&road(2).fleet(Seed(2))));
}

#[test]
fn a_drive_is_the_same_whoever_drives_beside_it() {
    let (few, many) = (road(2).fleet(Seed(1)), road(5).fleet(Seed(1)));
    assert!(few.drive(1).frames().eq(many.drive(1).frames()));
}

#[test]
fn drives_start_one_after_the_other_and_their_frames_are_ten_a_second() {
    let fleet = road(3).fleet(Seed(1));
    let mut before = TimestampNs(0);
    for drive in fleet.drives() {
        let frames: Vec<Frame> = drive.frames().collect();
        assert!(frames.len() > 150);
        assert!(frames[0].time() > before, "drive {}", drive.number());
        assert!(frames.windows(2).all(|pair| pair[1].time().0 - pair[0].time().0 == 100_000_000));
        before = frames[frames.len() - 1].time();
    }
}

#[test]
fn drives_of_one_road_go_both_ways_and_see_the_same_lines() {
    let fleet = road(2).fleet(Seed(3));
    let forward: Vec<bool> = fleet.drives().map(|drive| drive.route().legs[0].forward).collect();
    assert_eq!(forward, [true, false]);
    for drive in fleet.drives() {
        let seen = drive.observed().filter(|observed| observed.views.len() >= 3).count();
        assert!(seen * 10 > drive.states().len() * 8, "{seen} of {}", drive.states().len());
    }
}

#[test]
fn fixes_lie_about_the_true_place_by_the_drives_own_bias() {
    let fleet = road(2).fleet(Seed(1));
    let (on_earth, model) = (fleet.georeference(), fleet.scenario().receiver);
    for drive in fleet.drives() {
        let truth = drive.states().iter().map(|state| state.world_from_vehicle.translation.vector);
        let errors: Vec<Vector3<f64>> = drive
            .frames()
            .zip(truth)
            .map(|(frame, place)| {
                let fix = frame.gnss().unwrap();
                let on_the_earth =
                    Wgs84 { latitude_deg: fix.latitude_deg, longitude_deg: fix.longitude_deg, height_m: fix.height_m };
                on_earth.to_map(&on_the_earth).coords - place
            })
            .collect();
        let mean = errors.iter().sum::<Vector3<f64>>() / errors.len() as f64;
        assert!(mean.norm() < 4.0 * 2.0 * model.bias_sigma_m);
        for error in errors {
            assert!((error - mean).norm() < 1.2, "{}", (error - mean).norm());
        }
    }
}

#[test]
fn a_loop_comes_back_to_where_it_began_and_its_odometry_does_not() {
    let fleet = FleetScenario::closed_loop().fleet(Seed(2));
    let drive = fleet.drive(0);
    let states = drive.states();
    let first = states[0].world_from_vehicle.translation.vector;
    let again = states.iter().filter(|state| state.distance_m > 1_000.0).min_by(|a, b| {
        let distance = |state: &crate::drive::TrueState| (state.world_from_vehicle.translation.vector - first).norm();
        distance(a).total_cmp(&distance(b))
    });
    let again = again.unwrap();
    assert!((again.world_from_vehicle.translation.vector - first).xy().norm() < 8.0);
    assert!((again.distance_m - 2_000.0).abs() < 80.0, "{}", again.distance_m);
    let index = states.iter().position(|state| state.time == again.time).unwrap();
    let believed = drive.frames().nth(index).unwrap().odometry().odometry_from_vehicle;
    let drift_m =
        (drive.world_from_odometry() * believed).translation.vector - again.world_from_vehicle.translation.vector;
    assert!(drift_m.norm() > 1.0 && drift_m.norm() < 100.0, "{}", drift_m.norm());
    // Across the seam lines go on being seen.
    let seam = drive.observed().skip(index - 60).take(120);
    assert!(seam.filter(|observed| observed.views.len() >= 3).count() > 110);
}

#[test]
fn a_poisoned_fleet_has_its_share_of_drives_with_errors_and_the_rest_is_as_before() {
    let poison = PoisonPlan { gross_share: 0.3, adversarial_share: 0.1 };
    let (clean, poisoned) = (road(12).fleet(Seed(4)), FleetScenario { poison, ..road(12) }.fleet(Seed(4)));
    let mut kinds = std::collections::BTreeSet::new();
    for (a, b) in clean.drives().zip(poisoned.drives()) {
        match b.poison() {
            None => assert!(a.frames().eq(b.frames())),
            Some(poison) => {
                assert!(!a.frames().eq(b.frames()));
                kinds.insert(format!("{poison:?}").split(['(', ' ']).next().unwrap().to_owned());
            }
        }
    }
    assert!(kinds.len() >= 2, "{kinds:?}");
}

#[test]
fn drives_through_a_town_keep_to_its_roads_and_see_them() {
    let fleet = FleetScenario::small_town(12).fleet(Seed(3));
    let mut with_lines = 0;
    let mut frames = 0;
    for drive in fleet.drives() {
        assert!(drive.length_m() > 990.0, "{}", drive.length_m());
        for pair in drive.states().windows(2) {
            let motion = pair[0].world_from_vehicle.inverse() * pair[1].world_from_vehicle;
            let (ahead_m, aside_m) = (motion.translation.x, motion.translation.y.abs());
            assert!((0.2..3.2).contains(&ahead_m) && aside_m < 0.12 * ahead_m, "{ahead_m} {aside_m}");
        }
        for observed in drive.observed() {
            frames += 1;
            with_lines += usize::from(observed.views.len() >= 2);
        }
    }
    assert!(with_lines * 10 > frames * 7, "{with_lines} of {frames}");
}

#[test]
fn a_canyon_in_town_shifts_fixes_by_metres() {
    let fleet = FleetScenario { canyon_share: 1.0, ..FleetScenario::small_town(6) }.fleet(Seed(3));
    assert!(fleet.canyons().len() > 15);
    let mut jumps = 0;
    for drive in fleet.drives() {
        let errors: Vec<Vector3<f64>> = drive
            .observed()
            .map(|seen| {
                seen.gnss_world_from_vehicle.translation.vector - seen.truth.world_from_vehicle.translation.vector
            })
            .collect();
        jumps += errors.windows(2).filter(|pair| (pair[1] - pair[0]).norm() > 2.0).count();
    }
    assert!(jumps >= 12, "{jumps}");
}

#[test]
fn nothing_is_detected_behind_another_vehicle_and_the_frame_says_what_is_hidden() {
    let traffic = TrafficModel { vehicles_per_km: 25.0, ..TrafficModel::town() };
    let (empty, full) = (FleetScenario { traffic: TrafficModel::none(), ..FleetScenario::small_town(6) }, traffic);
    let (clear, busy) = (empty.fleet(Seed(5)), FleetScenario { traffic: full, ..empty }.fleet(Seed(5)));
    let sensor = busy.sensor();
    let points = |frame: &Frame| frame.detections().iter().map(|line| line.points_vehicle.len()).sum::<usize>();
    let (mut all, mut left, mut hidden_frames) = (0, 0, 0);
    for (a, b) in clear.drives().zip(busy.drives()) {
        for (clear, busy) in a.observed().zip(b.observed()) {
            assert!(clear.frame.occlusions().is_empty());
            for detection in busy.frame.detections() {
                assert!(detection.points_vehicle.iter().all(|point| !busy.frame.hides(point, &sensor)));
            }
            all += points(&clear.frame);
            left += points(&busy.frame);
            hidden_frames += usize::from(!busy.frame.occlusions().is_empty());
        }
    }
    assert!(hidden_frames > 1_000, "{hidden_frames}");
    assert!(left * 10 < all * 9 && left * 10 > all * 3, "{left} of {all} points are left");
}

#[test]
fn vehicles_keep_to_their_lanes_and_leave_the_ego_vehicle_its_room() {
    let fleet = FleetScenario { traffic: TrafficModel::town(), ..FleetScenario::straight_road() }.fleet(Seed(2));
    let (mut counted, mut frames) = (0, 0);
    for drive in fleet.drives() {
        for seen in drive.observed() {
            frames += 1;
            for vehicle in &seen.vehicles {
                counted += 1;
                let place = vehicle.place - seen.truth.world_from_vehicle.translation.vector.xy();
                assert!(place.coords.norm() > 3.0, "{place}");
                let lane = (vehicle.place.y / 3.5).floor() + 0.5;
                assert!((vehicle.place.y - 3.5 * lane).abs() < 1.0, "{}", vehicle.place);
                let rightwards = vehicle.heading_rad.cos() > 0.0;
                assert_eq!(rightwards, vehicle.place.y < 0.0, "traffic keeps to the right");
            }
        }
    }
    let per_km = f64::from(counted) / f64::from(frames) / 0.11 / 4.0;
    assert!((5.0..14.0).contains(&per_km), "{per_km} vehicles a kilometre and lane");
}

#[test]
fn nobody_crosses_a_solid_line_on_the_motorway_and_its_ramps() {
    use lanemap_core::Category;
    let fleet = FleetScenario { lane_changes_per_km: 2.0, ..FleetScenario::small_town(150) }.fleet(Seed(6));
    let network = fleet.network();
    let (mut ramps, mut frames) = (0, 0);
    for drive in fleet.drives() {
        let kind = |leg: usize| network.link(drive.route().legs[leg].link).kind;
        ramps += drive.route().legs.iter().filter(|leg| network.link(leg.link).kind == LinkKind::Ramp).count();
        let on_motorway = |leg: usize| matches!(kind(leg), LinkKind::Motorway { .. } | LinkKind::Ramp);
        for state in drive.states().iter().filter(|state| on_motorway(state.leg)).step_by(5) {
            frames += 1;
            let place = state.world_from_vehicle.translation.vector.xy();
            for line in &network.link(drive.route().legs[state.leg].link).lines {
                let line = network.line(*line);
                if matches!(line.category, Category::WhiteSolid | Category::YellowSolid) {
                    let nearest = line.points.iter().map(|point| (point.xy().coords - place).norm());
                    let nearest_m = nearest.fold(f64::INFINITY, f64::min);
                    assert!(nearest_m > 0.8, "drive {} at {place}: {nearest_m} m from a solid line", drive.number());
                }
            }
        }
    }
    assert!(ramps >= 10 && frames > 1_000, "{ramps} ramps, {frames} frames");
}
