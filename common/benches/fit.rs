//! Time of one fit of a whole hand: synthetic keypoints of the gesture tour with tracker noise, and the same
//! without a last posture; then the real recording, where it is at hand, without and with the filter.
//! `cargo bench -p teleop-common --bench fit`.
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs, reason = "a bench reports on the terminal")]

mod report;

use std::fs::File;
use std::hint::black_box;
use std::io::BufReader;

use nalgebra::Vector3;
use report::report;
use teleop_common::hand::{Finger, HandSide};
use teleop_common::master::{Calibrator, Filter, FilterSettings, Fitter, Gesture, Keypoints, MasterGeometry};
use teleop_common::recording::{FrameData, LastLine, RecordingReader};
use teleop_common::testing::shared_data;

/// Standard deviation of the noise, m.
const NOISE: f64 = 3e-3;
const FRAMES: usize = 20_000;

fn main() {
    let frames: Vec<Keypoints> = frames();
    let geometry = MasterGeometry::PARADIGMATIC;
    let mut fitter = Fitter::new(geometry, HandSide::Right);
    report("fit, warm", &frames, |frame| {
        black_box(fitter.fit(frame));
    });
    report("fit, cold", &frames, |frame| {
        let mut fitter = Fitter::new(geometry, HandSide::Right);
        black_box(fitter.fit(frame));
    });
    let Some(path) = shared_data("human_hand_right.csv") else { return };
    let reader = RecordingReader::new(BufReader::new(File::open(path).unwrap()), LastLine::Whole).unwrap();
    let frames: Vec<Keypoints> = reader
        .filter_map(|frame| match frame.unwrap().data {
            FrameData::Keypoints(keypoints) => Some(keypoints),
            FrameData::Joints(_) => None,
        })
        .collect();
    let mut calibrator = Calibrator::default();
    frames.iter().for_each(|frame| calibrator.push(frame));
    let calibration = calibrator.finish().unwrap();
    let mut fitter = Fitter::new(calibration.geometry, calibration.side);
    let repeated: Vec<Keypoints> = frames.iter().copied().cycle().take(FRAMES).collect();
    report("recording", &repeated, |frame| {
        black_box(fitter.fit(frame));
    });
    let mut filter = Filter::new(calibration.geometry, FilterSettings::default());
    report("filtered", &repeated, |frame| {
        let fitted = fitter.fit(frame).q;
        black_box(filter.apply(1.0 / 30.0, frame, &fitted));
    });
}

fn frames() -> Vec<Keypoints> {
    let geometry = MasterGeometry::PARADIGMATIC;
    let tour = Gesture::Tour;
    let mut noise = Noise(1);
    (0..FRAMES)
        .filter_map(|i| {
            let q = tour.sample(tour.duration() * i as f64 / FRAMES as f64);
            let mut points = [[0.0; 3]; 21];
            for finger in Finger::ALL {
                let f = finger.index();
                let angles = [q[4 * f], q[4 * f + 1], q[4 * f + 2], q[4 * f + 3]];
                for (k, point) in geometry.finger_points(finger, &angles).into_iter().enumerate() {
                    points[1 + 4 * f + k] = (point + noise.vector() * NOISE).into();
                }
            }
            Keypoints::new(points).ok()
        })
        .collect()
}

/// Normal numbers from a splitmix64 generator: the same on every run.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn vector(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0)
    }
}
