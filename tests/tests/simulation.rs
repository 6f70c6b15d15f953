//! Both ends over bad networks in virtual time: the operator's clutch, feedback and messages, the link model, the robot's
//! receiver, control tick and guard, all as they run live, without a socket, a thread or a clock.
//!
//! The table that comes out is `simulation.md` beside this file: a change of behaviour is a change of that file, for a
//! reviewer to read. `TELEOP_UPDATE=1 cargo test --release -p teleop-tests --test simulation` writes it anew.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::{Duration, Instant};

use teleop_common::authority::{LeaseParams, OperatorName, Takeover};
use teleop_common::hand::{HandModel, HandSide, JointVector};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::net::Arrival;
use teleop_common::time::{Histogram, MonoTime};
use teleop_common::wire::{JointStateMessage, PoseMessage, Stamper, pack_joints};
use teleop_link::{Blackouts, Impairment, Link, Profile};
use teleop_operator::feedback::Feedback;
use teleop_operator::pilot::{ClutchBy, Pilot};
use teleop_robot::control::{ControlParams, Controller, TickRecord};
use teleop_robot::driver::JointState;
use teleop_robot::receive::Receiver;
use teleop_robot::runtime::Shared;
use teleop_tests::judge::{Command, assert_limits};
use teleop_tests::network::Network;

const MS: u64 = 1_000_000;
/// Virtual seconds of each scenario.
const SECONDS: u64 = 30;
/// Poses and joint states come every so often.
const PERIOD: Duration = Duration::from_millis(10);
/// What tells the robot's clock from the world's, ns.
const ROBOT_ZERO: u64 = 5_000_000 * MS;
/// The same of the operator's.
const OPERATOR_ZERO: u64 = 777 * MS;
const OPERATOR: u64 = 7;
const ROBOT: u64 = 9;

struct Scenario {
    name: String,
    link: Link,
    /// The operator's clock runs faster by this, parts per million.
    drift: f64,
    max_age: Duration,
}

impl Scenario {
    fn new(name: &str, link: Link) -> Self {
        Self { name: name.to_owned(), link, drift: 0.0, max_age: Duration::from_millis(250) }
    }

    fn profile(name: &str) -> Self {
        Self::new(name, name.parse::<Profile>().unwrap().link())
    }

    fn both(name: &str, impairment: Impairment) -> Self {
        Self::new(name, Link { up: impairment, down: impairment, blackouts: Blackouts::default() })
    }
}

/// What came of one.
#[derive(Default)]
struct Outcome {
    /// Age of what is played, from capture.
    age: Histogram,
    /// Largest delay of the playout.
    playout: Duration,
    /// Mean |second difference| of the mapped joints from tick to tick, over that of the undisturbed motion.
    rough: f64,
    /// Largest distance of a mapped joint from the undisturbed motion as old as what is played, rad; 99 %.
    error: f64,
    followed: f64,
    holds: u64,
    engaged: u64,
    /// Ticks that followed a pose older than the limits allow.
    stale: u64,
    /// Longest time from the last good pose to the first tick that holds, beyond what is allowed.
    late: u64,
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap()
}

fn pose(time: Duration) -> MasterPose {
    let t = time.as_secs_f64() % Gesture::Tour.duration();
    MasterPose { q: Gesture::Tour.sample(t), geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

fn run(scenario: &Scenario, seed: u64) -> Outcome {
    let hand = HandModel::allegro_v4(HandSide::Right);
    let params = ControlParams::default();
    let shared = Arc::<Shared>::default();
    let lease =
        LeaseParams { max_age: scenario.max_age, release_after: Duration::from_secs(2), takeover: Takeover::Never };
    let (poses, mut admitted) = rtrb::RingBuffer::new(64);
    let mut receiver = Receiver::new(ROBOT, lease, poses, Arc::clone(&shared));
    let mut controller = Controller::new(hand.clone(), MappingParams::default(), params).unwrap();
    let feedback = Feedback::new(OPERATOR);
    let pilot = Pilot::new(ClutchBy::Auto, OperatorName::default(), false);
    let (mut pose_stamps, mut state_stamps) = (Stamper::new(OPERATOR), Stamper::new(ROBOT));
    let mut network = Network::new(&scenario.link, seed);

    let robot_clock = |time: Duration| MonoTime(ROBOT_ZERO + nanos(time));
    let operator_clock =
        |time: Duration| MonoTime(OPERATOR_ZERO + (time.as_secs_f64() * (1.0 + scenario.drift * 1e-6) * 1e9) as u64);
    let still = JointVector::zeros(hand.joints.len());
    let mut state = JointState { q: hand.home(), dq: still, tau: still };
    let (mut next_pose, mut next_state) = (Duration::ZERO, Duration::from_millis(3));
    // When a pose was captured, by the world's clock, by its number.
    let mut captures = vec![Duration::ZERO];
    let mut ideal = Retargeter::new(hand.clone(), MappingParams::default()).unwrap();
    let mut out = Outcome::default();
    let mut errors = Vec::new();
    let (mut rough, mut smooth) = (0.0, 0.0);
    let mut history: [Option<(JointVector, JointVector)>; 2] = [None; 2];
    let mut before: Option<TickRecord> = None;
    let mut commands = Vec::new();
    let tick = Duration::from_secs_f64(1.0 / params.rate);
    let ticks = (SECONDS as f64 * params.rate) as u32;
    for number in 1..=ticks {
        let now = tick * number;
        // What happens until this tick, in its order.
        loop {
            let arrival = network.next();
            let next = next_pose.min(next_state).min(arrival.unwrap_or(Duration::MAX));
            if next > now {
                break;
            }
            if arrival == Some(next) {
                let packet = network.take().unwrap();
                let payload = Ok(packet.bytes.as_slice());
                if packet.up {
                    receiver.on_pose(Arrival { payload, at: robot_clock(next) });
                } else {
                    feedback.on_joints(Arrival { payload, at: operator_clock(next) });
                }
            } else if next == next_pose {
                next_pose += PERIOD;
                let at = operator_clock(next);
                captures.push(next);
                pilot.step(at, feedback.snapshot(at).authority);
                feedback.on_sent(at);
                let header = pose_stamps.header::<PoseMessage>(at);
                let message = PoseMessage::new(header, feedback.echo(at), at, &pose(next), pilot.intent());
                network.send(next, true, &message);
            } else {
                next_state += PERIOD;
                let at = robot_clock(next);
                let sample = before.as_ref().and_then(|record| record.sample);
                let message = JointStateMessage {
                    header: state_stamps.header::<JointStateMessage>(at),
                    echo: receiver.echo(),
                    mode: controller.mode().to_wire(),
                    joints: 16,
                    tick: number.into(),
                    wall_offset_ns: 0,
                    pose_epoch: sample.map_or(0, |sample| sample.epoch),
                    pose_seq: sample.map_or(0, |sample| sample.sequence),
                    pose_captured: sample.map_or(MonoTime(0), |sample| sample.captured_remote),
                    q: pack_joints(&state.q),
                    dq: pack_joints(&state.dq),
                    tau: pack_joints(&state.tau),
                    q_command: pack_joints(&state.q),
                    stop: 0,
                    holder: receiver.holder(at).map_or(0, |(epoch, _)| epoch),
                };
                network.send(next, false, &message);
            }
        }
        while let Ok(sample) = admitted.pop() {
            controller.admit(&sample);
        }
        let follows = controller.mode().follows();
        let record = controller.tick(robot_clock(now), shared.latch.get(), &state);
        (state.q, state.dq) = (record.command.q, record.command.dq);
        commands.push(Command { epoch: ROBOT, tick: record.tick, q: record.command.q });
        if record.mode.follows() {
            out.followed += 1.0;
            out.engaged += u64::from(!follows);
            let sample = record.sample.unwrap();
            let age = now - captures[sample.sequence as usize];
            // The age limit holds for the estimated clock: half of the round trip is in doubt.
            let doubt = scenario.link.up.delay.max(scenario.link.down.delay) + scenario.link.up.jitter * 3;
            let patience = params.hold_after + PERIOD + tick;
            out.stale += u64::from(age > scenario.max_age + doubt + patience);
            // Ticks that follow although nothing good has come for longer than the watchdog waits.
            let silent = record.now.since(sample.received);
            out.late += u64::from(silent > params.hold_after + Duration::from_millis(100));
            if let (Some(played), Some(mapping)) = (record.played, &record.mapping) {
                let age = record.now.since(played);
                out.age.record(age);
                out.playout = out.playout.max(record.playout);
                let wanted = ideal.map(&pose(now.saturating_sub(age))).q;
                errors.push(mapping.q.iter().zip(wanted.iter()).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs())));
                if let [Some(a), Some(b)] = &history {
                    for joint in 0..16 {
                        rough += (mapping.q[joint] - 2.0 * b.0[joint] + a.0[joint]).abs();
                        smooth += (wanted[joint] - 2.0 * b.1[joint] + a.1[joint]).abs();
                    }
                }
                history = [history[1], Some((mapping.q, wanted))];
            }
        } else {
            history = [None; 2];
        }
        before = Some(record);
    }
    errors.sort_unstable_by(f64::total_cmp);
    out.error = errors.get(errors.len() * 99 / 100).copied().unwrap_or(f64::NAN);
    out.rough = rough / smooth;
    out.followed /= f64::from(ticks);
    assert_limits(&commands, &hand, params.rate, 1e-9);
    out.holds = before.map_or(0, |record| record.holds);
    out
}

fn scenarios() -> Vec<Scenario> {
    let ms = Duration::from_millis;
    let even = |delay, jitter, loss| Impairment { delay: ms(delay), jitter: ms(jitter), loss, ..Impairment::default() };
    let mut all: Vec<_> =
        ["perfect", "lan", "wifi", "good", "fair", "poor", "lossy30"].into_iter().map(Scenario::profile).collect();
    all.push(Scenario { max_age: ms(1000), ..Scenario::profile("satellite") });
    for (delay, jitter) in [(1, 0), (20, 5), (50, 20), (100, 40)] {
        for loss in [0.0, 0.05, 0.3] {
            all.push(Scenario::both(
                &format!("{delay} +- {jitter} ms, {:.0} % lost", 100.0 * loss),
                even(delay, jitter, loss),
            ));
        }
    }
    let reorder = Impairment { reorder: 0.2, reorder_by: ms(30), duplicate: 0.1, ..even(20, 5, 0.01) };
    all.push(Scenario::both("20 +- 5 ms, 20 % late by 30 ms, 10 % twice", reorder));
    for (length, every) in [(0.05, 2.0), (0.3, 5.0), (3.0, 15.0)] {
        let blackouts = Blackouts::every(Duration::from_secs_f64(every), Duration::from_secs_f64(length)).unwrap();
        let way = even(20, 5, 0.0);
        all.push(Scenario::new(
            &format!("20 +- 5 ms, dark {length} s every {every} s"),
            Link { up: way, down: way, blackouts },
        ));
    }
    for drift in [-500.0, 500.0] {
        all.push(Scenario { drift, ..Scenario::both(&format!("20 +- 5 ms, clock {drift:+} ppm"), even(20, 5, 0.01)) });
    }
    all
}

#[test]
fn both_ends_over_bad_networks() {
    let began = Instant::now();
    let mut table = String::from(
        "# Both ends over bad networks, in virtual time\n\n\
         30 s of the gesture tour per row, 100 poses a second, 333 ticks a second; made by `tests/tests/simulation.rs`.\n\
         *Age* is from capture to use in a tick; *playout* the largest delay that the buffer chose; *rough* the mean second\n\
         difference of the mapped joints over that of the undisturbed motion; *error* the 99 % quantile of the largest\n\
         distance of a joint from the undisturbed motion of that age; *stale* ticks that followed a pose older than allowed;\n\
         no command was beyond a limit of position, velocity, acceleration or penetration. After a hold the clutch closes\n\
         again a second after poses are good.\n\n\
         | link (each way) | age p50 / p99 ms | playout ms | rough | error mrad | followed % | holds | engaged | stale |\n\
         |---|--:|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    let all = scenarios();
    let mut wrong = Vec::new();
    for scenario in &all {
        let out = run(scenario, 1);
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        writeln!(
            table,
            "| {} | {:.0} / {:.0} | {:.0} | {:.1} | {:.0} | {:.0} | {} | {} | {} |",
            scenario.name,
            ms(out.age.p50()),
            ms(out.age.p99()),
            ms(out.playout),
            out.rough,
            out.error * 1e3,
            100.0 * out.followed,
            out.holds,
            out.engaged,
            out.stale + out.late
        )
        .unwrap();
        if out.stale + out.late > 0 {
            wrong.push(scenario.name.clone());
        }
    }
    let real = began.elapsed().as_secs_f64();
    println!("{table}\n{:.0} virtual seconds per real second", all.len() as f64 * SECONDS as f64 / real);
    assert!(wrong.is_empty(), "stale poses followed in {wrong:?}");
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/simulation.md");
    if std::env::var_os("TELEOP_UPDATE").is_some() {
        std::fs::write(path, &table).unwrap();
    }
    let expected = std::fs::read_to_string(path).unwrap_or_default();
    assert_eq!(table, expected, "the behaviour changed: read the table above, then run this with TELEOP_UPDATE=1");
}
