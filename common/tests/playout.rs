//! The playout buffer in virtual time: delay where it is needed, evenness, no jumps.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod master_support;

use std::time::Duration;

use master_support::Noise;
use teleop_common::master::{Calibrator, Filter, FilterSettings, Fitter, MasterGeometry, MasterPose};
use teleop_common::playout::{MAX_SPEED, Played, Playout, PlayoutMode, PlayoutParams};
use teleop_common::time::MonoTime;

const MS: u64 = 1_000_000;
/// Control period, ns.
const TICK: u64 = 3 * MS;

fn pose(value: f64) -> MasterPose {
    MasterPose { q: [value; 20], geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

/// The master's motion: rad at a time in s.
fn motion(t: f64) -> f64 {
    0.7 * (2.0 * t).sin() + 0.1 * (9.0 * t).sin()
}

struct Run {
    /// Largest error against the motion delayed by what `captured` says, rad.
    error: f64,
    /// Mean |second difference| from tick to tick, rad.
    rough: f64,
    delay: Duration,
}

/// 20 s of the motion, sent every `period` ms, over a link of `delay` +- `jitter` ms with `loss`; newest wins.
fn run(params: PlayoutParams, period: u64, delay: f64, jitter: f64, loss: f64) -> Run {
    let mut dice = Noise(1);
    let mut arrivals: Vec<(u64, u64)> = (0..20_000 / period)
        .map(|n| n * period * MS + MS * 1000)
        .filter_map(|captured| {
            let transit = ((delay + jitter * (2.0 * dice.uniform() - 1.0)) * 1e6) as u64;
            (dice.uniform() >= loss).then_some((captured + transit, captured))
        })
        .collect();
    arrivals.sort_unstable();
    let mut playout = Playout::new(params);
    let (mut next, mut newest) = (0, 0);
    let mut last: [Option<f64>; 2] = [None; 2];
    let (mut error, mut rough, mut ticks) = (0.0_f64, 0.0, 0.0);
    let (mut played_before, mut delay_before) = (MonoTime(0), playout.delay());
    for now in (1000 * MS..21_000 * MS).step_by(TICK as usize) {
        while let Some(&(received, captured)) = arrivals.get(next).filter(|(received, _)| *received <= now) {
            next += 1;
            // What was overtaken does not pass the lease.
            if captured > newest {
                newest = captured;
                playout.push(MonoTime(captured), MonoTime(received), &pose(motion(captured as f64 * 1e-9)));
            }
        }
        let Some(played) = playout.play(MonoTime(now)) else { continue };
        assert!(played.captured >= played_before, "time runs backwards");
        let change = playout.delay().abs_diff(delay_before).as_secs_f64();
        assert!(change <= 0.1 * TICK as f64 * 1e-9 + 1e-9, "the delay jumped by {change} s");
        (played_before, delay_before) = (played.captured, playout.delay());
        let value = played.pose.q[0];
        // After it has found its delay.
        if now > 6000 * MS {
            error = error.max((value - motion(played.captured.0 as f64 * 1e-9)).abs());
            if let [Some(a), Some(b)] = last {
                rough += (value - 2.0 * b + a).abs();
                ticks += 1.0;
            }
        }
        last = [last[1], Some(value)];
    }
    Run { error, rough: rough / ticks, delay: playout.delay() }
}

#[test]
fn a_good_link_gets_no_delay() {
    for (delay, jitter) in [(0.3, 0.2), (3.0, 1.0), (40.0, 1.0)] {
        for period in [8, 10, 33] {
            let run = run(PlayoutParams::default(), period, delay, jitter, 0.001);
            assert_eq!(run.delay, Duration::ZERO, "{delay} +- {jitter} ms, every {period} ms");
        }
    }
}

#[test]
fn a_bad_link_gets_as_much_as_it_needs_and_is_played_evenly() {
    let direct = PlayoutParams { mode: PlayoutMode::Direct, ..PlayoutParams::default() };
    for (delay, jitter, loss, most) in [(50.0, 20.0, 0.0, 95), (50.0, 20.0, 0.3, 130), (30.0, 0.0, 0.3, 80)] {
        let buffered = run(PlayoutParams::default(), 10, delay, jitter, loss);
        let newest = run(direct, 10, delay, jitter, loss);
        println!(
            "{delay} +- {jitter} ms, loss {loss}: delay {:?}, roughness {:.3} instead of {:.3} mrad, error {:.1} mrad",
            buffered.delay,
            buffered.rough * 1e3,
            newest.rough * 1e3,
            buffered.error * 1e3
        );
        let least = Duration::from_secs_f64((delay + 10.0) * 1e-3);
        assert!(buffered.delay >= least && buffered.delay <= Duration::from_millis(most), "{:?}", buffered.delay);
        assert!(buffered.rough < 0.35 * newest.rough, "{} against {}", buffered.rough, newest.rough);
        // At most 2.3 rad/s over the few ms of a gap that the delay does not cover.
        assert!(buffered.error < 0.1, "{} rad", buffered.error);
    }
}

#[test]
fn the_delay_is_bounded_and_can_be_fixed_or_off() {
    let params = PlayoutParams { max_delay: Duration::from_millis(60), ..PlayoutParams::default() };
    // 40 ms is the least that this link takes.
    let most = run(params, 10, 80.0, 40.0, 0.2).delay.as_secs_f64();
    assert!((0.100..0.102).contains(&most), "{most} s");
    let fixed = PlayoutParams { mode: PlayoutMode::Fixed, ..params };
    assert_eq!(run(fixed, 10, 1.0, 0.0, 0.0).delay, params.max_delay);
    let direct = PlayoutParams { mode: PlayoutMode::Direct, ..params };
    assert_eq!(run(direct, 10, 80.0, 40.0, 0.2).delay, Duration::ZERO);
}

#[test]
fn a_reset_forgets_the_other_operator() {
    let mut playout = Playout::new(PlayoutParams::default());
    assert_eq!(playout.play(MonoTime(5)), None);
    playout.push(MonoTime(1000), MonoTime(2000), &pose(1.0));
    assert_eq!(playout.play(MonoTime(3000)).unwrap().pose, pose(1.0));
    playout.reset();
    assert_eq!(playout.play(MonoTime(4000)), None);
    playout.push(MonoTime(10), MonoTime(4500), &pose(2.0));
    assert_eq!(playout.play(MonoTime(5000)).unwrap().pose, pose(2.0), "an earlier capture of another clock");
}

/// A link on which the buffer has a delay, and then nothing more comes, from 9 s on.
fn buffering() -> Playout {
    let mut playout = Playout::new(PlayoutParams::default());
    let mut dice = Noise(3);
    let mut newest = 0;
    for n in 0..800 {
        let captured = 1000 * MS + n * 10 * MS;
        let received = (captured + ((20.0 + 40.0 * dice.uniform()) * 1e6) as u64).max(newest);
        newest = received;
        playout.push(MonoTime(captured), MonoTime(received), &pose(motion(captured as f64 * 1e-9)));
        playout.play(MonoTime(received));
    }
    assert!(playout.delay() > Duration::from_millis(50), "{:?}", playout.delay());
    playout
}

/// Found by fuzzing: the prediction over a gap ended where the delay did, and the motion jumped back.
#[test]
fn a_delay_that_ends_in_a_gap_moves_nothing() {
    let mut playout = buffering();
    let mut before: Option<Played> = None;
    let mut after_the_delay = 0;
    for now in (9100 * MS..30_000 * MS).step_by(TICK as usize) {
        let played = playout.play(MonoTime(now)).unwrap();
        if let Some(before) = before {
            assert!(played.captured >= before.captured, "time runs backwards");
            let step = played.pose.q[0] - before.pose.q[0];
            assert!(step.abs() < 0.01, "a step of {step} rad");
        }
        after_the_delay += u32::from(playout.delay().is_zero());
        before = Some(played);
    }
    assert!(after_the_delay > 100, "it ended");
}

/// Found by fuzzing: two captures that lie closely together, as when the clock offset is corrected between two poses,
/// were taken for a speed of thousands of rad/s.
#[test]
fn a_prediction_is_no_faster_than_a_finger() {
    for apart in [1, 1000, 100_000] {
        let mut playout = buffering();
        let last = 1000 * MS + 799 * 10 * MS;
        let value = motion(last as f64 * 1e-9) + 0.3;
        playout.push(MonoTime(last + apart), MonoTime(9100 * MS), &pose(value));
        for now in (9100 * MS..9400 * MS).step_by(TICK as usize) {
            let played = playout.play(MonoTime(now)).unwrap().pose;
            played.validate().unwrap();
            let reach = MAX_SPEED * PlayoutParams::default().predict.as_secs_f64();
            assert!((played.q[0] - value).abs() <= reach + 0.3, "{} rad from {value}", played.q[0]);
        }
    }
}

/// What a gap in a real hand's motion is best filled with. Prints the table from which the default was chosen.
#[test]
fn a_damped_prediction_is_better_than_holding_and_a_linear_one_is_not() {
    let Some(keypoints) = master_support::recorded() else { return };
    let mut calibrator = Calibrator::default();
    keypoints.iter().for_each(|frame| calibrator.push(frame));
    let calibration = calibrator.finish().unwrap();
    let mut fitter = Fitter::new(calibration.geometry, calibration.side);
    let mut filter = Filter::new(calibration.geometry, FilterSettings::default());
    let frames: Vec<_> = keypoints.iter().map(|frame| (frame, fitter.fit(frame).q)).collect();
    let motion: Vec<[f64; 20]> = frames.iter().map(|(frame, q)| filter.apply(1.0 / 30.0, frame, q)).collect();
    // Root mean square over joints and frames, mrad, of a prediction over `gap` frames with this time constant (s).
    let error = |gap: usize, tau: f64| {
        let time = gap as f64 / 30.0;
        let ahead = if tau > 0.0 { tau * (1.0 - (-time / tau).exp()) } else { 0.0 };
        let (mut sum, mut count) = (0.0, 0.0);
        for (frames, later) in motion.windows(2).zip(&motion[1 + gap..]) {
            for ((before, now), later) in frames[0].iter().zip(&frames[1]).zip(later) {
                let velocity = (now - before) * 30.0;
                sum += (now + velocity * ahead - later).powi(2);
                count += 1.0;
            }
        }
        1e3 * (sum / count).sqrt()
    };
    println!("gap ms | hold | tau 10 ms | 20 ms | 40 ms | 80 ms | linear  (rms error, mrad)");
    for gap in 1..=3 {
        let hold = error(gap, 0.0);
        let taus = [0.01, 0.02, 0.04, 0.08];
        let (damped, linear) = (taus.map(|tau| error(gap, tau)), error(gap, 1e3));
        println!("{:.0} | {hold:.1} | {damped:.1?} | {linear:.1}", gap as f64 / 0.03);
        let own = error(gap, PlayoutParams::default().predict.as_secs_f64());
        assert!(own < 0.9 * hold, "{own} mrad where holding gives {hold}");
        assert!(own < 1.02 * damped.into_iter().fold(linear, f64::min), "another would be better");
    }
    assert!(error(3, 1e3) > error(3, 0.0), "over a tenth of a second a straight line is worse than holding");
}
