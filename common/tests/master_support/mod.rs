//! Synthetic hands and the real recording, for the tests of the master hand.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, reason = "every test binary uses its own part")]

use std::fs::File;
use std::io::BufReader;

use nalgebra::{Rotation3, Vector3};
use teleop_common::hand::Finger;
use teleop_common::master::{Keypoints, MasterGeometry};
use teleop_common::recording::{FrameData, LastLine, RecordingReader};
use teleop_common::testing::shared_data;

/// Normal numbers from splitmix64: the same on every run.
pub struct Noise(pub u64);

impl Noise {
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }
}

/// The points of a posture in O_W, m.
pub fn points(geometry: &MasterGeometry, q: &[f64; 20]) -> [[f64; 3]; 21] {
    let mut points = [[0.0; 3]; 21];
    for finger in Finger::ALL {
        let f = finger.index();
        let angles = [q[4 * f], q[4 * f + 1], q[4 * f + 2], q[4 * f + 3]];
        for (k, point) in geometry.finger_points(finger, &angles).into_iter().enumerate() {
            points[1 + 4 * f + k] = point.into();
        }
    }
    points
}

/// A right hand's keypoints in O_W.
pub fn keypoints(geometry: &MasterGeometry, q: &[f64; 20]) -> Keypoints {
    Keypoints::new(points(geometry, q)).unwrap()
}

/// The same with noise of standard deviation `sigma` (m) on every coordinate.
pub fn noisy(keypoints: &Keypoints, noise: &mut Noise, sigma: f64) -> Keypoints {
    Keypoints::new(keypoints.points().map(|point| point.map(|x| x + noise.normal() * sigma))).unwrap()
}

/// The same after a rigid motion.
pub fn moved(keypoints: &Keypoints, rotation: &Rotation3<f64>, translation: Vector3<f64>) -> Keypoints {
    let points = keypoints.points().map(|point| (rotation * Vector3::from(point) + translation).into());
    Keypoints::new(points).unwrap()
}

/// The 400 frames of the real recording, or `None` where it is not at hand.
pub fn recorded() -> Option<Vec<Keypoints>> {
    let path = shared_data("human_hand_right.csv")?;
    let reader = RecordingReader::new(BufReader::new(File::open(path).unwrap()), LastLine::Whole).unwrap();
    let frames = reader.map(|frame| match frame.unwrap().data {
        FrameData::Keypoints(keypoints) => keypoints,
        FrameData::Joints(_) => panic!("a CSV recording holds keypoints"),
    });
    Some(frames.collect())
}
