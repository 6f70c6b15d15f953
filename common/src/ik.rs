//! Bounded, lexicographic inverse kinematics of one finger.
//!
//! A four-joint finger that reaches for a point is redundant, so "reach p" alone does not say which posture. The
//! problem solved here is, in the joint box B of the finger,
//!
//! ```text
//! argmin { ||q - q_ref|| : q in argmin { ||F(q') - p|| : q' in B } }
//! ```
//!
//! position first, then closeness to the joint-mapped posture `q_ref`. It is approached by minimising
//! `1/2 ||F(q) - p||^2 + 1/2 mu^2 ||q - q_ref||^2` for a falling series of mu, by a projected Newton method with
//! Levenberg damping. The posture term keeps every system regular where the finger is singular (the Allegro's open
//! hand has rank 1), and the damping bounds every step. The smallest mu, 0.1 mm/rad, leaves a position bias of about
//! `mu^2 ||q - q_ref|| / sigma`, 0.2 um for a radian at the usual sigma = 50 mm/rad.

use nalgebra::{SMatrix, SVector, Vector3};

use crate::hand::{FingerChain, Joint, MAX_FINGER_JOINTS, TipFrame};

const N: usize = MAX_FINGER_JOINTS;
type Vector = SVector<f64, N>;
type Matrix = SMatrix<f64, N, N>;

/// mu where the posture decides, m/rad: position and posture weigh alike for a finger of this size.
pub const POSTURE_WEIGHT_MAX: f64 = 3e-3;
/// mu where the position decides, m/rad. The position bias `mu^2 ||q - q_ref|| / sigma` is then below 0.01 um for a
/// radian at the usual sigma = 50 mm/rad.
pub const POSTURE_WEIGHT_MIN: f64 = 2e-5;

// Stages of falling mu in one descent.
const STAGES: usize = 3;
const ITERATIONS_PER_WEIGHT: u16 = 14;
// Ways tried besides the one from the given start.
const SEEDS: usize = 3;
// A relative decrease of the weighted sum smaller than this ends a stage whose target is out of reach.
const SETTLED: f64 = 1e-11;
// A step smaller than this (rad) ends a stage.
const STEP_TOLERANCE: [f64; STAGES] = [1e-3, 1e-4, 1e-9];

/// How a solve ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum IkStatus {
    /// Not solved: the joint-mapped posture was taken as it is.
    #[default]
    Skipped,
    /// The target is reached, within 1 um or a twentieth of the posture weight times a radian.
    Reached,
    /// The target is out of reach; the nearest point found is returned.
    Unreachable,
    /// The iteration budget ran out first; the best point so far is returned.
    Budget,
}

/// What a solve did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct IkReport {
    /// How it ended.
    pub status: IkStatus,
    /// Iterations used, over all stages and starts.
    pub iterations: u16,
    /// Distance from the reached tip to the target, m.
    pub residual: f64,
}

/// The solver of one finger: its chain and joint box.
#[derive(Clone, Debug)]
pub struct FingerIk {
    lower: Vector,
    upper: Vector,
    count: usize,
    // Postures on a grid over the joint box, with their tips: where to begin when the warm start leads nowhere.
    samples: Vec<(Vector, Vector3<f64>)>,
}

struct Descent {
    q: Vector,
    cost: f64,
    iterations: u16,
    converged: bool,
}

impl FingerIk {
    /// A solver for `chain`, with the limits of the hand's `joints` (wire order). Allocates; [`FingerIk::solve`] does
    /// not.
    #[must_use]
    pub fn new(chain: &FingerChain, joints: &[Joint]) -> Self {
        let (mut lower, mut upper) = (Vector::zeros(), Vector::zeros());
        for (slot, joint) in chain.joints.iter().enumerate() {
            lower[slot] = joints[joint.joint].lower;
            upper[slot] = joints[joint.joint].upper;
        }
        let count = chain.joints.len();
        // The finest grid of at most a thousand or so postures.
        let per_joint = [1, 1000, 33, 10, 6, 4][count.min(N)];
        let total = (0..count).fold(1_usize, |total, _| total * per_joint);
        let samples = (0..total).map(|index| {
            let mut rest = index;
            let mut q = Vector::zeros();
            for slot in 0..count {
                let share = (rest % per_joint) as f64 / (per_joint - 1) as f64;
                q[slot] = lower[slot] + (upper[slot] - lower[slot]) * share;
                rest /= per_joint;
            }
            (q, chain.tip(&q.as_slice()[..count], TipFrame::Pole))
        });
        Self { lower, upper, count, samples: samples.collect() }
    }

    /// Most iterations one [`FingerIk::solve`] can take.
    pub const MAX_ITERATIONS: u16 = (1 + SEEDS as u16) * ITERATIONS_PER_WEIGHT * STAGES as u16;

    /// Joint angles (rad, palm outwards) that bring the pole of `chain` to `target` (m, palm frame), as close to
    /// `reference` as the target allows; `start` is where to begin, best the last solution.
    ///
    /// `posture_weight` is the final mu (m/rad), between [`POSTURE_WEIGHT_MIN`] and [`POSTURE_WEIGHT_MAX`]: the
    /// exchange rate of "position first". With a tiny one a target a few micrometres out of reach throws a joint
    /// across its range wherever the finger is singular.
    ///
    /// Does not allocate; at most [`FingerIk::MAX_ITERATIONS`] iterations. If the way from `start` does not reach the
    /// target, the ways from `reference` and from two sampled postures are tried too and the best end returned. The
    /// result is a local optimum of the posture and, for all but rare targets, the global one of the position.
    #[must_use]
    pub fn solve(
        &self,
        chain: &FingerChain,
        target: &Vector3<f64>,
        reference: &[f64; N],
        start: &[f64; N],
        posture_weight: f64,
    ) -> ([f64; N], IkReport) {
        let mu = posture_weight.clamp(POSTURE_WEIGHT_MIN, POSTURE_WEIGHT_MAX);
        let tolerance = 0.05 * mu;
        let reference = Vector::from(*reference);
        let mut best = self.descend(chain, target, &reference, &Vector::from(*start), mu);
        let mut residual = self.residual(chain, target, &best.q);
        let mut iterations = best.iterations;
        for seed in 0..SEEDS {
            if residual <= tolerance {
                break;
            }
            let other = self.descend(chain, target, &reference, &self.seed(seed, target, &reference), mu);
            let other_residual = self.residual(chain, target, &other.q);
            iterations += other.iterations;
            // Ends within rounding of each other are one end: stay on the way of the last solution.
            if other.cost < best.cost * (1.0 - 1e-6) {
                (best, residual) = (other, other_residual);
            }
        }
        let status = if residual <= tolerance {
            IkStatus::Reached
        } else if best.converged {
            IkStatus::Unreachable
        } else {
            IkStatus::Budget
        };
        (best.q.into(), IkReport { status, iterations, residual })
    }

    /// Where to begin anew: the reference, the sampled posture with the nearest tip, and the one that is nearest in
    /// tip and posture together.
    fn seed(&self, seed: usize, target: &Vector3<f64>, reference: &Vector) -> Vector {
        let weight = match seed {
            0 => return *reference,
            1 => 0.0,
            _ => POSTURE_WEIGHT_MAX * POSTURE_WEIGHT_MAX,
        };
        let mut best = (f64::INFINITY, *reference);
        for (q, tip) in &self.samples {
            let cost = (tip - target).norm_squared() + weight * (q - reference).norm_squared();
            if cost < best.0 {
                best = (cost, *q);
            }
        }
        best.1
    }

    fn residual(&self, chain: &FingerChain, target: &Vector3<f64>, q: &Vector) -> f64 {
        (chain.tip(&q.as_slice()[..self.count], TipFrame::Pole) - target).norm()
    }

    fn clip(&self, q: &Vector) -> Vector {
        q.zip_zip_map(&self.lower, &self.upper, |value, lower, upper| value.max(lower).min(upper))
    }

    fn descend(
        &self,
        chain: &FingerChain,
        target: &Vector3<f64>,
        reference: &Vector,
        start: &Vector,
        mu: f64,
    ) -> Descent {
        let mut out = Descent { q: self.clip(start), cost: f64::INFINITY, iterations: 0, converged: false };
        let weights = [POSTURE_WEIGHT_MAX, (POSTURE_WEIGHT_MAX * mu).sqrt(), mu];
        for (mu, tolerance) in weights.into_iter().zip(STEP_TOLERANCE) {
            let stage = self.stage(chain, target, reference, out.q, mu, tolerance);
            out = Descent { iterations: out.iterations + stage.iterations, ..stage };
        }
        out
    }

    /// Minimises the weighted sum for one mu.
    fn stage(
        &self,
        chain: &FingerChain,
        target: &Vector3<f64>,
        reference: &Vector,
        mut q: Vector,
        mu: f64,
        tolerance: f64,
    ) -> Descent {
        let weight = mu * mu;
        let cost = |residual: &Vector3<f64>, q: &Vector| {
            0.5 * residual.norm_squared() + 0.5 * weight * (q - reference).norm_squared()
        };
        let mut state = chain.differential(&q.as_slice()[..self.count], TipFrame::Pole);
        let mut residual = state.0 - target;
        let mut value = cost(&residual, &q);
        let mut damping = 0.0;
        for iteration in 0..ITERATIONS_PER_WEIGHT {
            let (gradient, hessian) = self.derivatives(&state.1, &state.2, &residual, &q, reference, weight);
            let Some(step) = self.step(&q, &gradient, hessian, &mut damping) else {
                return Descent { q, cost: value, iterations: iteration, converged: true };
            };
            let trial = self.clip(&(q + step));
            let moved = (trial - q).amax();
            if moved < tolerance {
                // The damping may have shortened the step: only an undamped one says that this is the minimum.
                if damping <= 1e-6 {
                    return Descent { q: trial, cost: value, iterations: iteration + 1, converged: true };
                }
                damping = 0.0;
                continue;
            }
            let trial_state = chain.differential(&trial.as_slice()[..self.count], TipFrame::Pole);
            let trial_residual = trial_state.0 - target;
            let trial_value = cost(&trial_residual, &trial);
            if trial_value < value {
                let settled = value - trial_value < SETTLED * value && damping == 0.0;
                (q, state, residual, value) = (trial, trial_state, trial_residual, trial_value);
                damping *= 0.1;
                if damping < 1e-8 {
                    damping = 0.0;
                }
                if settled && residual.norm_squared() > mu * mu {
                    // Out of reach and nothing left to gain.
                    return Descent { q, cost: value, iterations: iteration + 1, converged: true };
                }
            } else if moved < 1e-7 {
                // Down to rounding: no decrease is left to find.
                return Descent { q, cost: value, iterations: iteration + 1, converged: true };
            } else {
                damping = (damping * 8.0).max(1e-5);
            }
        }
        Descent { q, cost: value, iterations: ITERATIONS_PER_WEIGHT, converged: false }
    }

    /// Gradient and Hessian of the weighted sum; the Hessian with the curvature of the chain (exact), because for a
    /// target out of reach the residual does not vanish and Gauss-Newton crawls.
    fn derivatives(
        &self,
        jacobian: &SMatrix<f64, 3, N>,
        axes: &[Vector3<f64>; N],
        residual: &Vector3<f64>,
        q: &Vector,
        reference: &Vector,
        weight: f64,
    ) -> (Vector, Matrix) {
        let gradient = jacobian.tr_mul(residual) + (q - reference) * weight;
        let mut hessian = jacobian.tr_mul(jacobian);
        for column in 0..self.count {
            let tangent: Vector3<f64> = jacobian.column(column).into();
            // d2 F / dq_row dq_column = axis_row x J_column for row <= column.
            let lever = tangent.cross(residual);
            for row in 0..=column {
                let curvature = axes[row].dot(&lever);
                hessian[(row, column)] += curvature;
                if row != column {
                    hessian[(column, row)] += curvature;
                }
            }
        }
        for slot in 0..N {
            hessian[(slot, slot)] += weight;
        }
        (gradient, hessian)
    }

    /// Newton step of the joints that are free to move; `None` if none is.
    fn step(&self, q: &Vector, gradient: &Vector, mut hessian: Matrix, damping: &mut f64) -> Option<Vector> {
        let mut right = -gradient;
        let mut free = 0;
        for slot in 0..N {
            let pushed_out = slot >= self.count
                || (q[slot] <= self.lower[slot] && gradient[slot] > 0.0)
                || (q[slot] >= self.upper[slot] && gradient[slot] < 0.0);
            if pushed_out {
                hessian.row_mut(slot).fill(0.0);
                hessian.column_mut(slot).fill(0.0);
                hessian[(slot, slot)] = 1.0;
                right[slot] = 0.0;
            } else {
                free += 1;
            }
        }
        if free == 0 {
            return None;
        }
        // Not positive definite far from the minimum: more damping until it is. Ten-fold each time, so a dozen tries
        // pass any curvature a finger can have.
        for _ in 0..12 {
            let mut damped = hessian;
            for slot in 0..N {
                damped[(slot, slot)] += *damping;
            }
            if let Some(factor) = damped.cholesky() {
                return Some(factor.solve(&right));
            }
            *damping = (*damping * 10.0).max(1e-6);
        }
        None
    }
}
