//! Time of the inverse kinematics of one finger. `cargo bench -p teleop-common --bench ik`.
#![allow(clippy::print_stdout, missing_docs, reason = "a bench reports on the terminal")]

mod report;

use std::hint::black_box;

use nalgebra::Vector3;
use report::report;
use teleop_common::hand::{FingerChain, HandModel, HandSide, MAX_FINGER_JOINTS, TipFrame};
use teleop_common::ik::FingerIk;

type Own = [f64; MAX_FINGER_JOINTS];

/// A target, a reference and a last solution.
type Case = (Vector3<f64>, Own, Option<Own>);

/// mu of the Cartesian phase, m/rad.
const MU: f64 = 2e-5;
const COUNT: u32 = 5000;

fn main() {
    let hand = HandModel::allegro_v4(HandSide::Right);
    for chain in &hand.fingers {
        let ik = FingerIk::new(chain, &hand.joints);
        let name = chain.finger.name();
        let run = |kind: &str, cases: &[Case]| {
            report(&format!("{name}, {kind}"), cases, |(target, reference, start)| {
                black_box(ik.solve(chain, target, reference, start.as_ref(), MU));
            });
        };
        let posture = |unit: &dyn Fn(usize) -> f64| -> Own {
            let mut q = [0.0; MAX_FINGER_JOINTS];
            for (slot, joint) in chain.joints.iter().enumerate() {
                let joint = &hand.joints[joint.joint];
                q[slot] = joint.lower + (joint.upper - joint.lower) * unit(slot);
            }
            q
        };
        // Low-discrepancy numbers in 0..1 instead of random ones.
        let spread = |n: u32, slot: usize| (f64::from(n) * [0.754_878, 0.569_84, 0.810_44, 0.671_04][slot]).fract();
        let tip = |q: &Own| chain.tip(q, TipFrame::Pole);
        let reachable = |n: u32| {
            let witness = posture(&|slot| spread(n, slot));
            (tip(&witness), posture(&|slot| 0.5 * (spread(n, slot) + spread(n + 77, 3 - slot))))
        };
        // A smooth path inside the joint box, 3 ms apart as from one control tick to the next.
        let mut last = None;
        let path: Vec<Case> = (0..COUNT)
            .map(|n| {
                let time = f64::from(n) * 0.003;
                let wave = |slot: usize| 0.5 + 0.35 * (time * (2.0 + slot as f64 * 0.7)).sin();
                let target = tip(&posture(&wave));
                let reference = posture(&|slot| 0.5 + 0.3 * (time * (1.5 + slot as f64 * 0.3)).cos());
                let case = (target, reference, last);
                last = Some(ik.solve(chain, &target, &reference, last.as_ref(), MU).0);
                case
            })
            .collect();
        run("warm", &path);
        run("cold", &(0..COUNT).map(|n| (reachable(n).0, reachable(n).1, None)).collect::<Vec<_>>());
        let far = |n: u32| {
            let (target, reference) = reachable(n);
            (chain_origin(chain) + (target - chain_origin(chain)) * 1.3 + Vector3::new(0.0, 0.03, 0.0), reference)
        };
        run("unreachable, cold", &(0..COUNT).map(|n| (far(n).0, far(n).1, None)).collect::<Vec<_>>());
        let straight = tip(&[0.0; MAX_FINGER_JOINTS]);
        let singular = |n: u32| {
            let beside = Vector3::new(spread(n, 0) - 0.5, spread(n, 1) - 0.5, spread(n, 2) - 0.5) * 4e-3;
            (straight + beside, reachable(n).1, None)
        };
        run("singular, cold", &(0..COUNT).map(singular).collect::<Vec<_>>());
    }
}

fn chain_origin(chain: &FingerChain) -> Vector3<f64> {
    chain.joints[0].translation
}
