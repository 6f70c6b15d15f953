//! Poses as they come from the network, through every mapping: postures within the joints' limits, whatever the poses.
//!
//! The input is pose messages one after the other, but for the first eight bytes of each, which are always right.
#![no_main]

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use teleop_common::guard::TipGuard;
use teleop_common::hand::{HandModel, JointVector};
use teleop_common::mapping::{MappingMode, MappingParams, Retargeter};
use teleop_common::wire::{Message as _, PoseMessage, decode};
use teleop_fuzz::{allegro, without_allocating};

const HEAD: &[u8; 8] = b"ALGT\x03\x00\x01\x00";
/// Poses of one input.
const POSES: usize = 8;

static MAPPINGS: LazyLock<Vec<Retargeter>> = LazyLock::new(|| {
    let mode = |mode| MappingParams { mode, ..MappingParams::default() };
    let all = [
        (false, MappingParams::default()),
        (true, MappingParams::paper()),
        (false, mode(MappingMode::Cartesian)),
        (false, mode(MappingMode::Vector)),
        (true, mode(MappingMode::DexPilot)),
    ];
    all.map(|(left, params)| Retargeter::new(allegro(left).clone(), params).expect("a preset")).into()
});

fuzz_target!(|bytes: &[u8]| {
    let mut mappings: [Option<Retargeter>; 5] = Default::default();
    for body in bytes.chunks(PoseMessage::LEN - HEAD.len()).take(POSES) {
        let mut message = HEAD.to_vec();
        message.extend_from_slice(body);
        let Ok(message) = decode::<PoseMessage>(&message) else { return };
        let pose = message.pose();
        for (slot, fresh) in mappings.iter_mut().zip(&*MAPPINGS) {
            let mapping = slot.get_or_insert_with(|| fresh.clone());
            let out = without_allocating(|| mapping.map(&pose));
            let hand = mapping.hand();
            within_limits(hand, &out.q);
            assert!(out.q_joint.is_finite());
            for signals in out.fingers() {
                assert!((0.0..=1.0).contains(&signals.k), "gain {}", signals.k);
                let points = [signals.p_joint, signals.p_cartesian, signals.p_input, signals.p];
                assert!(
                    points.iter().flatten().chain(&[signals.delta, signals.e_q, signals.e_c]).all(|v| v.is_finite())
                );
            }
            let guard = TipGuard::new(hand, 0.0005);
            let apart = without_allocating(|| guard.apart(hand, &out.q, &[true; 5]));
            within_limits(hand, &apart);
        }
    }
});

fn within_limits(hand: &HandModel, q: &JointVector) {
    assert_eq!(q.len(), hand.joints.len());
    for (angle, joint) in q.iter().zip(&hand.joints) {
        assert!((joint.lower..=joint.upper).contains(angle), "{} at {angle}", joint.name);
    }
}
