use serde::{Deserialize, Serialize};

use super::BaselineParams;
use super::tuning::{MIN_BAND, Tuning};
use crate::hand::MAX_FINGERS;

/// Which mapping drives the hand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MappingMode {
    /// Blend of joint and Cartesian mapping by the distance from the thumb.
    #[default]
    Combined,
    /// Joint mapping only: the shape of the hand.
    Joint,
    /// Cartesian mapping only: the positions of the tips.
    Cartesian,
    /// AnyTeleop's objective, see [`Baseline`](super::Baseline).
    Vector,
    /// DexPilot's objective, see [`Baseline`](super::Baseline).
    DexPilot,
}

/// What the fingers' Cartesian targets hang on (p_ST in Eq. 9).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Anchor {
    /// The thumb's Cartesian target, even where the thumb cannot get there: the paper's letter.
    Reference,
    /// The point nearest to that target which the thumb can reach, so that a human touch is a robot touch.
    #[default]
    Projected,
}

/// How the gain falls between the two spheres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GainShape {
    /// Raised cosine, Eq. 14: continuous slope.
    #[default]
    Cosine,
    /// Minimum-jerk polynomial: continuous curvature too, 19 % steeper.
    Quintic,
}

/// The thumb's gain K_ST out of the fingers'.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ThumbGain {
    /// The gain of the closest finger, as in the paper.
    #[default]
    Closest,
    /// `1 - prod (1 - k_j)`: no kink where two fingers are equally close.
    Product,
}

/// Whose scale and radii hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TuningUse {
    /// The operator's, if the pose brings a [`Tuning`], but for what is [`Pinned`]; and the operator's contact distances.
    #[default]
    Operator,
    /// The robot's own, for every operator.
    Fixed,
}

/// How the thumb's joints follow the person's thumb.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ThumbMap {
    /// By directions if the pose brings a [`Tuning`], as those of a person seen by a tracker do; by angles otherwise.
    #[default]
    Auto,
    /// By the joint map, like the fingers.
    Angles,
    /// So that its phalanges point where the person's do.
    Directions,
}

/// Which parameters were set on purpose and hold for every operator.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pinned {
    /// c_s.
    pub scale: bool,
    /// r1.
    pub r1: bool,
    /// r2.
    pub r2: bool,
}

/// Parameters of the mapping. Lengths in m (of the master), angles in rad.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MappingParams {
    /// Which mapping.
    pub mode: MappingMode,
    /// r1, m.
    pub r1: f64,
    /// r2, m.
    pub r2: f64,
    /// c_s: robot lengths per human length.
    pub scale: f64,
    /// What the fingers' targets hang on.
    pub anchor: Anchor,
    /// Name of the joint map M_Q in the hand's description.
    pub joint_map: String,
    /// Shape of the gain.
    pub gain: GainShape,
    /// The thumb's gain.
    pub thumb_gain: ThumbGain,
    /// The thumb's joint mapping.
    pub thumb_map: ThumbMap,
    /// Whose `scale`, `r1` and `r2` hold.
    pub tuning: TuningUse,
    /// Those of the three that hold in any case.
    #[serde(skip)]
    pub pinned: Pinned,
    /// Of the modes `vector` and `dexpilot`.
    pub baseline: BaselineParams,
}

/// A parameter that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ParamError {
    /// A length or factor is out of its range.
    #[error("mapping.{name} = {value} is not usable: it must be {rule}")]
    Range {
        /// Name in the configuration.
        name: &'static str,
        /// The value.
        value: f64,
        /// What is allowed.
        rule: &'static str,
    },
    /// The hand has no joint map of that name.
    #[error("mapping.joint_map = {name:?} is unknown to the hand {hand}: it has {known}")]
    JointMap {
        /// The name asked for.
        name: String,
        /// The hand's model.
        hand: String,
        /// The names it has.
        known: String,
    },
    /// Neither preset has this name.
    #[error("preset {0:?} is unknown: use \"default\" or \"paper\"")]
    Preset(String),
}

impl Default for MappingParams {
    /// The recommended preset.
    ///
    /// The projected anchor closes contacts that the thumb's unreachable target leaves open; a scale near the ratio
    /// of the finger lengths (131 mm to 82 mm) keeps most targets in reach; `split` keeps the thumb off its straight
    /// singularity; a wide r2 spreads the transition, whose cost in joint speed is proportional to 1/(r2 - r1).
    fn default() -> Self {
        Self {
            mode: MappingMode::Combined,
            r1: 0.020,
            r2: 0.080,
            scale: 1.6,
            anchor: Anchor::Projected,
            joint_map: "split".to_owned(),
            gain: GainShape::Cosine,
            thumb_gain: ThumbGain::Closest,
            thumb_map: ThumbMap::Auto,
            tuning: TuningUse::Operator,
            pinned: Pinned::default(),
            baseline: BaselineParams::default(),
        }
    }
}

impl MappingParams {
    /// The paper's own choices: c_s of the thumbs of Table 1 (162 mm to 60 mm), the unprojected anchor, r1 20 mm and
    /// r2 40 mm (the paper gives no radii), M_Q by kinematic role, for every operator.
    #[must_use]
    pub fn paper() -> Self {
        Self {
            r2: 0.040,
            scale: 2.7,
            anchor: Anchor::Reference,
            joint_map: "role".to_owned(),
            thumb_map: ThumbMap::Angles,
            tuning: TuningUse::Fixed,
            ..Self::default()
        }
    }

    /// The preset called `default` or `paper`.
    ///
    /// # Errors
    /// Any other name.
    pub fn preset(name: &str) -> Result<Self, ParamError> {
        match name {
            "default" => Ok(Self::default()),
            "paper" => Ok(Self::paper()),
            other => Err(ParamError::Preset(other.to_owned())),
        }
    }

    /// What holds for a pose with this tuning of its operator; a tuning that passes [`Tuning::validate`] if both do.
    #[must_use]
    pub fn tuned(&self, operator: Option<&Tuning>) -> Tuning {
        let own = Tuning { scale: [self.scale; MAX_FINGERS], r1: self.r1, r2: self.r2, contact: [0.0; MAX_FINGERS] };
        let Some(operator) = operator.filter(|_| self.tuning == TuningUse::Operator) else {
            return own;
        };
        let scale = if self.pinned.scale { own.scale } else { operator.scale };
        let mut r1 = if self.pinned.r1 { own.r1 } else { operator.r1 };
        let mut r2 = if self.pinned.r2 { own.r2 } else { operator.r2 };
        // One radius of each need not fit together: the pinned one stays.
        if r2 < r1 + MIN_BAND {
            if self.pinned.r1 {
                r2 = r1 + MIN_BAND;
            } else {
                r1 = r2 - MIN_BAND;
            }
        }
        // Never beyond r1: where fingers are made to touch, the mapping is to be Cartesian.
        Tuning { scale, r1, r2, contact: operator.contact.map(|touch| touch.min(r1)) }
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// Names the first parameter that is out of its range.
    pub fn validate(&self) -> Result<(), ParamError> {
        let range = |name, value: f64, ok: bool, rule| {
            if ok && value.is_finite() { Ok(()) } else { Err(ParamError::Range { name, value, rule }) }
        };
        range("r1", self.r1, self.r1 > 0.0 && self.r1 < 0.3, "in metres of the human hand, above 0 and below 0.3")?;
        range("r2", self.r2, self.r2 >= self.r1 + 0.001 && self.r2 < 0.5, "at least r1 + 0.001 m and below 0.5 m")?;
        range("scale", self.scale, self.scale >= 0.1 && self.scale <= 10.0, "from 0.1 to 10")?;
        let BaselineParams { scale, low_pass } = self.baseline;
        range("baseline.scale", scale, (0.1..=10.0).contains(&scale), "from 0.1 to 10")?;
        range("baseline.low_pass", low_pass, low_pass > 0.0 && low_pass <= 1.0, "above 0 and at most 1 (off)")
    }
}
