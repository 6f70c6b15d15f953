//! The inverse kinematics of the Allegro's fingers against a reference that is certain to be global.
//!
//! The reference holds one joint (a finger's first flexion, the thumb's first joint), solves the other three exactly
//! with the dimensions of the hand, and searches the held joint: for the position by Lipschitz bounds, which exclude
//! every interval that cannot hold a nearer point; for the posture by a fine grid with refinement.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::f64::consts::{PI, TAU};

use nalgebra::Vector3;
use teleop_common::hand::{Finger, FingerChain, HandModel, HandSide, MAX_FINGER_JOINTS, TipFrame};
use teleop_common::ik::{FingerIk, IkStatus, POSTURE_WEIGHT_MIN};

type Own = [f64; MAX_FINGER_JOINTS];

/// Targets per finger of either hand.
const TARGETS: usize = 10_000;
/// Certainty of the reference's position, m.
const GAP: f64 = 5e-6;

/// Uniform numbers: splitmix64.
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn direction(&mut self) -> Vector3<f64> {
        loop {
            let v = Vector3::from_fn(|_, _| 2.0 * self.unit() - 1.0);
            if v.norm() > 1e-3 && v.norm() <= 1.0 {
                return v.normalize();
            }
        }
    }
}

struct Case {
    chain: FingerChain,
    limits: [(f64, f64); 4],
    thumb: bool,
    // Distances between the joints along the finger: roll to first flexion, then the phalanges, m.
    lengths: Vec<f64>,
}

/// The best posture for one angle of the held joint.
#[derive(Clone, Copy)]
struct Tail {
    /// Distance of the tip from the target, m.
    miss: f64,
    /// Distance of the target from the nearest plane of flexion, m: no other angle of a finger's held joint changes it.
    beside: f64,
    /// Distance from the reference, rad.
    posture: f64,
}

fn wrap(angle: f64) -> f64 {
    angle - TAU * (angle / TAU).round()
}

impl Case {
    fn new(hand: &HandModel, slot: usize) -> Self {
        let chain = hand.fingers[slot].clone();
        let limits = std::array::from_fn(|slot| {
            let joint = &hand.joints[chain.joints[slot].joint];
            (joint.lower, joint.upper)
        });
        let thumb = chain.finger == Finger::Thumb;
        let mut lengths: Vec<f64> = chain.joints[if thumb { 2 } else { 1 }..].iter().map(|j| j.translation.z).collect();
        lengths.push(chain.pole.z);
        Self { chain, limits, thumb, lengths }
    }

    fn held(&self) -> usize {
        usize::from(!self.thumb)
    }

    /// Speed of the tip per speed of the held joint, at most, m/rad.
    fn lipschitz(&self) -> f64 {
        if self.thumb {
            self.chain.joints[1].translation.norm() + self.lengths.iter().sum::<f64>()
        } else {
            self.lengths[1..].iter().sum()
        }
    }

    fn near(&self, slot: usize, angle: f64) -> (f64, bool) {
        let (lower, upper) = self.limits[slot];
        let middle = 0.5 * (lower + upper);
        let away = wrap(angle - middle);
        let half = 0.5 * (upper - lower);
        (middle + away.clamp(-half, half), away.abs() <= half)
    }

    /// The nearest posture with the held joint at `held`; among those that reach, the nearest to `reference`.
    fn tail(&self, held: f64, target: &Vector3<f64>, reference: &Own) -> Tail {
        let first = &self.chain.joints[0];
        let (roll_slot, at) = if self.thumb {
            (1, first.rotation_at(held).transpose() * (target - first.translation) - self.chain.joints[1].translation)
        } else {
            (0, first.rotation.transpose() * (target - first.translation))
        };
        // Turned by the roll, the flexion plane is x-z; the thumb's roll axis is mirrored on the left hand.
        let sense = self.chain.joints[roll_slot].axis.z;
        let mut best = Tail { miss: f64::INFINITY, beside: f64::INFINITY, posture: f64::INFINITY };
        let around = at.y.atan2(at.x);
        for behind in [0.0, PI] {
            let (roll, _) = self.near(roll_slot, sense * (around + behind));
            let (sin, cos) = (sense * roll).sin_cos();
            let beside = at.y * cos - at.x * sin;
            best.beside = best.beside.min(beside.abs());
            let (base, tilt, first, second) = if self.thumb {
                ((0.0, self.lengths[0]), 0.0, self.lengths[1], self.lengths[2])
            } else {
                let base = (self.lengths[1] * held.sin(), self.lengths[0] + self.lengths[1] * held.cos());
                (base, held, self.lengths[2], self.lengths[3])
            };
            // From the arm's first joint, in the frame in which it points along z at zero.
            let (x, z) = (at.x * cos + at.y * sin - base.0, at.z - base.1);
            let (sin, cos) = f64::sin_cos(tilt);
            let (x, z) = (x * cos - z * sin, z * cos + x * sin);
            let mut take = |alpha: f64, beta: f64| {
                let (near, far) = (alpha.sin_cos(), (alpha + beta).sin_cos());
                let tip = (first * near.0 + second * far.0, first * near.1 + second * far.1);
                let miss = ((tip.0 - x).powi(2) + (tip.1 - z).powi(2) + beside.powi(2)).sqrt();
                let mut q = [0.0; MAX_FINGER_JOINTS];
                (q[self.held()], q[roll_slot], q[2], q[3]) = (held, roll, alpha, beta);
                let posture = distance(&q, reference);
                let (floor, best_floor) = (miss.max(1e-9), best.miss.max(1e-9));
                if floor < best_floor || (floor <= best_floor && posture < best.posture) {
                    best = Tail { miss, posture, ..best };
                }
            };
            let square = x * x + z * z;
            let direction = x.atan2(z);
            let cosine = (square - first * first - second * second) / (2.0 * first * second);
            let bend = cosine.clamp(-1.0, 1.0).acos();
            for beta in [bend, -bend, self.limits[3].0, self.limits[3].1] {
                let (beta, _) = self.near(3, beta);
                let (sin, cos) = beta.sin_cos();
                take(self.near(2, direction - (second * sin).atan2(first + second * cos)).0, beta);
            }
            for alpha in [self.limits[2].0, self.limits[2].1] {
                let (sin, cos) = alpha.sin_cos();
                take(alpha, self.near(3, (x - first * sin).atan2(z - first * cos) - alpha).0);
            }
        }
        best
    }

    /// The least distance of the tip from `target` over the joint box, too large by at most [`GAP`], m.
    fn nearest(&self, target: &Vector3<f64>, reference: &Own) -> f64 {
        let (lower, upper) = self.limits[self.held()];
        let slope = self.lipschitz();
        let at = |held: f64| (held, self.tail(held, target, reference));
        let pieces = 16;
        let ends: Vec<(f64, Tail)> =
            (0..=pieces).map(|n| at(lower + (upper - lower) * f64::from(n) / f64::from(pieces))).collect();
        let mut best = ends.iter().map(|end| end.1.miss).fold(f64::INFINITY, f64::min);
        let floor = if self.thumb { 0.0 } else { ends[0].1.beside };
        let mut work: Vec<_> = ends.windows(2).map(|pair| (pair[0], pair[1])).collect();
        while let Some((left, right)) = work.pop() {
            if best <= floor + GAP {
                break;
            }
            let bound = 0.5 * (left.1.miss + right.1.miss - slope * (right.0 - left.0));
            if bound < best - GAP {
                let middle = at(0.5 * (left.0 + right.0));
                best = best.min(middle.1.miss);
                work.extend([(left, middle), (middle, right)]);
            }
        }
        best
    }

    /// The least distance from `reference` of the postures that reach `target`; infinite if none is found.
    fn least_posture(&self, target: &Vector3<f64>, reference: &Own) -> f64 {
        let (lower, upper) = self.limits[self.held()];
        let at = |held: f64| {
            let tail = self.tail(held, target, reference);
            if tail.miss < 1e-8 { tail.posture } else { f64::INFINITY }
        };
        let grid = 200;
        let values: Vec<f64> =
            (0..=grid).map(|n| at(lower + (upper - lower) * f64::from(n) / f64::from(grid))).collect();
        let least = (0..values.len()).min_by(|a, b| values[*a].total_cmp(&values[*b])).unwrap();
        let mut step = (upper - lower) / f64::from(grid);
        let mut held = lower + step * least as f64;
        let mut best = values[least];
        while step > 1e-7 {
            let (value, place) = [held - step, held + step]
                .map(|held| held.clamp(lower, upper))
                .map(|held| (at(held), held))
                .into_iter()
                .min_by(|a, b| a.0.total_cmp(&b.0))
                .unwrap();
            if value < best {
                (best, held) = (value, place);
            } else {
                step *= 0.5;
            }
        }
        best
    }

    fn posture(&self, random: &mut Random, at_limits: f64) -> Own {
        let mut q = [0.0; MAX_FINGER_JOINTS];
        for (slot, (lower, upper)) in self.limits.iter().enumerate() {
            q[slot] = if random.unit() < at_limits {
                if random.unit() < 0.5 { *lower } else { *upper }
            } else {
                lower + (upper - lower) * random.unit()
            };
        }
        q
    }

    /// Targets inside, at limits, at singular postures, just outside and far off.
    fn target(&self, random: &mut Random) -> Vector3<f64> {
        let tip = |q: &Own| self.chain.tip(q, TipFrame::Pole);
        match (random.unit() * 5.0) as usize {
            0 => tip(&self.posture(random, 0.0)),
            1 => tip(&self.posture(random, 0.5)),
            2 => {
                // Straight, or almost.
                let mut q = self.posture(random, 0.2);
                let size = 10_f64.powf(-6.0 * random.unit());
                for angle in &mut q[if self.thumb { 3 } else { 2 }..4] {
                    *angle = size * (random.unit() - 0.1);
                }
                tip(&q)
            }
            3 => {
                let size = 10_f64.powf(-1.5 - 5.0 * random.unit());
                tip(&self.posture(random, 0.5)) + random.direction() * size
            }
            _ => tip(&self.posture(random, 0.0)) + random.direction() * (0.15 * random.unit()),
        }
    }
}

fn distance(a: &Own, b: &Own) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

fn check(side: HandSide) {
    let hand = HandModel::allegro_v4(side);
    for slot in 0..4 {
        let case = Case::new(&hand, slot);
        let solver = FingerIk::new(&case.chain, &hand.joints);
        let mut random = Random(slot as u64 + if side == HandSide::Left { 100 } else { 1 });
        let (mut reached, mut excess, mut budget) = (0, 0.0_f64, 0);
        let mut dearer = Vec::new();
        for _ in 0..TARGETS {
            let target = case.target(&mut random);
            let reference = case.posture(&mut random, 0.1);
            let (q, report) = solver.solve(&case.chain, &target, &reference, None, POSTURE_WEIGHT_MIN);
            budget += usize::from(report.status == IkStatus::Budget);
            for (angle, (lower, upper)) in q.iter().zip(case.limits) {
                assert!((lower..=upper).contains(angle), "{q:?} leaves the joint box");
            }
            let residual = (case.chain.tip(&q, TipFrame::Pole) - target).norm();
            excess = excess.max(residual - case.nearest(&target, &reference));
            if report.status == IkStatus::Reached {
                assert!(residual < 1e-6);
                reached += 1;
                dearer.push(distance(&q, &reference) - case.least_posture(&target, &reference));
            }
        }
        dearer.sort_by(f64::total_cmp);
        let above = dearer.iter().filter(|dearer| **dearer > 1e-3).count();
        let worst = dearer.last().unwrap();
        println!(
            "{} {}: of {TARGETS} targets {reached} reached, {budget} out of budget; position at most {:.6} mm beyond the \
             nearest; {above} postures farther from the reference than needed, by at most {worst:.3} rad",
            side.name(),
            case.chain.finger.name(),
            excess * 1e3
        );
        assert!(reached > TARGETS / 2);
        assert!(excess < 1e-5, "{excess} m beyond the nearest point");
        assert!(above * 400 < TARGETS, "{above} postures");
    }
}

#[test]
fn the_right_hand_is_solved_globally() {
    check(HandSide::Right);
}

#[test]
fn the_left_hand_is_solved_globally() {
    check(HandSide::Left);
}
