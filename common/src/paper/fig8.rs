//! Fig. 8: the tripod over 80 s, and what must hold for its signals.

use std::f64::consts::PI;

use super::Check;
use super::motion::{Sample, run};
use crate::hand::{Finger, HandModel};
use crate::mapping::{FingerSignals, Gain, GainShape, MappingParams, ParamError, Retargeter};
use crate::master::Gesture;

/// Samples per second of the figure.
pub const RATE: f64 = 10.0;
/// The time about which the motion is its own mirror image, s.
pub const MIRROR: f64 = 40.0;
/// The fingers that the figure shows.
pub const FINGERS: [Finger; 3] = [Finger::Thumb, Finger::Index, Finger::Middle];
/// Below this residual (m) a target counts as reachable.
const REACHABLE: f64 = 1e-6;

/// When a gain leaves 0, passes one half and reaches 1, s; NaN for what does not happen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Times {
    /// First sample above 0.
    pub leaves: f64,
    /// Where it passes 0.5, interpolated.
    pub half: f64,
    /// First sample at 1.
    pub reaches: f64,
}

/// The tripod's signals, t = 0 to 80 s.
///
/// # Errors
/// A mapping parameter that cannot be used.
pub fn signals(hand: &HandModel, params: &MappingParams, gesture: Gesture) -> Result<Vec<Sample>, ParamError> {
    run(hand, params, gesture, RATE)
}

/// When the finger's gain rises, before [`MIRROR`].
#[must_use]
pub fn rise(samples: &[Sample], finger: Finger) -> Times {
    let k = |sample: &Sample| sample.output.finger(finger).map_or(0.0, |signals| signals.k);
    let first = |above: &dyn Fn(f64) -> bool| samples.iter().position(|sample| above(k(sample)));
    let time = |index: Option<usize>| index.map_or(f64::NAN, |index| samples[index].t);
    let half = first(&|k| k >= 0.5).map_or(f64::NAN, |after| {
        let Some(before) = after.checked_sub(1) else { return samples[after].t };
        let (from, to) = (&samples[before], &samples[after]);
        from.t + (to.t - from.t) * (0.5 - k(from)) / (k(to) - k(from))
    });
    Times { leaves: time(first(&|k| k > 0.0)), half, reaches: time(first(&|k| k >= 1.0)) }
}

/// The properties P1 to P7 of the signals, for the hand and parameters they were made with.
///
/// # Errors
/// A mapping parameter that cannot be used.
pub fn checks(hand: &HandModel, params: &MappingParams, samples: &[Sample]) -> Result<Vec<Check>, ParamError> {
    Ok(vec![
        joint_phase(samples),
        cartesian_phase(hand, params, samples)?,
        gains(samples),
        order(params, samples),
        sigmoid(params, samples),
        blend(samples),
        bounded(params, samples),
    ])
}

/// Signals of the finger over time.
fn of(samples: &[Sample], finger: Finger) -> impl Iterator<Item = &FingerSignals> {
    samples.iter().filter_map(move |sample| sample.output.finger(finger))
}

fn joint_phase(samples: &[Sample]) -> Check {
    let mut values = Vec::new();
    let mut holds = true;
    for finger in FINGERS {
        let (mut least, mut most, mut shape) = (f64::INFINITY, 0.0_f64, 0.0_f64);
        for signals in of(samples, finger).filter(|signals| signals.k == 0.0) {
            (least, most, shape) = (least.min(signals.e_c), most.max(signals.e_c), shape.max(signals.e_q));
        }
        holds &= shape < 1e-9 && least > 0.0;
        let name = finger.name();
        values.push((format!("{name}_max_e_q_rad"), shape));
        values.push((format!("{name}_min_e_c_mm"), least * 1e3));
        values.push((format!("{name}_max_e_c_mm"), most * 1e3));
    }
    Check {
        name: "P1",
        statement: "where k = 0: e_Q = 0 exactly and e_C > 0".into(),
        holds: Some(holds),
        values,
        note: String::new(),
    }
}

fn cartesian_phase(hand: &HandModel, params: &MappingParams, samples: &[Sample]) -> Result<Check, ParamError> {
    // Whether a target can be reached is asked of a solver that has not come along the motion.
    let mut cold = Retargeter::new(hand.clone(), params.clone())?;
    let (mut values, mut unreachable) = (Vec::new(), Vec::new());
    let (mut holds, mut asserted) = (true, false);
    for finger in FINGERS {
        let (mut total, mut reachable) = (0_u32, 0_u32);
        let (mut worst, mut shape) = (0.0_f64, f64::INFINITY);
        for sample in samples {
            let Some(signals) = sample.output.finger(finger).filter(|signals| signals.k == 1.0) else { continue };
            total += 1;
            cold.reset();
            let apart = cold.map(&sample.pose).finger(finger).map_or(f64::INFINITY, |signals| signals.e_c);
            reachable += u32::from(apart.min(signals.e_c) < REACHABLE);
            (worst, shape) = (worst.max(signals.e_c), shape.min(signals.e_q));
        }
        let name = finger.name();
        values.push((format!("{name}_reachable_share"), f64::from(reachable) / f64::from(total.max(1))));
        values.push((format!("{name}_max_e_c_mm"), worst * 1e3));
        values.push((format!("{name}_min_e_q_rad"), shape));
        if reachable < total {
            unreachable.push(format!(
                "{name} in {} of {total} samples, by up to {:.1} mm",
                total - reachable,
                worst * 1e3
            ));
        } else if total > 0 {
            asserted = true;
            holds &= worst < REACHABLE && shape > 0.0;
        }
    }
    let note = if unreachable.is_empty() {
        String::new()
    } else {
        format!(
            "not asserted for fingers whose Cartesian target is out of the hand's reach: {}",
            unreachable.join("; ")
        )
    };
    Ok(Check {
        name: "P2",
        statement: "where k = 1, of fingers that can reach their targets: e_C < 1e-3 mm while e_Q > 0".into(),
        holds: asserted.then_some(holds),
        values,
        note,
    })
}

fn gains(samples: &[Sample]) -> Check {
    let (mut closest, mut ring, mut mirror) = (0.0_f64, 0.0_f64, 0.0_f64);
    for (sample, mirrored) in samples.iter().zip(samples.iter().rev()) {
        let fingers = sample.output.fingers();
        let largest = fingers.iter().filter(|f| f.finger != Finger::Thumb).fold(0.0, |max: f64, f| max.max(f.k));
        for (signals, mirrored) in fingers.iter().zip(mirrored.output.fingers()) {
            match signals.finger {
                Finger::Thumb => closest = closest.max((signals.k - largest).abs()),
                Finger::Ring => ring = ring.max(signals.k),
                _ => {}
            }
            mirror = mirror.max((signals.k - mirrored.k).abs());
        }
    }
    Check {
        name: "P3",
        statement: format!("k_T = max k_j, k_R = 0 throughout, and k is symmetric in time about {MIRROR} s"),
        holds: Some(closest < 1e-12 && ring == 0.0 && mirror < 1e-9),
        values: vec![
            ("max_difference_k_t".into(), closest),
            ("max_k_ring".into(), ring),
            ("max_asymmetry".into(), mirror),
        ],
        note: String::new(),
    }
}

fn order(params: &MappingParams, samples: &[Sample]) -> Check {
    let mut values = vec![("r1_mm".into(), params.r1 * 1e3), ("r2_mm".into(), params.r2 * 1e3)];
    for finger in [Finger::Index, Finger::Middle] {
        let Times { leaves, half, reaches } = rise(samples, finger);
        let name = finger.name();
        values.extend([
            (format!("{name}_leaves_0_s"), leaves),
            (format!("{name}_half_s"), half),
            (format!("{name}_reaches_1_s"), reaches),
        ]);
    }
    let [index, middle] = [rise(samples, Finger::Index), rise(samples, Finger::Middle)];
    let rising = |times: Times| times.leaves <= times.half && times.half <= times.reaches;
    let first = index.leaves < middle.leaves && index.half < middle.half && index.reaches < middle.reaches;
    Check {
        name: "P4",
        statement: "the index changes over before the middle: leaves 0, passes 1/2, reaches 1".into(),
        holds: Some(rising(index) && rising(middle) && first),
        values,
        note: String::new(),
    }
}

fn sigmoid(params: &MappingParams, samples: &[Sample]) -> Check {
    let mut falling = 0.0_f64;
    for finger in FINGERS {
        let k: Vec<f64> = of(samples, finger).map(|signals| signals.k).collect();
        for (tick, pair) in k.windows(2).enumerate() {
            let rising = (tick as f64 + 0.5) / RATE < MIRROR;
            falling = falling.max(if rising { pair[0] - pair[1] } else { pair[1] - pair[0] });
        }
    }
    let gain = Gain { r1: params.r1, r2: params.r2, shape: params.gain };
    const STEPS: u32 = 1000;
    let k = |u: f64| gain.at(params.r1 + (params.r2 - params.r1) * u);
    let u = |step: u32| f64::from(step) / f64::from(STEPS);
    let symmetry = (0..=STEPS).map(|step| (k(u(step)) + k(1.0 - u(step)) - 1.0).abs()).fold(0.0, f64::max);
    let (steepest, _) = (0..STEPS)
        .map(|step| (0.5 * (u(step) + u(step + 1)), k(u(step)) - k(u(step + 1))))
        .fold((0.0, 0.0), |best, slope| if slope.1 > best.1 { slope } else { best });
    Check {
        name: "P5",
        statement: "k is monotone in each half; k(u) + k(1 - u) = 1; steepest at u = 1/2".into(),
        holds: Some(falling <= 0.0 && symmetry < 1e-12 && (steepest - 0.5).abs() < 1.5 / f64::from(STEPS)),
        values: vec![
            ("max_step_back".into(), falling.max(0.0)),
            ("max_asymmetry".into(), symmetry),
            ("steepest_at_u".into(), steepest),
        ],
        note: String::new(),
    }
}

fn blend(samples: &[Sample]) -> Check {
    let (mut worst, mut ends) = (0.0_f64, 0.0_f64);
    for signals in samples.iter().flat_map(|sample| sample.output.fingers()) {
        let blend = signals.p_joint * (1.0 - signals.k) + signals.p_cartesian * signals.k;
        worst = worst.max((signals.p_input - blend).norm());
        if signals.k == 0.0 {
            ends = ends.max((signals.p_input - signals.p_joint).norm());
        } else if signals.k == 1.0 {
            ends = ends.max((signals.p_input - signals.p_cartesian).norm());
        }
    }
    Check {
        name: "P6",
        statement: "p_input = (1 - k) p_Q + k p_C to 1e-12 m, and exactly p_Q at k = 0, p_C at k = 1".into(),
        holds: Some(worst < 1e-12 && ends == 0.0),
        values: vec![("max_difference_m".into(), worst), ("max_difference_at_ends_m".into(), ends)],
        note: String::new(),
    }
}

fn bounded(params: &MappingParams, samples: &[Sample]) -> Check {
    // max |dk/du| of either shape.
    let steepest = match params.gain {
        GainShape::Cosine => PI / 2.0,
        GainShape::Quintic => 1.875,
    };
    let slope = steepest / (params.r2 - params.r1);
    let mut largest = 0.0_f64;
    let mut holds = true;
    for pair in samples.windows(2) {
        for (before, after) in pair[0].output.fingers().iter().zip(pair[1].output.fingers()) {
            let apart = |signals: &FingerSignals| (signals.p_cartesian - signals.p_joint).norm();
            let step = (after.p_input - before.p_input).norm();
            let bound = (after.p_joint - before.p_joint).norm()
                + (after.p_cartesian - before.p_cartesian).norm()
                + slope * apart(before).max(apart(after)) * (after.delta - before.delta).abs();
            holds &= step <= bound + 1e-12;
            if bound > 1e-9 {
                largest = largest.max(step / bound);
            }
        }
    }
    Check {
        name: "P7",
        statement: "|dp_input| <= |dp_Q| + |dp_C| + max|k'| |p_C - p_Q| |ddelta| from sample to sample".into(),
        holds: Some(holds),
        values: vec![("max_share_of_bound".into(), largest), ("max_slope_per_mm".into(), slope * 1e-3)],
        note: String::new(),
    }
}
