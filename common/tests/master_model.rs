//! The paradigmatic hand: closed forms against the Denavit-Hartenberg product, derivatives, validation.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Matrix4, Vector3};
use proptest::prelude::*;
use teleop_common::hand::Finger;
use teleop_common::master::{JOINT_LIMITS, MasterError, MasterGeometry, MasterPose};

/// One row of SynGrasp's table: Rz(theta) Tx(a) Rx(alpha); all d are 0.
fn denavit_hartenberg(alpha: f64, a: f64, theta: f64) -> Matrix4<f64> {
    let (s, c) = theta.sin_cos();
    let (sa, ca) = alpha.sin_cos();
    Matrix4::new(
        c,
        -s * ca,
        s * sa,
        a * c, //
        s,
        c * ca,
        -c * sa,
        a * s, //
        0.0,
        sa,
        ca,
        0.0, //
        0.0,
        0.0,
        0.0,
        1.0,
    )
}

fn points_by_product(geometry: &MasterGeometry, finger: Finger, q: &[f64; 4]) -> [Vector3<f64>; 4] {
    let base = geometry.bases[finger.index()];
    let [a1, a2, a3] = geometry.phalanges[finger.index()];
    // x_b distal, y_b radial, z_b dorsal, written in O_W.
    #[rustfmt::skip]
    let mut transform = Matrix4::new(
        0.0, 1.0, 0.0, base[0],
        1.0, 0.0, 0.0, base[1],
        0.0, 0.0, -1.0, base[2],
        0.0, 0.0, 0.0, 1.0,
    );
    let alpha3 = if finger == Finger::Thumb { FRAC_PI_2 } else { 0.0 };
    let rows = [(-FRAC_PI_2, 0.0), (0.0, a1), (alpha3, a2), (0.0, a3)];
    std::array::from_fn(|k| {
        transform *= denavit_hartenberg(rows[k].0, rows[k].1, q[k]);
        transform.fixed_view::<3, 1>(0, 3).into_owned()
    })
}

fn finger() -> impl Strategy<Value = Finger> {
    prop::sample::select(Finger::ALL.to_vec())
}

fn angles() -> impl Strategy<Value = [f64; 4]> {
    prop::array::uniform4(-PI..PI)
}

proptest! {
    #[test]
    fn closed_form_is_the_product(finger in finger(), q in angles()) {
        let geometry = MasterGeometry::PARADIGMATIC;
        let closed = geometry.finger_points(finger, &q);
        for (a, b) in closed.iter().zip(points_by_product(&geometry, finger, &q)) {
            prop_assert!((a - b).norm() < 1e-15, "{a} {b}");
        }
    }

    #[test]
    fn jacobian_is_the_derivative(finger in finger(), q in angles()) {
        let geometry = MasterGeometry::PARADIGMATIC;
        let (points, jacobian) = geometry.finger_jacobian(finger, &q);
        prop_assert_eq!(points, geometry.finger_points(finger, &q));
        const H: f64 = 1e-5;
        for joint in 0..4 {
            let shifted = |h: f64| {
                let mut q = q;
                q[joint] += h;
                geometry.finger_points(finger, &q)
            };
            let (plus, minus) = (shifted(H), shifted(-H));
            for point in 1..4 {
                let numeric = (plus[point] - minus[point]) / (2.0 * H);
                let analytic = jacobian.fixed_view::<3, 1>((point - 1) * 3, joint);
                prop_assert!((numeric - analytic).norm() < 1e-10, "{finger:?} {joint} {point}");
            }
        }
    }

    #[test]
    fn validation_never_panics(q in prop::collection::vec(any::<f64>(), 20), x in any::<f64>(), a in any::<f64>()) {
        let mut pose = MasterPose { q: [0.0; 20], geometry: MasterGeometry::PARADIGMATIC, tuning: None };
        pose.q.copy_from_slice(&q);
        pose.geometry.bases[1][0] = x;
        pose.geometry.phalanges[4][2] = a;
        let _ = pose.validate();
    }
}

#[test]
fn spot_values() {
    let tip = |finger, q: [f64; 4]| MasterGeometry::PARADIGMATIC.finger_points(finger, &q)[3] * 1e3;
    let cases = [
        (Finger::Index, [0.0; 4], [24.0, 155.0, 0.0]),
        (Finger::Index, [0.0, FRAC_PI_2, 0.0, 0.0], [24.0, 73.0, 82.0]),
        (Finger::Thumb, [FRAC_PI_2, 0.0, 0.0, 0.0], [97.0, 45.0, 0.0]),
        (Finger::Thumb, [0.0; 4], [37.0, 105.0, 0.0]),
        (Finger::Thumb, [PI, 0.0, 0.0, 0.0], [37.0, -15.0, 0.0]),
        (Finger::Thumb, [FRAC_PI_2, FRAC_PI_2, 0.0, 0.0], [37.0, 45.0, 60.0]),
        (Finger::Middle, [0.0; 4], [8.0, 165.0, 0.0]),
        (Finger::Ring, [0.0; 4], [-8.0, 155.0, 0.0]),
        (Finger::Little, [0.0; 4], [-24.0, 135.0, 0.0]),
    ];
    for (finger, q, expected) in cases {
        assert!((tip(finger, q) - Vector3::from(expected)).norm() < 1e-12, "{finger:?} {q:?}");
    }
}

#[test]
fn signs_of_the_joints() {
    let tip = |finger, q: [f64; 4]| MasterGeometry::PARADIGMATIC.finger_points(finger, &q)[3];
    for finger in [Finger::Index, Finger::Middle, Finger::Ring, Finger::Little] {
        let straight = tip(finger, [0.0; 4]);
        assert!(tip(finger, [0.1, 0.0, 0.0, 0.0]).x > straight.x, "abduction is positive to the thumb side");
        for joint in 1..4 {
            let mut q = [0.0; 4];
            q[joint] = 0.1;
            assert!(tip(finger, q).z > 0.0, "flexion is positive towards the palm");
        }
    }
}

#[test]
fn limits_hold_the_open_hand_and_are_ordered() {
    for finger in Finger::ALL {
        for (joint, range) in JOINT_LIMITS[finger.index()].iter().enumerate() {
            let open = if finger == Finger::Thumb && joint == 0 { FRAC_PI_2 } else { 0.0 };
            assert!(range.min < range.max && range.contains(open));
        }
    }
    assert!((JOINT_LIMITS[0][3].min + 70f64.to_radians()).abs() < 1e-15);
    assert!((JOINT_LIMITS[0][3].max - 70f64.to_radians()).abs() < 1e-15);
}

#[test]
fn validation_names_what_is_wrong() {
    let good = MasterPose { q: [0.0; 20], geometry: MasterGeometry::PARADIGMATIC, tuning: None };
    assert_eq!(good.validate(), Ok(()));

    let mut pose = good;
    pose.q[6] = f64::NAN;
    assert!(matches!(pose.validate(), Err(MasterError::Angle { finger: Finger::Index, joint: 2, .. })));
    pose.q[6] = 7.0;
    assert_eq!(
        pose.validate().unwrap_err().to_string(),
        "joint 2 of the index is 7 rad; angles are finite and within +-2 pi"
    );

    let mut pose = good;
    pose.geometry.phalanges[0][1] = 20.0;
    assert!(matches!(pose.validate(), Err(MasterError::Phalanx { finger: Finger::Thumb, phalanx: 1, .. })));
    pose.geometry.phalanges[0][1] = f64::NAN;
    assert!(matches!(pose.validate(), Err(MasterError::Phalanx { finger: Finger::Thumb, phalanx: 1, .. })));

    let mut pose = good;
    pose.geometry.bases[3] = [0.0, f64::INFINITY, 0.0];
    assert!(matches!(pose.validate(), Err(MasterError::Base { finger: Finger::Ring, .. })));

    let mut pose = good;
    pose.geometry.bases.swap(1, 4);
    assert!(matches!(pose.validate(), Err(MasterError::BaseOrder { finger: Finger::Index, .. })));
}
