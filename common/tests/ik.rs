//! The inverse kinematics against brute force, at limits and at the singular open hand.

use nalgebra::Vector3;
use proptest::prelude::*;
use proptest::strategy::ValueTree as _;
use teleop_common::hand::{FingerChain, HandModel, HandSide, MAX_FINGER_JOINTS, TipFrame};
use teleop_common::ik::{FingerIk, IkReport, IkStatus, POSTURE_WEIGHT_MAX, POSTURE_WEIGHT_MIN};

type Own = [f64; MAX_FINGER_JOINTS];

#[derive(Debug)]
struct Case {
    hand: HandModel,
    finger: usize,
}

impl Case {
    fn chain(&self) -> &FingerChain {
        &self.hand.fingers[self.finger]
    }

    fn limits(&self, slot: usize) -> (f64, f64) {
        let joint = &self.hand.joints[self.chain().joints[slot].joint];
        (joint.lower, joint.upper)
    }

    /// A posture from numbers in 0..1.
    fn posture(&self, unit: &[f64; 4]) -> Own {
        let mut q = [0.0; MAX_FINGER_JOINTS];
        for (slot, unit) in unit.iter().enumerate() {
            let (lower, upper) = self.limits(slot);
            q[slot] = lower + (upper - lower) * unit;
        }
        q
    }

    fn solve(&self, target: &Vector3<f64>, reference: &Own, start: &Own) -> (Own, IkReport) {
        let solver = FingerIk::new(self.chain(), &self.hand.joints);
        let (q, report) = solver.solve(self.chain(), target, reference, start, POSTURE_WEIGHT_MIN);
        for (slot, angle) in q.iter().take(4).enumerate() {
            let (lower, upper) = self.limits(slot);
            assert!((lower..=upper).contains(angle), "joint {slot} outside its limits");
        }
        assert!(report.iterations <= FingerIk::MAX_ITERATIONS);
        let residual = (self.chain().tip(&q, TipFrame::Pole) - target).norm();
        assert!((residual - report.residual).abs() < 1e-12, "the report must tell the truth");
        (q, report)
    }
}

fn case() -> impl Strategy<Value = Case> {
    (any::<bool>(), 0..4_usize).prop_map(|(right, finger)| Case {
        hand: HandModel::allegro_v4(if right { HandSide::Right } else { HandSide::Left }),
        finger,
    })
}

fn distance(a: &Own, b: &Own) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(600) })]

    #[test]
    fn the_reference_itself_is_its_own_solution(
        case in case(), reference in prop::array::uniform4(0.0..=1.0_f64), start in prop::array::uniform4(0.0..=1.0_f64),
    ) {
        let (reference, start) = (case.posture(&reference), case.posture(&start));
        let target = case.chain().tip(&reference, TipFrame::Pole);
        let (q, report) = case.solve(&target, &reference, &reference);
        prop_assert_eq!(report.status, IkStatus::Reached);
        prop_assert!(distance(&q, &reference) < 1e-6);
        // From elsewhere at least the tip must get there, or as near as a start from there allows.
        let (_, report) = case.solve(&target, &reference, &start);
        prop_assert!(report.residual < 1e-4, "{report:?}");
    }

    #[test]
    fn a_small_step_of_the_target_is_a_small_step_of_the_tip(
        case in case(), from in prop::array::uniform4(0.1..=0.9_f64), step in prop::array::uniform3(-1e-4..1e-4_f64),
    ) {
        let reference = case.posture(&from);
        let target = case.chain().tip(&reference, TipFrame::Pole);
        let (before, _) = case.solve(&target, &reference, &reference);
        let moved = target + Vector3::from(step);
        let (after, report) = case.solve(&moved, &reference, &before);
        let way = (case.chain().tip(&after, TipFrame::Pole) - case.chain().tip(&before, TipFrame::Pole)).norm();
        prop_assert!(way <= 2.0 * Vector3::from(step).norm() + 1e-6, "{report:?}");
    }
}

/// The witness that made the target reaches it too, so the solution should not be farther from the reference.
#[test]
fn a_target_near_the_reference_is_reached_and_costs_no_more_than_it_must() {
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let unit = prop::array::uniform4(0.0..=1.0_f64);
    let (mut missed, mut dearer, total) = (0, 0, 4000);
    for _ in 0..total {
        let case = case().new_tree(&mut runner).unwrap().current();
        let reference = case.posture(&unit.new_tree(&mut runner).unwrap().current());
        let mut witness = reference;
        for (slot, way) in unit.new_tree(&mut runner).unwrap().current().into_iter().enumerate() {
            let (lower, upper) = case.limits(slot);
            witness[slot] = (witness[slot] + 0.3 * (way - 0.5)).clamp(lower, upper);
        }
        let target = case.chain().tip(&witness, TipFrame::Pole);
        let (q, report) = case.solve(&target, &reference, &reference);
        missed += usize::from(report.residual > 1e-5);
        dearer += usize::from(distance(&q, &reference) > distance(&witness, &reference) + 1e-3);
    }
    println!("of {total} targets {missed} were missed, {dearer} reached in a posture farther off than needed");
    assert!(missed * 1000 <= total, "{missed} of {total} targets missed");
    assert!(dearer * 200 < total, "{dearer} of {total} ended in a posture farther off than needed");
}

/// Targets anywhere around the hand: no dense sample of the joint box comes nearer by more than its own spacing allows.
#[test]
fn unreachable_targets_get_the_nearest_point() {
    for finger in 0..4 {
        let case = Case { hand: HandModel::allegro_v4(HandSide::Right), finger };
        let mut tips = Vec::new();
        let grid = 14;
        for index in 0..grid * grid * grid * grid {
            let unit = |divisor: usize| (index / divisor % grid) as f64 / (grid - 1) as f64;
            let q = case.posture(&[unit(1), unit(grid), unit(grid * grid), unit(grid * grid * grid)]);
            tips.push(case.chain().tip(&q, TipFrame::Pole));
        }
        let mut worst = 0.0_f64;
        for index in 0..343_u32 {
            let coordinate = |divisor: u32| f64::from(index / divisor % 7) * 0.06 - 0.18;
            let target = Vector3::new(coordinate(1), coordinate(7), coordinate(49));
            let middle = case.posture(&[0.5; 4]);
            let (_, report) = case.solve(&target, &middle, &middle);
            let nearest = tips.iter().map(|tip| (tip - target).norm()).fold(f64::INFINITY, f64::min);
            worst = worst.max(report.residual - nearest);
        }
        assert!(worst < 1e-3, "finger {finger}: a grid point is {worst} m nearer");
    }
}

/// The Allegro's open finger has a Jacobian of rank 1: sweeping the target through it must not throw the joints about.
#[test]
fn the_open_hand_is_passed_without_a_throw() {
    for finger in 1..4 {
        let case = Case { hand: HandModel::allegro_v4(HandSide::Right), finger };
        let straight = [0.0; MAX_FINGER_JOINTS];
        let tip = case.chain().tip(&straight, TipFrame::Pole);
        let mut last = straight;
        let mut largest = 0.0_f64;
        for step in 0..400 {
            let sideways = (f64::from(step) * 0.05).sin() * 2e-3;
            let target = tip + Vector3::new(1e-3, sideways, -1e-3);
            let solver = FingerIk::new(case.chain(), &case.hand.joints);
            let (q, _) = solver.solve(case.chain(), &target, &straight, &last, POSTURE_WEIGHT_MAX);
            largest = largest.max(distance(&q, &last));
            last = q;
        }
        assert!(largest < 0.3, "finger {finger} moved by {largest} rad in one step");
    }
}
