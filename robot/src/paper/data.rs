//! The numbers as JSON and CSV. Lengths in mm, angles as the names say.

use std::fmt::Write as _;

use serde_json::{Value, json};
use teleop_common::hand::{Finger, HandModel};
use teleop_common::mapping::{FingerSignals, Gain, MappingMode};
use teleop_common::master::MasterGeometry;
use teleop_common::paper::fig2::{self, Extremes, Loss};
use teleop_common::paper::fig6::{Tap, TapFinger};
use teleop_common::paper::motion::Sample;
use teleop_common::paper::smoothness::Smoothness;
use teleop_common::paper::{Check, fig4, table1};

use super::{Paper, Preset};

pub(super) const MM: f64 = 1e3;

pub(super) const fn mode_name(mode: MappingMode) -> &'static str {
    match mode {
        MappingMode::Joint => "joint",
        MappingMode::Cartesian => "cartesian",
        MappingMode::Combined => "combined",
        MappingMode::Vector => "vector",
        MappingMode::DexPilot => "dexpilot",
    }
}

pub(super) fn table1(hand: &HandModel) -> Value {
    let master = MasterGeometry::PARADIGMATIC;
    let mm = |lengths: [f64; 3]| lengths.map(|length| round(length * MM));
    let fingers = Finger::ALL.map(|finger| {
        let printed = table1::ALLEGRO.iter().find(|(own, _)| *own == finger).map(|(_, lengths)| mm(*lengths));
        let chain = hand.fingers.iter().find(|chain| chain.finger == finger);
        json!({
            "finger": finger.name(),
            "master_mm": mm(master.phalanges[finger.index()]),
            "slave_printed_mm": printed,
            "slave_model_mm": chain.and_then(|chain| table1::lengths(hand, chain)).map(mm),
        })
    });
    let ratios = table1::spacing_ratios(hand, &master)
        .into_iter()
        .map(|(from, to, ratio)| json!({ "from": from.name(), "to": to.name(), "d": round(ratio) }));
    let model = hand.fingers.iter().find(|chain| chain.finger == Finger::Thumb).and_then(|thumb| {
        let slave: f64 = table1::lengths(hand, thumb)?.iter().sum();
        Some(round(slave / master.phalanges[Finger::Thumb.index()].iter().sum::<f64>()))
    });
    json!({
        "fingers": fingers,
        "c_s": round(table1::printed_scale()),
        "c_s_model": model,
        "d": ratios.collect::<Vec<_>>(),
    })
}

pub(super) type Quantity = (&'static str, &'static str, fn(&Loss) -> f64);

/// The four quantities of Fig. 2, in degrees and mm: object, key, value.
pub(super) const FIG2: [Quantity; 4] = [
    ("shape", "q2_deg", |loss| loss.shape[1].to_degrees()),
    ("shape", "norm_deg", |loss| norm(&loss.shape).to_degrees()),
    ("cartesian", "y_mm", |loss| loss.position[0] * MM),
    ("cartesian", "norm_mm", |loss| norm(&loss.position) * MM),
];

pub(super) fn fig2(losses: &[Vec<Loss>]) -> Value {
    let extremes = |losses: &[Loss], value: fn(&Loss) -> f64| {
        let mm = |lengths: [f64; 3]| lengths.map(|length| round(length * MM));
        fig2::extremes(losses, value).map(|Extremes { max, max_at, min, min_at, mean }| {
            json!({ "max": max, "max_at": mm(max_at), "min": min, "min_at": mm(min_at), "mean": mean })
        })
    };
    let postures = fig2::POSTURES_DEG.iter().zip(losses).map(|(q, losses)| {
        let mut posture = json!({ "q_deg": q, "reachable": losses.len() });
        for (object, key, value) in FIG2 {
            // The Cartesian mapping of (a) loses shape, the joint mapping of (b) position. The magnitude of q2 counts.
            let value = if key == "q2_deg" { |loss: &Loss| loss.shape[1].abs().to_degrees() } else { value };
            posture[object][key] = json!(extremes(losses, value));
        }
        posture
    });
    json!({
        "combinations": fig2::combinations().len(),
        "master_mm": fig2::MASTER.map(|length| round(length * MM)),
        "postures": postures.collect::<Vec<_>>(),
    })
}

pub(super) fn fig2_csv(losses: &[Vec<Loss>]) -> String {
    let mut out = "q1_deg,q2_deg,q3_deg,a1_mm,a2_mm,a3_mm,shape_q1_deg,shape_q2_deg,shape_q3_deg,shape_norm_deg,\
                   position_y_mm,position_z_mm,position_norm_mm\n"
        .to_owned();
    for (q, losses) in fig2::POSTURES_DEG.iter().zip(losses) {
        for loss in losses {
            let lengths = loss.lengths.map(|length| round(length * MM));
            let shape = loss.shape.map(f64::to_degrees);
            let position = loss.position.map(|position| position * MM);
            let values = q.iter().chain(&lengths).chain(&shape).copied();
            let values = values.chain([norm(&shape), position[0], position[1], norm(&position)]);
            row(&mut out, values);
        }
    }
    out
}

/// Distances (mm) and gains, per preset corrected and as printed.
pub(super) fn fig4_csv(presets: &[Preset]) -> String {
    let mut out = "delta_mm".to_owned();
    for preset in presets {
        write!(out, ",k_{0},k_as_printed_{0}", preset.name).ok();
    }
    out.push('\n');
    for step in 0..=400 {
        let delta = f64::from(step) * 0.25e-3;
        let values = presets.iter().flat_map(|preset| {
            let gain = gain(preset);
            [gain.at(delta), fig4::as_printed(&gain, delta)]
        });
        row(&mut out, [round(delta * MM)].into_iter().chain(values));
    }
    out
}

pub(super) fn gain(preset: &Preset) -> Gain {
    Gain { r1: preset.params.r1, r2: preset.params.r2, shape: preset.params.gain }
}

type TapColumn = (&'static str, fn(&TapFinger) -> f64);

const TAP_COLUMNS: [TapColumn; 8] = [
    ("e_q_peak_rad", |finger| finger.e_q_peak),
    ("e_q_mean_rad", |finger| finger.e_q_mean),
    ("e_q_max_rad", |finger| finger.e_q_max),
    ("e_c_peak_mm", |finger| finger.e_c_peak * MM),
    ("e_c_mean_mm", |finger| finger.e_c_mean * MM),
    ("distance_peak_mm", |finger| finger.distance_peak * MM),
    ("distance_error_peak_mm", |finger| finger.distance_error_peak * MM),
    ("distance_error_rms_mm", |finger| finger.distance_error_rms * MM),
];

pub(super) fn fig6_csv(presets: &[Preset]) -> String {
    let mut out = "preset,gesture,mapping,finger,involved".to_owned();
    TAP_COLUMNS.iter().for_each(|(name, _)| write!(out, ",{name}").unwrap_or(()));
    out.push('\n');
    for (preset, tap) in presets.iter().flat_map(|preset| preset.taps.iter().flatten().map(move |tap| (preset, tap))) {
        for finger in &tap.fingers {
            let name = finger.finger.name();
            write!(out, "{},{},{},{name},{},", preset.name, tap.gesture, mode_name(tap.mode), finger.involved).ok();
            row(&mut out, TAP_COLUMNS.iter().map(|(_, value)| value(finger)));
        }
    }
    out
}

pub(super) fn fig6(presets: &[Preset]) -> Value {
    let finger = |finger: &TapFinger| {
        let mut out = json!({ "involved": finger.involved });
        for (name, value) in TAP_COLUMNS {
            out[name] = json!(value(finger));
        }
        (finger.finger.name().to_owned(), out)
    };
    let tap = |tap: &Tap| {
        let fingers: serde_json::Map<_, _> = tap.fingers.iter().map(finger).collect();
        (mode_name(tap.mode).to_owned(), Value::Object(fingers))
    };
    let preset = |preset: &Preset| {
        let gestures = preset.taps.iter().map(|taps| {
            let modes: serde_json::Map<_, _> = taps.iter().map(tap).collect();
            (taps[0].gesture.name().to_owned(), Value::Object(modes))
        });
        (preset.name.clone(), Value::Object(gestures.collect()))
    };
    Value::Object(presets.iter().map(preset).collect())
}

type Scalar = (&'static str, &'static str, fn(&FingerSignals) -> f64);
type Vector = (&'static str, fn(&FingerSignals) -> nalgebra::Vector3<f64>);

const SCALARS: [Scalar; 4] = [
    ("delta", "_mm", |signals| signals.delta * MM),
    ("k", "", |signals| signals.k),
    ("e_q", "_rad", |signals| signals.e_q),
    ("e_c", "_mm", |signals| signals.e_c * MM),
];
pub(super) const VECTORS: [Vector; 4] = [
    ("p_c", |signals| signals.p_cartesian),
    ("p_q", |signals| signals.p_joint),
    ("p_input", |signals| signals.p_input),
    ("p", |signals| signals.p),
];

/// One row per sample; positions in O_SW (x radial, y distal, z palmar).
pub(super) fn fig8_csv(hand: &HandModel, samples: &[Sample]) -> String {
    let mut out = "t".to_owned();
    let names: Vec<_> = hand.fingers.iter().map(|chain| chain.finger.name()).collect();
    for (name, unit, _) in SCALARS {
        names.iter().for_each(|finger| write!(out, ",{name}_{finger}{unit}").unwrap_or(()));
    }
    for (name, _) in VECTORS {
        for finger in &names {
            ["x", "y", "z"].iter().for_each(|axis| write!(out, ",{name}_{finger}_{axis}_mm").unwrap_or(()));
        }
    }
    out.push('\n');
    for sample in samples {
        let fingers = sample.output.fingers();
        let scalars = SCALARS.iter().flat_map(|(_, _, value)| fingers.iter().map(value));
        let vectors = VECTORS.iter().flat_map(|(_, value)| {
            let turned = fingers.iter().map(|signals| hand.anatomical_from_palm * value(signals) * MM);
            turned.flat_map(<[f64; 3]>::from)
        });
        row(&mut out, [round(sample.t)].into_iter().chain(scalars).chain(vectors));
    }
    out
}

type SmoothnessColumn = (&'static str, &'static str, fn(&Smoothness) -> f64);

/// Name, unit, value.
pub(super) const SMOOTHNESS: [SmoothnessColumn; 4] = [
    ("peak_speed", "rad_s", |s| s.peak_speed),
    ("velocity_jump", "rad_s", |s| s.velocity_jump),
    ("peak_jerk", "rad_s3", |s| s.peak_jerk),
    ("rms_jerk", "rad_s3", |s| s.rms_jerk),
];

pub(super) fn smoothness_csv(presets: &[Preset]) -> String {
    let mut out = "preset,gesture,stage".to_owned();
    SMOOTHNESS.iter().for_each(|(name, unit, _)| write!(out, ",{name}_{unit}").unwrap_or(()));
    out.push('\n');
    for preset in presets {
        for (gesture, stages) in &preset.smoothness {
            for (stage, smoothness) in super::STAGES.iter().zip(stages) {
                write!(out, "{},{gesture},{stage},", preset.name).ok();
                row(&mut out, SMOOTHNESS.iter().map(|(_, _, value)| value(smoothness)));
            }
        }
    }
    out
}

pub(super) fn smoothness(presets: &[Preset]) -> Value {
    let one = |smoothness: &Smoothness| {
        let values = SMOOTHNESS.iter().map(|(name, unit, value)| (format!("{name}_{unit}"), json!(value(smoothness))));
        Value::Object(values.collect())
    };
    let preset = |preset: &Preset| {
        let gestures = preset.smoothness.iter().map(|(gesture, [before, after])| {
            (gesture.name().to_owned(), json!({ "before": one(before), "after": one(after) }))
        });
        (preset.name.clone(), Value::Object(gestures.collect()))
    };
    Value::Object(presets.iter().map(preset).collect())
}

pub(super) fn summary(paper: &Paper) -> Value {
    let preset = |preset: &Preset| {
        let fig8 = preset.fig8_checks().map(|(gesture, list)| (gesture.name().to_owned(), checks(list)));
        let fig6 = preset.tap_checks().map(|(gesture, list)| (gesture.name().to_owned(), checks(list)));
        let value = json!({
            "parameters": preset.params,
            "fig8": Value::Object(fig8.collect()),
            "fig6": Value::Object(fig6.collect()),
        });
        (preset.name.clone(), value)
    };
    json!({
        "hand": paper.hand.name,
        "version": env!("CARGO_PKG_VERSION"),
        "presets": Value::Object(paper.presets.iter().map(preset).collect()),
    })
}

fn checks(checks: &[Check]) -> Value {
    let one = |check: &Check| {
        let values: serde_json::Map<_, _> =
            check.values.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
        let value = json!({ "statement": check.statement, "holds": check.holds, "values": values, "note": check.note });
        (check.name.to_owned(), value)
    };
    Value::Object(checks.iter().map(one).collect())
}

fn row(out: &mut String, values: impl IntoIterator<Item = f64>) {
    for (column, value) in values.into_iter().enumerate() {
        let comma = if column == 0 { "" } else { "," };
        write!(out, "{comma}{value}").ok();
    }
    out.push('\n');
}

/// Takes off the last digits, which are only the way to the unit.
pub(super) fn round(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}

pub(super) fn norm(values: &[f64]) -> f64 {
    values.iter().map(|value| value * value).sum::<f64>().sqrt()
}
