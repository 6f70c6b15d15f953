//! Configuration: a preset, then the file, then the command line.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use teleop_common::authority::{LeaseParams, Takeover};
use teleop_common::hand::{HandError, HandModel, HandSide, allegro_v4_texts};
use teleop_common::mapping::{MappingMode, MappingParams, ParamError, Pinned};
use teleop_common::playout::{PlayoutMode, PlayoutParams};

use crate::control::{ControlParams, Relax, StopAction};

/// Everything that can be set in a configuration file, with its defaults.
///
/// ```toml
/// preset = "default"        # or "paper"; [mapping] then changes single parameters of it
/// [mapping]
/// r2 = 0.06
/// [control]
/// rate_hz = 333.0
/// [authority]
/// takeover = "idle"
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct File {
    preset: String,
    mapping: toml::Table,
    control: ControlFile,
    authority: AuthorityFile,
    playout: PlayoutFile,
}

impl Default for File {
    fn default() -> Self {
        Self {
            preset: "default".to_owned(),
            mapping: toml::Table::new(),
            control: ControlFile::default(),
            authority: AuthorityFile::default(),
            playout: PlayoutFile::default(),
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct AuthorityFile {
    hold_after_s: f64,
    max_age_s: f64,
    release_after_s: f64,
    takeover: Takeover,
    relax: Relax,
    relax_after_s: f64,
    stop: StopAction,
}

impl Default for AuthorityFile {
    fn default() -> Self {
        let params = ControlParams::default();
        Self {
            hold_after_s: params.hold_after.as_secs_f64(),
            max_age_s: 0.25,
            release_after_s: 2.0,
            takeover: Takeover::Never,
            relax: params.relax,
            relax_after_s: params.relax_after.as_secs_f64(),
            stop: params.stop,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct PlayoutFile {
    mode: PlayoutMode,
    max_delay_s: f64,
    tolerance_s: f64,
    predict_s: f64,
}

impl Default for PlayoutFile {
    fn default() -> Self {
        let params = PlayoutParams::default();
        Self {
            mode: params.mode,
            max_delay_s: params.max_delay.as_secs_f64(),
            tolerance_s: params.tolerance.as_secs_f64(),
            predict_s: params.predict.as_secs_f64(),
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct ControlFile {
    rate_hz: f64,
    smoothing_s: f64,
    engage_speed_rad_s: f64,
    engage_ramp_s: f64,
    tip_overlap_m: f64,
    velocity_scale: f64,
    acceleration_scale: f64,
}

impl Default for ControlFile {
    fn default() -> Self {
        let params = ControlParams::default();
        Self {
            rate_hz: params.rate,
            smoothing_s: params.smoothing,
            engage_speed_rad_s: params.engage_speed,
            engage_ramp_s: params.engage_ramp,
            tip_overlap_m: params.tip_overlap,
            velocity_scale: 1.0,
            acceleration_scale: 1.0,
        }
    }
}

/// What the command line may override.
#[derive(Clone, Debug, Default)]
pub struct Overrides {
    /// Preset name.
    pub preset: Option<String>,
    /// Which mapping.
    pub mode: Option<MappingMode>,
    /// Control rate, Hz.
    pub rate: Option<f64>,
}

/// Checked configuration of the control loop.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// The mapping.
    pub mapping: MappingParams,
    /// The loop.
    pub control: ControlParams,
    /// Whose poses are obeyed.
    pub lease: LeaseParams,
    /// Factor on the velocity limits of the hand's description, (0, 1].
    pub velocity_scale: f64,
    /// Factor on its acceleration limits, (0, 10].
    pub acceleration_scale: f64,
}

/// A configuration that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not what is expected.
    #[error("{path}: {message}", path = path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What is wrong, with its line.
        message: String,
    },
    /// A mapping parameter is not usable.
    #[error(transparent)]
    Mapping(#[from] ParamError),
    /// A parameter of the loop is out of range.
    #[error("{name} = {value} is not usable: it must be {rule}")]
    Range {
        /// Name in the file.
        name: &'static str,
        /// The value.
        value: f64,
        /// What is allowed.
        rule: &'static str,
    },
    /// The hand's URDF or description cannot be used.
    #[error("{origin}")]
    Hand {
        /// Where it came from.
        origin: String,
        /// What is wrong.
        source: HandError,
    },
}

impl Config {
    /// Reads `path` (if any) over the preset, then applies `overrides`, then checks everything.
    ///
    /// # Errors
    /// Names the file and the parameter.
    pub fn load(path: Option<&Path>, overrides: &Overrides) -> Result<Self, ConfigError> {
        let (text, origin) = match path {
            Some(path) => {
                let read = std::fs::read_to_string(path);
                (read.map_err(|source| ConfigError::Read { path: path.to_owned(), source })?, path.to_owned())
            }
            None => (String::new(), PathBuf::from("defaults")),
        };
        Self::parse(&text, &origin, overrides)
    }

    fn parse(text: &str, origin: &Path, overrides: &Overrides) -> Result<Self, ConfigError> {
        let syntax = |message: String| ConfigError::Syntax { path: origin.to_owned(), message };
        let file: File = toml::from_str(text).map_err(|error| syntax(error.to_string()))?;
        let preset = MappingParams::preset(overrides.preset.as_ref().unwrap_or(&file.preset))?;
        let mut merged = toml::Table::try_from(&preset).map_err(|error| syntax(error.to_string()))?;
        let given = |name| file.mapping.contains_key(name);
        let pinned = Pinned { scale: given("scale"), r1: given("r1"), r2: given("r2") };
        merged.extend(file.mapping);
        let mut mapping: MappingParams =
            merged.try_into().map_err(|error| syntax(format!("in [mapping]: {}", error.message())))?;
        mapping.pinned = pinned;
        if let Some(mode) = overrides.mode {
            mapping.mode = mode;
        }
        mapping.validate()?;
        let mut control = file.control;
        if let Some(rate) = overrides.rate {
            control.rate_hz = rate;
        }
        control.check(mapping, &file.authority, &file.playout)
    }
}

impl ControlFile {
    fn check(
        &self,
        mapping: MappingParams,
        authority: &AuthorityFile,
        playout: &PlayoutFile,
    ) -> Result<Config, ConfigError> {
        let range = |name, value: f64, from: f64, to: f64, rule| {
            if (from..=to).contains(&value) { Ok(value) } else { Err(ConfigError::Range { name, value, rule }) }
        };
        let rate = range("control.rate_hz", self.rate_hz, 20.0, 2000.0, "from 20 to 2000 Hz")?;
        let seconds = |name, value, from, to, rule| range(name, value, from, to, rule).map(Duration::from_secs_f64);
        Ok(Config {
            mapping,
            control: ControlParams {
                rate,
                hold_after: seconds("authority.hold_after_s", authority.hold_after_s, 0.01, 2.0, "from 0.01 to 2 s")?,
                relax: authority.relax,
                relax_after: seconds(
                    "authority.relax_after_s",
                    authority.relax_after_s,
                    0.1,
                    86_400.0,
                    "from 0.1 to 86400 s",
                )?,
                stop: authority.stop,
                smoothing: range("control.smoothing_s", self.smoothing_s, 0.0, 1.0, "from 0 (off) to 1 s")?,
                engage_speed: range(
                    "control.engage_speed_rad_s",
                    self.engage_speed_rad_s,
                    0.05,
                    20.0,
                    "from 0.05 to 20 rad/s",
                )?,
                engage_ramp: range("control.engage_ramp_s", self.engage_ramp_s, 0.0, 30.0, "from 0 to 30 s")?,
                playout: PlayoutParams {
                    mode: playout.mode,
                    max_delay: seconds("playout.max_delay_s", playout.max_delay_s, 0.0, 2.0, "from 0 to 2 s")?,
                    tolerance: seconds("playout.tolerance_s", playout.tolerance_s, 0.0, 1.0, "from 0 to 1 s")?,
                    predict: seconds("playout.predict_s", playout.predict_s, 0.0, 0.2, "from 0 (off) to 0.2 s")?,
                },
                tip_overlap: range(
                    "control.tip_overlap_m",
                    self.tip_overlap_m,
                    0.0,
                    0.1,
                    "from 0 to 0.1 m (no guard)",
                )?,
            },
            lease: LeaseParams {
                max_age: seconds("authority.max_age_s", authority.max_age_s, 0.01, 5.0, "from 0.01 to 5 s")?,
                release_after: seconds(
                    "authority.release_after_s",
                    authority.release_after_s,
                    0.1,
                    3600.0,
                    "from 0.1 to 3600 s",
                )?,
                takeover: authority.takeover,
            },
            velocity_scale: range("control.velocity_scale", self.velocity_scale, 0.01, 1.0, "from 0.01 to 1")?,
            acceleration_scale: range(
                "control.acceleration_scale",
                self.acceleration_scale,
                0.01,
                10.0,
                "from 0.01 to 10",
            )?,
        })
    }
}

/// Where the hand comes from.
#[derive(Clone, Debug)]
pub struct HandSource {
    /// Which of the compiled-in hands.
    pub side: HandSide,
    /// A URDF instead of the compiled-in one.
    pub urdf: Option<PathBuf>,
    /// A description instead of the compiled-in one.
    pub description: Option<PathBuf>,
}

impl HandSource {
    /// Loads the hand and applies the configured limits.
    ///
    /// # Errors
    /// Names the file and the element that is wrong.
    pub fn load(&self, config: &Config) -> Result<HandModel, ConfigError> {
        let read = |path: &PathBuf| {
            std::fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.clone(), source })
        };
        let mut hand = if self.urdf.is_none() && self.description.is_none() {
            HandModel::allegro_v4(self.side)
        } else {
            let (urdf, description) = allegro_v4_texts(self.side);
            let urdf_text = self.urdf.as_ref().map_or_else(|| Ok(urdf.to_owned()), read)?;
            let text = self.description.as_ref().map_or_else(|| Ok(description.to_owned()), read)?;
            HandModel::load(&urdf_text, &text).map_err(|source| ConfigError::Hand { origin: self.origin(), source })?
        };
        for joint in &mut hand.joints {
            joint.velocity *= config.velocity_scale;
            joint.acceleration *= config.acceleration_scale;
        }
        Ok(hand)
    }

    fn origin(&self) -> String {
        let name = |path: &Option<PathBuf>, kind: &str| {
            path.as_ref().map_or_else(|| format!("built-in {kind}"), |path| path.display().to_string())
        };
        format!("hand from {} and {}", name(&self.urdf, "URDF"), name(&self.description, "description"))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::sample::Index;
    use teleop_common::authority::{Clutch, Latch};
    use teleop_common::hand::JointVector;
    use teleop_common::mapping::BaselineParams;
    use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
    use teleop_common::mode::Mode;
    use teleop_common::time::MonoTime;

    use super::*;
    use crate::control::{Controller, PoseSample};
    use crate::driver::JointState;

    fn parse(text: &str) -> Result<Config, ConfigError> {
        Config::parse(text, Path::new("robot.toml"), &Overrides::default())
    }

    #[test]
    fn a_file_changes_single_parameters_of_its_preset() {
        let config = parse("preset = \"paper\"\n[mapping]\nr2 = 0.05\n[control]\nrate_hz = 500").unwrap();
        let pinned = Pinned { r2: true, ..Pinned::default() };
        assert_eq!(config.mapping, MappingParams { r2: 0.05, pinned, ..MappingParams::paper() });
        assert_eq!(config.control.rate, 500.0);
        assert_eq!(parse("").unwrap().mapping, MappingParams::default());
        let config = parse("[mapping]\nmode = \"dexpilot\"\n[mapping.baseline]\nlow_pass = 0.2").unwrap();
        let baseline = BaselineParams { low_pass: 0.2, ..BaselineParams::default() };
        assert_eq!(config.mapping, MappingParams { mode: MappingMode::DexPilot, baseline, ..MappingParams::default() });
    }

    #[test]
    fn the_command_line_wins() {
        let overrides =
            Overrides { preset: Some("paper".to_owned()), mode: Some(MappingMode::Joint), rate: Some(100.0) };
        let config = Config::parse("preset = \"default\"", Path::new("x"), &overrides).unwrap();
        assert_eq!(config.mapping, MappingParams { mode: MappingMode::Joint, ..MappingParams::paper() });
        assert_eq!(config.control.rate, 100.0);
    }

    #[test]
    fn errors_name_the_value_and_the_rule() {
        for (text, expected) in [
            ("preset = \"best\"", "preset \"best\" is unknown"),
            ("[mapping]\nr1 = -1", "mapping.r1 = -1 is not usable"),
            ("[mapping]\nr2 = 0.01", "mapping.r2 = 0.01 is not usable: it must be at least r1"),
            ("[mapping]\nradius = 1", "radius"),
            ("[mapping]\ntuning = \"mine\"", "expected `operator` or `fixed`"),
            (
                "[mapping]\nbaseline = { scale = 0 }",
                "mapping.baseline.scale = 0 is not usable: it must be from 0.1 to 10",
            ),
            ("[control]\nrate_hz = 0", "control.rate_hz = 0 is not usable: it must be from 20 to 2000 Hz"),
            ("[authority]\nhold_after_s = nan", "authority.hold_after_s = NaN"),
            ("[authority]\ntakeover = \"please\"", "expected one of `never`, `idle`, `always`"),
            ("speed = 3", "speed"),
        ] {
            let message = parse(text).unwrap_err().to_string();
            assert!(message.contains(expected), "{text}: {message}");
        }
    }

    /// All there is, with its defaults.
    fn everything() -> String {
        let mut table = toml::Table::try_from(File::default()).unwrap();
        table.insert("mapping".to_owned(), toml::Value::try_from(MappingParams::default()).unwrap());
        toml::to_string(&table).unwrap()
    }

    const PIECES: [&str; 12] = ["\n", "=", ".", "[", "]", "{", "}", "\"", "#", ",", "[control]\n", "\u{0}"];
    const VALUES: [&str; 16] = [
        "nan",
        "-inf",
        "1e400",
        "-0.0",
        "-1",
        "0",
        "1e-300",
        "0.1",
        "0.25",
        "1",
        "2.5",
        "9223372036854775808",
        "true",
        "\"paper\"",
        "\"open\"",
        "\"always\"",
    ];

    #[derive(Clone, Debug)]
    enum Change {
        /// So many characters become a piece of syntax, or nothing.
        Text(Index, usize, usize),
        /// A line's value becomes another.
        Value(Index, usize),
    }

    fn change() -> impl Strategy<Value = Change> {
        prop_oneof![
            1 => (any::<Index>(), 0..12_usize, 0..=PIECES.len()).prop_map(|(at, cut, piece)| Change::Text(at, cut, piece)),
            4 => (any::<Index>(), 0..VALUES.len()).prop_map(|(at, value)| Change::Value(at, value)),
        ]
    }

    proptest! {
        /// Damaged configurations are refused in a few lines, or the loop runs with them.
        #[test]
        fn damaged_text(changes in prop::collection::vec(change(), 1..5)) {
            let mut text = everything();
            prop_assert!(parse(&text).is_ok());
            for change in changes {
                let (range, piece) = match change {
                    Change::Text(at, cut, piece) => {
                        let start = at.index(text.len() + 1);
                        (start..(start + cut).min(text.len()), PIECES.get(piece).copied().unwrap_or(""))
                    }
                    Change::Value(at, value) => {
                        let values: Vec<_> = text.match_indices(" = ").map(|(start, _)| start + 3).collect();
                        let start = *at.get(&values);
                        let end = text[start..].find('\n').map_or(text.len(), |length| start + length);
                        (start..end, VALUES[value])
                    }
                };
                text.replace_range(range, piece);
            }
            let config = match parse(&text) {
                Ok(config) => config,
                Err(error) => {
                    let message = error.to_string();
                    prop_assert!(!message.is_empty() && message.len() < 4096, "{message}");
                    return Ok(());
                }
            };
            let source = HandSource { side: HandSide::Right, urdf: None, description: None };
            let hand = source.load(&config).unwrap();
            // It may name a joint map that this hand does not have.
            let Ok(mut controller) = Controller::new(hand.clone(), config.mapping, config.control) else { return Ok(()) };
            let still = JointVector::zeros(hand.joints.len());
            let state = JointState { q: hand.home(), dq: still, tau: still };
            let (mut now, mut clutch) = (MonoTime(0), Clutch::default());
            for sequence in 1..60 {
                now = now + Duration::from_secs_f64(1.0 / config.control.rate);
                clutch = clutch.eager(controller.mode());
                let q = Gesture::Fist.sample(2.0);
                let pose = MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None };
                controller.admit(&PoseSample::instant(now, sequence, pose, clutch));
                let record = controller.tick(now, Latch::default(), &state);
                prop_assert_ne!(record.mode, Mode::Faulted);
                for (q, joint) in record.command.q.iter().zip(&hand.joints) {
                    prop_assert!((joint.lower..=joint.upper).contains(q), "{} at {}", joint.name, q);
                }
            }
            prop_assert!(controller.mode().follows());
        }
    }
}
