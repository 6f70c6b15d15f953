//! How well a robot hand followed a recorded human hand: one set of figures, the same for every mapping and filter.
//!
//! The human side of every figure is the recording as it came ([`HumanTips::of_keypoints`] of the unfiltered keypoints),
//! so that a filter cannot improve its own yardstick. Everything here runs over a whole recording at once and allocates.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::Serialize;

use crate::hand::{Finger, FingerChain, HandModel, HandSide, JointVector, MAX_FINGERS, TipFrame};
use crate::mapping::MappingOutput;
use crate::master::{Keypoints, MasterPose, PalmFrame};

/// Thumb and finger of the human touch at and below this distance of their keypoints, m: keypoints lie in the middle of
/// the fingertip, so they never meet.
pub const PINCH: f64 = 0.025;
/// Radius of the spheres that stand for the robot's fingertips, m.
pub const TIP_RADIUS: f64 = 0.012;
/// Spheres may dent each other by this much before it counts as penetration, m.
const DENT: f64 = 0.001;
/// Longest lag looked for, s.
const MAX_LAG: f64 = 0.5;
/// Largest share by which an interval may differ from the median one before the series is resampled, and a speed from
/// the limit before it exceeds it.
const EVEN: f64 = 0.1;
/// A distance that varies by less (root mean square) stands still, m.
const STILL: f64 = 1e-6;
/// A joint this near to a limit is at it, rad.
const AT_LIMIT: f64 = 1e-3;

/// The human's fingertips in O_W (thumb to little finger).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HumanTips {
    /// Positions, m.
    pub tips: [Vector3<f64>; MAX_FINGERS],
    /// Unit vectors along the last phalanges, towards the tips.
    pub distal: [Vector3<f64>; MAX_FINGERS],
}

impl HumanTips {
    /// Of keypoints, as measured.
    #[must_use]
    pub fn of_keypoints(keypoints: &Keypoints, side: HandSide) -> Self {
        let palm = PalmFrame::estimate(keypoints);
        Self::of(|finger| keypoints.finger(finger).map(|point| palm.to_hand(side, &point)))
    }

    /// Of joint angles, for recordings that hold no keypoints.
    #[must_use]
    pub fn of_pose(pose: &MasterPose) -> Self {
        Self::of(|finger| pose.geometry.finger_points(finger, &pose.finger(finger)))
    }

    fn of(points: impl Fn(Finger) -> [Vector3<f64>; 4]) -> Self {
        let fingers = Finger::ALL.map(points);
        Self {
            tips: fingers.map(|points| points[3]),
            distal: fingers.map(|points| (points[3] - points[2]).normalize()),
        }
    }

    fn distance(&self, finger: Finger) -> f64 {
        (self.tips[finger.index()] - self.tips[Finger::Thumb.index()]).norm()
    }
}

/// One frame: what the human did and what the robot made of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Time, s, increasing from frame to frame.
    pub t: f64,
    /// The human.
    pub human: HumanTips,
    /// The posture that was commanded, rad, wire order.
    pub q: JointVector,
    /// Largest distance of a joint from where the joint mapping wants it, of fingers with gain k = 0, rad.
    pub uninvolved: f64,
}

impl Sample {
    /// Of a frame's mapping, with the posture that was commanded in its `q`.
    #[must_use]
    pub fn new(hand: &HandModel, t: f64, human: HumanTips, mapping: &MappingOutput) -> Self {
        let alone = |chain: &&FingerChain| mapping.finger(chain.finger).is_some_and(|signals| signals.k == 0.0);
        let joints = hand.fingers.iter().filter(alone).flat_map(|chain| &chain.joints);
        let away = joints.map(|joint| (mapping.q[joint.joint] - mapping.q_joint[joint.joint]).abs());
        Self { t, human, q: mapping.q, uninvolved: away.fold(0.0, f64::max) }
    }
}

/// The figures. Lengths in m, angles in rad, times in s; `null` where a recording has nothing to measure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Quality {
    /// Frames measured.
    pub frames: usize,
    /// Median interval between frames, s: the "frame" of every figure per frame.
    pub period_s: f64,
    /// Per finger opposing the thumb.
    pub fingers: BTreeMap<&'static str, FingerQuality>,
    /// Mean over frames and joints of |q(t+1) - 2 q(t) + q(t-1)|, rad per frame squared. If the intervals differ by more
    /// than a tenth from their median, the postures are first interpolated linearly onto an even grid of that median.
    pub second_difference_rad: f64,
    /// The same per joint, wire order.
    pub second_difference_by_joint_rad: Vec<f64>,
    /// Largest change of a joint from one frame to the next, rad.
    pub max_step_rad: f64,
    /// Largest such change over the interval in which it happened, rad/s.
    pub max_speed_rad_s: f64,
    /// Share of all joints of all frames that were faster than the joint's limit by more than a tenth. Commands of a
    /// control loop fall beside the frames by up to a tick, so that is how well such speeds are known.
    pub over_speed_share: f64,
    /// Largest distance of a joint beyond its position limits, rad.
    pub limit_violation_rad: f64,
    /// Share of all joints of all frames that were at or beyond a limit.
    pub at_limit_share: f64,
    /// Mean angle between the human's last phalanx and the robot's in the anatomical frames, per finger, rad.
    pub tip_direction_rad: BTreeMap<&'static str, f64>,
    /// Share of the frames in which the tip spheres of thumb and finger, or of neighbouring fingers, overlap by more than
    /// 1 mm.
    pub penetration_share: f64,
    /// Deepest such overlap, m; negative if the spheres never touch.
    pub penetration_m: f64,
    /// Largest distance of a joint from where the joint mapping wants it, among fingers far from the thumb (k = 0), rad.
    pub uninvolved_rad: f64,
}

/// The figures of one finger against the thumb.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FingerQuality {
    /// Frames in which the human's keypoints are nearer than [`PINCH`].
    pub pinch_frames: usize,
    /// Mean distance of the human's keypoints in these frames, m.
    pub pinch_human_m: Option<f64>,
    /// Mean distance of the robot's tip poles in these frames, m.
    pub pinch_gap_m: Option<f64>,
    /// Their 95th percentile, m.
    pub pinch_gap_p95_m: Option<f64>,
    /// Correlation of the human's and the robot's distance from the thumb, without a shift.
    pub correlation: Option<f64>,
    /// The shift of the robot's distance against the human's that correlates best, frames; positive is late.
    pub lag_frames: Option<i64>,
    /// The same between the frames, by a parabola through the best three shifts, s.
    pub lag_s: Option<f64>,
}

impl Quality {
    /// Measures a recording; `None` if it has fewer than three frames or its times do not increase.
    #[must_use]
    pub fn measure(hand: &HandModel, samples: &[Sample]) -> Option<Self> {
        let times: Vec<f64> = samples.iter().map(|sample| sample.t).collect();
        let mut intervals: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let even_enough = |period: f64, interval: &f64| (interval - period).abs() <= EVEN * period;
        if samples.len() < 3 || !intervals.iter().all(|interval| *interval > 0.0) {
            return None;
        }
        let steps = steps(hand, samples, &intervals);
        let period = quantile(&mut intervals, 0.5)?;
        let even = intervals.iter().all(|interval| even_enough(period, interval));
        let grid = |values: Vec<f64>| if even { values } else { resampled(&times, &values, period) };

        let joints = samples[0].q.len();
        let by_joint: Vec<f64> = (0..joints)
            .map(|joint| second_difference(&grid(samples.iter().map(|sample| sample.q[joint]).collect())))
            .collect();
        let thumb = hand.fingers.iter().find(|chain| chain.finger == Finger::Thumb)?;
        let opposing = hand.fingers.iter().filter(|chain| chain.finger != Finger::Thumb);
        let fingers = opposing.map(|chain| {
            let human: Vec<f64> = samples.iter().map(|sample| sample.human.distance(chain.finger)).collect();
            let robot: Vec<f64> = samples.iter().map(|sample| gap(thumb, chain, &sample.q)).collect();
            (chain.finger.name(), FingerQuality::measure(human, robot, period, grid))
        });
        let (penetration_share, penetration_m) = penetration(hand, samples);
        Some(Self {
            frames: samples.len(),
            period_s: period,
            fingers: fingers.collect(),
            second_difference_rad: mean(by_joint.iter().copied())?,
            second_difference_by_joint_rad: by_joint,
            max_step_rad: steps.largest,
            max_speed_rad_s: steps.fastest,
            over_speed_share: steps.over_speed,
            limit_violation_rad: steps.violation,
            at_limit_share: steps.at_limit,
            tip_direction_rad: tip_directions(hand, samples),
            penetration_share,
            penetration_m,
            uninvolved_rad: samples.iter().fold(0.0, |most, sample| sample.uninvolved.max(most)),
        })
    }
}

impl FingerQuality {
    fn measure(human: Vec<f64>, robot: Vec<f64>, period: f64, grid: impl Fn(Vec<f64>) -> Vec<f64>) -> Self {
        let pinched = || human.iter().zip(&robot).filter(|(human, _)| **human < PINCH);
        let mut gaps: Vec<f64> = pinched().map(|(_, gap)| *gap).collect();
        let (pinch_frames, pinch_human_m) = (gaps.len(), mean(pinched().map(|(human, _)| *human)));
        let (pinch_gap_m, pinch_gap_p95_m) = (mean(gaps.iter().copied()), quantile(&mut gaps, 0.95));
        let (human, robot) = (grid(human), grid(robot));
        let correlation = correlation(&human, &robot, 0);
        let lag = lag(&human, &robot, (MAX_LAG / period) as i64);
        Self {
            pinch_frames,
            pinch_human_m,
            pinch_gap_m,
            pinch_gap_p95_m,
            correlation,
            lag_frames: lag.map(|(frames, _)| frames),
            lag_s: lag.map(|(_, between)| between * period),
        }
    }
}

struct Steps {
    largest: f64,
    fastest: f64,
    over_speed: f64,
    violation: f64,
    at_limit: f64,
}

fn steps(hand: &HandModel, samples: &[Sample], intervals: &[f64]) -> Steps {
    let (mut largest, mut fastest, mut violation) = (0.0_f64, 0.0_f64, 0.0_f64);
    let (mut over, mut at_limit) = (0_usize, 0_usize);
    for (pair, interval) in samples.windows(2).zip(intervals) {
        for (joint, (before, after)) in hand.joints.iter().zip(pair[0].q.iter().zip(pair[1].q.iter())) {
            let step = (after - before).abs();
            largest = largest.max(step);
            fastest = fastest.max(step / interval);
            over += usize::from(step / interval > joint.velocity * (1.0 + EVEN));
        }
    }
    for sample in samples {
        for (joint, angle) in hand.joints.iter().zip(sample.q.iter()) {
            violation = violation.max(joint.lower - angle).max(angle - joint.upper);
            at_limit += usize::from(*angle <= joint.lower + AT_LIMIT || *angle >= joint.upper - AT_LIMIT);
        }
    }
    let share = |count: usize, frames: usize| count as f64 / (frames * hand.joints.len()) as f64;
    Steps {
        largest,
        fastest,
        over_speed: share(over, intervals.len()),
        violation,
        at_limit: share(at_limit, samples.len()),
    }
}

/// Distance of the finger's pole from the thumb's, m.
fn gap(thumb: &FingerChain, finger: &FingerChain, q: &JointVector) -> f64 {
    let pole = |chain: &FingerChain| chain.tip(&chain.select(q), TipFrame::Pole);
    (pole(finger) - pole(thumb)).norm()
}

fn tip_directions(hand: &HandModel, samples: &[Sample]) -> BTreeMap<&'static str, f64> {
    let of = |chain: &FingerChain| {
        mean(samples.iter().map(|sample| {
            let own = chain.select(&sample.q);
            let link = chain.tip(&own, TipFrame::Pole) - chain.tip(&own, TipFrame::Center);
            (hand.anatomical_from_palm * link).angle(&sample.human.distal[chain.finger.index()])
        }))
    };
    hand.fingers.iter().filter_map(|chain| Some((chain.finger.name(), of(chain)?))).collect()
}

/// Share of the frames with an overlap of more than [`DENT`], and the deepest overlap.
fn penetration(hand: &HandModel, samples: &[Sample]) -> (f64, f64) {
    let (mut deepest, mut frames) = (f64::NEG_INFINITY, 0_usize);
    for sample in samples {
        let mut overlap = f64::NEG_INFINITY;
        for (k, a) in hand.fingers.iter().enumerate() {
            for b in &hand.fingers[k + 1..] {
                let neighbours = b.finger.index() == a.finger.index() + 1;
                if a.finger == Finger::Thumb || neighbours {
                    let centre = |chain: &FingerChain| chain.tip(&chain.select(&sample.q), TipFrame::Center);
                    overlap = overlap.max(2.0 * TIP_RADIUS - (centre(a) - centre(b)).norm());
                }
            }
        }
        deepest = deepest.max(overlap);
        frames += usize::from(overlap > DENT);
    }
    (frames as f64 / samples.len() as f64, deepest)
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0_usize), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / count as f64)
}

/// The value at share `p` of the sorted values, between two of them by linear interpolation.
fn quantile(values: &mut [f64], p: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let place = p * values.len().checked_sub(1)? as f64;
    let (low, high) = (values[place.floor() as usize], values[place.ceil() as usize]);
    Some(low + (high - low) * place.fract())
}

fn second_difference(values: &[f64]) -> f64 {
    mean(values.windows(3).map(|w| (w[2] - 2.0 * w[1] + w[0]).abs())).unwrap_or(0.0)
}

/// `values` at `times`, interpolated linearly onto a grid of `period` from the first time on.
fn resampled(times: &[f64], values: &[f64], period: f64) -> Vec<f64> {
    let (Some(first), Some(last)) = (times.first(), times.last()) else { return Vec::new() };
    let mut at = 0;
    (0..=((last - first) / period) as usize)
        .map(|k| {
            let t = first + k as f64 * period;
            while at + 2 < times.len() && times[at + 1] < t {
                at += 1;
            }
            let share = ((t - times[at]) / (times[at + 1] - times[at])).clamp(0.0, 1.0);
            values[at] + (values[at + 1] - values[at]) * share
        })
        .collect()
}

/// Pearson's correlation of `a` with `b` read `shift` frames later; `None` if one of them is constant.
fn correlation(a: &[f64], b: &[f64], shift: i64) -> Option<f64> {
    let cut = usize::try_from(shift.unsigned_abs()).ok()?;
    let length = a.len().min(b.len()).checked_sub(cut)?;
    let (a, b) = if shift >= 0 { (&a[..length], &b[cut..cut + length]) } else { (&a[cut..cut + length], &b[..length]) };
    let (mean_a, mean_b) = (mean(a.iter().copied())?, mean(b.iter().copied())?);
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in a.iter().zip(b) {
        let (a, b) = (a - mean_a, b - mean_b);
        ab += a * b;
        aa += a * a;
        bb += b * b;
    }
    let moves = |squares: f64| squares > STILL * STILL * length as f64;
    (moves(aa) && moves(bb)).then(|| ab / (aa * bb).sqrt())
}

/// The shift of `robot` with the largest correlation, in whole frames and refined by a parabola.
fn lag(human: &[f64], robot: &[f64], most: i64) -> Option<(i64, f64)> {
    // Shifts of more than a quarter of the recording say nothing.
    let most = most.min(human.len() as i64 / 4);
    let at = |shift| correlation(human, robot, shift);
    let (best, peak) =
        (-most..=most).filter_map(|shift| Some((shift, at(shift)?))).max_by(|a, b| a.1.total_cmp(&b.1))?;
    let refined = match (at(best - 1), at(best + 1)) {
        (Some(before), Some(after)) if before + after < 2.0 * peak => {
            best as f64 + 0.5 * (before - after) / (before - 2.0 * peak + after)
        }
        _ => best as f64,
    };
    Some((best, refined))
}
