//! `robot retarget`: the contract of its output, the mapping in it, conditioning, and what it does with bad input.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::Value;
use teleop_common::authority::{Clutch, Latch};
use teleop_common::hand::{Finger, HandModel, HandSide, JointVector, TipFrame};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::testing::shared_data;
use teleop_common::time::MonoTime;
use teleop_robot::control::{ControlParams, Controller, PoseSample};
use teleop_robot::driver::{HandDriver, SimHand};
use teleop_tests::judge::{Command, assert_limits};
use teleop_tests::process::run;

const FINGERS: [Finger; 4] = [Finger::Thumb, Finger::Index, Finger::Middle, Finger::Ring];
const FIELDS: [&str; 12] =
    ["t", "q_master", "q_joint", "q", "delta", "k", "p_joint", "p_cartesian", "p_input", "p", "e_q", "e_c"];
const RATE: f64 = 333.0;

/// A folder with an input and the place of an output.
struct Job {
    folder: tempfile::TempDir,
    input: PathBuf,
    output: PathBuf,
}

impl Job {
    fn new(input: impl AsRef<[u8]>) -> Self {
        Self::named("input.jsonl", input)
    }

    fn named(name: &str, input: impl AsRef<[u8]>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (path, output) = (folder.path().join(name), folder.path().join("output.jsonl"));
        std::fs::write(&path, input).unwrap();
        Self { folder, input: path, output }
    }

    /// Exit code and what it says.
    fn run(&self, more: &[&str]) -> (i32, String) {
        let mut arguments = vec!["retarget", "--input", self.input.to_str().unwrap()];
        arguments.extend(["--output", self.output.to_str().unwrap()]);
        arguments.extend(more);
        let output = run("robot", &arguments);
        (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
    }

    #[track_caller]
    fn rows(&self, more: &[&str]) -> Vec<Value> {
        let (code, text) = self.run(more);
        assert_eq!(code, 0, "{more:?}: {text}");
        read(&self.output)
    }

    /// Names in the folder.
    fn files(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.folder.path()).unwrap();
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

fn read(path: &Path) -> Vec<Value> {
    std::fs::read_to_string(path).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// A motion at 100 frames a second, slower than life by `slowness`.
///
/// Angles are rounded to nanoradians: a JSON parser is exact for numbers of few digits, not for all.
fn motion(gesture: Gesture, slowness: f64) -> Vec<(f64, [f64; 20])> {
    let frames = (gesture.duration() * slowness * 100.0) as u32;
    let round = |angle: f64| (angle * 1e9).round() / 1e9;
    (0..=frames).map(|frame| f64::from(frame) / 100.0).map(|t| (t, gesture.sample(t / slowness).map(round))).collect()
}

fn lines(motion: &[(f64, [f64; 20])]) -> String {
    motion.iter().fold(String::new(), |mut text, (t, q)| {
        writeln!(text, "{}", serde_json::json!({ "t": t, "q": q.to_vec() })).unwrap();
        text
    })
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

fn of(row: &Value, field: &str, finger: Finger) -> f64 {
    row[field][finger.name()].as_f64().unwrap()
}

fn point(row: &Value, field: &str, finger: Finger) -> nalgebra::Vector3<f64> {
    nalgebra::Vector3::from_vec(numbers(&row[field][finger.name()]))
}

#[track_caller]
fn assert_near(what: &str, a: f64, b: f64) {
    assert!((a - b).abs() <= 1e-9, "{what}: {a} is not {b}");
}

/// Checks one row against the contract, and its signals against each other and the hand.
#[track_caller]
fn assert_row(row: &Value, (t, q_master): &(f64, [f64; 20]), hand: &HandModel, mode: &str) {
    let mut fields: Vec<_> = row.as_object().unwrap().keys().map(String::as_str).collect();
    let mut expected = FIELDS.to_vec();
    fields.sort_unstable();
    expected.sort_unstable();
    expected.sort_unstable();
    assert_eq!(fields, expected);
    assert_eq!((row["t"].as_f64().unwrap(), numbers(&row["q_master"])), (*t, q_master.to_vec()));
    let (q, q_joint) = (numbers(&row["q"]), numbers(&row["q_joint"]));
    assert_eq!((q.len(), q_joint.len()), (16, 16));
    for values in [&q, &q_joint] {
        for (value, joint) in values.iter().zip(&hand.joints) {
            assert!((joint.lower..=joint.upper).contains(value), "t {t}: {} at {value}", joint.name);
        }
    }
    for field in &FIELDS[4..] {
        let names: Vec<_> = row[field].as_object().unwrap().keys().map(String::as_str).collect();
        let expected = FINGERS.iter().filter(|finger| *field != "delta" || **finger != Finger::Thumb);
        let mut expected: Vec<_> = expected.map(|finger| finger.name()).collect();
        expected.sort_unstable();
        assert_eq!(
            {
                let mut names = names;
                names.sort_unstable();
                names
            },
            expected,
            "{field}"
        );
    }
    let pose = MasterPose { q: *q_master, geometry: MasterGeometry::PARADIGMATIC, tuning: None };
    for chain in &hand.fingers {
        let finger = chain.finger;
        let (own, joint) = (chain.select(&q), chain.select(&q_joint));
        let k = of(row, "k", finger);
        assert!((0.0..=1.0).contains(&k), "{k}");
        let baseline = matches!(mode, "vector" | "dexpilot");
        match mode {
            "joint" | "vector" => assert_eq!(k, 0.0),
            "cartesian" => assert_eq!(k, 1.0),
            "dexpilot" => assert!(k == 0.0 || k == 1.0),
            _ => {}
        }
        if k == 0.0 && !baseline {
            assert_eq!(own, joint, "t {t}: k of the {} is 0", finger.name());
        }
        if finger != Finger::Thumb {
            let delta = (pose.tip(finger) - pose.tip(Finger::Thumb)).norm();
            assert_near("delta", of(row, "delta", finger), delta);
        }
        let (p, p_joint) = (chain.tip(&own, TipFrame::Pole), chain.tip(&joint, TipFrame::Pole));
        assert_near("p", (point(row, "p", finger) - p).norm(), 0.0);
        assert_near("p_joint", (point(row, "p_joint", finger) - p_joint).norm(), 0.0);
        let weight = if baseline { 1.0 } else { k };
        let blend = p_joint * (1.0 - weight) + point(row, "p_cartesian", finger) * weight;
        assert_near("p_input", (point(row, "p_input", finger) - blend).norm(), 0.0);
        let e_q = own.iter().zip(&joint).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert_near("e_q", of(row, "e_q", finger), e_q);
        assert_near("e_c", of(row, "e_c", finger), (point(row, "p_cartesian", finger) - p).norm());
    }
}

#[test]
fn every_row_keeps_the_contract() {
    let motion = motion(Gesture::TapIndex, 1.0);
    let job = Job::new(lines(&motion));
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        for mode in ["combined", "joint", "cartesian", "vector", "dexpilot"] {
            for preset in ["default", "paper"] {
                let rows = job.rows(&["--hand", side.name(), "--mode", mode, "--preset", preset]);
                assert_eq!(rows.len(), motion.len());
                for (row, frame) in rows.iter().zip(&motion) {
                    assert_row(row, frame, &hand, mode);
                }
                // The mapping is the library's own, from the first frame on.
                let mut params = MappingParams::preset(preset).unwrap();
                params.mode = serde_json::from_value(mode.into()).unwrap();
                let mut retargeter = Retargeter::new(hand.clone(), params).unwrap();
                for (row, (_, q)) in rows.iter().zip(&motion) {
                    let mapped =
                        retargeter.map(&MasterPose { q: *q, geometry: MasterGeometry::PARADIGMATIC, tuning: None });
                    let q = numbers(&row["q"]);
                    assert!(q.iter().zip(mapped.q.iter()).all(|(a, b)| (a - b).abs() < 1e-12), "{q:?}");
                }
            }
        }
    }
    assert_eq!(job.files(), ["input.jsonl", "output.jsonl"]);
}

#[test]
fn taps_close_to_scale_at_their_peak() {
    let taps: [(Gesture, &[Finger]); 6] = [
        (Gesture::TapIndex, &[Finger::Index]),
        (Gesture::TapMiddle, &[Finger::Middle]),
        (Gesture::TapRing, &[Finger::Ring]),
        (Gesture::Tripod, &[Finger::Index, Finger::Middle]),
        (Gesture::TapIndexClose, &[Finger::Index]),
        (Gesture::TapMiddleClose, &[Finger::Middle]),
    ];
    for side in ["right", "left"] {
        for (gesture, fingers) in taps {
            let rows = Job::new(lines(&motion(gesture, 1.0))).rows(&["--hand", side]);
            for &finger in fingers {
                let delta = |row: &&Value| of(row, "delta", finger);
                let peak = rows.iter().min_by(|a, b| delta(a).total_cmp(&delta(b))).unwrap();
                assert!(delta(&peak) < 0.02 && of(peak, "k", finger) == 1.0, "{gesture}: {} m", delta(&peak));
                let apart = (point(peak, "p", finger) - point(peak, "p", Finger::Thumb)).norm();
                let error = (apart - 1.6 * delta(&peak)).abs();
                assert!(error <= 0.5e-3, "{side} {gesture}, {}: {:.2} mm off", finger.name(), error * 1e3);
            }
        }
        // At an index tap the ring finger is nobody's: exactly joint-mapped all the time.
        let rows = Job::new(lines(&motion(Gesture::TapIndex, 1.0))).rows(&["--hand", side]);
        for row in &rows {
            assert_eq!(of(row, "e_q", Finger::Ring), 0.0);
            assert_eq!(numbers(&row["q"])[8..12], numbers(&row["q_joint"])[8..12]);
        }
    }
}

#[test]
fn a_recording_of_keypoints_is_mapped_onto_either_hand() {
    let Some(recording) = shared_data("human_hand_right.csv") else { return };
    let job = Job::named("hand.csv", std::fs::read(recording).unwrap());
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        let rows = job.rows(&["--hand", side.name()]);
        assert_eq!(rows.len(), 400);
        let mut gaps = Vec::new();
        for row in &rows {
            for (value, joint) in numbers(&row["q"]).iter().zip(&hand.joints) {
                assert!((joint.lower..=joint.upper).contains(value), "{} at {value}", joint.name);
            }
            if of(row, "delta", Finger::Index) < 0.025 {
                gaps.push((point(row, "p", Finger::Index) - point(row, "p", Finger::Thumb)).norm());
            }
        }
        // The person's touch is tuned to be the robot's.
        gaps.sort_by(f64::total_cmp);
        let worst = gaps.last().unwrap();
        println!("{}: gap of index and thumb at most {:.2} mm in {} frames", side.name(), worst * 1e3, gaps.len());
        assert!(*worst < 0.002 && gaps.len() >= 5, "{gaps:?}");
        // Pinches of the recording: frames 311 to 333.
        let closest = rows[311..333].iter().map(|row| of(row, "delta", Finger::Index)).fold(1.0, f64::min);
        assert!(closest < 0.03, "{closest} m");
    }
}

#[test]
fn bad_input_names_its_line_and_leaves_nothing_behind() {
    let good = lines(&motion(Gesture::Wave, 1.0)[..3]);
    let q = serde_json::json!(vec![0.1; 20]).to_string();
    let huge = format!("{{\"t\": 9, \"q\": [{}0]}}", "0.1, ".repeat(20_000));
    let cases: Vec<(String, Vec<u8>, &str)> = vec![
        ("truncated".into(), b"{\"t\": 9, \"q\": [0.1, 0.2\n".to_vec(), "line 4"),
        ("cut off at the end".into(), b"{\"t\": 9, \"q\": [0.1, 0.2".to_vec(), "line 4"),
        ("too few angles".into(), b"{\"t\": 9, \"q\": [0.1, 0.2]}\n".to_vec(), "line 4"),
        ("no time".into(), format!("{{\"q\": {q}}}\n").into_bytes(), "line 4"),
        ("no hand".into(), b"{\"t\": 9}\n".to_vec(), "line 4"),
        ("time runs back".into(), format!("{{\"t\": 0.005, \"q\": {q}}}\n").into_bytes(), "line 4"),
        ("NaN".into(), format!("{{\"t\": 9, \"q\": {}}}\n", q.replacen("0.1", "NaN", 1)).into_bytes(), "line 4"),
        ("infinite".into(), format!("{{\"t\": 9, \"q\": {}}}\n", q.replacen("0.1", "1e999", 1)).into_bytes(), "line 4"),
        ("no angle".into(), format!("{{\"t\": 9, \"q\": {}}}\n", q.replacen("0.1", "99", 1)).into_bytes(), "line 4"),
        ("unknown field".into(), format!("{{\"t\": 9, \"q\": {q}, \"s\": 1}}\n").into_bytes(), "line 4"),
        ("keypoints among angles".into(), format!("{{\"t\": 9, \"keypoints\": {}}}\n", keypoints()).into(), "line 4"),
        ("text".into(), b"and so on\n".to_vec(), "line 4"),
        ("no UTF-8".into(), b"{\"t\": \xff\xfe}\n".to_vec(), "line 4"),
        ("huge".into(), (huge + "\n").into_bytes(), "line 4"),
        ("blank lines count".into(), b"\n\nno\n".to_vec(), "line 6"),
    ];
    for conditioning in ["off", "on"] {
        for (name, bad, expected) in &cases {
            let job = Job::new([good.as_bytes(), bad].concat());
            let (code, text) = job.run(&["--conditioning", conditioning]);
            assert_eq!(code, 2, "{name}: {text}");
            assert!(text.contains(expected) && text.contains("input.jsonl"), "{name}: {text}");
            assert!(!text.contains("panicked"), "{name}: {text}");
            assert_eq!(job.files(), ["input.jsonl"], "{name}");
            // An output of an earlier run stays as it is.
            std::fs::write(&job.output, "before").unwrap();
            assert_eq!(job.run(&[]).0, 2, "{name}");
            assert_eq!(std::fs::read(&job.output).unwrap(), b"before", "{name}");
            assert_eq!(job.files(), ["input.jsonl", "output.jsonl"], "{name}");
        }
    }
    for (name, input) in [("empty", ""), ("blank", "\n\n"), ("no recording", "frame;time\n"), ("CSV", "frame,time_s\n")]
    {
        let job = Job::new(input);
        let (code, text) = job.run(&[]);
        assert_eq!(code, 2, "{name}: {text}");
        assert!(text.contains("input.jsonl"), "{name}: {text}");
        assert_eq!(job.files(), ["input.jsonl"], "{name}");
    }
    let job = Job::new(&good);
    std::fs::remove_file(&job.input).unwrap();
    let (code, text) = job.run(&[]);
    assert!(code != 0 && text.contains("input.jsonl") && text.contains("No such file"), "{code}: {text}");
    assert_eq!(job.files(), Vec::<String>::new());
}

#[test]
fn a_broken_csv_row_names_its_line() {
    let Some(recording) = shared_data("human_hand_right.csv") else { return };
    let text = std::fs::read_to_string(recording).unwrap();
    let rows: Vec<_> = text.lines().collect();
    let cut = rows[6].rsplit_once(',').unwrap().0;
    for bad in [cut.to_owned(), rows[6].replacen("0.", "nan", 1), "a,b,c".to_owned()] {
        let broken = [&rows[..6], &[bad.as_str()], &rows[7..]].concat().join("\n");
        let job = Job::named("hand.csv", broken);
        let (code, text) = job.run(&[]);
        assert_eq!(code, 2, "{text}");
        assert!(text.contains("line 7") && text.contains("hand.csv"), "{text}");
        assert_eq!(job.files(), ["hand.csv"]);
    }
}

/// 21 points of a flat hand, JSON.
fn keypoints() -> String {
    let points: Vec<_> = (0..21).map(|i| [0.0, 0.002 * f64::from(i), 0.008 * f64::from(i)]).collect();
    serde_json::json!(points).to_string()
}

/// What the live robot commands for these frames: the controller, ticked in virtual time with the simulated hand.
///
/// Frame i arrives at its time, the ticks are 1 / rate apart from the first frame on, and the result is where the hand
/// is when the next frame comes, on its way from the command before the last tick to the one of the last tick.
fn live(motion: &[(f64, [f64; 20])], side: HandSide) -> (Vec<JointVector>, Vec<Command>) {
    let hand = HandModel::allegro_v4(side);
    let params = ControlParams::default();
    let mut driver = SimHand::new(&hand, 1.0 / params.rate);
    driver.start().unwrap();
    let mut commands = vec![Command { epoch: 0, tick: 0, q: hand.home() }];
    let mut controller = Controller::new(hand, MappingParams::default(), params).unwrap();
    let at = |t: f64| MonoTime(((t - motion[0].0) * 1e9) as u64);
    let (mut rows, mut tick, mut clutch) = (Vec::new(), 0_u64, Clutch::default());
    let period = motion[motion.len() - 1].0 - motion[motion.len() - 2].0;
    for (index, (t, q)) in motion.iter().enumerate() {
        let pose = MasterPose { q: *q, geometry: MasterGeometry::PARADIGMATIC, tuning: None };
        clutch = clutch.eager(controller.mode());
        controller.admit(&PoseSample::instant(at(*t), index as u64, pose, clutch));
        let end = at(motion.get(index + 1).map_or(t + period, |(next, _)| *next));
        loop {
            let now = MonoTime((tick as f64 * 1e9 / params.rate) as u64);
            if now >= end {
                break;
            }
            tick += 1;
            let state = driver.read(Duration::ZERO).unwrap();
            let record = controller.tick(now, Latch::default(), &state);
            driver.write(&record.command).unwrap();
            commands.push(Command { epoch: 0, tick, q: record.command.q });
        }
        let [.., before, last] = &commands[..] else { panic!("no tick") };
        let share = end.since(MonoTime(((tick - 1) as f64 * 1e9 / params.rate) as u64)).as_secs_f64() * params.rate;
        let way = before.q.iter().zip(last.q.iter()).map(|(from, to)| from + (to - from) * share.min(1.0));
        rows.push(JointVector::from_slice(&way.collect::<Vec<_>>()));
    }
    (rows, commands)
}

#[test]
fn conditioning_gives_what_the_live_robot_commands() {
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        for gesture in [Gesture::Pinch, Gesture::Wave] {
            // With a gap, in which the robot holds, and starts again.
            let mut motion = motion(gesture, 1.0);
            let from = motion.len() / 2;
            for (t, _) in &mut motion[from..] {
                *t += 0.5;
            }
            let rows = Job::new(lines(&motion)).rows(&["--conditioning", "on", "--hand", side.name()]);
            assert_eq!(rows.len(), motion.len());
            let (expected, commands) = live(&motion, side);
            let mut last: Option<(f64, JointVector)> = None;
            for (row, expected) in rows.iter().zip(&expected) {
                let q = JointVector::from_slice(&numbers(&row["q"]));
                let t = &row["t"];
                let apart = q.iter().zip(expected.iter()).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()));
                assert!(apart < 1e-12, "{gesture} at {t} s: {apart:e} rad apart");
                let t = t.as_f64().unwrap();
                if let Some((before, from)) = last.replace((t, q)) {
                    let farthest = q.iter().zip(from.iter()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    assert!(farthest <= 7.0 * (t - before) + 1e-9, "{gesture} at {t} s: {farthest} rad");
                }
            }
            let extremes = assert_limits(&commands, &hand, RATE, 1e-12);
            println!("{} {gesture}: {extremes:?}", side.name());
            assert!(extremes.speed > 0.5, "{extremes:?}");
        }
    }
}

#[test]
fn conditioning_leaves_slow_motion_as_it_is() {
    // Not a fist: there the guard keeps the fingers off the palm and each other.
    let motion = motion(Gesture::Wave, 8.0);
    let job = Job::new(lines(&motion));
    let (off, on) = (job.rows(&[]), job.rows(&["--conditioning", "on"]));
    assert_eq!(off.len(), on.len());
    for (off, on) in off.iter().zip(&on) {
        assert_eq!((&off["q_joint"], &off["k"], &off["p_input"]), (&on["q_joint"], &on["k"], &on["p_input"]));
    }
    let (off, on) = (off.iter().map(posture), on.iter().map(posture));
    let (off, on): (Vec<_>, Vec<_>) = (off.collect(), on.collect());
    // A low-pass gives a mean of the last targets, here of two stages of 8 ms; where no limit is in force that is all.
    // The first two seconds take the robot from its home to the hand's first posture.
    let mut farthest: f64 = 0.0;
    for frame in 200..off.len() {
        for joint in 0..16 {
            let recent = off[frame - 10..=frame].iter().map(|q| q[joint]);
            let (low, high) = recent.fold((f64::MAX, f64::MIN), |(low, high), q| (low.min(q), high.max(q)));
            let q = on[frame][joint];
            assert!((low - 1e-4..=high + 1e-4).contains(&q), "frame {frame}: joint {joint} at {q}, {low} to {high}");
            farthest = farthest.max((q - off[frame][joint]).abs());
        }
    }
    println!("farthest from the pure mapping: {:.2} mrad", farthest * 1e3);
    assert!(farthest > 0.0 && farthest < 0.05, "{farthest} rad");
}

fn posture(row: &Value) -> Vec<f64> {
    numbers(&row["q"])
}

#[test]
fn a_data_set_is_mapped_on_all_threads() {
    let folder = tempfile::tempdir().unwrap();
    let (input, output) = (folder.path().join("set"), folder.path().join("mapped"));
    std::fs::create_dir(&input).unwrap();
    let gestures = [Gesture::Wave, Gesture::Fist, Gesture::Tripod, Gesture::Count];
    for gesture in gestures {
        std::fs::write(input.join(format!("{gesture}.jsonl")), lines(&motion(gesture, 1.0))).unwrap();
    }
    std::fs::write(input.join("notes.txt"), "no recording").unwrap();
    let (input, output) = (input.to_str().unwrap(), output.to_str().unwrap());
    let stats = folder.path().join("stats.json");
    let base = ["retarget", "--input", input, "--output", output, "--threads", "3"];
    let done = run("robot", &[&base[..], &["--stats", stats.to_str().unwrap()]].concat());
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let mut frames = 0;
    for gesture in gestures {
        let own = Job::new(lines(&motion(gesture, 1.0))).rows(&["--threads", "1"]);
        frames += own.len();
        assert_eq!(read(&Path::new(output).join(format!("{gesture}.jsonl"))), own, "{gesture}");
    }
    let stats: Value = serde_json::from_slice(&std::fs::read(stats).unwrap()).unwrap();
    assert_eq!((&stats["frames"], &stats["threads"]), (&frames.into(), &3.into()));
    assert!(stats["frames_per_second"].as_f64().unwrap() > 0.0);

    // One that is bad does not keep the others from being mapped.
    std::fs::remove_dir_all(output).unwrap();
    std::fs::write(Path::new(input).join("bad.jsonl"), "{\"t\": 0}\n").unwrap();
    let failed = run("robot", &base);
    let text = String::from_utf8_lossy(&failed.stderr);
    assert_eq!(failed.status.code(), Some(2), "{text}");
    assert!(text.contains("bad.jsonl") && text.contains("1 of 5 recordings failed"), "{text}");
    assert_eq!(std::fs::read_dir(output).unwrap().count(), gestures.len());

    std::fs::write(Path::new(input).join("fist.csv"), "").unwrap();
    let failed = run("robot", &base);
    let text = String::from_utf8_lossy(&failed.stderr);
    assert!(failed.status.code() == Some(2) && text.contains("would both be written to"), "{text}");
}

#[test]
fn a_long_gap_is_passed_at_once() {
    let mut motion = motion(Gesture::Wave, 1.0);
    for (t, _) in &mut motion[50..] {
        *t += 3600.1234;
    }
    let rows = Job::new(lines(&motion)).rows(&["--conditioning", "on"]);
    assert_eq!(rows.len(), motion.len());
}

#[test]
fn statistics_and_unwritable_outputs() {
    let motion = motion(Gesture::TapMiddle, 1.0);
    let job = Job::new(lines(&motion));
    let stats = job.folder.path().join("stats.json");
    job.rows(&["--stats", stats.to_str().unwrap()]);
    let stats: Value = serde_json::from_slice(&std::fs::read(stats).unwrap()).unwrap();
    assert_eq!(stats["frames"], motion.len());
    let step = |name: &str| stats["step_us"][name].as_f64().unwrap();
    println!("mapping and IK per frame: {stats}");
    assert!(step("p50") > 0.0 && step("p50") <= step("p99") && step("p99") <= step("max"), "{stats}");

    let mut job = Job::new(lines(&motion));
    job.output = job.folder.path().join("none/output.jsonl");
    let (code, text) = job.run(&[]);
    assert_eq!(code, 1, "{text}");
    assert!(text.contains("none/output.jsonl") && text.contains("No such file"), "{text}");
    assert_eq!(job.files(), ["input.jsonl"]);

    // The recording's own header is no frame, and its geometry counts.
    let header = "{\"format\":\"allegro-teleop-recording\",\"version\":1,\"side\":\"right\"}\n";
    assert_eq!(Job::new(header.to_owned() + &lines(&motion)).rows(&[]).len(), motion.len());
}
