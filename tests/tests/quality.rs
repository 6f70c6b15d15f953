//! How well `robot retarget` follows the real recording of a human hand, against the figures reached.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::path::Path;

use serde_json::Value;
use teleop_common::testing::shared_data;
use teleop_tests::process::run;

/// The recording with x negated: the same motion of a left hand.
fn mirrored(recording: &str) -> String {
    let row = |line: &str| {
        let mirror = |(column, field): (usize, &str)| match field.parse::<f64>() {
            Ok(x) if column >= 2 && (column - 2) % 3 == 0 => format!("{}", -x),
            _ => field.to_owned(),
        };
        line.split(',').enumerate().map(mirror).collect::<Vec<_>>().join(",")
    };
    recording.lines().map(row).collect::<Vec<_>>().join("\n")
}

fn quality(folder: &Path, input: &str, options: &[&str]) -> Value {
    let path = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    std::fs::write(path("hand.csv"), input).unwrap();
    let (input, output, quality) = (path("hand.csv"), path("out.jsonl"), path("quality.json"));
    let mut arguments = vec!["retarget", "--input", &input, "--output", &output, "--quality", &quality];
    arguments.extend(options);
    let run = run("robot", &arguments);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    serde_json::from_slice(&std::fs::read(quality).unwrap()).unwrap()
}

#[test]
fn the_recorded_hand_is_followed_smoothly_without_lag_on_either_side() {
    let Some(path) = shared_data("human_hand_right.csv") else { return };
    let right = std::fs::read_to_string(path).unwrap();
    let left = mirrored(&right);
    let folder = tempfile::tempdir().unwrap();
    for (side, recording) in [("right", &right), ("left", &left)] {
        // The filter nearly alone: the joint mapping adds little of its own.
        let joint = quality(folder.path(), recording, &["--hand", side, "--mode", "joint"]);
        let mrad = joint["second_difference_rad"].as_f64().unwrap() * 1e3;
        assert!(mrad < 15.0, "{side}: {mrad} mrad per frame^2");

        for conditioning in ["off", "on"] {
            let measure = |filter: &str| {
                let options = ["--hand", side, "--filter", filter, "--conditioning", conditioning];
                quality(folder.path(), recording, &options)
            };
            let (raw, filtered) = (measure("off"), measure("on"));
            println!("{side}, conditioning {conditioning}\noff {raw}\non {filtered}");
            let number = |quality: &Value, key: &str| quality[key].as_f64().unwrap();
            assert_eq!(number(&filtered, "frames"), 400.0);
            assert!((number(&filtered, "period_s") - 1.0 / 30.0).abs() < 1e-5);

            let smooth = |quality: &Value| number(quality, "second_difference_rad");
            assert!(smooth(&filtered) < 0.6 * smooth(&raw), "{} to {}", smooth(&raw), smooth(&filtered));
            for finger in ["index", "middle", "ring"] {
                let lag = |quality: &Value| quality["fingers"][finger]["lag_s"].as_f64().unwrap();
                let added = lag(&filtered) - lag(&raw);
                assert!((0.0..0.05).contains(&added), "{side} {finger}: {added} s later than without the filter");
                if conditioning == "off" {
                    let frames = filtered["fingers"][finger]["lag_frames"].as_i64().unwrap();
                    assert!((0..=1).contains(&frames), "{side} {finger}: {frames} frames late");
                }
            }
            assert_eq!(filtered["fingers"]["index"]["pinch_frames"], 6);
            if conditioning == "off" {
                // Where the human pinches, the robot is no farther open than without the filter.
                let gap = |quality: &Value| quality["fingers"]["index"]["pinch_gap_m"].as_f64().unwrap();
                assert!(gap(&filtered) < gap(&raw) + 0.002, "{} m, unfiltered {} m", gap(&filtered), gap(&raw));
                assert!(gap(&filtered) < 0.002, "a human touch leaves the robot {} m open", gap(&filtered));
                assert_eq!(number(&filtered, "uninvolved_rad"), 0.0);
            }
            assert_eq!(number(&filtered, "limit_violation_rad"), 0.0);
            if conditioning == "on" {
                assert_eq!(number(&filtered, "over_speed_share"), 0.0);
                assert_eq!(number(&filtered, "penetration_share"), 0.0);
            }
        }
    }
}
