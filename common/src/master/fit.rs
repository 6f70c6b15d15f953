//! Joint angles of the paradigmatic hand from 21 keypoints: per finger, bounded least squares on PIP, DIP and tip.
//!
//! The frame O_W is found by registering wrist and knuckles rigidly with the operator's geometry, so the fit does
//! not depend on where the hand is, nor on the frame of the keypoints, and noise of one knuckle is spread over
//! five. The fingertip weighs most: where the model cannot follow the person (a real thumb's MCP and IP axes are
//! not the paradigmatic thumb's), the joints in between give way and the tip, which decides a pinch, stays right.
//! What the data leaves open (the abduction of a finger bent at a right angle, say) stays near the last posture. A
//! thumb that stands up within some 10 deg of the palm's normal has nearly the same points for every q0: there noise
//! moves q0 and q3, not the tip.

use nalgebra::{Matrix3, Matrix4, SVector, Vector3, Vector4};

use super::keypoints::{Keypoints, PalmFrame};
use super::model::{JOINT_LIMITS, JointRange, MasterGeometry, MasterPose};
use crate::hand::{Finger, HandSide, MAX_FINGERS};

/// Joint ranges of the fit, wider than the paradigmatic hand's [`JOINT_LIMITS`]: real knuckles bend backwards and
/// spread further, and a straight finger seen by a noisy tracker bends a little backwards half the time.
pub const FIT_LIMITS: [[JointRange; 4]; MAX_FINGERS] = {
    const FINGER: [JointRange; 4] = [
        JointRange::deg(-40.0, 40.0),
        JointRange::deg(-40.0, 100.0),
        JointRange::deg(-15.0, 125.0),
        JointRange::deg(-25.0, 95.0),
    ];
    const THUMB: [JointRange; 4] = [
        // Half a turn, no more: (q0, q1, q2, q3) and (q0 + pi, pi - q1, -q2, -q3) are the same thumb.
        JointRange::deg(-15.0, 165.0),
        JointRange::deg(-60.0, 120.0),
        JointRange::deg(-60.0, 100.0),
        JointRange::deg(-90.0, 90.0),
    ];
    [THUMB, FINGER, FINGER, FINGER, FINGER]
};

/// Most iterations of one least-squares run; a finger needs at most two runs a frame.
const MAX_ITERATIONS: u8 = 16;
/// A step below this ends the run, rad.
const STEP_TOLERANCE: f64 = 1e-6;
/// So does a step that lowers the cost by less than this share of it.
const COST_TOLERANCE: f64 = 1e-6;
/// Weighted rms residual above which the fit starts again without the last posture, m.
const POOR: f64 = 0.012;
/// Abduction angles tried when there is no last posture.
const SEEDS: usize = 8;
/// Weight of bending against residual in choosing among them, m/rad.
const SEED_PRIOR: f64 = 3e-3;
/// Longest step of a joint in one iteration, rad: far from the solution longer ones leap.
const MAX_STEP: f64 = 0.3;

/// What the fit may trade.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitSettings {
    /// Joint ranges, rad.
    pub limits: [[JointRange; 4]; MAX_FINGERS],
    /// Weight of PIP and DIP against the tip's 1.
    pub joint_weight: f64,
    /// Pull towards the last posture, m/rad.
    pub pull: f64,
}

impl Default for FitSettings {
    fn default() -> Self {
        Self { limits: FIT_LIMITS, joint_weight: 0.3, pull: 3e-3 }
    }
}

impl FitSettings {
    /// The default weights inside the paradigmatic hand's own limits.
    #[must_use]
    pub fn paradigmatic() -> Self {
        Self { limits: JOINT_LIMITS, ..Self::default() }
    }
}

/// How the fit of one finger ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FitStatus {
    /// At the least-squares solution, inside all joint ranges.
    #[default]
    Converged,
    /// At the least-squares solution, a joint at the end of its range.
    AtLimit,
    /// The iterations ran out; the best posture so far.
    Budget,
}

/// Fit of one finger.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FingerFit {
    /// How it ended.
    pub status: FitStatus,
    /// Iterations used.
    pub iterations: u8,
    /// Root mean square distance of PIP, DIP and tip from their keypoints, m.
    pub residual: f64,
    /// Distance of the tip from its keypoint, m.
    pub tip_error: f64,
}

/// Fit of a hand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// The posture, rad.
    pub q: [f64; 20],
    /// Per finger, thumb first.
    pub fingers: [FingerFit; MAX_FINGERS],
}

impl Fit {
    /// Root mean square distance over all 15 points, m.
    #[must_use]
    pub fn residual(&self) -> f64 {
        (self.fingers.iter().map(|f| f.residual * f.residual).sum::<f64>() / MAX_FINGERS as f64).sqrt()
    }
}

/// Fits frame after frame of one person's hand. No allocation, bounded work.
#[derive(Clone, Copy, Debug)]
pub struct Fitter {
    geometry: MasterGeometry,
    side: HandSide,
    settings: FitSettings,
    last: Option<[f64; 20]>,
}

/// The least-squares problem of one finger.
struct Problem<'a> {
    geometry: &'a MasterGeometry,
    finger: Finger,
    /// PIP, DIP, tip in O_W, m.
    target: [Vector3<f64>; 3],
    /// Square roots of the weights of the nine residuals.
    weights: SVector<f64, 9>,
    /// Posture to stay near, with the weight of the squared distance (m^2/rad^2).
    last: Vector4<f64>,
    pull: f64,
    limits: &'a [JointRange; 4],
}

struct Solution {
    q: Vector4<f64>,
    cost: f64,
    iterations: u8,
    converged: bool,
}

impl Fitter {
    /// For an operator's geometry and hand.
    #[must_use]
    pub fn new(geometry: MasterGeometry, side: HandSide) -> Self {
        Self::with_settings(geometry, side, FitSettings::default())
    }

    /// With other weights or joint ranges.
    #[must_use]
    pub const fn with_settings(geometry: MasterGeometry, side: HandSide, settings: FitSettings) -> Self {
        Self { geometry, side, settings, last: None }
    }

    /// Forgets the last posture; to be called after a gap in the stream.
    pub fn reset(&mut self) {
        self.last = None;
    }

    /// The geometry fitted with.
    #[must_use]
    pub const fn geometry(&self) -> &MasterGeometry {
        &self.geometry
    }

    /// Fits one frame, starting from the one before.
    pub fn fit(&mut self, keypoints: &Keypoints) -> Fit {
        let to_hand = register(&self.geometry, self.side, keypoints);
        let mut fit = Fit { q: [0.0; 20], fingers: [FingerFit::default(); MAX_FINGERS] };
        let w = self.settings.joint_weight;
        let pull = self.settings.pull * self.settings.pull;
        for finger in Finger::ALL {
            let [_, pip, dip, tip] = keypoints.finger(finger);
            let start = finger.index() * 4;
            let last = self.last.map(|q| Vector4::new(q[start], q[start + 1], q[start + 2], q[start + 3]));
            let problem = Problem {
                geometry: &self.geometry,
                finger,
                target: [pip, dip, tip].map(|point| to_hand.apply(&point)),
                weights: SVector::from([w, w, w, w, w, w, 1.0, 1.0, 1.0]),
                last: last.unwrap_or_else(Vector4::zeros),
                pull: if last.is_some() { pull } else { 0.0 },
                limits: &self.settings.limits[finger.index()],
            };
            let solution = problem.solve(last);
            fit.fingers[finger.index()] = problem.report(&solution);
            fit.q[start..start + 4].copy_from_slice(solution.q.as_slice());
        }
        self.last = Some(fit.q);
        fit
    }

    /// [`Fitter::fit`] with the geometry, as the mapping takes it.
    pub fn pose(&mut self, keypoints: &Keypoints) -> MasterPose {
        MasterPose { q: self.fit(keypoints).q, geometry: self.geometry, tuning: None }
    }
}

impl Problem<'_> {
    fn solve(&self, last: Option<Vector4<f64>>) -> Solution {
        let warm = last.map(|q| self.descend(self.clamp(q)));
        match warm {
            Some(warm) if warm.cost < 0.5 * POOR * POOR => warm,
            // The first frame, or a hand that has moved on too far: look everywhere.
            _ => {
                let cold = self.descend(self.seed());
                match warm {
                    Some(warm) if warm.cost <= cold.cost => warm,
                    _ => cold,
                }
            }
        }
    }

    /// The best of a few postures that point every phalanx as measured, given an abduction angle.
    fn seed(&self) -> Vector4<f64> {
        let mut best = (f64::INFINITY, Vector4::zeros());
        let [a, b, c] = self.bones();
        for k in 0..SEEDS {
            let range = self.limits[0];
            let q0 = range.min + (range.max - range.min) * (k as f64 + 0.5) / SEEDS as f64;
            let (s, co) = q0.sin_cos();
            let (along, side) = (Vector3::new(s, co, 0.0), Vector3::new(co, -s, 0.0));
            let elevation = |bone: &Vector3<f64>| bone.z.atan2(bone.dot(&along));
            let (first, second) = (elevation(&a), elevation(&b));
            let last = if self.finger == Finger::Thumb {
                let direction = along * second.cos() + Vector3::z() * second.sin();
                c.dot(&side).atan2(c.dot(&direction))
            } else {
                wrapped(elevation(&c) - second)
            };
            let q = self.clamp(Vector4::new(q0, first, wrapped(second - first), last));
            // Of nearly equal solutions the one that bends less.
            let bending = SEED_PRIOR * (q[1].abs() - 2.0 * q[2].min(0.0));
            let residual = self.residual(&self.geometry.finger_points(self.finger, &q.into()));
            let cost = 0.5 * (residual.norm_squared() + bending * bending);
            if cost < best.0 {
                best = (cost, q);
            }
        }
        best.1
    }

    /// Levenberg-Marquardt with an active set: joints at a bound that the descent pushes outward are held.
    fn descend(&self, start: Vector4<f64>) -> Solution {
        let mut q = start;
        let (points, mut jacobian) = self.geometry.finger_jacobian(self.finger, &q.into());
        let mut residual = self.residual(&points);
        let mut cost = self.cost(&residual, &q);
        let mut damping = 1e-2;
        for iteration in 0..MAX_ITERATIONS {
            let mut weighted = jacobian;
            for (row, weight) in self.weights.iter().enumerate() {
                weighted.row_mut(row).scale_mut(*weight);
            }
            let mut gradient = weighted.tr_mul(&residual) + (q - self.last) * self.pull;
            let mut hessian: Matrix4<f64> = weighted.tr_mul(&weighted);
            let floor = damping * hessian.trace();
            for joint in 0..4 {
                hessian[(joint, joint)] += floor + self.pull;
                let JointRange { min, max } = self.limits[joint];
                let held = (q[joint] <= min && gradient[joint] > 0.0) || (q[joint] >= max && gradient[joint] < 0.0);
                if held {
                    gradient[joint] = 0.0;
                    hessian.row_mut(joint).fill(0.0);
                    hessian.column_mut(joint).fill(0.0);
                    hessian[(joint, joint)] = 1.0;
                }
            }
            let Some(factor) = hessian.cholesky() else {
                // Only damping can be lacking.
                damping = (damping * 10.0).min(1e3);
                continue;
            };
            let step = factor.solve(&gradient);
            let next = self.clamp(q - step * (MAX_STEP / step.amax().max(MAX_STEP)));
            let step = (next - q).amax();
            let (points, next_jacobian) = self.geometry.finger_jacobian(self.finger, &next.into());
            let next_residual = self.residual(&points);
            let next_cost = self.cost(&next_residual, &next);
            let mut converged = step < STEP_TOLERANCE;
            if next_cost < cost {
                converged |= cost - next_cost < COST_TOLERANCE * cost;
                (q, residual, jacobian, cost) = (next, next_residual, next_jacobian, next_cost);
                damping = (damping * 0.2).max(1e-4);
            } else {
                damping = (damping * 5.0).min(1e3);
            }
            if converged {
                return Solution { q, cost, iterations: iteration + 1, converged: true };
            }
        }
        Solution { q, cost, iterations: MAX_ITERATIONS, converged: false }
    }

    fn bones(&self) -> [Vector3<f64>; 3] {
        let base = Vector3::from(self.geometry.bases[self.finger.index()]);
        let [pip, dip, tip] = self.target;
        [pip - base, dip - pip, tip - dip]
    }

    /// Weighted.
    fn residual(&self, points: &[Vector3<f64>; 4]) -> SVector<f64, 9> {
        let mut residual = SVector::<f64, 9>::zeros();
        for k in 0..3 {
            residual.fixed_rows_mut::<3>(3 * k).copy_from(&(points[k + 1] - self.target[k]));
        }
        residual.component_mul(&self.weights)
    }

    fn cost(&self, residual: &SVector<f64, 9>, q: &Vector4<f64>) -> f64 {
        0.5 * (residual.norm_squared() + self.pull * (q - self.last).norm_squared())
    }

    fn clamp(&self, q: Vector4<f64>) -> Vector4<f64> {
        Vector4::from_fn(|joint, _| q[joint].clamp(self.limits[joint].min, self.limits[joint].max))
    }

    fn report(&self, solution: &Solution) -> FingerFit {
        let points = self.geometry.finger_points(self.finger, &solution.q.into());
        let errors = [1, 2, 3].map(|k| (points[k] - self.target[k - 1]).norm_squared());
        let at_limit = (0..4).any(|j| {
            let JointRange { min, max } = self.limits[j];
            solution.q[j] <= min || solution.q[j] >= max
        });
        let status = match (solution.converged, at_limit) {
            (false, _) => FitStatus::Budget,
            (true, true) => FitStatus::AtLimit,
            (true, false) => FitStatus::Converged,
        };
        FingerFit {
            status,
            iterations: solution.iterations,
            residual: (errors.iter().sum::<f64>() / 3.0).sqrt(),
            tip_error: errors[2].sqrt(),
        }
    }
}

/// To (-pi, pi].
fn wrapped(angle: f64) -> f64 {
    let (s, c) = angle.sin_cos();
    s.atan2(c)
}

/// Rigid motion from the frame of the keypoints to O_W; includes the mirror for a left hand.
struct ToHand {
    palm: PalmFrame,
    side: HandSide,
    rotation: Matrix3<f64>,
    from: Vector3<f64>,
    to: Vector3<f64>,
}

impl ToHand {
    fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * (self.palm.to_hand(self.side, point) - self.from) + self.to
    }
}

/// Least-squares rigid registration (Kabsch) of wrist and knuckles with the geometry, from the palm frame on.
fn register(geometry: &MasterGeometry, side: HandSide, keypoints: &Keypoints) -> ToHand {
    let palm = PalmFrame::estimate(keypoints);
    let pairs = [Finger::Index, Finger::Middle, Finger::Ring, Finger::Little]
        .map(|f| (palm.to_hand(side, &keypoints.base(f)), Vector3::from(geometry.bases[f.index()])));
    // The wrist is the origin on both sides.
    let from = pairs.iter().map(|pair| pair.0).sum::<Vector3<f64>>() / 5.0;
    let to = pairs.iter().map(|pair| pair.1).sum::<Vector3<f64>>() / 5.0;
    let mut covariance = to * from.transpose();
    for (measured, model) in &pairs {
        covariance += (model - to) * (measured - from).transpose();
    }
    let svd = covariance.svd(true, true);
    let rotation = match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => {
            let sign = (u * v_t).determinant().signum();
            // nalgebra sorts singular values in descending order.
            u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t
        }
        _ => Matrix3::identity(),
    };
    ToHand { palm, side, rotation, from, to }
}
