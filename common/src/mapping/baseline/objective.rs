use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use crate::hand::{HandModel, JointVector, MAX_FINGER_JOINTS, MAX_FINGERS, MAX_JOINTS, TipFrame, TipJacobian};

/// Joints of the smaller of the two sizes that the solver is compiled for: a factorisation costs their cube.
const USUAL_JOINTS: usize = 16;

/// Every tip from the wrist, and every pair of tips.
const MAX_TERMS: usize = MAX_FINGERS * (MAX_FINGERS + 1) / 2;
const MAX_ITERATIONS: u16 = 60;
/// A descent ends when the quadratic model promises less than this.
const PRECISION: f64 = 1e-12;

/// `w H(|| p_to - p_from - target ||)`; without `from`, `target` is a point of the palm frame.
#[derive(Clone, Copy, Debug)]
struct Term {
    from: Option<usize>,
    to: usize,
    target: Vector3<f64>,
    weight: f64,
}

/// A sum of Huber losses of vectors between fingertips, and of the squared distance from the last posture.
///
/// Fingers are meant by their position in [`HandModel::fingers`]; points are tip poles in the palm frame, m.
#[derive(Clone, Debug)]
pub struct TipObjective {
    terms: [Term; MAX_TERMS],
    len: usize,
    beta: f64,
    temporal: f64,
    last: JointVector,
}

/// What minimising came to.
#[derive(Clone, Copy, Debug)]
pub struct Minimum {
    /// Where, rad, wire order, inside the limits.
    pub q: JointVector,
    /// The sum there.
    pub value: f64,
    /// Newton steps, over all starts.
    pub iterations: u16,
    /// False if the budget of steps ran out first.
    pub converged: bool,
}

/// Tip, Jacobian and axes of one finger.
type TipState = (Vector3<f64>, TipJacobian, [Vector3<f64>; MAX_FINGER_JOINTS]);

#[derive(Clone, Copy)]
struct State<const N: usize> {
    q: SVector<f64, N>,
    tips: [TipState; MAX_FINGERS],
    value: f64,
}

impl TipObjective {
    /// Only the temporal term, `temporal || q - last ||^2`; the losses turn linear at `beta` (m).
    #[must_use]
    pub(super) fn new(beta: f64, temporal: f64, last: JointVector) -> Self {
        let none = Term { from: None, to: 0, target: Vector3::zeros(), weight: 0.0 };
        Self { terms: [none; MAX_TERMS], len: 0, beta, temporal, last }
    }

    /// Adds `weight * H(|| p_to - p_from - target ||)`, or with a point as `target` and no `from`.
    pub(super) fn push(&mut self, from: Option<usize>, to: usize, target: Vector3<f64>, weight: f64) {
        if let Some(term) = self.terms.get_mut(self.len) {
            *term = Term { from, to, target, weight };
            self.len += 1;
        }
    }

    /// The target of one vector.
    #[must_use]
    pub(super) fn target(&self, from: Option<usize>, to: usize) -> Option<Vector3<f64>> {
        self.terms().iter().find(|term| (term.from, term.to) == (from, to)).map(|term| term.target)
    }

    /// What the sum would be for one finger with its tip at `tip`, if it were alone with the wrist.
    pub(super) fn alone(&self, slot: usize, tip: &Vector3<f64>, q: &[f64], last: &[f64]) -> f64 {
        let Some(term) = self.terms().iter().find(|term| (term.from, term.to) == (None, slot)) else { return 0.0 };
        let moved: f64 = q.iter().zip(last).map(|(a, b)| (a - b).powi(2)).sum();
        term.weight * self.huber((tip - term.target).norm()) + self.temporal * moved
    }

    /// H
    fn huber(&self, distance: f64) -> f64 {
        if distance < self.beta { 0.5 * distance * distance / self.beta } else { distance - 0.5 * self.beta }
    }

    /// The sum at `q` (rad, wire order).
    #[must_use]
    pub fn value(&self, hand: &HandModel, q: &JointVector) -> f64 {
        self.state::<MAX_JOINTS>(hand, padded(q)).value
    }

    /// The least minimum that the descents from `starts` (rad, wire order) come to, each clipped into the joint box.
    ///
    /// Projected Newton with Levenberg damping. In the tips' positions the sum is convex; what curves the other way
    /// is the hand, and that part of the Hessian is left out of a step where it makes it indefinite. Bounded, and
    /// does not allocate.
    #[must_use]
    pub fn minimize(&self, hand: &HandModel, starts: &[JointVector]) -> Minimum {
        let mut best = Minimum { q: self.last, value: f64::INFINITY, iterations: 0, converged: false };
        let mut iterations = 0;
        for start in starts {
            let end = if hand.joints.len() <= USUAL_JOINTS {
                self.descend::<USUAL_JOINTS>(hand, start)
            } else {
                self.descend::<MAX_JOINTS>(hand, start)
            };
            iterations += end.iterations;
            // Ends within rounding of each other are one: stay on the way of the first start.
            if end.value < best.value - 1e-9 {
                best = end;
            }
        }
        Minimum { iterations, ..best }
    }

    fn terms(&self) -> &[Term] {
        &self.terms[..self.len]
    }

    fn state<const N: usize>(&self, hand: &HandModel, q: SVector<f64, N>) -> State<N> {
        let mut tips = [(Vector3::zeros(), TipJacobian::zeros(), [Vector3::zeros(); MAX_FINGER_JOINTS]); MAX_FINGERS];
        for (tip, chain) in tips.iter_mut().zip(&hand.fingers) {
            let (pole, columns, axes) = chain.differential(&chain.select(q.as_slice()), TipFrame::Pole);
            *tip = (pole, TipJacobian::from_columns(&columns), axes);
        }
        let mut value = self.temporal * (q - padded(&self.last)).norm_squared();
        for term in self.terms() {
            value += term.weight * self.huber(residual(term, &tips).norm());
        }
        State { q, tips, value }
    }

    fn descend<const N: usize>(&self, hand: &HandModel, start: &JointVector) -> Minimum {
        let clip = |mut q: SVector<f64, N>| {
            for (value, joint) in q.iter_mut().zip(&hand.joints) {
                *value = value.clamp(joint.lower, joint.upper);
            }
            q
        };
        let mut state = self.state(hand, clip(padded(start)));
        let mut damping = 0.0;
        let (mut iterations, mut converged) = (0, false);
        while iterations < MAX_ITERATIONS && !converged {
            iterations += 1;
            let Some((step, promised)) = self.step(hand, &state, damping) else { break };
            let trial = self.state(hand, clip(state.q + step));
            converged = promised < PRECISION && damping == 0.0;
            if trial.value < state.value {
                state = trial;
                damping = if damping > 1e-5 { damping * 0.1 } else { 0.0 };
            } else if promised < PRECISION {
                // Down to rounding: no decrease is left to find.
                converged = true;
            } else {
                damping = (damping * 8.0).max(self.temporal);
            }
        }
        let q = JointVector::from_slice(&state.q.as_slice()[..hand.joints.len().min(N)]);
        Minimum { q, value: state.value, iterations, converged }
    }

    /// Newton step of the joints that are free to move, and the decrease that the quadratic model promises for it.
    fn step<const N: usize>(&self, hand: &HandModel, state: &State<N>, damping: f64) -> Option<(SVector<f64, N>, f64)> {
        // Gradient and Hessian of the losses by the tips' positions.
        let mut by_tip = [Vector3::zeros(); MAX_FINGERS];
        let mut by_tips = [[Matrix3::zeros(); MAX_FINGERS]; MAX_FINGERS];
        for term in self.terms() {
            let error = residual(term, &state.tips);
            let distance = error.norm();
            let (slope, bend) = if distance < self.beta {
                (1.0 / self.beta, 0.0)
            } else {
                (distance.recip(), distance.powi(3).recip())
            };
            let gradient = error * (term.weight * slope);
            let hessian = (Matrix3::from_diagonal_element(slope) - error * error.transpose() * bend) * term.weight;
            by_tip[term.to] += gradient;
            by_tips[term.to][term.to] += hessian;
            if let Some(from) = term.from {
                by_tip[from] -= gradient;
                by_tips[from][from] += hessian;
                by_tips[term.to][from] -= hessian;
                by_tips[from][term.to] -= hessian;
            }
        }
        // By the joints: J^T B J, and apart from it what the curvature of the chains adds.
        let mut gradient = (state.q - padded(&self.last)) * (2.0 * self.temporal);
        let mut hessian = SMatrix::<f64, N, N>::from_diagonal_element(2.0 * self.temporal + damping);
        let mut curvature = SMatrix::<f64, N, N>::zeros();
        for (a, chain) in hand.fingers.iter().enumerate() {
            let (_, jacobian, axes) = &state.tips[a];
            let own = jacobian.tr_mul(&by_tip[a]);
            for (column, joint) in chain.joints.iter().enumerate() {
                gradient[joint.joint] += own[column];
                // d2 p / dq_row dq_column = axis_row x J_column for row <= column.
                let lever = Vector3::from(jacobian.column(column)).cross(&by_tip[a]);
                for (row, other) in chain.joints[..=column].iter().enumerate() {
                    curvature[(other.joint, joint.joint)] = axes[row].dot(&lever);
                    curvature[(joint.joint, other.joint)] = axes[row].dot(&lever);
                }
            }
            for (b, other) in hand.fingers.iter().enumerate() {
                let block = jacobian.tr_mul(&(by_tips[a][b] * state.tips[b].1));
                for (row, joint) in chain.joints.iter().enumerate() {
                    for (column, across) in other.joints.iter().enumerate() {
                        hessian[(joint.joint, across.joint)] += block[(row, column)];
                    }
                }
            }
        }
        // Joints held by their limits stay.
        for (slot, joint) in hand.joints.iter().enumerate() {
            let (q, slope) = (state.q[slot], gradient[slot]);
            if (q <= joint.lower && slope > 0.0) || (q >= joint.upper && slope < 0.0) {
                gradient[slot] = 0.0;
                for matrix in [&mut hessian, &mut curvature] {
                    matrix.row_mut(slot).fill(0.0);
                    matrix.column_mut(slot).fill(0.0);
                }
                hessian[(slot, slot)] = 1.0;
            }
        }
        let factor = (hessian + curvature).cholesky().or_else(|| hessian.cholesky())?;
        let step = -factor.solve(&gradient);
        Some((step, -0.5 * gradient.dot(&step)))
    }
}

fn residual(term: &Term, tips: &[TipState; MAX_FINGERS]) -> Vector3<f64> {
    let origin = term.from.map_or_else(Vector3::zeros, |from| tips[from].0);
    tips[term.to].0 - origin - term.target
}

fn padded<const N: usize>(q: &JointVector) -> SVector<f64, N> {
    let mut out = SVector::<f64, N>::zeros();
    for (value, angle) in out.iter_mut().zip(q.iter()) {
        *value = *angle;
    }
    out
}
