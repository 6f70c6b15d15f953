//! Two published objectives to compare with: `vector` (AnyTeleop) and `dexpilot` (DexPilot).
//!
//! Both choose the whole hand's posture q as the minimum, in the joint box, of
//!
//! ```text
//! sum_i w_i H_beta(|| r_i(q) - t_i ||) + lambda || q - q_last ||^2
//! H_beta(d) = d^2 / (2 beta) for d < beta, d - beta / 2 beyond
//! ```
//!
//! where `r_i` are vectors between points of the robot hand (its wrist and its tips' poles), `t_i` what the same
//! vectors of the human hand ask for, and q_last the minimum of the pose before (at first the middle of the box). The
//! constants are those that dex-retargeting (AnyTeleop's library, commit 3f56141) uses for the Allegro Hand.
//!
//! | | `vector` | `dexpilot` |
//! |---|---|---|
//! | vectors | wrist to every tip | wrist to every tip, and between all tips |
//! | t_i | human vector times `scale` | the same, but for the projected pairs |
//! | w_i | 1/n | 1 from the wrist, 1/m between tips, 200/m and 400/m projected (m vectors) |
//! | beta | 0.02 m | 0.03 m |
//! | lambda | 4e-3 | 4e-3 |
//!
//! A finger is projected from when the human's tip comes within 3 cm of the thumb's until it is farther than 5 cm: the
//! target of that pair is then 0.1 mm long (weight 200). Two projected fingers within 3 cm of each other are asked for
//! 3 cm (weight 400).
//!
//! Differences to that library: the box is kept exactly (it allows 1e-3 rad beyond), the minimum is found to rounding
//! and from two starts (it stops when the sum changes by less than 1e-6), and the line search sees the same sum
//! as the gradient (its value lacks the temporal term).

mod objective;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

pub use objective::{Minimum, TipObjective};

use super::{FingerSignals, MappingMode, MappingOutput};
use crate::hand::{Finger, FingerChain, HandModel, JointVector, MAX_FINGER_JOINTS, MAX_FINGERS, TipFrame};
use crate::ik::{IkReport, IkStatus};

/// Weight of the temporal term, 1/rad^2.
const TEMPORAL: f64 = 4e-3;
/// Where H turns from a square to a line, m.
const BETA_VECTOR: f64 = 0.02;
const BETA_DEXPILOT: f64 = 0.03;
/// Human distances at which a finger is projected and released, m.
const PROJECT: f64 = 0.03;
const RELEASE: f64 = 0.05;
/// Length asked of a projected vector between thumb and finger, and between two fingers, m.
const ETA_THUMB: f64 = 1e-4;
const ETA_FINGERS: f64 = 3e-2;
/// Weights of the same.
const WEIGHT_THUMB: f64 = 200.0;
const WEIGHT_FINGERS: f64 = 400.0;

/// Parameters of the modes `vector` and `dexpilot`; the blend's own (r1, r2, scale, ...) do not concern them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BaselineParams {
    /// Robot lengths per human length.
    pub scale: f64,
    /// alpha of the low-pass behind the solver, `q += alpha (q_new - q)` per pose; 1 is off.
    ///
    /// The library's configuration for the Allegro has 0.2, which hides the jumps of `dexpilot`, opens its pinches
    /// and lags by three frames.
    pub low_pass: f64,
}

impl Default for BaselineParams {
    fn default() -> Self {
        Self { scale: 1.6, low_pass: 1.0 }
    }
}

/// The state of one of the two mappings: the last minimum, who is projected, the filter.
#[derive(Clone, Debug)]
pub struct Baseline {
    dexpilot: bool,
    params: BaselineParams,
    middle: JointVector,
    last: JointVector,
    filtered: Option<JointVector>,
    projected: [bool; MAX_FINGERS],
    // Per finger, postures on a grid over its joint box, with their tips: where else to look for the minimum.
    grid: Vec<Vec<GridPoint>>,
}

type GridPoint = ([f64; MAX_FINGER_JOINTS], Vector3<f64>);

impl Baseline {
    /// The mapping for `mode`, or `None` if that is not one of the two.
    #[must_use]
    pub fn new(hand: &HandModel, mode: MappingMode, params: BaselineParams) -> Option<Self> {
        let dexpilot = match mode {
            MappingMode::Vector => false,
            MappingMode::DexPilot => true,
            _ => return None,
        };
        let mut middle = JointVector::zeros(hand.joints.len());
        for (value, joint) in middle.iter_mut().zip(&hand.joints) {
            *value = 0.5 * (joint.lower + joint.upper);
        }
        let grid = hand.fingers.iter().map(|chain| grid(hand, chain)).collect();
        Some(Self { dexpilot, params, middle, last: middle, filtered: None, projected: [false; MAX_FINGERS], grid })
    }

    /// Starts anew, from the middle of the joint box.
    pub fn reset(&mut self) {
        (self.last, self.filtered, self.projected) = (self.middle, None, [false; MAX_FINGERS]);
    }

    /// The sum to minimise for the human's `tips` (O_W, m, in the order of [`Finger::ALL`]); updates who is projected.
    pub fn objective(&mut self, hand: &HandModel, tips: &[Vector3<f64>; MAX_FINGERS]) -> TipObjective {
        let palm_from_anatomical = hand.anatomical_from_palm.transpose();
        let human = |slot: usize| tips[hand.fingers[slot].finger.index()];
        let count = hand.fingers.len();
        let beta = if self.dexpilot { BETA_DEXPILOT } else { BETA_VECTOR };
        let mut objective = TipObjective::new(beta, TEMPORAL, self.last);
        let weight = if self.dexpilot { 1.0 } else { 1.0 / count as f64 };
        for slot in 0..count {
            let target = hand.wrist + palm_from_anatomical * human(slot) * self.params.scale;
            objective.push(None, slot, target, weight);
        }
        if !self.dexpilot {
            return objective;
        }
        let share = 1.0 / (count * (count + 1) / 2) as f64;
        for to in 0..count {
            for from in to + 1..count {
                let vector = human(to) - human(from);
                let distance = vector.norm();
                let (projected, length, weight) = if to == 0 {
                    // The thumb is the first.
                    let state = &mut self.projected[from];
                    *state = distance < PROJECT || (*state && distance <= RELEASE);
                    (*state, ETA_THUMB, WEIGHT_THUMB)
                } else {
                    let both = self.projected[to] && self.projected[from];
                    (both && distance <= PROJECT, ETA_FINGERS, WEIGHT_FINGERS)
                };
                let (factor, weight) =
                    if projected { (length / (distance + 1e-6), weight) } else { (self.params.scale, 1.0) };
                objective.push(Some(from), to, palm_from_anatomical * vector * factor, weight * share);
            }
        }
        objective
    }

    /// Minimises for the human's `tips` (as in [`Baseline::objective`]), and remembers the minimum for the next pose.
    pub fn step(&mut self, hand: &HandModel, tips: &[Vector3<f64>; MAX_FINGERS]) -> (TipObjective, Minimum) {
        let objective = self.objective(hand, tips);
        // From the last minimum alone, one pose in 40 that comes as a jump ends in a higher one than need be.
        let minimum = objective.minimize(hand, &[self.last, self.nearest(hand, &objective)]);
        self.last = minimum.q;
        (objective, minimum)
    }

    /// The best posture of each finger's grid, as if the vectors between tips were not there.
    fn nearest(&self, hand: &HandModel, objective: &TipObjective) -> JointVector {
        let mut nearest = self.last;
        for ((slot, chain), grid) in hand.fingers.iter().enumerate().zip(&self.grid) {
            let last = chain.select(&self.last);
            let mut least = f64::INFINITY;
            for (q, tip) in grid {
                let value = objective.alone(slot, tip, q, &last);
                if value < least {
                    least = value;
                    chain.scatter(q, &mut nearest);
                }
            }
        }
        nearest
    }

    /// Maps one pose. `signals` come with finger and delta filled in, thumb first.
    pub(super) fn map(
        &mut self,
        hand: &HandModel,
        tips: &[Vector3<f64>; MAX_FINGERS],
        q_joint: JointVector,
        signals: &mut [FingerSignals; MAX_FINGERS],
    ) -> MappingOutput {
        let (objective, minimum) = self.step(hand, tips);
        let mut q = self.filtered.unwrap_or(minimum.q);
        for (value, new) in q.iter_mut().zip(minimum.q.iter()) {
            *value += self.params.low_pass * (new - *value);
        }
        // Rounding may have taken it a hair beyond.
        q = hand.clip(&q);
        self.filtered = Some(q);

        let thumb =
            hand.fingers.first().map_or_else(Vector3::zeros, |chain| chain.tip(&chain.select(&q), TipFrame::Pole));
        let any_projected = self.projected.contains(&true);
        for (slot, (chain, out)) in hand.fingers.iter().zip(signals.iter_mut()).enumerate() {
            let (own, posture) = (chain.select(&q), chain.select(&q_joint));
            out.k = f64::from(self.projected[slot] || (chain.finger == Finger::Thumb && any_projected));
            out.p_joint = chain.tip(&posture, TipFrame::Pole);
            out.p = chain.tip(&own, TipFrame::Pole);
            // Where the finger is asked to be: at the thumb's tip if projected, else where the wrist's vector ends.
            out.p_cartesian = objective.target(None, slot).unwrap_or(out.p);
            if let (true, Some(vector)) = (self.projected[slot], objective.target(Some(slot), 0)) {
                out.p_cartesian = thumb - vector;
            }
            out.p_input = out.p_cartesian;
            out.e_q = own.iter().zip(&posture).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
            out.e_c = (out.p_cartesian - out.p).norm();
            let status = match minimum.converged {
                false => IkStatus::Budget,
                true if out.e_c <= 1e-6 => IkStatus::Reached,
                true => IkStatus::Unreachable,
            };
            out.ik = IkReport { status, iterations: minimum.iterations, residual: out.e_c, jumped: false };
        }
        MappingOutput::new(q_joint, q, &signals[..hand.fingers.len()])
    }
}

/// At most a few hundred postures of the finger, evenly over its joint box.
fn grid(hand: &HandModel, chain: &FingerChain) -> Vec<GridPoint> {
    let steps = [1, 100, 16, 6, 4, 3][chain.joints.len().min(MAX_FINGER_JOINTS)];
    let total = chain.joints.iter().fold(1_usize, |total, _| total * steps);
    let point = |index: usize| {
        let (mut rest, mut q) = (index, [0.0; MAX_FINGER_JOINTS]);
        for (value, joint) in q.iter_mut().zip(&chain.joints) {
            let limits = &hand.joints[joint.joint];
            let share = ((rest % steps) as f64 + 0.5) / steps as f64;
            *value = limits.lower + (limits.upper - limits.lower) * share;
            rest /= steps;
        }
        (q, chain.tip(&q[..chain.joints.len()], TipFrame::Pole))
    };
    (0..total).map(point).collect()
}
