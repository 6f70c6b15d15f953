//! The Allegro Hand V4 as compiled in: figures, kinematics, joint maps, shapes.

use std::sync::LazyLock;

use nalgebra::{Isometry3, Matrix3, Vector3};
use proptest::prelude::*;
use teleop_common::hand::{
    Finger, FingerChain, HandModel, HandSide, JointVector, Shape, TipFrame, TipJacobian, allegro_v4_texts,
};
use teleop_common::testing::shared_data;

const SIDES: [HandSide; 2] = [HandSide::Right, HandSide::Left];
/// Right, left.
static HANDS: LazyLock<[HandModel; 2]> = LazyLock::new(|| SIDES.map(HandModel::allegro_v4));
/// Joints 0-3 of a finger, then the thumb's.
const LIMITS: [[(f64, f64); 4]; 2] = [
    [(-0.47, 0.47), (-0.196, 1.61), (-0.174, 1.709), (-0.227, 1.618)],
    [(0.263, 1.396), (-0.105, 1.163), (-0.189, 1.644), (-0.162, 1.719)],
];
/// Vendor's home posture, degrees.
const HOME: [f64; 16] = [0., -10., 45., 45., 0., -10., 45., 45., 5., -5., 50., 45., 60., 25., 15., 45.];

fn finger(hand: &HandModel, finger: Finger) -> &FingerChain {
    hand.fingers.iter().find(|chain| chain.finger == finger).expect("the hand has this finger")
}

fn tip(hand: &HandModel, name: Finger, q: &[f64], frame: TipFrame) -> Vector3<f64> {
    let chain = finger(hand, name);
    chain.tip(&chain.select(q), frame)
}

#[track_caller]
fn assert_near(actual: Vector3<f64>, expected: [f64; 3], tolerance: f64) {
    let error = (actual - Vector3::from(expected)).amax();
    assert!(error <= tolerance, "{actual} is {error:e} m from {expected:?}");
}

#[test]
fn both_hands_load_with_the_published_limits() {
    for side in SIDES {
        let (urdf, description) = allegro_v4_texts(side);
        let hand = HandModel::load(urdf, description).unwrap();
        assert_eq!(hand.side, side);
        assert_eq!(hand.name, format!("allegro-v4-{}", side.name()));
        assert!(hand.warnings.is_empty(), "{:?}", hand.warnings);
        assert_eq!(hand.joints.len(), 16);
        for (index, joint) in hand.joints.iter().enumerate() {
            assert_eq!(joint.name, format!("joint_{index}.0"));
            assert_eq!((joint.lower, joint.upper), LIMITS[index / 12][index % 4], "{}", joint.name);
            assert_eq!(joint.velocity, 7.0);
            let roll = index % 4 == 0 && index < 12;
            let home = if roll && side == HandSide::Left { -HOME[index] } else { HOME[index] };
            assert!((joint.home - home.to_radians()).abs() < 1e-6, "{}", joint.name);
        }
        let order: Vec<_> = hand.fingers.iter().map(|chain| chain.finger).collect();
        assert_eq!(order, [Finger::Thumb, Finger::Index, Finger::Middle, Finger::Ring]);
        for (chain, first) in hand.fingers.iter().zip([12, 0, 4, 8]) {
            let joints: Vec<_> = chain.joints.iter().map(|joint| joint.joint).collect();
            assert_eq!(joints, (first..first + 4).collect::<Vec<_>>());
            let length = if chain.finger == Finger::Thumb { 0.162 } else { 0.130 };
            assert!((chain.length - length).abs() < 1e-12);
        }
    }
}

#[test]
fn pole_is_the_radius_of_the_fingertip_past_its_centre() {
    for side in SIDES {
        for chain in HandModel::allegro_v4(side).fingers {
            assert_near(chain.pole - chain.center, [0.0, 0.0, 0.012], 1e-15);
            let distal = if chain.finger == Finger::Thumb { 0.0423 } else { 0.0267 };
            assert_near(chain.center, [0.0, 0.0, distal], 1e-15);
        }
    }
}

/// Sphere centres in the palm frame (m), index, middle, ring, thumb: Pinocchio on the vendor's URDFs, to 1e-6 m.
#[test]
fn forward_kinematics_has_the_published_spot_values() {
    type Tips = [[f64; 3]; 4];
    let postures: [(&str, Tips, Tips); 5] = [
        (
            "zero",
            [[0., 0.055310, 0.133442], [0., 0., 0.136200], [0., -0.055310, 0.133442], [-0.013200, 0.167704, -0.086071]],
            [
                [0., -0.055310, 0.133442],
                [0., 0., 0.136200],
                [0., 0.055310, 0.133442],
                [-0.013200, -0.167704, -0.086071],
            ],
        ),
        (
            "home",
            [
                [0.038943, 0.052710, 0.103727],
                [0.038943, 0., 0.106371],
                [0.048959, -0.047717, 0.095808],
                [0.106048, 0.062359, -0.031424],
            ],
            [
                [0.038943, -0.052710, 0.103727],
                [0.038943, 0., 0.106371],
                [0.048959, 0.056251, 0.095062],
                [0.106048, -0.062359, -0.031424],
            ],
        ),
        (
            "middle",
            [
                [0.095347, 0.047517, 0.044373],
                [0.095347, 0., 0.046791],
                [0.095347, -0.047517, 0.044373],
                [0.084029, 0.057136, -0.010195],
            ],
            [
                [0.095347, -0.047517, 0.044373],
                [0.095347, 0., 0.046791],
                [0.095347, 0.047517, 0.044373],
                [0.084029, -0.057136, -0.010195],
            ],
        ),
        (
            "lower",
            [
                [-0.035139, 0.072372, 0.123667],
                [-0.035139, 0.017849, 0.127949],
                [-0.035139, -0.036809, 0.126778],
                [0.027504, 0.155110, -0.109129],
            ],
            [
                [-0.035139, -0.036809, 0.126778],
                [-0.035139, 0.017849, 0.127949],
                [-0.035139, 0.072372, 0.123667],
                [0.027504, -0.155110, -0.109129],
            ],
        ),
        (
            "upper",
            [
                [0.018859, 0.051512, -0.019877],
                [0.018859, 0.009580, -0.016867],
                [0.018859, -0.032426, -0.018207],
                [0.001752, -0.022096, -0.052756],
            ],
            [
                [0.018859, -0.032426, -0.018207],
                [0.018859, 0.009580, -0.016867],
                [0.018859, 0.051512, -0.019877],
                [0.001752, 0.022096, -0.052756],
            ],
        ),
    ];
    for (name, right, left) in postures {
        for (side, tips) in [(HandSide::Right, right), (HandSide::Left, left)] {
            let hand = HandModel::allegro_v4(side);
            let q: Vec<f64> = hand
                .joints
                .iter()
                .zip(HOME)
                .map(|(joint, home)| match name {
                    "home" => home.to_radians(),
                    "middle" => f64::midpoint(joint.lower, joint.upper),
                    "lower" => joint.lower,
                    "upper" => joint.upper,
                    _ => 0.0,
                })
                .collect();
            for (which, expected) in [Finger::Index, Finger::Middle, Finger::Ring, Finger::Thumb].into_iter().zip(tips)
            {
                assert_near(tip(&hand, which, &q, TipFrame::Center), expected, 0.6e-6);
            }
        }
    }
}

#[test]
fn anatomical_frame_and_finger_bases_are_where_the_mapping_expects_them() {
    for side in SIDES {
        let hand = HandModel::allegro_v4(side);
        // The same in O_SW for either hand: that is what the frame is for.
        let knuckle = 0.0435 + 0.0164 * 5_f64.to_radians().sin();
        assert_near(finger(&hand, Finger::Index).base, [0.044929354, 0.014795593, 0.0], 1e-9);
        assert_near(finger(&hand, Finger::Middle).base, [0.0, 0.0171, 0.0], 1e-12);
        assert_near(finger(&hand, Finger::Ring).base, [-0.044929354, 0.014795593, 0.0], 1e-9);
        assert_near(finger(&hand, Finger::Thumb).base, [0.019333, -0.045987, -0.0182], 1e-12);
        assert!((finger(&hand, Finger::Index).base.x - knuckle).abs() < 1e-11);

        let zero = [0.0; 16];
        let (sin, cos) = 5_f64.to_radians().sin_cos();
        let index = hand.anatomical_from_palm * tip(&hand, Finger::Index, &zero, TipFrame::Pole);
        assert_near(index, [0.0435 + 0.1475 * sin, -0.001542 + 0.1475 * cos, 0.0], 1e-11);
        let middle = hand.anatomical_from_palm * tip(&hand, Finger::Middle, &zero, TipFrame::Pole);
        assert_near(middle, [0.0, 0.1482, 0.0], 1e-12);

        let expected = if side == HandSide::Right { 1.0 } else { -1.0 };
        assert_eq!(hand.anatomical_from_palm.determinant(), expected);
    }
}

#[test]
fn kinematics_agree_with_the_recorded_cases_of_the_vendors_urdf() {
    let Some(path) = shared_data("allegro_fk_golden.json") else { return };
    let golden: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let numbers = |value: &serde_json::Value| -> Vec<f64> {
        value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
    };
    let tips = ["link_3.0_tip", "link_7.0_tip", "link_11.0_tip", "link_15.0_tip"];
    for side in SIDES {
        let hand = HandModel::allegro_v4(side);
        let cases = golden["hands"][side.name()]["cases"].as_array().unwrap();
        assert_eq!(cases.len(), 100);
        let mut worst = [0.0_f64; 3];
        let mut poses = Vec::new();
        for case in cases {
            let q = numbers(&case["q"]);
            hand.link_poses(&q, &mut poses);
            for (slot, name) in [Finger::Index, Finger::Middle, Finger::Ring, Finger::Thumb].into_iter().enumerate() {
                let chain = finger(&hand, name);
                let (position, jacobian) = chain.tip_and_jacobian(&chain.select(&q), TipFrame::Center);
                let expected = Vector3::from_vec(numbers(&case["tip_xyz"][slot]));
                worst[0] = worst[0].max((position - expected).amax());
                let expected = nalgebra::Matrix3x4::from_row_slice(&numbers(&case["J_lin_3x4_rowmajor"][slot]));
                worst[1] = worst[1].max((jacobian.fixed_columns::<4>(0) - expected).amax());
                let expected = Matrix3::from_row_slice(&numbers(&case["tip_R_rowmajor"][slot]));
                let pose = &poses[hand.link(tips[slot]).unwrap()];
                worst[2] = worst[2].max((pose.rotation.to_rotation_matrix().matrix() - expected).amax());
            }
        }
        println!(
            "{}: position {:.1e} m, Jacobian {:.1e} m/rad, rotation {:.1e}",
            side.name(),
            worst[0],
            worst[1],
            worst[2]
        );
        assert!(worst.iter().all(|error| *error <= 1e-9), "{}: {worst:?}", side.name());
    }
}

#[test]
fn joint_maps_have_the_hand_computed_values() {
    use std::f64::consts::{FRAC_PI_2, PI};
    let mut master = [0.0; 20];
    for (index, angle) in master.iter_mut().enumerate() {
        *angle = 0.01 * (index + 1) as f64;
    }
    // Thumb turned by 2.0, lifted by 1.5, bent by 0.4 and 0.1; index spread by 0.05.
    master[..5].copy_from_slice(&[2.0, 1.5, 0.4, 0.1, 0.05]);
    let beyond = 1.5 - 1.396;
    let thumbs = [
        ("index", [2.0, 1.5, 0.4, 0.1]),
        ("role", [1.5, PI - 2.0, 0.4, 0.1]),
        ("carry", [1.5, PI - 2.0, 0.4 + beyond, 0.1]),
        ("split", [1.5, PI - 2.0, (0.4 + beyond) / 2.0, (0.4 + beyond) / 2.0 + 0.1]),
    ];
    for side in SIDES {
        let hand = HandModel::allegro_v4(side);
        assert_eq!(hand.joint_maps.len(), 4);
        for (name, thumb) in thumbs {
            let q = hand.joint_map(name).unwrap().apply(&master);
            let mut expected: Vec<f64> = master[4..16].to_vec();
            if side == HandSide::Left {
                [0, 4, 8].into_iter().for_each(|roll| expected[roll] = -expected[roll]);
            }
            expected.extend(thumb);
            for (actual, expected) in q.iter().zip(&expected) {
                assert!((actual - expected).abs() < 1e-15, "{name}: {q:?} instead of {expected:?}");
            }
        }
        // Open hand: thumb sideways, the rest straight. Below the threshold nothing is carried over.
        master[..4].copy_from_slice(&[FRAC_PI_2, 0.0, 0.0, 0.0]);
        let open = hand.joint_map("split").unwrap().apply(&master);
        assert!((open[13] - FRAC_PI_2).abs() < 1e-15 && open[12] == 0.0 && open[14] == 0.0 && open[15] == 0.0);
        master[..4].copy_from_slice(&[2.0, 1.5, 0.4, 0.1]);
        assert_eq!(hand.joint_map("nonsense").map(|map| &map.name), None);
    }
}

#[test]
fn masses_and_inertias_are_those_of_the_solid_shapes() {
    use urdf_rs::Geometry;
    for side in SIDES {
        let robot = urdf_rs::read_from_string(allegro_v4_texts(side).0).unwrap();
        let total: f64 = robot.links.iter().map(|link| link.inertial.mass.value).sum();
        assert!((total - 0.9549).abs() < 1e-9, "{total} kg");
        for link in robot.links.iter().filter(|link| !link.name.ends_with("_pole")) {
            let [collision] = link.collision.as_slice() else { panic!("{}: one collision shape", link.name) };
            assert_eq!(link.inertial.origin.xyz, collision.origin.xyz, "{}", link.name);
            assert_eq!(*collision.origin.rpy, [0.0; 3], "{}", link.name);
            let mass = link.inertial.mass.value;
            let expected = match &collision.geometry {
                Geometry::Box { size } => {
                    let [x, y, z] = size.map(|edge| mass / 12.0 * edge * edge);
                    [y + z, x + z, x + y]
                }
                Geometry::Sphere { radius } => [0.4 * mass * radius * radius; 3],
                other => panic!("{}: {other:?}", link.name),
            };
            let inertia = &link.inertial.inertia;
            for (actual, expected) in [inertia.ixx, inertia.iyy, inertia.izz].into_iter().zip(expected) {
                assert!((actual / expected - 1.0).abs() < 1e-6, "{}: {actual} instead of {expected}", link.name);
            }
            assert_eq!([inertia.ixy, inertia.ixz, inertia.iyz], [0.0; 3], "{}", link.name);
        }
    }
}

#[test]
fn every_link_is_drawn_and_the_left_hand_mirrors_the_right() {
    let [right, left] = SIDES.map(HandModel::allegro_v4);
    let mut poses = [Vec::new(), Vec::new()];
    right.link_poses(&right.home(), &mut poses[0]);
    left.link_poses(&left.home(), &mut poses[1]);
    assert_eq!((right.links[0].name.as_str(), right.links[0].parent), ("palm_link", None));
    for (index, link) in right.links.iter().enumerate() {
        assert!(index == 0 || link.parent.is_some_and(|parent| parent < index), "{} before its parent", link.name);
        assert_eq!(link.visuals.is_empty(), link.name.ends_with("_pole"), "{}", link.name);
        let carried = link.name.starts_with("link_") && !link.name.contains("0_");
        assert_eq!(link.joint.is_some(), carried, "{}", link.name);

        let twin = left.link(&link.name).unwrap();
        let mut expected = poses[0][index].translation.vector;
        expected.y = -expected.y;
        assert_near(poses[1][twin].translation.vector, expected.into(), 1e-12);
        assert_eq!(left.links[twin].visuals.len(), link.visuals.len());
    }
    let ball = &right.links[right.link("link_7.0_tip").unwrap()].visuals[0];
    assert_eq!(ball.shape, Shape::Sphere { radius: 0.012 });
    // Colours come by reference: light fingertips, dark palm.
    assert!(ball.rgba[0] > 0.7 && right.links[0].visuals[0].rgba[0] < 0.3);
}

fn posture() -> impl Strategy<Value = Vec<f64>> {
    prop::collection::vec(-2.0..2.0_f64, 16)
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn jacobian_is_the_derivative_of_the_tip(q in posture(), left: bool, pole: bool) {
        const STEP: f64 = 1e-6;
        let hand = &HANDS[usize::from(left)];
        let frame = if pole { TipFrame::Pole } else { TipFrame::Center };
        for chain in &hand.fingers {
            let own = chain.select(&q);
            let (position, jacobian) = chain.tip_and_jacobian(&own, frame);
            prop_assert!((position - chain.tip(&own, frame)).amax() < 1e-15);
            let mut difference = TipJacobian::zeros();
            for column in 0..4 {
                let (mut ahead, mut behind) = (own, own);
                ahead[column] += STEP;
                behind[column] -= STEP;
                let slope = (chain.tip(&ahead, frame) - chain.tip(&behind, frame)) / (2.0 * STEP);
                difference.set_column(column, &slope);
            }
            prop_assert!((jacobian - difference).amax() < 1e-9, "{jacobian} {difference}");
        }
    }

    #[test]
    fn link_poses_agree_with_the_chains(q in posture(), left: bool) {
        let hand = &HANDS[usize::from(left)];
        let mut poses = vec![Isometry3::identity(); 3];
        hand.link_poses(&q, &mut poses);
        prop_assert_eq!(poses.len(), hand.links.len());
        for chain in &hand.fingers {
            let last = chain.joints[3].joint;
            for (name, frame) in [("tip", TipFrame::Center), ("pole", TipFrame::Pole)] {
                let link = hand.link(&format!("link_{last}.0_{name}")).unwrap();
                let error = poses[link].translation.vector - chain.tip(&chain.select(&q), frame);
                prop_assert!(error.amax() < 1e-14, "{name} of {}: {error}", chain.finger.name());
            }
        }
    }

    /// The same master posture moves the left hand as the mirror image of the right one.
    #[test]
    fn joint_maps_mirror(master in prop::collection::vec(-0.6..1.9_f64, 20), map in 0..4_usize) {
        let master: [f64; 20] = master.try_into().unwrap();
        let name = ["index", "role", "carry", "split"][map];
        let [right, left] = &*HANDS;
        let [q_right, q_left] =
            [right, left].map(|hand| hand.clip(&hand.joint_map(name).unwrap().apply(&master)));
        for finger in [Finger::Thumb, Finger::Index, Finger::Middle, Finger::Ring] {
            for frame in [TipFrame::Pole, TipFrame::Center] {
                let mut mirrored = tip(right, finger, &q_right, frame);
                mirrored.y = -mirrored.y;
                let error = tip(left, finger, &q_left, frame) - mirrored;
                prop_assert!(error.amax() < 1e-14, "{}: {error}", finger.name());
            }
        }
    }

    #[test]
    fn clip_keeps_every_joint_within_its_limits(q in prop::collection::vec(-1e3..1e3_f64, 16), left: bool) {
        let hand = &HANDS[usize::from(left)];
        for (value, joint) in hand.clip(&JointVector::from_slice(&q)).iter().zip(&hand.joints) {
            prop_assert!((joint.lower..=joint.upper).contains(value));
        }
    }
}
