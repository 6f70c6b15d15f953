//! Gestures: contacts, time lines, smoothness, and fingers that do not pass through one another.

use nalgebra::Vector3;
use proptest::prelude::*;
use teleop_common::hand::Finger;
use teleop_common::master::{FINGER_TAPS, Gesture, JOINT_LIMITS, MasterGeometry, MasterPose, OPEN, minimum_jerk};

const CONTACT: f64 = 1e-6;

fn pose(q: [f64; 20]) -> MasterPose {
    MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

fn delta(q: [f64; 20], finger: Finger) -> f64 {
    (pose(q).tip(Finger::Thumb) - pose(q).tip(finger)).norm()
}

#[test]
fn taps_close() {
    let taps = [
        (Gesture::TapIndex, Finger::Index),
        (Gesture::TapMiddle, Finger::Middle),
        (Gesture::TapRing, Finger::Ring),
        (Gesture::TapIndexClose, Finger::Index),
        (Gesture::TapMiddleClose, Finger::Middle),
        (Gesture::Pinch, Finger::Index),
    ];
    for (gesture, finger) in taps {
        let gap = delta(gesture.posture().unwrap(), finger);
        assert!(gap < CONTACT, "{gesture}: {gap}");
    }
    for gesture in [Gesture::TapIndex, Gesture::TapMiddle, Gesture::TapRing] {
        assert_eq!(gesture.sample(2.25), gesture.posture().unwrap(), "held from 2 to 2.5 s");
    }
    let tip = pose(Gesture::TapRing.posture().unwrap()).tip(Finger::Ring) * 1e3;
    assert!((tip - Vector3::new(-6.58, 57.82, 33.52)).norm() < 0.01, "{tip}");
}

#[test]
fn tripods_close_half_way_between_the_tips() {
    for gesture in [Gesture::Tripod, Gesture::TripodFig8] {
        let q = gesture.posture().unwrap();
        assert!((delta(q, Finger::Index) - 8e-3).abs() < CONTACT && (delta(q, Finger::Middle) - 8e-3).abs() < CONTACT);
    }
    for gesture in [Gesture::Tripod, Gesture::TripodClose] {
        let pose = pose(gesture.posture().unwrap());
        let middle = (pose.tip(Finger::Index) + pose.tip(Finger::Middle)) / 2.0;
        assert!((pose.tip(Finger::Thumb) - middle).norm() < CONTACT, "{gesture}");
    }
}

#[test]
fn comparison_runs_are_the_papers() {
    for gesture in FINGER_TAPS {
        assert!((gesture.duration() - 4.5).abs() < 1e-12);
        let end = gesture.posture().unwrap();
        for i in 0..=450 {
            let t = f64::from(i) * 0.01;
            let s = if t < 2.0 {
                minimum_jerk(t / 2.0)
            } else if t <= 2.5 {
                1.0
            } else {
                1.0 - minimum_jerk((t - 2.5) / 2.0)
            };
            for (joint, q) in gesture.sample(t).into_iter().enumerate() {
                assert!((q - (OPEN[joint] + s * (end[joint] - OPEN[joint]))).abs() < 1e-12, "{gesture} {t} {joint}");
            }
        }
    }
}

#[test]
fn fig8_time_line() {
    let gesture = Gesture::TripodFig8;
    assert!((gesture.duration() - 80.0).abs() < 1e-12);
    assert_eq!(gesture.sample(15.9), OPEN);
    assert_eq!(gesture.sample(40.0), gesture.posture().unwrap());
    for i in 0..400 {
        let t = f64::from(i) * 0.1;
        let (closing, opening) = (gesture.sample(t), gesture.sample(80.0 - t));
        for joint in 0..20 {
            assert!((closing[joint] - opening[joint]).abs() < 1e-9, "not mirrored about 40 s at {t}");
        }
    }
    // The gain of the index is half (delta 30 mm between radii of 20 and 40 mm) at 30.0 and 50.0 s, the middle's
    // at 30.8 and 49.2 s.
    let crossing = |finger| (160..360).map(|i| f64::from(i) * 0.1).find(|&t| delta(gesture.sample(t), finger) <= 30e-3);
    assert!((crossing(Finger::Index).unwrap() - 30.0).abs() < 0.11);
    assert!((crossing(Finger::Middle).unwrap() - 30.8).abs() < 0.11);
}

#[test]
#[allow(clippy::needless_range_loop, reason = "joints index four arrays")]
fn every_gesture_loops_smoothly_inside_the_limits() {
    const H: f64 = 1e-3;
    for gesture in Gesture::ALL {
        let duration = gesture.duration();
        assert_eq!(gesture.sample(0.0), OPEN);
        let steps = (duration / H) as usize;
        let (mut top_speed, mut top_acceleration) = (0f64, 0f64);
        let mut previous = gesture.sample(-H);
        let mut before = gesture.sample(-2.0 * H);
        // Through the seam, too.
        for i in 0..steps + 10 {
            let q = gesture.sample(i as f64 * H);
            for finger in Finger::ALL {
                for joint in 0..4 {
                    let (k, range) = (finger.index() * 4 + joint, JOINT_LIMITS[finger.index()][joint]);
                    assert!(
                        q[k] > range.min - 1e-6 && q[k] < range.max + 1e-6,
                        "{gesture} {finger:?} {joint} {}",
                        q[k]
                    );
                    top_speed = top_speed.max((q[k] - previous[k]).abs() / H);
                    top_acceleration = top_acceleration.max((q[k] - 2.0 * previous[k] + before[k]).abs() / (H * H));
                }
            }
            (before, previous) = (previous, q);
        }
        println!("{gesture:18} {duration:6.1} s, joint speed {top_speed:.2} rad/s, acceleration {top_acceleration:.1}");
        assert!(top_speed < 4.5, "{gesture} {top_speed}");
        assert!(top_acceleration < 30.0, "{gesture}: a jump of speed? {top_acceleration}");
    }
}

/// Distance between two segments, by dense sampling of one and projection on the other.
fn segment_distance(a: [Vector3<f64>; 2], b: [Vector3<f64>; 2]) -> f64 {
    let direction = b[1] - b[0];
    (0..=20)
        .map(|i| {
            let p = a[0] + (a[1] - a[0]) * (f64::from(i) / 20.0);
            let s = ((p - b[0]).dot(&direction) / direction.norm_squared()).clamp(0.0, 1.0);
            (p - b[0] - direction * s).norm()
        })
        .fold(f64::INFINITY, f64::min)
}

#[test]
fn thumb_does_not_pass_through_fingers() {
    // A finger is some 14 mm thick; the paradigmatic hand is small, so 11 mm between centre lines is touching.
    for gesture in [Gesture::Fist, Gesture::Count, Gesture::Wave] {
        let mut nearest = (f64::INFINITY, 0.0, Finger::Index);
        for i in 0..(gesture.duration() / 0.01) as usize {
            let t = i as f64 * 0.01;
            let pose = pose(gesture.sample(t));
            let points = |finger| pose.geometry.finger_points(finger, &pose.finger(finger));
            let thumb = points(Finger::Thumb);
            for &finger in &Finger::ALL[1..] {
                let other = points(finger);
                for (i, j) in (0..9).map(|k| (k / 3, k % 3)) {
                    let distance = segment_distance([thumb[i], thumb[i + 1]], [other[j], other[j + 1]]);
                    if distance < nearest.0 {
                        nearest = (distance, t, finger);
                    }
                }
            }
        }
        println!("{gesture}: nearest {nearest:?}");
        assert!(nearest.0 > 11e-3, "{gesture}: {nearest:?}");
    }
}

#[test]
fn tour_visits_every_posture() {
    let tour = Gesture::Tour;
    println!("tour lasts {:.1} s", tour.duration());
    for gesture in FINGER_TAPS.into_iter().chain([Gesture::Fist]) {
        let goal = gesture.posture().unwrap();
        let reached = (0..(tour.duration() * 50.0) as usize).any(|i| tour.sample(i as f64 / 50.0) == goal);
        assert!(reached, "{gesture}");
    }
}

#[test]
fn names_parse() {
    for gesture in Gesture::ALL {
        assert_eq!(Gesture::parse(gesture.name()), Ok(gesture));
        assert!(!gesture.description().is_empty() && gesture.duration() > 0.0);
    }
    let error = "thumbs_up".parse::<Gesture>().unwrap_err().to_string();
    assert!(error.contains("`thumbs_up`") && error.contains("tap_index") && error.contains("tour"), "{error}");
}

proptest! {
    #[test]
    fn any_time_gives_finite_angles(gesture in prop::sample::select(Gesture::ALL.to_vec()), t in any::<f64>()) {
        prop_assert!(gesture.sample(t).iter().all(|q| q.is_finite()));
    }
}
