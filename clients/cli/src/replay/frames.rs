//! Frames of a recorded drive as a vehicle would have streamed them: disturbed as asked for, validated one by one.

use lanemap_core::{
    Frame, FrameError, FrameLimits, GnssFix, Pose,
    geometry::georeference::{Anchor, Georeference, Wgs84},
};
use lanemap_openlane::{noisy_odometry, timestamp_stem};
use lanemap_recording::{Camera, Frames, RecordedDrive, RecordedFrame};
use lanemap_simulator::OdometryNoise;
use rand::Rng;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

/// Standard deviations of the GNSS fixes, metres: those of the biases of simulated receivers.
const GNSS_SIGMA_M: f64 = 1.0;

/// What is done to the frames of a drive before they are streamed.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disturbance {
    /// Noise of the odometry.
    pub pose_noise: OdometryNoise,
    /// Probability that one detection of a frame is left out.
    pub drop: f64,
    /// Seed of both.
    pub seed: u64,
}

/// A frame ready to be streamed, with what was recorded beside it.
#[derive(Debug)]
pub struct PreparedFrame {
    /// The frame.
    pub frame: Frame,
    /// The pose that was recorded, undisturbed.
    pub recorded_pose: Pose,
    /// The camera.
    pub camera: Camera,
}

/// Why a frame was left out.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Fault {
    /// The frame: the name of its file, without ending, or its place in the recording.
    pub frame: String,
    /// What is wrong, with file or field.
    pub error: String,
}

/// Reads the frames of a drive. A frame that cannot be read or is not valid is left out and noted; the rest goes on.
pub struct FrameSource<'a> {
    name: String,
    frames: Frames<'a>,
    disturbance: Disturbance,
    noise_rng: ChaCha8Rng,
    drop_rng: ChaCha8Rng,
    last: Option<(Pose, Pose)>,
    world: Option<Georeference>,
    has_fix: bool,
    faults: Vec<Fault>,
}

impl<'a> FrameSource<'a> {
    /// The frames of a drive, `world` being where its world lies on the earth.
    pub fn new(drive: &'a mut RecordedDrive, disturbance: Disturbance, world: Option<Georeference>) -> Self {
        let name = drive.name().to_owned();
        let rng = |purpose| {
            let mut rng = ChaCha8Rng::seed_from_u64(disturbance.seed);
            rng.set_stream(stream_of(&name) ^ purpose);
            rng
        };
        let (noise_rng, drop_rng) = (rng(0), rng(1));
        let frames = drive.frames();
        Self { name, frames, disturbance, noise_rng, drop_rng, last: None, world, has_fix: false, faults: Vec::new() }
    }

    /// What was left out.
    pub fn into_faults(self) -> Vec<Fault> {
        self.faults
    }

    fn prepare(&mut self, recorded: RecordedFrame) -> Result<PreparedFrame, FrameError> {
        let RecordedFrame { mut parts, poses_are_true, world_from_vehicle_gnss, camera } = recorded;
        let recorded_pose = parts.odometry.odometry_from_vehicle;
        let noise = self.disturbance.pose_noise;
        parts.odometry.odometry_from_vehicle = self.odometry_at(recorded_pose);
        if poses_are_true || noise != OdometryNoise::default() {
            parts.odometry.motion_covariance = Some(noise.motion_covariance());
        }
        if !parts.detections.is_empty() && self.drop_rng.random::<f64>() < self.disturbance.drop {
            let dropped = self.drop_rng.random_range(0..parts.detections.len());
            parts.detections.remove(dropped);
        }
        parts.gnss = self.fix_of(parts.gnss, world_from_vehicle_gnss, &recorded_pose);
        let frame = Frame::new(parts, &FrameLimits::default())?;
        Ok(PreparedFrame { frame, recorded_pose, camera })
    }

    /// The odometry's pose: the last one, moved by the true motion since then and by its noise.
    fn odometry_at(&mut self, truth: Pose) -> Pose {
        let noise = self.disturbance.pose_noise;
        let odometry = match self.last {
            Some(_) if noise == OdometryNoise::default() => truth,
            Some((last_truth, last_odometry)) => {
                let motion = [Pose::identity(), last_truth.inverse() * truth];
                let noisy =
                    noisy_odometry(&motion, noise.yaw_sigma_deg, noise.translation_sigma_m, &mut self.noise_rng);
                let mut moved = last_odometry * noisy[1];
                moved.rotation.renormalize();
                moved
            }
            None => truth,
        };
        self.last = Some((truth, odometry));
        odometry
    }

    /// The fix that was recorded, else the pose that a receiver gave, else, once, the pose itself.
    fn fix_of(&mut self, fix: Option<GnssFix>, gnss: Option<Pose>, pose: &Pose) -> Option<GnssFix> {
        let fix = fix.or_else(|| {
            let world = self.world.as_ref()?;
            let pose = match (&gnss, self.has_fix) {
                (Some(gnss), _) => gnss,
                (None, false) => pose,
                (None, true) => return None,
            };
            Some(world.fix_at(pose, GNSS_SIGMA_M, GNSS_SIGMA_M))
        });
        self.has_fix |= fix.is_some();
        fix
    }

    fn leave_out(&mut self, frame: String, error: String) {
        tracing::error!("{}: {frame} left out: {error}", self.name);
        self.faults.push(Fault { frame, error });
    }
}

impl Iterator for FrameSource<'_> {
    type Item = PreparedFrame;

    fn next(&mut self) -> Option<PreparedFrame> {
        loop {
            match self.frames.next()? {
                Ok(recorded) => {
                    let stem = timestamp_stem(recorded.parts.time);
                    match self.prepare(recorded) {
                        Ok(frame) => return Some(frame),
                        Err(error) => self.leave_out(stem, error.to_string()),
                    }
                }
                Err(fault) => self.leave_out(fault.frame, fault.error.to_string()),
            }
        }
    }
}

/// A stream number from a drive's name (FNV-1a), so that a drive's noise does not depend on what else is replayed.
fn stream_of(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)) << 1
}

/// Reads `DEG,M`.
pub fn parse_pose_noise(text: &str) -> Result<OdometryNoise, String> {
    let (yaw_sigma_deg, translation_sigma_m) = pair(text)?;
    if yaw_sigma_deg < 0.0 || translation_sigma_m < 0.0 {
        return Err("both standard deviations must be 0 or above".to_owned());
    }
    Ok(OdometryNoise { yaw_sigma_deg, translation_sigma_m })
}

/// Reads `LAT,LON`.
pub fn parse_origin(text: &str) -> Result<Georeference, String> {
    let (latitude_deg, longitude_deg) = pair(text)?;
    if !(-90.0..=90.0).contains(&latitude_deg) {
        return Err(format!("latitude {latitude_deg} is outside -90 ..= 90"));
    }
    if !(-180.0..=180.0).contains(&longitude_deg) {
        return Err(format!("longitude {longitude_deg} is outside -180 ..= 180"));
    }
    let anchor = Anchor::new(Wgs84 { latitude_deg, longitude_deg, height_m: 0.0 });
    Ok(Georeference { anchor, enu_from_map: Pose::identity() })
}

/// Reads a probability.
pub fn parse_probability(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=1.0).contains(&value) => Ok(value),
        _ => Err(format!("{text:?} is not a probability from 0 to 1")),
    }
}

fn pair(text: &str) -> Result<(f64, f64), String> {
    let number = |text: &str| text.trim().parse::<f64>().ok().filter(|value| value.is_finite());
    text.split_once(',')
        .and_then(|(first, second)| Some((number(first)?, number(second)?)))
        .ok_or_else(|| format!("{text:?} is not two numbers with a comma between them"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_of_two_numbers_say_what_is_wrong_with_them() {
        assert_eq!(parse_pose_noise("0.3, 0.2"), Ok(OdometryNoise { yaw_sigma_deg: 0.3, translation_sigma_m: 0.2 }));
        assert!(parse_pose_noise("0.3").unwrap_err().contains("comma"));
        assert!(parse_pose_noise("-1,0").unwrap_err().contains("0 or above"));
        assert!(parse_pose_noise("NaN,0").is_err());
        assert!(parse_origin("91,0").unwrap_err().contains("latitude 91"));
        assert!(parse_origin("22.3,-181").unwrap_err().contains("longitude -181"));
        assert!(parse_probability("1.5").is_err());
    }
}
