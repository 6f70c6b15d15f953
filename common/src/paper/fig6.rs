//! Fig. 6: taps of the thumb and a finger under joint, Cartesian and combined mapping.

use super::Check;
use super::motion::{Sample, run};
use crate::hand::{Finger, HandModel, TipFrame};
use crate::mapping::{MappingMode, MappingParams, ParamError};
use crate::master::{Gesture, OPEN};

/// The taps of the figure.
pub const TAPS: [Gesture; 3] = [Gesture::TapIndex, Gesture::TapMiddle, Gesture::TapRing];

/// The mappings compared, in the figure's order.
pub const MODES: [MappingMode; 3] = [MappingMode::Joint, MappingMode::Cartesian, MappingMode::Combined];

/// Samples per second of a tap.
pub const RATE: f64 = 100.0;

/// One gesture under one mapping.
#[derive(Clone, Debug)]
pub struct Tap {
    /// The gesture.
    pub gesture: Gesture,
    /// The mapping.
    pub mode: MappingMode,
    /// The whole run, [`RATE`] samples per second.
    pub samples: Vec<Sample>,
    /// Index of the sample at which the gesture is closed: the contact.
    pub peak: usize,
    /// What it comes to, per finger of the slave, thumb first.
    pub fingers: Vec<TapFinger>,
}

/// One finger in one tap. Cartesian errors and distances are of the tip poles, m; shape errors in rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TapFinger {
    /// Which.
    pub finger: Finger,
    /// Whether the gesture moves it.
    pub involved: bool,
    /// e_Q at the peak.
    pub e_q_peak: f64,
    /// Mean e_Q over the motion.
    pub e_q_mean: f64,
    /// Largest e_Q.
    pub e_q_max: f64,
    /// e_C at the peak.
    pub e_c_peak: f64,
    /// Mean e_C over the motion.
    pub e_c_mean: f64,
    /// Distance from the slave's thumb tip at the peak, 0 for the thumb.
    pub distance_peak: f64,
    /// `|p_ST - p_Sj| - c_s delta_j` at the peak, 0 for the thumb.
    pub distance_error_peak: f64,
    /// Root mean square of that error while delta_j is within r1; 0 if it never is.
    pub distance_error_rms: f64,
}

/// Runs a gesture under one mapping.
///
/// # Errors
/// A mapping parameter that cannot be used.
pub fn tap(hand: &HandModel, params: &MappingParams, gesture: Gesture, mode: MappingMode) -> Result<Tap, ParamError> {
    let samples = run(hand, &MappingParams { mode, ..params.clone() }, gesture, RATE)?;
    let closed = gesture.posture().unwrap_or(OPEN);
    let open = |sample: &Sample| sample.pose.q.iter().zip(&closed).map(|(a, b)| (a - b).abs()).sum::<f64>();
    let peak = (0..samples.len()).fold(0, |peak, tick| {
        // Where the hand rests closed, the first sample of the rest.
        if open(&samples[tick]) < open(&samples[peak]) - 1e-9 { tick } else { peak }
    });
    let fingers = (0..hand.fingers.len()).map(|slot| finger(params, gesture, &samples, peak, slot)).collect();
    Ok(Tap { gesture, mode, samples, peak, fingers })
}

fn finger(params: &MappingParams, gesture: Gesture, samples: &[Sample], peak: usize, slot: usize) -> TapFinger {
    let signals = |tick: usize| samples[tick].output.fingers()[slot];
    let distance = |tick: usize| {
        samples[tick].output.finger(Finger::Thumb).map_or(0.0, |thumb| (thumb.p - signals(tick).p).norm())
    };
    let finger = signals(peak).finger;
    let opposing = finger != Finger::Thumb;
    let error = |tick: usize| if opposing { distance(tick) - params.scale * signals(tick).delta } else { 0.0 };
    let mean = |value: &dyn Fn(usize) -> f64| (0..samples.len()).map(value).sum::<f64>() / samples.len() as f64;
    let near: Vec<usize> = (0..samples.len()).filter(|&tick| opposing && signals(tick).delta <= params.r1).collect();
    let square = near.iter().fold(0.0, |sum, &tick| sum + error(tick).powi(2)) / near.len().max(1) as f64;
    TapFinger {
        finger,
        involved: involved(gesture, finger),
        e_q_peak: signals(peak).e_q,
        e_q_mean: mean(&|tick| signals(tick).e_q),
        e_q_max: (0..samples.len()).fold(0.0, |max, tick| signals(tick).e_q.max(max)),
        e_c_peak: signals(peak).e_c,
        e_c_mean: mean(&|tick| signals(tick).e_c),
        distance_peak: distance(peak),
        distance_error_peak: error(peak),
        distance_error_rms: square.sqrt(),
    }
}

/// Whether the gesture's closed posture moves the finger.
fn involved(gesture: Gesture, finger: Finger) -> bool {
    let joints = finger.index() * 4..finger.index() * 4 + 4;
    gesture.posture().is_some_and(|posture| posture[joints.clone()] != OPEN[joints])
}

/// The paper's argument for the combined mapping, checked on one gesture.
///
/// `taps` are the same gesture under the three [`MODES`], in that order.
#[must_use]
pub fn checks(hand: &HandModel, taps: &[Tap; 3]) -> Vec<Check> {
    let [joint, cartesian, combined] = taps;
    let gesture = combined.gesture;
    let mut out = Vec::new();

    let mut shape = Vec::new();
    let mut holds = true;
    for (slot, finger) in combined.fingers.iter().enumerate().filter(|(_, finger)| finger.involved) {
        let (ours, theirs) = (finger.e_q_mean, cartesian.fingers[slot].e_q_mean);
        holds &= ours < theirs;
        shape.push((format!("{}_combined_rad", finger.finger.name()), ours));
        shape.push((format!("{}_cartesian_rad", finger.finger.name()), theirs));
        holds &= joint.fingers[slot].e_q_max == 0.0;
    }
    out.push(Check {
        name: "shape",
        statement: "mean e_Q of combined < Cartesian mapping, and 0 of joint mapping".into(),
        holds: Some(holds),
        values: shape,
        note: String::new(),
    });

    let idle = |tap: &Tap| {
        let idle = tap.fingers.iter().filter(|finger| !finger.involved);
        idle.fold(0.0, |max, finger| finger.e_q_max.max(max))
    };
    let (ours, theirs) = (idle(combined), idle(cartesian));
    out.push(Check {
        name: "uninvolved",
        statement: "uninvolved fingers keep e_Q = 0, while Cartesian mapping moves them".into(),
        holds: Some(ours == 0.0 && theirs > 0.0),
        values: vec![("combined_max_rad".into(), ours), ("cartesian_max_rad".into(), theirs)],
        note: String::new(),
    });

    // The tips, not the postures: a redundant finger may reach one point from two sides.
    let mut apart = 0.0_f64;
    for chain in hand.fingers.iter().filter(|chain| involved(gesture, chain.finger)) {
        let tip = |tap: &Tap| chain.tip(&chain.select(&tap.samples[tap.peak].output.q), TipFrame::Pole);
        apart = apart.max((tip(combined) - tip(cartesian)).norm());
    }
    out.push(Check {
        name: "contact",
        statement: "at contact the tips of combined and Cartesian mapping coincide within 10 um".into(),
        holds: Some(apart < 1e-5),
        values: vec![("apart_mm".into(), apart * 1e3)],
        note: String::new(),
    });
    out
}
