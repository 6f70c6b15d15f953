//! Calibration: an operator's side and bone lengths from a few seconds of keypoints.

use std::fmt::Write as _;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::fit::Fitter;
use super::keypoints::{Keypoints, PalmFrame};
use super::model::{MasterError, MasterGeometry, MasterPose};
use super::side::{Inspector, SideVerdict};
use crate::hand::{Finger, HandModel, HandSide, MAX_FINGERS};
use crate::mapping::{MappingParams, ParamError, Tuning, TuningError, tune};

/// Most frames kept; of longer streams every second, fourth, ... frame is kept.
pub const MAX_FRAMES: usize = 600;
/// Fewest frames that make a calibration.
pub const MIN_FRAMES: usize = 30;
/// Least range of a fingertip in the palm frame that shows a living hand, m.
const MIN_MOTION: f64 = 0.010;
/// Spread (MAD over length) of a bone above which the tracker cannot be trusted.
const MAX_SPREAD: f64 = 0.25;

/// Distance of touching keypoints where none were seen touching, m.
const TOUCH: f64 = 0.020;
/// Farthest apart that touching keypoints can be, m.
const MAX_TOUCH: f64 = 0.030;
/// The same as far as a file may say so, m.
const READABLE_TOUCH: f64 = 0.050;
/// How far the distance scatters while fingers touch, m.
const TOUCH_SCATTER: f64 = 0.006;
/// Fewest frames of a finger's touches to go by.
const MIN_TOUCH_FRAMES: u64 = 5;

const FORMAT: &str = "allegro-teleop-calibration";
const VERSION: u32 = 1;
/// Longest calibration file, bytes.
const MAX_TEXT: usize = 64 * 1024;

/// Median absolute deviations, m: how far the tracker's bones vary.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spread {
    /// Of the finger bases, largest coordinate.
    pub bases: [f64; MAX_FINGERS],
    /// Of the phalanges.
    pub phalanges: [[f64; 3]; MAX_FINGERS],
}

/// When thumb and fingers touch: a tracker's keypoints lie inside the fingertips.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Touch {
    /// Distance of the tips of thumb and finger up to which they touch, m; thumb (0), index, middle, ring, little.
    pub distance: [f64; MAX_FINGERS],
    /// In how many frames each was seen touching; with fewer than 5 its distance is that of all fingers together.
    pub frames: [u64; MAX_FINGERS],
}

impl Default for Touch {
    /// No touch seen: 20 mm.
    fn default() -> Self {
        Self { distance: [0.0, TOUCH, TOUCH, TOUCH, TOUCH], frames: [0; MAX_FINGERS] }
    }
}

/// What the mapping onto one robot hand should know about the operator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HandTuning {
    /// Name of the robot hand's model.
    pub hand: String,
    /// For this hand.
    pub values: Tuning,
}

/// What is known about an operator's hand.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Which hand.
    pub side: HandSide,
    /// Frames used.
    pub frames: u64,
    /// Frames that were no hand.
    pub rejected: u64,
    /// Median over the frames of the fit's rms residual, m.
    pub residual: f64,
    /// Bone lengths and knuckles, m, in O_W with the wrist as origin.
    pub geometry: MasterGeometry,
    /// How far they vary, m.
    pub spread: Spread,
    /// When its fingers touch.
    #[serde(default)]
    pub touch: Touch,
    /// What follows for one robot hand, if it was worked out.
    #[serde(skip)]
    pub tuning: Option<HandTuning>,
}

/// Why the frames seen make no calibration.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// Too short.
    #[error("{frames} usable frames ({rejected} rejected); calibration needs at least {MIN_FRAMES}")]
    TooFewFrames {
        /// Usable.
        frames: u64,
        /// Not a hand.
        rejected: u64,
    },
    /// A frozen tracker, or a hand held still.
    #[error("the hand moved only {:.1} mm; open and close it a few times while calibrating", motion * 1e3)]
    NoMotion {
        /// Largest range of a fingertip in the palm frame, m.
        motion: f64,
    },
    /// Left or right?
    #[error(
        "cannot tell a left hand from a right one ({:.0} % of the bending agrees); bend and stretch the fingers",
        agreement * 100.0
    )]
    SideUnclear {
        /// Share of the evidence that agrees.
        agreement: f64,
    },
    /// A bone's length varies too much.
    #[error(
        "phalanx {phalanx} of the {} varies by {:.1} mm about {:.1} mm; the tracker does not see it well",
        finger.name(), spread * 1e3, length * 1e3
    )]
    Unsteady {
        /// Its finger.
        finger: Finger,
        /// 0 proximal to 2 distal.
        phalanx: usize,
        /// Median length, m.
        length: f64,
        /// Median absolute deviation, m.
        spread: f64,
    },
    /// The medians are not those of a hand.
    #[error("implausible hand")]
    Implausible(#[from] MasterError),
}

/// Why a calibration file cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationTextError {
    /// Not TOML, or unknown, missing or mistyped fields.
    #[error("calibration file: {0}")]
    Toml(String),
    /// A file of something else.
    #[error("not a calibration file: `format` is `{found}`, expected `{FORMAT}`")]
    Format {
        /// What it says.
        found: String,
    },
    /// Of another version of this software.
    #[error("calibration file has version {found}; this program reads version {VERSION}: calibrate again")]
    Version {
        /// What it says.
        found: i64,
    },
    /// Numbers no hand has.
    #[error("calibration file: implausible hand")]
    Implausible(#[from] MasterError),
    /// A tuning no operator can have.
    #[error("calibration file: {0}")]
    Tuning(#[from] TuningError),
    /// A distance at which no fingers touch.
    #[error("calibration file: touch.distance has {value}; expected 0 to {READABLE_TOUCH} m")]
    Touch {
        /// The value.
        value: f64,
    },
    /// A statistic that is no number of metres.
    #[error("calibration file: {field} is {value}; expected a finite number of metres, not negative")]
    Statistic {
        /// Which.
        field: &'static str,
        /// Its value.
        value: f64,
    },
}

/// Collects frames; memory is bounded by [`MAX_FRAMES`].
#[derive(Clone, Debug)]
pub struct Calibrator {
    kept: Vec<Keypoints>,
    /// Every how many frames one is kept.
    stride: u64,
    seen: u64,
    rejected: u64,
    inspector: Inspector,
}

impl Default for Calibrator {
    fn default() -> Self {
        Self { kept: Vec::with_capacity(MAX_FRAMES), stride: 1, seen: 0, rejected: 0, inspector: Inspector::default() }
    }
}

impl Calibrator {
    /// Takes one frame.
    pub fn push(&mut self, keypoints: &Keypoints) {
        self.inspector.push(keypoints);
        if self.seen.is_multiple_of(self.stride) {
            if self.kept.len() == MAX_FRAMES {
                let mut index = 0usize;
                self.kept.retain(|_| {
                    index += 1;
                    index % 2 == 1
                });
                self.stride *= 2;
            }
            // After thinning the frame is still on the new, coarser grid: MAX_FRAMES is even.
            self.kept.push(*keypoints);
        }
        self.seen += 1;
    }

    /// Counts a frame that could not be used.
    pub fn reject(&mut self) {
        self.rejected += 1;
    }

    /// Frames taken so far.
    #[must_use]
    pub const fn frames(&self) -> u64 {
        self.seen
    }

    /// Which hand, as far as known.
    #[must_use]
    pub const fn inspector(&self) -> &Inspector {
        &self.inspector
    }

    /// The medians over all frames.
    ///
    /// # Errors
    /// [`CalibrationError`] says what to do better.
    pub fn finish(&self) -> Result<Calibration, CalibrationError> {
        if self.kept.len() < MIN_FRAMES {
            return Err(CalibrationError::TooFewFrames { frames: self.seen, rejected: self.rejected });
        }
        let motion = self.motion();
        if motion < MIN_MOTION {
            return Err(CalibrationError::NoMotion { motion });
        }
        let SideVerdict::Hand(side) = self.inspector.side() else {
            return Err(CalibrationError::SideUnclear { agreement: self.inspector.agreement() });
        };
        let (geometry, spread) = self.medians(side);
        geometry.validate()?;
        for finger in Finger::ALL {
            for phalanx in 0..3 {
                let length = geometry.phalanges[finger.index()][phalanx];
                let spread = spread.phalanges[finger.index()][phalanx];
                if spread > MAX_SPREAD * length {
                    return Err(CalibrationError::Unsteady { finger, phalanx, length, spread });
                }
            }
        }
        Ok(self.calibration(side, geometry, spread))
    }

    /// The medians over whatever was seen, for a recording that cannot be taken again: however short, still or
    /// unsteady. A side that is not clear is taken to be `side`.
    ///
    /// # Errors
    /// No frames, or the medians are not those of a hand.
    pub fn best_effort(&self, side: HandSide) -> Result<Calibration, CalibrationError> {
        if self.kept.is_empty() {
            return Err(CalibrationError::TooFewFrames { frames: self.seen, rejected: self.rejected });
        }
        let side = if let SideVerdict::Hand(seen) = self.inspector.side() { seen } else { side };
        let (geometry, spread) = self.medians(side);
        geometry.validate()?;
        Ok(self.calibration(side, geometry, spread))
    }

    fn calibration(&self, side: HandSide, geometry: MasterGeometry, spread: Spread) -> Calibration {
        let mut fitter = Fitter::new(geometry, side);
        let mut distances = Vec::with_capacity(self.kept.len());
        let (residual, _) = median_and_deviation(self.kept.iter().map(|frame| {
            let fit = fitter.fit(frame);
            let pose = MasterPose { q: fit.q, geometry, tuning: None };
            // Of the fitted tips, because those are what the mapping sees.
            distances.push(Finger::ALL.map(|finger| (pose.tip(finger) - pose.tip(Finger::Thumb)).norm()));
            fit.residual()
        }));
        let touch = touches(&distances);
        let (frames, rejected) = (self.seen, self.rejected);
        Calibration { side, frames, rejected, residual, geometry, spread, touch, tuning: None }
    }

    /// Largest range of a fingertip coordinate in the palm frame between the 5th and 95th percentile, m.
    fn motion(&self) -> f64 {
        let mut largest = 0f64;
        for finger in Finger::ALL {
            for axis in 0..3 {
                let mut values: Vec<f64> = self
                    .kept
                    .iter()
                    .map(|frame| PalmFrame::estimate(frame).to_hand(HandSide::Right, &frame.finger(finger)[3])[axis])
                    .collect();
                values.sort_by(f64::total_cmp);
                let edge = values.len() / 20;
                if let (Some(low), Some(high)) = (values.get(edge), values.get(values.len() - 1 - edge)) {
                    largest = largest.max(high - low);
                }
            }
        }
        largest
    }

    fn medians(&self, side: HandSide) -> (MasterGeometry, Spread) {
        let mut geometry = MasterGeometry::PARADIGMATIC;
        let mut spread = Spread { bases: [0.0; MAX_FINGERS], phalanges: [[0.0; 3]; MAX_FINGERS] };
        for finger in Finger::ALL {
            let f = finger.index();
            for phalanx in 0..3 {
                let lengths = self.kept.iter().map(|frame| {
                    let points = frame.finger(finger);
                    (points[phalanx + 1] - points[phalanx]).norm()
                });
                (geometry.phalanges[f][phalanx], spread.phalanges[f][phalanx]) = median_and_deviation(lengths);
            }
            for axis in 0..3 {
                let coordinates = self.kept.iter().map(|frame| {
                    let base: Vector3<f64> = PalmFrame::estimate(frame).to_hand(side, &frame.base(finger));
                    base[axis]
                });
                let (median, deviation) = median_and_deviation(coordinates);
                geometry.bases[f][axis] = median;
                spread.bases[f] = spread.bases[f].max(deviation);
            }
        }
        (geometry, spread)
    }
}

/// When fingers touch, out of the distances of their tips from the thumb's (m, the thumb's own is not used) over time.
///
/// A finger touches near the bottom of each dip of its distance below 30 mm, if no other finger is clearly closer to the
/// thumb then: in the frames within 6 mm of the dip's lowest. The 90 % quantile of all of these covers the tracker's
/// scatter.
fn touches(distances: &[[f64; MAX_FINGERS]]) -> Touch {
    let mut touching: [Vec<f64>; MAX_FINGERS] = Default::default();
    for (finger, found) in touching.iter_mut().enumerate().skip(1) {
        let dips = distances.split(|frame| frame[finger] >= MAX_TOUCH);
        for dip in dips {
            let lowest = dip.iter().map(|frame| frame[finger]).fold(f64::INFINITY, f64::min);
            found.extend(dip.iter().filter_map(|frame| {
                let closest = frame[1..].iter().copied().fold(f64::INFINITY, f64::min);
                let distance = frame[finger];
                (distance <= lowest + TOUCH_SCATTER && distance <= closest + TOUCH_SCATTER).then_some(distance)
            }));
        }
    }
    let quantile = |values: &mut Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() * 9 / 10).copied()
    };
    let frames = [0, 1, 2, 3, 4].map(|finger: usize| touching[finger].len() as u64);
    let all = quantile(&mut touching.concat()).unwrap_or(TOUCH);
    let mut distance = [0.0; MAX_FINGERS];
    for finger in 1..MAX_FINGERS {
        let own = quantile(&mut touching[finger]).filter(|_| frames[finger] >= MIN_TOUCH_FRAMES);
        distance[finger] = own.unwrap_or(all);
    }
    Touch { distance, frames }
}

/// Median and median absolute deviation; NaN of nothing.
fn median_and_deviation(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let mut values: Vec<f64> = values.collect();
    let middle = median(&mut values);
    for value in &mut values {
        *value = (*value - middle).abs();
    }
    (middle, median(&mut values))
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// The file: what it is first, so that a file of another version is refused by its version, not by its fields.
#[derive(Serialize)]
struct File<'a> {
    format: &'static str,
    version: u32,
    calibration: &'a Calibration,
    #[serde(skip_serializing_if = "Option::is_none")]
    tuning: Option<&'a HandTuning>,
}

impl Calibration {
    /// Works out the tuning for `hand` (if it is not there already) and gives the reasons, for a person to read.
    ///
    /// # Errors
    /// Parameters of the mapping that do not fit the hand.
    pub fn tune(&mut self, hand: &HandModel, params: &MappingParams) -> Result<Vec<String>, ParamError> {
        if self.tuning.as_ref().is_some_and(|tuning| tuning.hand == hand.name) {
            return Ok(Vec::new());
        }
        let tuned = tune(hand, params, &self.geometry, &self.touch.distance)?;
        self.tuning = Some(HandTuning { hand: hand.name.clone(), values: tuned.tuning });
        Ok(tuned.report())
    }

    /// As TOML text, to be saved.
    #[must_use]
    pub fn to_text(&self) -> String {
        let tuning = self.tuning.as_ref();
        let file = File { format: FORMAT, version: VERSION, calibration: self, tuning };
        // Plain numbers in structs: TOML can hold them all.
        toml::to_string(&file).unwrap_or_default()
    }

    /// Reads what [`Calibration::to_text`] wrote.
    ///
    /// # Errors
    /// Names the unknown format, version or field, or the number no hand has.
    pub fn from_text(text: &str) -> Result<Self, CalibrationTextError> {
        let size = text.len();
        if size > MAX_TEXT {
            let problem = format!("{size} bytes are more than the {MAX_TEXT} allowed; is this the right file?");
            return Err(CalibrationTextError::Toml(problem));
        }
        let toml = |error: toml::de::Error| CalibrationTextError::Toml(error.to_string());
        let mut table: toml::Table = toml::from_str(text).map_err(toml)?;
        let found = table.remove("format").map_or_else(String::new, |v| v.as_str().unwrap_or_default().to_owned());
        if found != FORMAT {
            return Err(CalibrationTextError::Format { found });
        }
        let found = table.remove("version").and_then(|version| version.as_integer()).unwrap_or(-1);
        if found != i64::from(VERSION) {
            return Err(CalibrationTextError::Version { found });
        }
        let missing = || CalibrationTextError::Toml("missing table `calibration`".into());
        let mut calibration: Self = table.remove("calibration").ok_or_else(missing)?.try_into().map_err(toml)?;
        calibration.tuning = table.remove("tuning").map(toml::Value::try_into).transpose().map_err(toml)?;
        if let Some(key) = table.keys().next() {
            return Err(CalibrationTextError::Toml(format!("unknown field `{key}`")));
        }
        calibration.geometry.validate()?;
        if let Some(tuning) = &calibration.tuning {
            tuning.values.validate()?;
        }
        let statistic = |field, value: f64| {
            if value.is_finite() && value >= 0.0 {
                Ok(())
            } else {
                Err(CalibrationTextError::Statistic { field, value })
            }
        };
        statistic("residual", calibration.residual)?;
        calibration.spread.bases.iter().try_for_each(|&value| statistic("spread.bases", value))?;
        let phalanges = calibration.spread.phalanges.iter().flatten();
        phalanges.copied().try_for_each(|value| statistic("spread.phalanges", value))?;
        match calibration.touch.distance.iter().find(|&value| !(0.0..=READABLE_TOUCH).contains(value)) {
            Some(&value) => Err(CalibrationTextError::Touch { value }),
            None => Ok(calibration),
        }
    }

    /// Lines for a person to read.
    #[must_use]
    pub fn report(&self) -> Vec<String> {
        let mut lines = vec![
            format!("{} hand, {} frames used, {} rejected", self.side.name(), self.frames, self.rejected),
            format!("fit residual {:.1} mm (median rms)", self.residual * 1e3),
            "finger   phalanges in mm, +- median absolute deviation".to_owned(),
        ];
        for finger in Finger::ALL {
            let mut line = format!("{:8}", finger.name());
            let f = finger.index();
            for (length, spread) in self.geometry.phalanges[f].iter().zip(self.spread.phalanges[f]) {
                // Writing to a string does not fail.
                let _ = write!(line, " {:5.1} +- {:3.1}", length * 1e3, spread * 1e3);
            }
            lines.push(line);
        }
        let touch = Finger::ALL[1..].iter().map(|finger| {
            let (distance, frames) = (self.touch.distance[finger.index()], self.touch.frames[finger.index()]);
            format!("{} {:.1} mm ({frames} frames)", finger.name(), distance * 1e3)
        });
        lines.push(format!("touches the thumb up to a distance of: {}", touch.collect::<Vec<_>>().join(", ")));
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Thumb-finger distances (mm) of index, middle, ring, little in m.
    fn frame(fingers: [f64; 4]) -> [f64; MAX_FINGERS] {
        let [index, middle, ring, little] = fingers.map(|distance| distance * 1e-3);
        [0.0, index, middle, ring, little]
    }

    #[test]
    fn touches_are_the_bottoms_of_the_dips_of_the_closest_finger() {
        // Two pinches of the index with the middle beside it, and a short one of the middle.
        let mut frames = Vec::new();
        for bottom in [18.0, 22.0] {
            frames.extend([90.0, 60.0, 29.0].map(|index| frame([index, 40.0, 80.0, 95.0])));
            frames.extend([0.0, 1.0, 2.0, 1.5, 0.5].map(|more| frame([bottom + more, 28.4, 80.0, 95.0])));
            frames.extend([50.0, 90.0].map(|index| frame([index, 40.0, 80.0, 95.0])));
        }
        frames.extend([45.0, 25.0, 26.0, 45.0].map(|middle| frame([70.0, middle, 60.0, 80.0])));
        let touch = touches(&frames);
        // 29 mm is too far from either bottom, the middle beside the index is not the closest, but for 22 + 2 and more.
        assert_eq!(touch.frames, [0, 10, 2 + 4, 0, 0]);
        assert!((touch.distance[1] - 0.024).abs() < 1e-12, "{touch:?}");
        // Never seen: of all together.
        assert!(touch.distance[3] == touch.distance[4] && touch.distance[3] > 0.024, "{touch:?}");
        assert_eq!(touches(&[frame([50.0, 60.0, 70.0, 80.0])]), Touch::default());
        assert_eq!(touches(&[]), Touch::default());
    }
}
