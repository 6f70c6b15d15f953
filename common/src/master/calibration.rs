//! Calibration: an operator's side and bone lengths from a few seconds of keypoints.

use std::fmt::Write as _;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::fit::Fitter;
use super::keypoints::{Keypoints, PalmFrame};
use super::model::{MasterError, MasterGeometry};
use super::side::{Inspector, SideVerdict};
use crate::hand::{Finger, HandSide, MAX_FINGERS};

/// Most frames kept; of longer streams every second, fourth, ... frame is kept.
pub const MAX_FRAMES: usize = 600;
/// Fewest frames that make a calibration.
pub const MIN_FRAMES: usize = 30;
/// Least range of a fingertip in the palm frame that shows a living hand, m.
const MIN_MOTION: f64 = 0.010;
/// Spread (MAD over length) of a bone above which the tracker cannot be trusted.
const MAX_SPREAD: f64 = 0.25;

const FORMAT: &str = "allegro-teleop-calibration";
const VERSION: u32 = 1;

/// Median absolute deviations, m: how far the tracker's bones vary.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spread {
    /// Of the finger bases, largest coordinate.
    pub bases: [f64; MAX_FINGERS],
    /// Of the phalanges.
    pub phalanges: [[f64; 3]; MAX_FINGERS],
}

/// What is known about an operator's hand.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
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
        let (residual, _) = median_and_deviation(self.kept.iter().map(|frame| fitter.fit(frame).residual()));
        Calibration { side, frames: self.seen, rejected: self.rejected, residual, geometry, spread }
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
}

impl Calibration {
    /// As TOML text, to be saved.
    #[must_use]
    pub fn to_text(&self) -> String {
        let file = File { format: FORMAT, version: VERSION, calibration: self };
        // Plain numbers in structs: TOML can hold them all.
        toml::to_string(&file).unwrap_or_default()
    }

    /// Reads what [`Calibration::to_text`] wrote.
    ///
    /// # Errors
    /// Names the unknown format, version or field, or the number no hand has.
    pub fn from_text(text: &str) -> Result<Self, CalibrationTextError> {
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
        let calibration: Self = table.remove("calibration").ok_or_else(missing)?.try_into().map_err(toml)?;
        if let Some(key) = table.keys().next() {
            return Err(CalibrationTextError::Toml(format!("unknown field `{key}`")));
        }
        calibration.geometry.validate()?;
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
        Ok(calibration)
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
        lines
    }
}
