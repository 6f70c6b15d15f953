use nalgebra::{Matrix3, Vector3, Vector4};

use super::{
    Anchor, CartesianMap, MappingMode, MappingParams, ParamError, Pinned, Retargeter, ThumbMap, Tuning, TuningUse,
};
use crate::hand::{Finger, FingerChain, HandModel, JointMap, MAX_FINGERS, TipFrame};
use crate::ik::{FingerIk, POSTURE_WEIGHT_MIN};
use crate::master::{JOINT_LIMITS, MasterGeometry, MasterPose, OPEN, minimum_jerk};

/// A contact closes if the robot's poles come this near, m.
const CLOSED: f64 = 0.001;
/// Contacts of each finger that are judged.
const CONTACTS: usize = 150;
/// Share of them that should close.
const TARGET: f64 = 0.99;
/// c_s looked at, in tenths.
const SCALES: std::ops::RangeInclusive<u32> = 8..=28;
const SCALES_PER_UNIT: f64 = 10.0;
/// Most a finger's scale may exceed the thumb's: beyond it the shape of the grasp suffers.
const MAX_RATIO: f64 = 1.25;
/// r1 of an exact hand, m, and by how much r1 exceeds the distance at which keypoints touch: k = 1 there, whatever the
/// tracker's noise.
const R1: f64 = 0.020;
const R1_MARGIN: f64 = 0.005;
/// Widths of the transition looked at, m, and the largest r2 unless the narrowest needs more: the fingers of a relaxed
/// hand are not much farther from its thumb, and are not to be moved.
const WIDTHS: [f64; 4] = [0.030, 0.040, 0.050, 0.060];
const MAX_R2: f64 = 0.080;
/// Duration of a tap, s, that the robot should follow; the contacts of each finger tried; and the steps per second.
const TAP: f64 = 2.0;
const TAPS: usize = 5;
const TAP_RATE: f64 = 50.0;

/// What was chosen for one operator and one robot hand, and why.
#[derive(Clone, Debug)]
pub struct Tuned {
    /// Name of the robot hand.
    pub hand: String,
    /// The choice.
    pub tuning: Tuning,
    /// Scales c_s, and the share of contacts of index, middle, ring, little that close there with the projected anchor,
    /// 0 to 1; `None` where the robot has no such finger.
    pub coverage: Vec<(f64, [Option<f64>; 4])>,
    /// Median over the taps of the fastest joint's speed, as a share of its limit.
    pub speed: f64,
}

/// Chooses scales and radii for an operator with this geometry, whose keypoints of thumb and fingers touch at `contact`
/// (m, thumb first; 0 for an exact hand), on `hand` with the joint map of `params`.
///
/// c_s of the thumb's map is the largest at which 99 % of the contacts of every finger close, or the one that closes
/// most; c_s of a finger the largest at which 99 % of its own do, at most a quarter above the thumb's. r1 is 5 mm beyond
/// the contacts, r2 as close as taps of 2 s allow without exceeding the speed of the robot's joints (the transition
/// multiplies the speed by up to `1 + pi D / (2 (r2 - r1))`, D the distance of the two targets), but not beyond 80 mm.
/// Deterministic; takes a second or less.
///
/// # Errors
/// A joint map that the hand does not have, or a parameter out of its range.
pub fn tune(
    hand: &HandModel,
    params: &MappingParams,
    geometry: &MasterGeometry,
    contact: &[f64; MAX_FINGERS],
) -> Result<Tuned, ParamError> {
    // The tuning that is being made is to hold, whatever the robot will do with it.
    // The thumb by angles, because it is the transition that is judged, not what the thumb does before.
    let params = MappingParams {
        mode: MappingMode::Combined,
        thumb_map: ThumbMap::Angles,
        tuning: TuningUse::Operator,
        pinned: Pinned::default(),
        ..params.clone()
    };
    let mut retargeter = Retargeter::new(hand.clone(), params)?;
    let joint_map = retargeter.joint_map().clone();
    let judge = Judge::new(hand, &joint_map);
    let samples: Vec<(Finger, Vec<MasterPose>)> = Finger::ALL[1..]
        .iter()
        .filter(|&&finger| hand.fingers.iter().any(|chain| chain.finger == finger))
        .map(|&finger| (finger, contacts(geometry, finger, contact[finger.index()], CONTACTS, 1)))
        // A person whose thumb does not reach a finger says nothing about it.
        .filter(|(_, contacts)| !contacts.is_empty())
        .collect();

    let mut coverage = Vec::new();
    let mut best = 0.0_f64;
    for scale in SCALES.map(|step| f64::from(step) / SCALES_PER_UNIT) {
        let mut shares = [None; 4];
        for (finger, contacts) in &samples {
            shares[finger.index() - 1] = Some(judge.coverage(contacts, *finger, scale, Anchor::Projected));
        }
        coverage.push((scale, shares));
        let most = shares.iter().flatten().copied().fold(0.0, f64::max);
        best = best.max(most);
        if most < 0.8 * best {
            // Larger ones only close less.
            break;
        }
    }
    // A thumb that reaches no finger says nothing either.
    let thumb = if samples.is_empty() {
        retargeter.params().scale
    } else {
        largest(&coverage, |shares| shares.iter().flatten().copied().fold(1.0, f64::min))
    };
    let mut scale = [thumb; MAX_FINGERS];
    for (finger, _) in &samples {
        let own = largest(&coverage, |shares| shares[finger.index() - 1].unwrap_or(1.0));
        scale[finger.index()] = own.clamp(thumb, MAX_RATIO * thumb);
    }

    let r1 = contact.iter().fold(R1, |r1, touch| r1.max(touch + R1_MARGIN));
    let mut tuning = Tuning { scale, r1, r2: r1, contact: *contact };
    let mut speed = f64::INFINITY;
    for width in WIDTHS {
        tuning.r2 = (r1 + width).min(MAX_R2.max(r1 + WIDTHS[0]));
        speed = tap_speed(&mut retargeter, &tuning, &samples);
        if speed <= 1.0 {
            break;
        }
    }
    Ok(Tuned { hand: hand.name.clone(), tuning, coverage, speed })
}

/// The largest scale at which `share` reaches the target, or the one where it is largest.
fn largest(coverage: &[(f64, [Option<f64>; 4])], share: impl Fn(&[Option<f64>; 4]) -> f64) -> f64 {
    let mut best = (0.0, 1.0);
    for (scale, shares) in coverage {
        let share = share(shares).min(TARGET);
        if share >= best.0 {
            best = (share, *scale);
        }
    }
    best.1
}

/// The median over taps of the fastest joint's speed, as a share of its limit.
fn tap_speed(retargeter: &mut Retargeter, tuning: &Tuning, samples: &[(Finger, Vec<MasterPose>)]) -> f64 {
    let mut peaks = Vec::with_capacity(samples.len() * TAPS);
    for contact in samples.iter().flat_map(|(_, contacts)| contacts.iter().take(TAPS)) {
        retargeter.reset();
        let mut last = None;
        let mut peak = 0.0_f64;
        for step in 0..=(TAP * TAP_RATE) as usize {
            let share = minimum_jerk(step as f64 / (TAP * TAP_RATE));
            let q = std::array::from_fn(|joint| OPEN[joint] + share * (contact.q[joint] - OPEN[joint]));
            let output = retargeter.map(&MasterPose { q, tuning: Some(*tuning), ..*contact });
            if let Some(last) = last.replace(output.q) {
                for ((now, before), joint) in output.q.iter().zip(last.iter()).zip(&retargeter.hand().joints) {
                    peak = peak.max((now - before).abs() * TAP_RATE / joint.velocity);
                }
            }
        }
        peaks.push(peak);
    }
    peaks.sort_by(f64::total_cmp);
    peaks.get(peaks.len() / 2).copied().unwrap_or(0.0)
}

impl Tuned {
    /// Lines for a person to read.
    #[must_use]
    pub fn report(&self) -> Vec<String> {
        let Tuning { scale, r1, r2, contact } = &self.tuning;
        let millimetres = |finger: Finger| format!("{} {:.0}", finger.name(), contact[finger.index()] * 1e3);
        let fingers: Vec<Finger> = Finger::ALL[1..]
            .iter()
            .copied()
            .filter(|finger| self.coverage.iter().any(|(_, shares)| shares[finger.index() - 1].is_some()))
            .collect();
        let list = |text: &dyn Fn(Finger) -> String| fingers.iter().map(|&f| text(f)).collect::<Vec<_>>().join(", ");
        let mut lines = vec![
            format!(
                "tuned for {}: scale {:.2} of the thumb ({}), r1 {:.0} mm, r2 {:.0} mm, contact at {} mm",
                self.hand,
                scale[0],
                list(&|finger| format!("{} {:.2}", finger.name(), scale[finger.index()])),
                r1 * 1e3,
                r2 * 1e3,
                list(&millimetres),
            ),
            format!(
                "a tap of {TAP} s takes at most {:.0} % of the joints' speed (median over taps)",
                self.speed * 100.0
            ),
            format!("share of the person's contacts that close, by scale: {}", list(&|f| f.name().to_owned())),
        ];
        for (scale, shares) in self.coverage.iter().step_by(2) {
            let shares = list(&|finger| {
                shares[finger.index() - 1].map_or_else(String::new, |share| format!("{:3.0} %", share * 100.0))
            });
            lines.push(format!("  {scale:.1}  {shares}"));
        }
        lines
    }
}

/// Postures of a master hand in which the tips of thumb and `finger` are `distance` (m) apart: `count` of them, or
/// fewer for a hand whose thumb hardly reaches the finger.
///
/// The finger's posture is drawn uniformly from [`JOINT_LIMITS`], another for the thumb, which then reaches for the
/// finger; fingers it cannot reach are left out. The sequence is deterministic and fills the range evenly; another
/// `first` gives another sample.
#[must_use]
pub fn contacts(
    geometry: &MasterGeometry,
    finger: Finger,
    distance: f64,
    count: usize,
    first: usize,
) -> Vec<MasterPose> {
    let posture = |finger: Finger, point: &[f64]| {
        let limits = &JOINT_LIMITS[finger.index()];
        Vector4::from_fn(|joint, _| limits[joint].min + (limits[joint].max - limits[joint].min) * point[joint])
    };
    let contact = |index: usize| {
        // Multiples of the roots of primes, modulo 1.
        let point = [2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0_f64].map(|prime| (prime.sqrt() * index as f64).fract());
        let own: [f64; 4] = posture(finger, &point[..4]).into();
        let tip = geometry.finger_points(finger, &own)[3];
        // From the drawn posture and from its mirror image in the middle of the range.
        let starts = [[0, 1, 2, 3].map(|joint| point[4 + joint]), [0, 1, 2, 3].map(|joint| 1.0 - point[4 + joint])];
        let thumb = starts.into_iter().find_map(|start| {
            let start = posture(Finger::Thumb, &start);
            let from = geometry.finger_points(Finger::Thumb, &start.into())[3] - tip;
            reach(geometry, start, &(tip + from.try_normalize(0.0).unwrap_or_default() * distance))
        })?;
        let mut q = OPEN;
        q[..4].copy_from_slice(thumb.as_slice());
        q[4 * finger.index()..4 * finger.index() + 4].copy_from_slice(&own);
        Some(MasterPose { q, geometry: *geometry, tuning: None })
    };
    (first..first + 60 * count).filter_map(contact).take(count).collect()
}

/// The master's thumb with its tip at `target`, if it gets there from `q` within its limits.
fn reach(geometry: &MasterGeometry, mut q: Vector4<f64>, target: &Vector3<f64>) -> Option<Vector4<f64>> {
    let limits = &JOINT_LIMITS[Finger::Thumb.index()];
    // (3 mm/rad)^2 keeps the steps bounded where the thumb is straight.
    let damping = Matrix3::identity() * 9e-6;
    let base = Vector3::from(geometry.bases[Finger::Thumb.index()]);
    if (target - base).norm() > geometry.phalanges[Finger::Thumb.index()].iter().sum::<f64>() {
        return None;
    }
    for _ in 0..50 {
        let (points, jacobian) = geometry.finger_jacobian(Finger::Thumb, &q.into());
        let error = target - points[3];
        if error.norm() < 1e-5 {
            return Some(q);
        }
        let jacobian = jacobian.fixed_rows::<3>(6);
        let step = jacobian.tr_mul(&(jacobian * jacobian.transpose() + damping).cholesky()?.solve(&error));
        for joint in 0..4 {
            q[joint] = (q[joint] + step[joint]).clamp(limits[joint].min, limits[joint].max);
        }
    }
    None
}

/// Judges whether a robot hand can close the contacts of a master hand.
#[derive(Debug)]
pub struct Judge<'a> {
    hand: &'a HandModel,
    joint_map: &'a JointMap,
    solvers: Vec<FingerIk>,
}

impl<'a> Judge<'a> {
    /// A judge of `hand`, whose fingers are as near to `joint_map` as a contact allows.
    #[must_use]
    pub fn new(hand: &'a HandModel, joint_map: &'a JointMap) -> Self {
        let solvers = hand.fingers.iter().map(|chain| FingerIk::new(chain, &hand.joints)).collect();
        Self { hand, joint_map, solvers }
    }

    /// How far from closed the robot stays, m, at scale c_s, where the master's tips of thumb and `finger` touch: with
    /// the projected anchor the distance of the robot's poles, with the reference anchor the larger of the distances
    /// of the two poles from the thumb's target.
    #[must_use]
    pub fn gap(&self, pose: &MasterPose, finger: Finger, scale: f64, anchor: Anchor) -> f64 {
        let posture = self.hand.clip(&self.joint_map.apply(&pose.q));
        let solve = |slot: usize, target: &Vector3<f64>| {
            let chain: &FingerChain = &self.hand.fingers[slot];
            let posture = chain.select(&posture);
            let (q, report) = self.solvers[slot].solve(chain, target, &posture, None, POSTURE_WEIGHT_MIN);
            (chain.tip(&q, TipFrame::Pole), report.residual)
        };
        let Some(slot) = self.hand.fingers.iter().position(|chain| chain.finger == finger) else {
            return f64::INFINITY;
        };
        let map = CartesianMap::new(self.hand, scale);
        let meeting = (pose.tip(Finger::Thumb) + pose.tip(finger)) * 0.5;
        let target = self.hand.anatomical_from_palm.transpose() * map.thumb(&pose.geometry, &meeting);
        // The thumb comes first in the model.
        let (reached, residual) = solve(0, &target);
        match anchor {
            Anchor::Projected => solve(slot, &reached).1,
            Anchor::Reference => residual.max(solve(slot, &target).1),
        }
    }

    /// Share of `contacts` that close to within 1 mm, 0 to 1.
    #[must_use]
    pub fn coverage(&self, contacts: &[MasterPose], finger: Finger, scale: f64, anchor: Anchor) -> f64 {
        let closed = contacts.iter().filter(|pose| self.gap(pose, finger, scale, anchor) < CLOSED).count();
        closed as f64 / contacts.len().max(1) as f64
    }
}
