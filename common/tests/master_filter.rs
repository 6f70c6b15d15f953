//! The keypoint filter: exact hands pass, noise does not, pinches stay, at any frame rate.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod master_support;

use master_support::{Noise, keypoints, moved, noisy, recorded};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;
use teleop_common::hand::{Finger, HandSide};
use teleop_common::master::{
    Calibrator, Filter, FilterSettings, Fitter, Gesture, Keypoints, MasterGeometry, MasterPose,
};

const HAND: MasterGeometry = MasterGeometry::PARADIGMATIC;

struct Tracker {
    fitter: Fitter,
    filter: Filter,
}

impl Tracker {
    fn new(geometry: MasterGeometry, side: HandSide) -> Self {
        Self { fitter: Fitter::new(geometry, side), filter: Filter::new(geometry, FilterSettings::default()) }
    }

    /// Fitted and filtered angles.
    fn push(&mut self, dt: f64, keypoints: &Keypoints) -> (MasterPose, MasterPose) {
        let geometry = *self.fitter.geometry();
        let fitted = self.fitter.fit(keypoints).q;
        let q = self.filter.apply(dt, keypoints, &fitted);
        (MasterPose { q: fitted, geometry, tuning: None }, MasterPose { q, geometry, tuning: None })
    }
}

fn distance(pose: &MasterPose, finger: Finger) -> f64 {
    (pose.tip(finger) - pose.tip(Finger::Thumb)).norm()
}

/// Mean over the series of |second difference|.
fn jitter(series: &[[f64; 20]]) -> f64 {
    let second = |w: &[[f64; 20]]| (0..20).map(|j| (w[2][j] - 2.0 * w[1][j] + w[0][j]).abs()).sum::<f64>() / 20.0;
    series.windows(3).map(second).sum::<f64>() / (series.len() - 2) as f64
}

#[test]
fn exact_keypoints_pass_as_they_are_at_any_rate() {
    for rate in [20.0, 30.0, 60.0, 120.0] {
        for gesture in [Gesture::Tour, Gesture::Pinch] {
            let mut tracker = Tracker::new(HAND, HandSide::Right);
            let frames = (gesture.duration() * rate) as u32;
            for t in (0..frames).map(|frame| f64::from(frame) / rate) {
                let (fitted, filtered) = tracker.push(1.0 / rate, &keypoints(&HAND, &gesture.sample(t)));
                for finger in Finger::ALL {
                    let off = (filtered.tip(finger) - fitted.tip(finger)).norm();
                    assert!(off < 0.1e-3, "{gesture} at {t} s, {rate} Hz: {} off by {off} m", finger.name());
                }
            }
            assert!(tracker.filter.noise() < 1e-9, "{}", tracker.filter.noise());
        }
    }
}

#[test]
fn the_noise_is_measured_whatever_the_hand_does() {
    for (gesture, sigma) in [(Gesture::Open, 1e-3), (Gesture::Tour, 1e-3), (Gesture::Tour, 3e-3)] {
        let (mut tracker, mut noise) = (Tracker::new(HAND, HandSide::Right), Noise(7));
        for frame in 0..300 {
            let exact = keypoints(&HAND, &gesture.sample(f64::from(frame) / 60.0));
            tracker.push(1.0 / 60.0, &noisy(&exact, &mut noise, sigma));
        }
        let measured = tracker.filter.noise();
        assert!((0.8..1.2).contains(&(measured / sigma)), "{gesture}: measured {measured} m, is {sigma} m");
    }
}

#[test]
fn a_hand_at_rest_is_still_and_a_moving_one_is_followed() {
    for rate in [20.0, 30.0, 60.0, 120.0] {
        let mut noise = Noise(3);
        let mut run = |gesture: Gesture, seconds: f64| {
            let mut tracker = Tracker::new(HAND, HandSide::Right);
            let frames = (seconds * rate) as u32;
            let poses = (0..frames).map(|frame| {
                let exact = keypoints(&HAND, &gesture.sample(f64::from(frame) / rate));
                tracker.push(1.0 / rate, &noisy(&exact, &mut noise, 0.3e-3))
            });
            poses.collect::<Vec<_>>().split_off((rate * 0.5) as usize)
        };
        let still = run(Gesture::Open, 4.0);
        let series = |pick: fn(&(MasterPose, MasterPose)) -> [f64; 20]| still.iter().map(pick).collect::<Vec<_>>();
        let (raw, filtered) = (jitter(&series(|poses| poses.0.q)), jitter(&series(|poses| poses.1.q)));
        assert!(filtered < 0.15 * raw, "{rate} Hz: {raw} to {filtered} rad per frame^2");

        // Lag: the delay that explains the filtered distances best.
        let fist = run(Gesture::Fist, Gesture::Fist.duration());
        let start = (rate * 0.5).floor() / rate;
        let error = |delay: f64| -> f64 {
            let truth = |frame: usize, finger| {
                let q = Gesture::Fist.sample((start + frame as f64 / rate - delay).max(0.0));
                MasterPose { q, geometry: HAND, tuning: None }.tip(finger)
            };
            let off = |(frame, poses): (usize, &(MasterPose, MasterPose))| {
                (poses.1.tip(Finger::Index) - truth(frame, Finger::Index)).norm_squared()
            };
            fist.iter().enumerate().map(off).sum()
        };
        let best = (0..100).map(|k| f64::from(k) * 2e-3).min_by(|a, b| error(*a).total_cmp(&error(*b))).unwrap();
        println!("{rate} Hz: at rest {:.1} to {:.2} mrad, lag {:.0} ms", raw * 1e3, filtered * 1e3, best * 1e3);
        assert!(best <= 0.075, "{rate} Hz: {best} s late");
    }
}

#[test]
fn a_spike_of_one_frame_is_not_followed_and_a_step_is() {
    let mut noise = Noise(5);
    let straight = keypoints(&HAND, &Gesture::Open.sample(0.0));
    let bent = keypoints(&HAND, &Gesture::Wave.sample(1.9));
    let dt = 1.0 / 30.0;
    let mut tracker = Tracker::new(HAND, HandSide::Right);
    let mut before = straight_tip(&mut tracker, &straight, &mut noise, dt);
    let far =
        (MasterPose { q: Gesture::Wave.sample(1.9), geometry: HAND, tuning: None }.tip(Finger::Middle) - before).norm();
    let (_, spike) = tracker.push(dt, &noisy(&bent, &mut noise, 1e-3));
    let followed = (spike.tip(Finger::Middle) - before).norm() / far;
    assert!(followed < 0.2, "a spike is followed by {followed} of its height");
    before = straight_tip(&mut tracker, &straight, &mut noise, dt);
    for frame in 0..5 {
        let (_, pose) = tracker.push(dt, &noisy(&bent, &mut noise, 1e-3));
        if frame == 4 {
            let followed = (pose.tip(Finger::Middle) - before).norm() / far;
            assert!(followed > 0.8, "a step is followed by {followed} of its height after 5 frames");
        }
    }
}

/// The middle fingertip after two seconds of rest.
fn straight_tip(tracker: &mut Tracker, straight: &Keypoints, noise: &mut Noise, dt: f64) -> Vector3<f64> {
    (0..60).map(|_| tracker.push(dt, &noisy(straight, noise, 1e-3)).1.tip(Finger::Middle)).last().unwrap()
}

#[test]
fn every_pinch_of_the_recording_is_kept() {
    let Some(recording) = recorded() else { return };
    for side in [HandSide::Right, HandSide::Left] {
        let frames: Vec<Keypoints> =
            recording.iter().map(|k| if side == HandSide::Left { k.mirrored() } else { *k }).collect();
        let mut calibrator = Calibrator::default();
        frames.iter().for_each(|frame| calibrator.push(frame));
        let calibration = calibrator.finish().unwrap();
        assert_eq!(calibration.side, side);
        let mut tracker = Tracker::new(calibration.geometry, side);
        let (mut pinches, mut raw, mut smooth) = (0, Vec::new(), Vec::new());
        for frame in &frames {
            let (fitted, filtered) = tracker.push(1.0 / 30.0, frame);
            for finger in &Finger::ALL[1..] {
                let measured = distance(&fitted, *finger);
                if measured < FilterSettings::default().near {
                    let wider = distance(&filtered, *finger) - measured;
                    assert!(wider < 2e-3, "{}: {wider} m wider than measured {measured} m", finger.name());
                    pinches += 1;
                }
            }
            raw.push(fitted.q);
            smooth.push(filtered.q);
        }
        assert!(pinches > 30, "{pinches}");
        let (raw, smooth) = (jitter(&raw), jitter(&smooth));
        println!("{}: {pinches} pinches, second difference {:.1} to {:.1} mrad", side.name(), raw * 1e3, smooth * 1e3);
        assert!(smooth < 0.3 * raw, "{raw} to {smooth}");
    }
}

#[test]
fn a_gap_starts_anew_and_no_time_changes_nothing() {
    let mut noise = Noise(11);
    let mut tracker = Tracker::new(HAND, HandSide::Right);
    let frame = |t: f64, noise: &mut Noise| noisy(&keypoints(&HAND, &Gesture::Fist.sample(t)), noise, 1e-3);
    for k in 0..60 {
        tracker.push(0.02, &frame(0.02 * f64::from(k), &mut noise));
    }
    let (_, last) = tracker.push(0.02, &frame(1.2, &mut noise));
    for dt in [0.0, -1.0, f64::NAN] {
        assert_eq!(tracker.push(dt, &frame(2.0, &mut noise)).1.q, last.q, "dt {dt}");
    }
    for dt in [0.31, f64::INFINITY] {
        let (fitted, filtered) = tracker.push(dt, &frame(2.0, &mut noise));
        assert_eq!(fitted.q, filtered.q, "dt {dt}");
        tracker.push(0.02, &frame(1.0, &mut noise));
    }
    tracker.filter.reset();
    let (fitted, filtered) = tracker.push(0.02, &frame(2.0, &mut noise));
    assert_eq!(fitted.q, filtered.q);
}

proptest! {
    #[test]
    fn it_does_not_depend_on_the_frame_of_the_keypoints_nor_on_the_hand_moving(
        axis in prop::array::uniform3(-1.0..1.0_f64), turn in -0.2..0.2_f64, seed: u64,
    ) {
        let axis = nalgebra::UnitVector3::try_new(Vector3::from(axis), 0.1);
        prop_assume!(axis.is_some());
        let (mut still, mut moving) = (Tracker::new(HAND, HandSide::Right), Tracker::new(HAND, HandSide::Right));
        let mut noise = Noise(seed);
        for k in 0..40 {
            let exact = keypoints(&HAND, &Gesture::Pinch.sample(f64::from(k) / 30.0));
            let frame = noisy(&exact, &mut noise, 1e-3);
            let rotation = Rotation3::from_axis_angle(&axis.unwrap(), turn * f64::from(k));
            let elsewhere = moved(&frame, &rotation, Vector3::new(0.02 * f64::from(k), 0.3, -1.0));
            let (a, b) = (still.push(1.0 / 30.0, &frame).1, moving.push(1.0 / 30.0, &elsewhere).1);
            for finger in Finger::ALL {
                let off = (a.tip(finger) - b.tip(finger)).norm();
                prop_assert!(off < 1e-4, "frame {}: {} m", k, off);
            }
        }
    }

    #[test]
    fn any_times_give_finite_angles_near_the_measured_ones(
        steps in prop::collection::vec((prop_oneof![0.0..0.1_f64, Just(1e-9), Just(0.5), Just(f64::NAN)], 0.0..8.0_f64), 1..60),
        sigma in prop_oneof![Just(0.0), 1e-6..5e-3_f64],
    ) {
        let (mut tracker, mut noise) = (Tracker::new(HAND, HandSide::Right), Noise(1));
        for (dt, t) in steps {
            let frame = noisy(&keypoints(&HAND, &Gesture::Fist.sample(t)), &mut noise, sigma);
            let (_, filtered) = tracker.push(dt, &frame);
            prop_assert!(filtered.q.iter().all(|q| q.abs() < 6.0), "{:?}", filtered.q);
        }
    }
}
