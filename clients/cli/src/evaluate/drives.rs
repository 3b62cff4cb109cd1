//! A recorded drive in memory, disturbed as asked for: the frames that a mapper gets, and the truth about them.

use anyhow::Context;
use clap::Args;
use lanemap_core::{
    Frame, FrameLimits, Pose, Sensor, Sequence, TangentCovariance, geometry::pose::covariance_from_sigmas,
};
use lanemap_openlane::{DriveFolder, DriveFrame, Drives, MotionNoise, apply_motion_noise, draw_motion_noise};
use rand::Rng;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

use super::CommonArgs;

/// What a vehicle states of a motion that has no error: a tenth of a millimetre and 0.0001 degrees.
const RESIDUAL_M: f64 = 0.0001;
const RESIDUAL_DEG: f64 = 0.0001;

/// Noise of the odometry between every two frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PoseNoise {
    /// Standard deviation of the yaw, degrees.
    pub yaw_deg: f64,
    /// Standard deviation of x and of y, metres.
    pub shift_m: f64,
}

impl PoseNoise {
    /// Reads `DEG,M`.
    fn parse(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.trim().parse::<f64>().ok().filter(|value| value.is_finite() && *value >= 0.0);
        text.split_once(',')
            .and_then(|(deg, m)| Some(Self { yaw_deg: number(deg)?, shift_m: number(m)? }))
            .ok_or_else(|| format!("{text:?} is not two numbers of 0 or above with a comma between them"))
    }

    /// The covariance of one motion that a vehicle with this odometry would state.
    fn motion_covariance(self) -> TangentCovariance {
        let plane_m = self.shift_m.max(RESIDUAL_M);
        let yaw = self.yaw_deg.max(RESIDUAL_DEG).to_radians();
        let residual = RESIDUAL_DEG.to_radians();
        covariance_from_sigmas([plane_m, plane_m, RESIDUAL_M], [residual, residual, yaw])
    }
}

/// What is done to the frames of a drive before the mapper gets them.
#[derive(Clone, Copy, Debug, Args)]
pub struct DisturbanceArgs {
    /// Noise between every two frames: standard deviation of yaw (degrees), and of x and y (metres)
    #[arg(long, value_name = "DEG,M", value_parser = PoseNoise::parse, default_value = "0,0")]
    pub pose_noise: PoseNoise,
    /// Probability that one lane of a frame's detections is left out
    #[arg(long, value_name = "P", value_parser = parse_probability, default_value = "0")]
    pub drop: f64,
}

fn parse_probability(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=1.0).contains(&value) => Ok(value),
        _ => Err(format!("{text:?} is not a probability from 0 to 1")),
    }
}

/// The drives that the arguments name.
pub fn chosen(args: &CommonArgs) -> anyhow::Result<Vec<DriveFolder>> {
    let drives = Drives::list(&args.drives, &args.only)?;
    anyhow::ensure!(!drives.is_empty(), "{} has no folder segment-*", args.drives.display());
    Ok(drives)
}

/// A whole drive in memory.
pub struct RecordedDrive {
    pub name: String,
    pub frames: Vec<DriveFrame>,
    /// True poses of the vehicle in the world.
    pub poses: Vec<Pose>,
}

impl RecordedDrive {
    /// Reads every frame of a drive; each must have a pose.
    pub fn read(folder: &DriveFolder) -> anyhow::Result<Self> {
        let frames = folder.frames().collect::<Result<Vec<_>, _>>()?;
        let poses = frames.iter().map(|frame| frame.annotation.pose()).collect::<Result<_, _>>()?;
        Ok(Self { name: folder.name().to_owned(), frames, poses })
    }

    /// The camera of the first frame.
    pub fn sensor(&self) -> Sensor {
        self.frames.first().map(|frame| frame.annotation.sensor()).unwrap_or_default()
    }

    /// Leaves out one lane of a frame's detections, with this probability. As `lanemap replay` does for the same seed.
    pub fn drop_detections(&mut self, probability: f64, seed: u64) {
        let mut rng = stream(&self.name, seed, 1);
        for lanes in self.frames.iter_mut().filter_map(|frame| Some(&mut frame.detections.as_mut()?.lanes)) {
            if !lanes.is_empty() && rng.random::<f64>() < probability {
                let dropped = rng.random_range(0..lanes.len());
                lanes.remove(dropped);
            }
        }
    }

    /// Draws the odometry's noise, a motion each. As `lanemap replay` does for the same seed.
    pub fn draw_noise(&self, noise: PoseNoise, seed: u64) -> Vec<MotionNoise> {
        let mut rng = stream(&self.name, seed, 0);
        draw_motion_noise(self.poses.len().saturating_sub(1), noise.yaw_deg, noise.shift_m, &mut rng)
    }

    /// The poses that an odometry of this noise would report.
    pub fn odometry(&self, noise: PoseNoise, seed: u64) -> Vec<Pose> {
        if noise == PoseNoise::default() {
            return self.poses.clone();
        }
        apply_motion_noise(&self.poses, &self.draw_noise(noise, seed))
    }

    /// The frames as a mapper gets them.
    pub fn mapper_frames(&self, odometry: &[Pose], noise: PoseNoise) -> anyhow::Result<Vec<Frame>> {
        let covariance = noise.motion_covariance();
        let frame = |(index, (frame, pose)): (usize, (&DriveFrame, &Pose))| {
            let parts = frame.frame_parts(Sequence(index as u64 + 1), *pose, Some(covariance));
            Frame::new(parts, &FrameLimits::default())
                .with_context(|| format!("{} and its result file", frame.annotation.path.display()))
        };
        self.frames.iter().zip(odometry).enumerate().map(frame).collect()
    }
}

/// A random stream of a drive, which does not depend on what else is evaluated (FNV-1a of the drive's name).
fn stream(drive: &str, seed: u64, purpose: u64) -> ChaCha8Rng {
    let hash = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream((drive.bytes().fold(0xcbf2_9ce4_8422_2325, hash) << 1) ^ purpose);
    rng
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_read_as_degrees_and_metres() {
        assert_eq!(PoseNoise::parse("0.3, 0.2"), Ok(PoseNoise { yaw_deg: 0.3, shift_m: 0.2 }));
        assert!(PoseNoise::parse("0.3").is_err());
        assert!(PoseNoise::parse("-1,0").is_err());
        assert!(parse_probability("1.5").is_err());
    }

    #[test]
    fn a_drive_has_the_same_noise_whatever_else_is_evaluated() {
        let draw = |name, seed, purpose| stream(name, seed, purpose).random::<u64>();
        assert_eq!(draw("segment-a", 1, 0), draw("segment-a", 1, 0));
        assert_ne!(draw("segment-a", 1, 0), draw("segment-b", 1, 0));
        assert_ne!(draw("segment-a", 1, 0), draw("segment-a", 2, 0));
        assert_ne!(draw("segment-a", 1, 0), draw("segment-a", 1, 1));
    }
}
