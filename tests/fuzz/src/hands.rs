//! What any hand that loads must be able to do.

use teleop_common::conditioner::Conditioner;
use teleop_common::guard::{MotionGuard, TipGuard};
use teleop_common::hand::{HandModel, JointVector, TipFrame};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};

use crate::{brief, within};

const PERIOD: f64 = 0.003;

/// Loads a hand, and computes with whatever loads: numbers, and commands within its limits.
///
/// # Panics
/// If it does not.
pub fn exercise(urdf: &str, description: &str) {
    let room = 512 * (urdf.len() + description.len()) + (1 << 20);
    let hand = match within(room, || HandModel::load(urdf, description)) {
        Ok(hand) => hand,
        Err(error) => return brief(&error),
    };
    let home = hand.home();
    assert_eq!(hand.clip(&home), home);
    let mut poses = Vec::new();
    hand.link_poses(&home, &mut poses);
    assert!(poses.iter().all(|pose| pose.translation.vector.iter().all(|value| value.is_finite())));
    for chain in &hand.fingers {
        let (tip, jacobian) = chain.tip_and_jacobian(&chain.select(&home), TipFrame::Pole);
        assert!(tip.iter().chain(jacobian.iter()).all(|value| value.is_finite()), "{tip} {jacobian}");
    }
    for map in &hand.joint_maps {
        assert!(map.apply(&[1.0; 20]).is_finite());
    }

    // A pinch, then as far as the joints go.
    let Some(map) = hand.joint_maps.first() else { return };
    let params = MappingParams { joint_map: map.name.clone(), ..MappingParams::default() };
    let mut mapping = Retargeter::new(hand.clone(), params).expect("a map of its own");
    let q = Gesture::Tripod.sample(1.0);
    let posture = mapping.map(&MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None }).q;
    let apart = TipGuard::new(&hand, 0.0005).apart(&hand, &posture, &[true; 5]);
    let end = |upper: bool| hand.joints.iter().map(move |joint| if upper { joint.upper } else { joint.lower });
    let ends = [false, true].map(|upper| JointVector::from_slice(&end(upper).collect::<Vec<_>>()));
    let guard = MotionGuard::new(&hand, 0.0005);
    let mut conditioner = Conditioner::new(&hand, &home, PERIOD, 0.008);
    let mut before = *conditioner.position();
    for target in [apart, ends[0], ends[1]] {
        for _ in 0..8 {
            conditioner.follow(&target, f64::INFINITY, |q, velocity, range| {
                guard.guard(&hand, q, &[true; 5], velocity, range, PERIOD);
            });
            for ((q, last), joint) in conditioner.position().iter().zip(before.iter()).zip(&hand.joints) {
                assert!((joint.lower..=joint.upper).contains(q), "{} at {q}", joint.name);
                let speed = (q - last).abs() / PERIOD;
                assert!(speed <= joint.velocity * (1.0 + 1e-9) + 1e-9, "{} at {speed} rad/s", joint.name);
            }
            before = *conditioner.position();
        }
    }
}
