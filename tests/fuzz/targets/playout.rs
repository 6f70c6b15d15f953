//! The playout buffer with arbitrary arrivals: time never runs backwards, the delay changes slowly and is bounded, and
//! what is played is a pose between those that came, or a little beyond.
#![no_main]

use std::time::Duration;

use arbitrary::Arbitrary;
use libfuzzer_sys::fuzz_target;
use teleop_common::master::{MasterGeometry, MasterPose};
use teleop_common::playout::{MAX_SPEED, Playout, PlayoutMode, PlayoutParams};
use teleop_common::time::MonoTime;
use teleop_fuzz::without_allocating;

const MS: u64 = 1_000_000;
/// Needs beyond this are no needs.
const MAX_NEED: f64 = 0.5;

#[derive(Arbitrary, Debug)]
struct Input {
    mode: u8,
    max_delay_ms: u8,
    tolerance_ms: u8,
    predict_ms: u8,
    events: Vec<Event>,
}

#[derive(Arbitrary, Clone, Copy, Debug)]
enum Event {
    /// A pose of so many us ago.
    Pose { age: u32, angle: i8 },
    /// One captured so many ns after the last.
    Close { after: u16, angle: i8 },
    /// Ticks of 3 ms.
    Play(u8),
    /// A tick after so many us.
    Wait(u32),
    /// Another operator.
    Reset,
}

fuzz_target!(|input: Input| {
    let ms = |ms: u8| Duration::from_millis(ms.into());
    let params = PlayoutParams {
        mode: [PlayoutMode::Auto, PlayoutMode::Direct, PlayoutMode::Fixed][usize::from(input.mode % 3)],
        max_delay: ms(input.max_delay_ms),
        tolerance: ms(input.tolerance_ms),
        predict: ms(input.predict_ms % 201),
    };
    let mut playout = Playout::new(params);
    let mut now = 10_000 * MS;
    let (mut captured, mut came) = (0, false);
    let mut range = [0.0_f64; 2];
    let mut played = MonoTime(0);
    for event in input.events.into_iter().take(3000) {
        let (mut waits, mut comes) = ((0, 0), None);
        match event {
            Event::Pose { age, angle } => comes = Some((now - u64::from(age % 5_000_000) * 1000, angle)),
            Event::Close { after, angle } => comes = Some(((captured + u64::from(after)).min(now), angle)),
            Event::Play(count) => waits = (count, 3 * MS),
            Event::Wait(us) => waits = (1, u64::from(us % 60_000_000) * 1000),
            Event::Reset => {
                playout.reset();
                (captured, came, range, played) = (0, false, [0.0; 2], MonoTime(0));
            }
        }
        if let Some((at, angle)) = comes {
            let value = f64::from(angle) / 20.5;
            let pose = MasterPose { q: [value; 20], geometry: MasterGeometry::PARADIGMATIC, tuning: None };
            pose.validate().expect("up to 6.2 rad");
            without_allocating(|| playout.push(MonoTime(at), MonoTime(now), &pose));
            if at > captured || !came {
                (captured, came) = (at, true);
                range = [range[0].min(value), range[1].max(value)];
            }
        }
        for _ in 0..waits.0 {
            now += waits.1;
            let before = playout.delay().as_secs_f64();
            let out = without_allocating(|| playout.play(MonoTime(now)));
            assert_eq!(out.is_some(), came);
            let Some(out) = out else { continue };
            let delay = playout.delay().as_secs_f64();
            assert!(delay <= MAX_NEED + params.max_delay.as_secs_f64());
            assert!((delay - before).abs() <= 0.1 * waits.1 as f64 * 1e-9 + 2e-9 || before == 0.0);
            assert!(out.captured >= played, "time runs backwards, from {played:?} to {:?}", out.captured);
            assert!(out.captured.0 <= now, "from the future");
            played = out.captured;
            out.pose.validate().expect("what is played is a pose");
            let beyond = MAX_SPEED * params.predict.as_secs_f64() + 1e-9;
            let angle = out.pose.q[0];
            assert!((range[0] - beyond..=range[1] + beyond).contains(&angle), "{angle} rad, of {range:?}");
        }
    }
});
