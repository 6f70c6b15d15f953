//! Keypoints: validation, palm frame, and what is said of a wrong hand or a wrong frame.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod master_support;

use std::f64::consts::FRAC_PI_2;

use master_support::{Noise, keypoints, moved, noisy, points, recorded};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;
use teleop_common::hand::{Finger, HandSide};
use teleop_common::master::{
    Diagnosis, Gesture, Inspector, Keypoints, KeypointsError, MasterGeometry, OPEN, PalmFrame, SideVerdict,
};

const GEOMETRY: MasterGeometry = MasterGeometry::PARADIGMATIC;

fn open_points() -> [[f64; 3]; 21] {
    points(&GEOMETRY, &OPEN)
}

#[test]
fn refuses_what_is_no_hand_and_names_it() {
    assert!(Keypoints::new(open_points()).is_ok());

    let mut points = open_points();
    points[8][1] = f64::NAN;
    assert_eq!(Keypoints::new(points), Err(KeypointsError::NotFinite { name: "index_tip" }));

    let error = Keypoints::new(open_points().map(|point| point.map(|x| x * 1e3))).unwrap_err();
    assert!(error.to_string().contains("millimetres"), "{error}");
    let error = Keypoints::new(open_points().map(|point| point.map(|x| x * 1e2))).unwrap_err();
    assert!(error.to_string().contains("centimetres"), "{error}");

    let mut points = open_points();
    points[11] = points[12];
    let error = Keypoints::new(points).unwrap_err();
    assert!(matches!(error, KeypointsError::BoneLength { from: "middle_dip", to: "middle_tip", .. }), "{error}");

    let mut points = open_points();
    points[20][0] += 0.5;
    assert!(matches!(Keypoints::new(points), Err(KeypointsError::BoneLength { to: "pinky_tip", .. })));

    // All knuckles on the line from the wrist.
    let mut points = open_points();
    for finger in 1..5 {
        points[1 + 4 * finger][0] = 0.0;
    }
    assert!(matches!(Keypoints::new(points), Err(KeypointsError::FlatPalm { .. })));
    assert!(matches!(Keypoints::new([[0.0; 3]; 21]), Err(KeypointsError::PalmLength { .. })));
}

#[test]
fn palm_frame_of_the_flat_hand() {
    let palm = PalmFrame::estimate(&keypoints(&GEOMETRY, &OPEN));
    // From the wrist to the middle knuckle, which lies 8 mm to the thumb side.
    let distal = Vector3::new(8.0, 73.0, 0.0).normalize();
    assert!((palm.distal - distal).norm() < 1e-12);
    assert!((palm.normal - Vector3::z()).norm() < 1e-12);
    assert!((palm.radial - distal.cross(&Vector3::z())).norm() < 1e-12);
    let palmar = palm.to_hand(HandSide::Right, &Vector3::new(0.0, 0.0, 0.01));
    assert!((palmar - Vector3::new(0.0, 0.0, 0.01)).norm() < 1e-12);
    let dorsal_of_left = palm.to_hand(HandSide::Left, &Vector3::new(0.0, 0.0, 0.01));
    assert!((dorsal_of_left.z + 0.01).abs() < 1e-12);
}

fn inspect(frames: impl IntoIterator<Item = Keypoints>) -> Inspector {
    let mut inspector = Inspector::default();
    frames.into_iter().for_each(|frame| inspector.push(&frame));
    inspector
}

/// A second of the closing fist with tracker noise.
fn closing_fist() -> impl Iterator<Item = Keypoints> {
    let mut noise = Noise(7);
    (0..30).map(move |i| noisy(&keypoints(&GEOMETRY, &Gesture::Fist.sample(f64::from(i) / 30.0)), &mut noise, 3e-3))
}

#[test]
fn tells_right_from_left() {
    assert_eq!(inspect(closing_fist()).side(), SideVerdict::Hand(HandSide::Right));
    assert_eq!(inspect(closing_fist()).diagnose(HandSide::Right, false), None);
    let left = inspect(closing_fist().map(|frame| frame.mirrored()));
    assert_eq!(left.side(), SideVerdict::Hand(HandSide::Left));
    let diagnosis = left.diagnose(HandSide::Right, false).unwrap();
    assert!(matches!(diagnosis, Diagnosis::OtherHand { found: HandSide::Left, .. }));
    let text = diagnosis.to_string();
    assert!(
        text.starts_with("keypoints are those of a left hand (or of a mirrored image), expected a right"),
        "{text}"
    );
    assert_eq!(left.diagnose(HandSide::Left, false), None);
}

#[test]
fn a_straight_noisy_hand_decides_nothing() {
    for seed in 0..20 {
        let mut noise = Noise(seed);
        let mut inspector = Inspector::default();
        for frame in 0..1000 {
            inspector.push(&noisy(&keypoints(&GEOMETRY, &OPEN), &mut noise, 3e-3));
            assert_eq!(inspector.side(), SideVerdict::Undecided, "seed {seed} frame {frame}");
        }
    }
}

#[test]
fn notices_a_change_of_hands() {
    let mut inspector = inspect(closing_fist());
    let fist = keypoints(&GEOMETRY, &Gesture::Fist.posture().unwrap()).mirrored();
    let frames = (0..300).find(|_| {
        inspector.push(&fist);
        inspector.side() == SideVerdict::Hand(HandSide::Left)
    });
    assert!(frames.is_some_and(|n| n < 150), "{frames:?}");
}

/// O_W (radial, distal, palmar) to the recordings' frame (x palmar, y radial, z distal).
fn in_palm_frame(frame: Keypoints) -> Keypoints {
    let points = frame.points().map(|[radial, distal, palmar]| [palmar, radial, distal]);
    Keypoints::new(points).unwrap()
}

#[test]
fn names_the_turn_against_the_claimed_frame() {
    let axes = [(Vector3::x_axis(), "palmar"), (Vector3::y_axis(), "radial"), (Vector3::z_axis(), "distal")];
    for (axis, name) in axes {
        for degrees in [92f64, -60.0, 40.0] {
            let turn = Rotation3::from_axis_angle(&axis, degrees.to_radians());
            let Some(frames) = recorded() else { return };
            let inspector = inspect(frames.into_iter().take(200).map(|f| moved(&f, &turn, Vector3::zeros())));
            assert_eq!(inspector.diagnose(HandSide::Right, false), None, "no claim, nothing wrong");
            let Some(Diagnosis::Turned { angle, .. }) = inspector.diagnose(HandSide::Right, true) else {
                panic!("{name} {degrees} not seen")
            };
            assert!((angle.to_degrees() - degrees).abs() < 0.1, "{name} {degrees} {}", angle.to_degrees());
            let text = inspector.diagnose(HandSide::Right, true).unwrap().to_string();
            assert!(text.contains(&format!("about the {name} axis")), "{text}");
        }
    }
}

#[test]
fn the_true_frame_is_accepted() {
    assert_eq!(inspect(closing_fist().map(in_palm_frame)).diagnose(HandSide::Right, true), None);
    let swapped = inspect(closing_fist());
    assert!(matches!(swapped.diagnose(HandSide::Right, true), Some(Diagnosis::Turned { .. })), "O_W is another frame");
}

#[test]
fn the_recording_is_a_right_hand_in_its_palm_frame() {
    let Some(frames) = recorded() else { return };
    assert_eq!(frames.len(), 400);
    let inspector = inspect(frames.clone());
    assert_eq!(inspector.side(), SideVerdict::Hand(HandSide::Right));
    assert!(inspector.agreement() > 0.95);
    assert_eq!(inspector.diagnose(HandSide::Right, true), None);
    let decided = (0..400).find(|&n| inspect(frames[..n].iter().copied()).side() != SideVerdict::Undecided);
    println!("side known after {decided:?} frames");
    let worst = frames
        .iter()
        .map(|f| PalmFrame::estimate(f).rotation())
        .map(|r| Rotation3::from_matrix_unchecked(r).angle().to_degrees());
    println!("palm frame differs from the recorded one by at most {:.1} deg", worst.fold(0.0, f64::max));
    let mirrored = inspect(frames.iter().map(Keypoints::mirrored));
    assert_eq!(mirrored.side(), SideVerdict::Hand(HandSide::Left));
}

proptest! {
    #[test]
    fn garbage_never_panics(values in prop::collection::vec(any::<f64>(), 63)) {
        let mut points = [[0.0; 3]; 21];
        points.as_flattened_mut().copy_from_slice(&values);
        if let Ok(keypoints) = Keypoints::new(points) {
            prop_assert!(PalmFrame::estimate(&keypoints).origin.norm().is_finite());
        }
    }

    #[test]
    fn accepted_points_have_a_finite_orthonormal_palm(values in prop::collection::vec(-0.1f64..0.1, 63)) {
        let mut points = [[0.0; 3]; 21];
        points.as_flattened_mut().copy_from_slice(&values);
        if let Ok(keypoints) = Keypoints::new(points) {
            let r = PalmFrame::estimate(&keypoints).rotation();
            prop_assert!((r.transpose() * r - nalgebra::Matrix3::identity()).norm() < 1e-9);
            prop_assert!((r.determinant() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn palm_frame_moves_with_the_hand(
        axis in prop::array::uniform3(-FRAC_PI_2..FRAC_PI_2), t in prop::array::uniform3(-2.0f64..2.0), s in 0.0f64..5.0,
    ) {
        let hand = keypoints(&GEOMETRY, &Gesture::Fist.sample(s));
        let (turn, t) = (Rotation3::new(Vector3::from(axis)), Vector3::from(t));
        let other = moved(&hand, &turn, t);
        let (a, b) = (PalmFrame::estimate(&hand), PalmFrame::estimate(&other));
        for finger in Finger::ALL {
            let (p, q) = (hand.finger(finger)[3], other.finger(finger)[3]);
            prop_assert!((a.to_hand(HandSide::Right, &p) - b.to_hand(HandSide::Right, &q)).norm() < 1e-12);
        }
    }
}
