//! `robot paper`: its files, their contracts, and what it does where it cannot write.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::Value;
use teleop_common::hand::{HandModel, HandSide};
use teleop_tests::process::run;

const FINGERS: [&str; 4] = ["thumb", "index", "middle", "ring"];

fn paper(arguments: &[&str]) -> (i32, String) {
    let mut all = vec!["paper"];
    all.extend(arguments);
    let output = run("robot", &all);
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

#[track_caller]
fn written(folder: &Path, more: &[&str]) -> String {
    let mut arguments = vec!["--out", folder.to_str().unwrap()];
    arguments.extend(more);
    let (code, text) = paper(&arguments);
    assert_eq!(code, 0, "{text}");
    text
}

fn read(folder: &Path, file: &str) -> String {
    std::fs::read_to_string(folder.join(file)).unwrap_or_else(|error| panic!("{file}: {error}"))
}

fn json(folder: &Path, file: &str) -> Value {
    serde_json::from_str(&read(folder, file)).unwrap_or_else(|error| panic!("{file}: {error}"))
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Columns of numbers by name.
fn columns(text: &str) -> BTreeMap<String, Vec<f64>> {
    let mut lines = text.lines();
    let head: Vec<_> = lines.next().unwrap().split(',').map(str::to_owned).collect();
    let mut out: BTreeMap<String, Vec<f64>> = head.iter().map(|name| (name.clone(), Vec::new())).collect();
    assert_eq!(out.len(), head.len(), "two columns have the same name");
    for line in lines {
        let values: Vec<f64> = line.split(',').map(|value| value.parse().unwrap()).collect();
        assert_eq!(values.len(), head.len(), "{line}");
        for (name, value) in head.iter().zip(values) {
            assert!(value.is_finite(), "{name}");
            out.get_mut(name).unwrap().push(value);
        }
    }
    out
}

/// The whole run, shared by the tests that only look.
fn folder() -> PathBuf {
    static FOLDER: std::sync::OnceLock<tempfile::TempDir> = std::sync::OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let text = written(&folder.path().join("made/by/it"), &[]);
        assert!(text.contains("index.html") && !text.contains("does not hold"), "{text}");
        folder
    });
    folder.path().join("made/by/it")
}

#[test]
fn all_files_are_there_and_well_formed() {
    let folder = folder();
    let mut expected = vec![
        "fig2.csv",
        "fig2.json",
        "fig2_position.svg",
        "fig2_shape.svg",
        "fig4.csv",
        "fig4.svg",
        "fig6.csv",
        "fig6.json",
        "index.html",
        "paper.rrd",
        "smoothness.csv",
        "smoothness.json",
        "smoothness.svg",
        "summary.json",
        "table1.json",
    ]
    .into_iter()
    .map(str::to_owned)
    .collect::<Vec<_>>();
    for preset in ["paper", "default"] {
        expected.push(format!("fig6_{preset}.svg"));
        for close in ["", "_close"] {
            expected.extend([
                format!("fig7_{preset}{close}.svg"),
                format!("fig8_{preset}{close}.svg"),
                format!("fig8_{preset}{close}.csv"),
            ]);
        }
    }
    expected.sort();
    assert_eq!(names(&folder), expected);

    let page = read(&folder, "index.html");
    for name in expected.iter().filter(|name| name.ends_with(".svg")) {
        let svg = read(&folder, name);
        // No number of a drawing got lost.
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"), "{name}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{name}");
        assert!(svg.matches("<text").count() > 10, "{name}");
        assert!(page.contains(&format!("src=\"{name}\"")), "{name} is not on the page");
    }
    assert!(page.trim_end().ends_with("</html>") && !page.contains("NaN"));
    let recording = std::fs::read(folder.join("paper.rrd")).unwrap();
    assert!(recording.starts_with(b"RRF") && recording.len() > 100_000, "{} bytes", recording.len());
}

#[test]
fn fig2_keeps_its_contract() {
    let fig2 = json(&folder(), "fig2.json");
    assert_eq!(fig2["combinations"], 455);
    let postures = fig2["postures"].as_array().unwrap();
    assert_eq!(postures.len(), 3);
    assert_eq!(postures[0]["q_deg"], serde_json::json!([30.0, 45.0, 30.0]));
    let rows = columns(&read(&folder(), "fig2.csv"));
    for (posture, number) in postures.iter().zip(0_usize..) {
        for (object, key, column) in [
            ("shape", "q2_deg", "shape_q2_deg"),
            ("shape", "norm_deg", "shape_norm_deg"),
            ("cartesian", "y_mm", "position_y_mm"),
            ("cartesian", "norm_mm", "position_norm_mm"),
        ] {
            let extremes = &posture[object][key];
            let mut keys: Vec<_> = extremes.as_object().unwrap().keys().map(String::as_str).collect();
            keys.sort_unstable();
            assert_eq!(keys, ["max", "max_at", "mean", "min", "min_at"], "{object} {key}");
            // Recomputed from the rows of the CSV.
            let range = number * 455..(number + 1) * 455;
            let values = &rows[column][range.clone()];
            let at = |index: usize| ["a1_mm", "a2_mm", "a3_mm"].map(|name| rows[name][range.start + index]);
            let signed = key == "y_mm";
            let value = |index: usize| if signed { values[index] } else { values[index].abs() };
            let by = |a: &usize, b: &usize| values[*a].abs().total_cmp(&values[*b].abs());
            let (largest, smallest) = ((0..455).max_by(by).unwrap(), (0..455).min_by(by).unwrap());
            // A JSON parser is exact for numbers of few digits, not for all.
            assert!((extremes["max"].as_f64().unwrap() - value(largest)).abs() < 1e-9);
            assert!((extremes["min"].as_f64().unwrap() - value(smallest)).abs() < 1e-9);
            assert_eq!(extremes["max_at"], serde_json::json!(at(largest)));
            assert_eq!(extremes["min_at"], serde_json::json!(at(smallest)));
            let mean = values.iter().map(|value| value.abs()).sum::<f64>() / 455.0;
            assert!((extremes["mean"].as_f64().unwrap() - mean).abs() < 1e-9);
        }
    }
}

#[test]
fn fig8_has_its_columns_and_properties() {
    for file in ["fig8_paper.csv", "fig8_default.csv", "fig8_paper_close.csv", "fig8_default_close.csv"] {
        let signals = columns(&read(&folder(), file));
        assert_eq!(signals.len(), 1 + 4 * 4 + 4 * 3 * 4, "{file}");
        let t = &signals["t"];
        assert_eq!((t.len(), t[0], t[800]), (801, 0.0, 80.0), "{file}");
        assert!(t.windows(2).all(|pair| (pair[1] - pair[0] - 0.1).abs() < 1e-9));
        for row in 0..801 {
            let k = |finger: &str| signals[&format!("k_{finger}")][row];
            assert_eq!(k("thumb"), ["index", "middle", "ring"].map(k).into_iter().fold(0.0, f64::max));
            assert_eq!(k("ring"), 0.0);
            for finger in FINGERS {
                let (k, e_q) = (k(finger), signals[&format!("e_q_{finger}_rad")][row]);
                let e_c = signals[&format!("e_c_{finger}_mm")][row];
                if k == 0.0 {
                    assert!(e_q == 0.0 && e_c > 0.0, "{file} {finger} at {} s", t[row]);
                }
                let mut square = 0.0;
                for axis in ["x", "y", "z"] {
                    let p = |name: &str| signals[&format!("{name}_{finger}_{axis}_mm")][row];
                    assert!((p("p_input") - (1.0 - k) * p("p_q") - k * p("p_c")).abs() < 1e-9, "{file} {finger}");
                    square += (p("p_c") - p("p")).powi(2);
                }
                assert!((square.sqrt() - e_c).abs() < 1e-6, "{file} {finger} at {} s", t[row]);
            }
        }
    }
}

#[test]
fn the_summary_says_what_holds_and_what_must_not_be_asserted() {
    let summary = json(&folder(), "summary.json");
    for preset in ["paper", "default"] {
        let own = &summary["presets"][preset];
        assert!(own["parameters"]["r2"].as_f64().unwrap() > own["parameters"]["r1"].as_f64().unwrap());
        for motion in ["tripod_fig8", "tripod_close_fig8"] {
            for property in ["P1", "P2", "P3", "P4", "P5", "P6", "P7"] {
                let check = &own["fig8"][motion][property];
                let asserted = !(preset == "paper" && motion == "tripod_fig8" && property == "P2");
                assert_eq!(
                    check["holds"],
                    if asserted { Value::Bool(true) } else { Value::Null },
                    "{preset} {motion} {check}"
                );
                assert!(asserted || check["note"].as_str().unwrap().contains("out of the hand's reach"), "{check}");
                assert!(!check["values"].as_object().unwrap().is_empty());
            }
        }
        for tap in ["tap_index", "tap_middle", "tap_ring"] {
            for check in own["fig6"][tap].as_object().unwrap().values() {
                assert_eq!(check["holds"], true, "{preset} {tap} {check}");
            }
        }
    }
}

#[test]
fn conditioned_gestures_keep_the_limits_and_the_papers_become_smoother() {
    let joints = HandModel::allegro_v4(HandSide::Right).joints;
    let velocity = joints.iter().map(|joint| joint.velocity).fold(0.0, f64::max);
    let acceleration = joints.iter().map(|joint| joint.acceleration).fold(0.0, f64::max);
    // The velocity changes at the loop's ticks, so up to one more of them than fit may lie between two samples.
    let period = 0.01_f64;
    let change = acceleration * (period + 1.0 / 333.0);
    let smoothness = json(&folder(), "smoothness.json");
    for preset in ["paper", "default"] {
        let gestures = smoothness[preset].as_object().unwrap();
        assert_eq!(gestures.len(), 7);
        for (gesture, stages) in gestures {
            let of = |stage: &str, name: &str| stages[stage][name].as_f64().unwrap();
            assert!(of("after", "peak_speed_rad_s") <= velocity + 1e-9, "{preset} {gesture}: {stages}");
            assert!(of("after", "velocity_jump_rad_s") <= change, "{preset} {gesture}: {stages}");
            assert!(of("after", "peak_jerk_rad_s3") <= 2.0 * change / period.powi(2), "{preset} {gesture}: {stages}");
            // A motion that is within the limits already need not become smoother.
            for name in ["peak_speed_rad_s", "velocity_jump_rad_s", "peak_jerk_rad_s3", "rms_jerk_rad_s3"] {
                assert!(preset != "paper" || of("after", name) < of("before", name), "{gesture} {name}: {stages}");
            }
        }
    }
}

#[test]
fn a_single_preset_and_the_left_hand_give_the_same_numbers() {
    let whole = folder();
    let folder = tempfile::tempdir().unwrap();
    written(folder.path(), &["--preset", "default", "--hand", "left"]);
    assert!(!folder.path().join("fig8_paper.csv").exists());
    // Deterministic, and in the anatomical frame both hands are one.
    assert_eq!(read(folder.path(), "fig2.json"), read(&whole, "fig2.json"));
    let (left, right) = (columns(&read(folder.path(), "fig8_default.csv")), columns(&read(&whole, "fig8_default.csv")));
    for (name, values) in &left {
        for (left, right) in values.iter().zip(&right[name]) {
            assert!((left - right).abs() < 1e-3, "{name}: {left}, right hand {right}");
        }
    }
}

#[test]
fn what_cannot_be_written_or_is_unknown_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let below = file.join("below");
    let (code, text) = paper(&["--out", below.to_str().unwrap()]);
    assert!(code == 2 && text.contains("--out") && text.contains("below"), "{code}: {text}");
    let (code, text) = paper(&["--out", folder.path().join("new").to_str().unwrap(), "--preset", "papr"]);
    assert!(code == 2 && text.contains("papr") && text.contains("\"paper\""), "{code}: {text}");
    assert!(!folder.path().join("new").exists());
    let (code, text) = paper(&[]);
    assert!(code == 2 && text.contains("--out"), "{code}: {text}");
}
