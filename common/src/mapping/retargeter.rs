use nalgebra::Vector3;

use super::{
    Anchor, Baseline, CartesianMap, FingerSignals, Gain, MappingMode, MappingOutput, MappingParams, ParamError,
    ThumbGain, ThumbMap,
    thumb::{ThumbPosture, ThumbShape},
};
use crate::hand::{Finger, FingerChain, HandModel, JointMap, JointVector, MAX_FINGER_JOINTS, MAX_FINGERS, TipFrame};
use crate::ik::{FingerIk, POSTURE_WEIGHT_MAX};
use crate::master::MasterPose;

/// The whole mapping step, from a human pose to a robot posture.
///
/// Holds the last solutions as the next starting points, so successive poses of one motion go through one retargeter.
/// [`Retargeter::map`] does not allocate and its cost is bounded.
#[derive(Clone, Debug)]
pub struct Retargeter {
    hand: HandModel,
    params: MappingParams,
    joint_map: JointMap,
    cartesian: CartesianMap,
    gain: Gain,
    solvers: Vec<FingerIk>,
    thumb_shape: Option<ThumbShape>,
    last_shape: Option<ThumbPosture>,
    // Last solution per finger, and of the thumb's projection.
    last: [Option<[f64; MAX_FINGER_JOINTS]>; MAX_FINGERS],
    last_anchor: Option<[f64; MAX_FINGER_JOINTS]>,
    baseline: Option<Baseline>,
}

impl Retargeter {
    /// A retargeter onto `hand`.
    ///
    /// # Errors
    /// A parameter out of range, or a joint map that the hand does not have.
    pub fn new(hand: HandModel, params: MappingParams) -> Result<Self, ParamError> {
        params.validate()?;
        let joint_map = hand.joint_map(&params.joint_map).cloned().ok_or_else(|| ParamError::JointMap {
            name: params.joint_map.clone(),
            hand: hand.name.clone(),
            known: hand.joint_maps.iter().map(|map| map.name.as_str()).collect::<Vec<_>>().join(", "),
        })?;
        Ok(Self {
            cartesian: CartesianMap::new(&hand, params.scale),
            gain: Gain { r1: params.r1, r2: params.r2, shape: params.gain },
            solvers: hand.fingers.iter().map(|chain| FingerIk::new(chain, &hand.joints)).collect(),
            thumb_shape: ThumbShape::new(&hand),
            last_shape: None,
            baseline: Baseline::new(&hand, params.mode, params.baseline),
            hand,
            params,
            joint_map,
            last: [None; MAX_FINGERS],
            last_anchor: None,
        })
    }

    /// The hand mapped onto.
    #[must_use]
    pub fn hand(&self) -> &HandModel {
        &self.hand
    }

    /// The parameters in force.
    #[must_use]
    pub fn params(&self) -> &MappingParams {
        &self.params
    }

    /// M_Q.
    pub(super) fn joint_map(&self) -> &JointMap {
        &self.joint_map
    }

    /// Forgets the last solutions, for a motion that does not continue the one before.
    pub fn reset(&mut self) {
        self.last = [None; MAX_FINGERS];
        self.last_anchor = None;
        self.last_shape = None;
        if let Some(baseline) = &mut self.baseline {
            baseline.reset();
        }
    }

    /// Maps one pose: all of Eq. 1-14, or one of the baselines.
    #[must_use]
    pub fn map(&mut self, pose: &MasterPose) -> MappingOutput {
        let q_joint = self.joint(pose);
        let palm_from_anatomical = self.hand.anatomical_from_palm.transpose();
        let tips = Finger::ALL.map(|finger| pose.tip(finger));
        self.tune(pose);
        let meeting = self.cartesian.meeting(&tips);
        let thumb_tip = tips[Finger::Thumb.index()];

        let mut signals = Finger::ALL.map(FingerSignals::zero);
        let mut q = q_joint;
        let (k_thumb, closest) = self.gains(&tips, &mut signals);

        if let Some(baseline) = &mut self.baseline {
            signals[0].delta = closest;
            return baseline.map(&self.hand, &tips, q_joint, &mut signals);
        }

        // In O_SW. The thumb comes first in the model: the fingers' targets hang on it.
        let mut anchor = Vector3::zeros();
        for (slot, chain) in self.hand.fingers.iter().enumerate() {
            let posture = chain.select(&q_joint);
            let out = &mut signals[slot];
            out.p_joint = chain.tip(&posture, TipFrame::Pole);
            if chain.finger == Finger::Thumb {
                (out.delta, out.k) = (closest, k_thumb);
                anchor = self.cartesian.thumb(&pose.geometry, &meeting);
                out.p_cartesian = palm_from_anatomical * anchor;
                if self.params.anchor == Anchor::Projected {
                    let (solver, weight) = (&self.solvers[slot], posture_weight(k_thumb));
                    let nearest = match &self.last_anchor {
                        // Nothing hangs on the thumb yet, so its signal is all that has to go on.
                        Some(start) if k_thumb == 0.0 => {
                            solver.follow(chain, &out.p_cartesian, &posture, start, weight)
                        }
                        start => solver.solve(chain, &out.p_cartesian, &posture, start.as_ref(), weight).0,
                    };
                    self.last_anchor = Some(nearest);
                    out.p_cartesian = chain.tip(&nearest, TipFrame::Pole);
                    anchor = self.hand.anatomical_from_palm * out.p_cartesian;
                }
            } else {
                let tip = &tips[chain.finger.index()];
                out.p_cartesian = palm_from_anatomical * self.cartesian.finger(chain.finger, tip, &thumb_tip, &anchor);
            }
            let own = blend(chain, &self.solvers[slot], &posture, &mut self.last[slot], out);
            chain.scatter(&own, &mut q);
        }
        MappingOutput::new(q_joint, q, &signals[..self.hand.fingers.len()])
    }

    /// Clipped M_Q(q), rad.
    fn joint(&mut self, pose: &MasterPose) -> JointVector {
        let mut q = self.hand.clip(&self.joint_map.apply(&pose.q));
        let by_directions = match self.params.thumb_map {
            ThumbMap::Auto => pose.tuning.is_some(),
            ThumbMap::Angles => false,
            ThumbMap::Directions => true,
        };
        let thumb = self.hand.fingers.iter().find(|chain| chain.finger == Finger::Thumb);
        if let (true, Some(chain), Some(shape)) = (by_directions, thumb, &self.thumb_shape) {
            let palm_from_anatomical = self.hand.anatomical_from_palm.transpose();
            let own = shape.solve(chain, &palm_from_anatomical, pose, self.last_shape.as_ref());
            chain.scatter(&own.q, &mut q);
            self.last_shape = Some(own);
        }
        q
    }

    /// Takes over what the pose says about its operator.
    fn tune(&mut self, pose: &MasterPose) {
        let tuning = self.params.tuned(pose.tuning.as_ref());
        self.cartesian.tune(&tuning);
        (self.gain.r1, self.gain.r2) = (tuning.r1, tuning.r2);
    }

    /// Distances and gains of the fingers (Eq. 14); returns K_ST and the smallest distance.
    fn gains(&self, tips: &[Vector3<f64>; 5], signals: &mut [FingerSignals; MAX_FINGERS]) -> (f64, f64) {
        let (mut largest, mut open, mut closest) = (0.0_f64, 1.0, f64::INFINITY);
        for (chain, out) in self.hand.fingers.iter().zip(signals) {
            out.finger = chain.finger;
            if chain.finger == Finger::Thumb {
                continue;
            }
            out.delta = (tips[Finger::Thumb.index()] - tips[chain.finger.index()]).norm();
            out.k = match self.params.mode {
                MappingMode::Combined => self.gain.at(out.delta),
                MappingMode::Joint | MappingMode::Vector | MappingMode::DexPilot => 0.0,
                MappingMode::Cartesian => 1.0,
            };
            largest = largest.max(out.k);
            open *= 1.0 - out.k;
            closest = closest.min(out.delta);
        }
        let k_thumb = match self.params.thumb_gain {
            ThumbGain::Closest => largest,
            ThumbGain::Product => 1.0 - open,
        };
        (k_thumb, closest)
    }
}

/// Blends the two targets (Eq. 13), solves, and fills in the finger's signals; returns its joint angles.
fn blend(
    chain: &FingerChain,
    solver: &FingerIk,
    posture: &[f64; MAX_FINGER_JOINTS],
    last: &mut Option<[f64; MAX_FINGER_JOINTS]>,
    out: &mut FingerSignals,
) -> [f64; MAX_FINGER_JOINTS] {
    let own = if out.k > 0.0 {
        out.p_input = out.p_joint * (1.0 - out.k) + out.p_cartesian * out.k;
        let (own, report) = solver.solve(chain, &out.p_input, posture, last.as_ref(), posture_weight(out.k));
        out.ik = report;
        out.p = chain.tip(&own, TipFrame::Pole);
        own
    } else {
        // Exactly the joint mapping: no solver between the human's finger and the robot's.
        out.p_input = out.p_joint;
        out.p = out.p_joint;
        *posture
    };
    *last = Some(own);
    out.e_q = own.iter().zip(posture).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    out.e_c = (out.p_cartesian - out.p).norm();
    own
}

/// mu where only the tip counts, m/rad.
const POSTURE_WEIGHT_CARTESIAN: f64 = 2e-5;

/// How much the posture weighs at gain k: from most in the joint phase to least in the Cartesian phase, where only the
/// tip counts.
fn posture_weight(k: f64) -> f64 {
    POSTURE_WEIGHT_MAX * (POSTURE_WEIGHT_CARTESIAN / POSTURE_WEIGHT_MAX).powf(k)
}
