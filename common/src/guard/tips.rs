//! Targets: keeps the fingertips out of each other.
//!
//! The mapping brings the *poles* of two fingertips together, which is where two fingers touch only if they meet tip
//! to tip; at any other angle their spheres (12 mm for the Allegro) overlap, by 9 mm at worst. The guard moves a
//! posture x0 as little as possible to one whose spheres do not:
//!
//! ```text
//! argmin  sum_f w^2 ||F_f(x) - F_f(x0)||^2 + sum_f v_f ||F_Tf(x) - F_Tf(x0)||^2 + mu^2 ||x - x0||^2
//! subject to  ||c_a(x) - c_b(x)|| >= R_a + R_b - allowance,    x in the joint box,
//! ```
//!
//! with poles F_f, centres c_f, and the vectors F_Tf from the thumb's pole to those of the fingers at it, which decide a
//! grasp and so weigh more than the places. Because a finger can turn its distal phalanx while its pole stays where it
//! is, most of the overlap goes into that turn and little into the gap between the poles: the fingers meet tip to tip,
//! as a person's do. Two fingers that meet at the thumb part sideways. Solved by sequential quadratic programming with
//! one multiplier per pair.

use nalgebra::{SMatrix, SVector, Vector3};

use super::direction;
use crate::hand::{Finger, HandModel, Joint, JointVector, MAX_FINGERS, MAX_JOINTS, TipFrame, TipJacobian};

const MAX_PAIRS: usize = MAX_FINGERS * (MAX_FINGERS - 1) / 2;

/// mu: what a radian of posture weighs against a metre between two poles, m/rad.
const POSTURE_WEIGHT: f64 = 3e-3;
/// w: what a metre of one pole's place weighs against one between two poles.
const PLACE_WEIGHT: f64 = 0.2;
/// Linearisations at most.
const ITERATIONS: usize = 16;
/// Times that joints are found to be at their end in each linearisation.
const MAX_HELD: usize = 3;
/// Sweeps over the pairs in each linearisation.
const SWEEPS: usize = 8;
/// Pairs with a gap below this are watched, m.
const NEAR: f64 = 0.01;
/// Largest move of a joint in one linearisation, rad.
const MAX_STEP: f64 = 0.15;
/// Overlap this much smaller than asked for is as good, m.
const TOLERANCE: f64 = 2e-5;
/// Below this step (rad) the posture has settled.
const SETTLED: f64 = 1e-3;

/// Keeps the fingertips of one hand's target postures apart.
#[derive(Clone, Debug)]
pub struct TipGuard {
    // Radius of each fingertip's sphere, m.
    radii: [f64; MAX_FINGERS],
    // Base of each finger in the palm frame, m.
    bases: Centers,
    thumb: Option<usize>,
    allowance: f64,
}

/// Points of a fingertip and their derivatives by the finger's own joints.
#[derive(Clone, Copy, Default)]
struct Tip {
    center: Vector3<f64>,
    center_jacobian: TipJacobian,
    pole: Vector3<f64>,
    pole_jacobian: TipJacobian,
}

/// A pair of fingertips, linearised.
#[derive(Clone, Copy)]
struct Pair<const N: usize> {
    // Derivative of the distance of the centres by the variables, m/rad.
    slope: SVector<f64, N>,
    // What the step must add to the distance, m.
    lacking: f64,
    multiplier: f64,
}

impl TipGuard {
    /// A guard that lets spheres overlap by `allowance` (m).
    #[must_use]
    pub fn new(hand: &HandModel, allowance: f64) -> Self {
        let mut radii = [0.0; MAX_FINGERS];
        for (radius, chain) in radii.iter_mut().zip(&hand.fingers) {
            *radius = (chain.pole - chain.center).norm();
        }
        let mut bases = Centers::default();
        for (base, chain) in bases.iter_mut().zip(&hand.fingers) {
            *base = hand.anatomical_from_palm.tr_mul(&chain.base);
        }
        let thumb = hand.fingers.iter().position(|chain| chain.finger == Finger::Thumb);
        Self { radii, bases, thumb, allowance }
    }

    /// The deepest overlap of any two fingertips at `q`, m; negative if all are apart.
    #[must_use]
    pub fn deepest(&self, hand: &HandModel, q: &JointVector) -> f64 {
        self.deepest_of(hand.fingers.len(), &centers(hand, q))
    }

    /// The posture nearest to `q` (rad, wire order, inside the joint box) whose fingertips are apart.
    ///
    /// `movable` says which of the hand's fingers may give way; of a pair of which neither may, both do. Returns `q`
    /// itself, bit for bit, if there is nothing to do. Does not allocate; bounded work.
    #[must_use]
    pub fn apart(&self, hand: &HandModel, q: &JointVector, movable: &[bool; MAX_FINGERS]) -> JointVector {
        let count = hand.fingers.len();
        let mut state = Involved::default();
        let before = centers(hand, q);
        self.involve(count, &before, movable, &mut state);
        if !state.fingers.contains(&true) {
            return *q;
        }
        let mut wanted = Tips::default();
        update(hand, q, &[true; MAX_FINGERS], &mut wanted);
        let (mut x, mut now) = (*q, wanted);
        for _ in 0..ITERATIONS {
            let own = hand.fingers.iter().zip(&state.fingers).filter(|(_, own)| **own);
            // Two fingers of four joints, nearly always.
            let step = match own.map(|(chain, _)| chain.joints.len()).sum::<usize>() {
                0..=8 => self.step::<8>(hand, q, &x, &wanted, &now, &state),
                9..=12 => self.step::<12>(hand, q, &x, &wanted, &now, &state),
                13..=16 => self.step::<16>(hand, q, &x, &wanted, &now, &state),
                _ => self.step::<MAX_JOINTS>(hand, q, &x, &wanted, &now, &state),
            };
            let shorten = MAX_STEP / step.iter().fold(MAX_STEP, |most, own| most.max(own.abs()));
            let mut moved = 0.0_f64;
            for (index, joint) in hand.joints.iter().enumerate() {
                let next = (x[index] + step[index] * shorten).clamp(joint.lower, joint.upper);
                moved = moved.max((next - x[index]).abs());
                x[index] = next;
            }
            // Nobody else has moved.
            update(hand, &x, &state.fingers, &mut now);
            // The way out may lead into another finger.
            let apart = !self.involve(count, &now.map(|tip| tip.center), movable, &mut state);
            if moved < SETTLED && apart {
                break;
            }
        }
        // Where there is no way out near by, nothing is better than something worse.
        if self.deepest_of(count, &now.map(|tip| tip.center)) <= self.deepest_of(count, &before) { x } else { *q }
    }

    fn deepest_of(&self, count: usize, centers: &Centers) -> f64 {
        pairs(count).map(|(a, b)| self.overlap(centers, a, b)).fold(f64::NEG_INFINITY, f64::max)
    }

    fn overlap(&self, centers: &Centers, a: usize, b: usize) -> f64 {
        self.radii[a] + self.radii[b] - (centers[b] - centers[a]).norm()
    }

    /// Notes who has to give way; true if anybody overlaps.
    fn involve(&self, count: usize, centers: &Centers, movable: &[bool; MAX_FINGERS], out: &mut Involved) -> bool {
        let mut any = false;
        for (a, b) in pairs(count) {
            if self.overlap(centers, a, b) > self.allowance + TOLERANCE {
                any = true;
                let neither = !movable[a] && !movable[b];
                out.fingers[a] |= movable[a] || neither;
                out.fingers[b] |= movable[b] || neither;
            }
        }
        any
    }

    /// v: how much the vector between two poles counts: of thumb and finger 1 where their tips touch, and less the
    /// farther they are apart. How two fingers lie to each other decides no grasp.
    fn grasp(&self, wanted: &Tips, a: usize, b: usize) -> f64 {
        if self.thumb != Some(a) && self.thumb != Some(b) {
            return 0.0;
        }
        let apart = (wanted[b].center - wanted[a].center).norm() - self.radii[a] - self.radii[b];
        let share = (apart / NEAR).clamp(0.0, 1.0);
        1.0 - share * share * (3.0 - 2.0 * share)
    }

    /// In which direction `b` goes out of `a`. Of two fingers that are sent to one place the tips' own direction is
    /// chance: the deeper they are in each other, the more it is that of their bases.
    fn normal(&self, a: usize, b: usize, between: &Vector3<f64>) -> Vector3<f64> {
        if self.thumb == Some(a) || self.thumb == Some(b) {
            return direction(*between);
        }
        let depth = (self.radii[a] + self.radii[b] - between.norm()).max(0.0);
        direction(between + direction(self.bases[b] - self.bases[a]) * depth)
    }

    /// One step of the sequential quadratic program from `x`, by joint.
    ///
    /// N is the room for the joints of the fingers that give way; the rest of the hand is a fixed obstacle.
    fn step<const N: usize>(
        &self,
        hand: &HandModel,
        q: &JointVector,
        x: &JointVector,
        wanted: &Tips,
        now: &Tips,
        state: &Involved,
    ) -> JointVector {
        let count = hand.fingers.len();
        // Where each finger's joints are among the N variables, and which joint a variable is.
        let (mut first, mut joints, mut used) = ([None; MAX_FINGERS], [0; N], 0);
        for (finger, chain) in hand.fingers.iter().enumerate().filter(|&(finger, _)| state.fingers[finger]) {
            first[finger] = Some(used);
            for joint in &chain.joints {
                joints[used] = joint.joint;
                used += 1;
            }
        }
        let place = |finger: usize, jacobian: &TipJacobian, sign: f64| {
            let mut wide = SMatrix::<f64, 3, N>::zeros();
            if let Some(first) = first[finger] {
                for slot in 0..hand.fingers[finger].joints.len() {
                    wide.set_column(first + slot, &(jacobian.column(slot) * sign));
                }
            }
            wide
        };
        let (mut hessian, mut gradient) = (SMatrix::<f64, N, N>::zeros(), SVector::<f64, N>::zeros());
        let mut add = |jacobian: SMatrix<f64, 3, N>, residual: Vector3<f64>, weight: f64| {
            gradient += jacobian.tr_mul(&residual) * weight;
            hessian += jacobian.tr_mul(&jacobian) * weight;
        };
        let error = |finger: usize| now[finger].pole - wanted[finger].pole;
        for (a, b) in pairs(count).filter(|&(a, b)| state.fingers[a] || state.fingers[b]) {
            let weight = self.grasp(wanted, a, b);
            if weight > 0.0 {
                let jacobian = place(a, &now[a].pole_jacobian, -1.0) + place(b, &now[b].pole_jacobian, 1.0);
                add(jacobian, error(b) - error(a), weight);
            }
        }
        for finger in (0..count).filter(|&finger| state.fingers[finger]) {
            add(place(finger, &now[finger].pole_jacobian, 1.0), error(finger), PLACE_WEIGHT * PLACE_WEIGHT);
        }
        for variable in 0..N {
            hessian[(variable, variable)] += POSTURE_WEIGHT * POSTURE_WEIGHT;
            if variable < used {
                gradient[variable] += POSTURE_WEIGHT * POSTURE_WEIGHT * (x[joints[variable]] - q[joints[variable]]);
            }
        }
        let mut slack = [Pair { slope: SVector::<f64, N>::zeros(), lacking: 0.0, multiplier: 0.0 }; MAX_PAIRS];
        let mut close = 0;
        for (a, b) in pairs(count).filter(|&(a, b)| state.fingers[a] || state.fingers[b]) {
            let between = now[b].center - now[a].center;
            let normal = self.normal(a, b, &between);
            let lacking = self.radii[a] + self.radii[b] - self.allowance - between.dot(&normal);
            if lacking > -NEAR {
                let jacobian = place(a, &now[a].center_jacobian, -1.0) + place(b, &now[b].center_jacobian, 1.0);
                slack[close] = Pair { slope: jacobian.tr_mul(&normal), lacking, multiplier: 0.0 };
                close += 1;
            }
        }
        let slack = &mut slack[..close];

        // A joint that the step takes out of its range goes to the end of it, and the others' steps are computed again.
        let mut out = JointVector::zeros(x.len());
        for _ in 0..=MAX_HELD {
            // Positive definite by the weight; it fails only for numbers that are none, and then nothing moves.
            let Some(factor) = hessian.cholesky() else { break };
            let mut step = -factor.solve(&gradient);
            let mut towards = [SVector::<f64, N>::zeros(); MAX_PAIRS];
            for (towards, pair) in towards.iter_mut().zip(&mut *slack) {
                *towards = factor.solve(&pair.slope);
                pair.multiplier = 0.0;
            }
            for _ in 0..SWEEPS {
                for (pair, towards) in slack.iter_mut().zip(&towards) {
                    let gain = pair.slope.dot(towards);
                    if gain > 1e-12 {
                        let next = (pair.multiplier + (pair.lacking - pair.slope.dot(&step)) / gain).max(0.0);
                        step += towards * (next - pair.multiplier);
                        pair.multiplier = next;
                    }
                }
            }
            let mut held = false;
            for (variable, &joint) in joints.iter().enumerate().take(used) {
                let Joint { lower, upper, .. } = hand.joints[joint];
                let inside = step[variable].clamp(lower - x[joint], upper - x[joint]);
                if (step[variable] - inside).abs() > 1e-9 {
                    held = true;
                    gradient += hessian.column(variable) * inside;
                    hessian.row_mut(variable).fill(0.0);
                    hessian.column_mut(variable).fill(0.0);
                    hessian[(variable, variable)] = 1.0;
                    gradient[variable] = -inside;
                    for pair in &mut *slack {
                        pair.lacking -= pair.slope[variable] * inside;
                        pair.slope[variable] = 0.0;
                    }
                }
            }
            joints.iter().enumerate().take(used).for_each(|(variable, &joint)| out[joint] = step[variable]);
            if !held {
                break;
            }
        }
        out
    }
}

/// Who takes part in a solve.
#[derive(Clone, Copy, Default)]
struct Involved {
    fingers: [bool; MAX_FINGERS],
}

type Tips = [Tip; MAX_FINGERS];

type Centers = [Vector3<f64>; MAX_FINGERS];

fn centers(hand: &HandModel, q: &JointVector) -> Centers {
    let mut out = [Vector3::zeros(); MAX_FINGERS];
    for (center, chain) in out.iter_mut().zip(&hand.fingers) {
        *center = chain.tip(&chain.select(q)[..chain.joints.len()], TipFrame::Center);
    }
    out
}

/// Computes the tips of `fingers` anew.
fn update(hand: &HandModel, q: &JointVector, fingers: &[bool; MAX_FINGERS], out: &mut Tips) {
    for ((tip, chain), _) in out.iter_mut().zip(&hand.fingers).zip(fingers).filter(|(_, own)| **own) {
        let own = chain.select(q);
        let own = &own[..chain.joints.len()];
        (tip.center, tip.center_jacobian) = chain.tip_and_jacobian(own, TipFrame::Center);
        (tip.pole, tip.pole_jacobian) = chain.tip_and_jacobian(own, TipFrame::Pole);
    }
}

/// All pairs of `count` fingers.
fn pairs(count: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..count).flat_map(move |a| (a + 1..count).map(move |b| (a, b)))
}
