//! The protocol path of both ends over every combination of delay, jitter, loss, reordering, blackouts and clock drift,
//! in virtual time: the operator's clutch, feedback and messages, the link model, the robot's receiver with clock, lease,
//! watchdog, clutch and playout, as they run live; without mapping, guards and torques, and with only those ticks in
//! which something can change. `simulation.rs` runs the whole control tick over fewer networks.
//!
//! The table that comes out is `sweep.md` beside this file, for a reviewer to read.
//! `TELEOP_UPDATE=1 cargo test --release -p teleop-tests --test sweep` writes it anew.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use teleop_common::authority::{Heard, Latch, LeaseParams, Machine, MachineParams, OperatorName, Takeover};
use teleop_common::hand::{HandModel, HandSide};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::mode::Mode;
use teleop_common::net::Arrival;
use teleop_common::playout::{Playout, PlayoutParams};
use teleop_common::time::MonoTime;
use teleop_common::wire::{JointStateMessage, PoseMessage, Stamper, pack_joints};
use teleop_link::{Blackouts, Impairment, Link};
use teleop_operator::feedback::Feedback;
use teleop_operator::pilot::{ClutchBy, Pilot};
use teleop_robot::control::PoseSample;
use teleop_robot::receive::Receiver;
use teleop_robot::runtime::Shared;
use teleop_tests::network::Network;

const MS: u64 = 1_000_000;
/// Virtual seconds of each combination.
const SECONDS: u64 = 60;
/// Poses and joint states come every so often.
const PERIOD: Duration = Duration::from_millis(10);
const TICK: Duration = Duration::from_nanos(3_003_003);
const HOLD_AFTER: Duration = Duration::from_millis(100);
const MAX_AGE: Duration = Duration::from_millis(250);
const RAMP: Duration = Duration::from_secs(1);
/// What clocks may do to each other in the 8 s in which an offset is remembered.
const DRIFT: Duration = Duration::from_millis(8);
/// What tells the robot's clock from the world's, ns.
const ROBOT_ZERO: u64 = 5_000_000 * MS;
/// The same of the operator's.
const OPERATOR_ZERO: u64 = 777 * MS;
const OPERATOR: u64 = 7;
const ROBOT: u64 = 9;

const DELAYS: [u64; 4] = [1, 20, 50, 200];
const JITTERS: [u64; 4] = [0, 5, 20, 50];
const LOSSES: [f64; 3] = [0.0, 0.05, 0.30];
/// Share of the messages that come 30 ms late; or all as a stream: what is lost, or sent while the link is dark, comes
/// late instead of never, and all behind it.
const ORDERS: [Option<f64>; 3] = [Some(0.0), Some(0.20), None];
/// Length and period, s.
const BLACKOUTS: [Option<(f64, f64)>; 3] = [None, Some((0.3, 5.0)), Some((3.0, 15.0))];
const DRIFTS: [f64; 3] = [-500.0, 0.0, 500.0];
const SIZES: [usize; 6] = [DELAYS.len(), JITTERS.len(), LOSSES.len(), ORDERS.len(), BLACKOUTS.len(), DRIFTS.len()];

/// One combination: a level of each factor.
#[derive(Clone, Copy)]
struct Combination([usize; 6]);

impl Combination {
    fn all() -> Vec<Self> {
        let number = |mut index: usize| {
            Self(SIZES.map(|size| {
                let level = index % size;
                index /= size;
                level
            }))
        };
        (0..SIZES.iter().product()).map(number).collect()
    }

    fn link(&self) -> Link {
        let [delay, jitter, loss, order, blackout, _] = self.0;
        let way = Impairment {
            delay: Duration::from_millis(DELAYS[delay]),
            jitter: Duration::from_millis(JITTERS[jitter]),
            loss: LOSSES[loss],
            reorder: ORDERS[order].unwrap_or(0.0),
            reorder_by: Duration::from_millis(30),
            ..Impairment::default()
        };
        let seconds = Duration::from_secs_f64;
        let blackouts = BLACKOUTS[blackout].map_or_else(Blackouts::default, |(length, every)| {
            Blackouts::every(seconds(every), seconds(length)).unwrap()
        });
        Link { up: way, down: way, blackouts }
    }

    fn is_stream(&self) -> bool {
        ORDERS[self.0[3]].is_none()
    }
}

/// The fastest round trip of the last 8 s, from what the messages say: half of it is what an age may be wrong by.
#[derive(Default)]
struct RoundTrips {
    slots: [Option<(u64, u64)>; 16],
}

impl RoundTrips {
    /// Of a pose that arrives at `now`, robot's clock.
    fn push(&mut self, now: MonoTime, pose: &[u8]) {
        let [sent, epoch, echoed, received] =
            [24, 32, 40, 48].map(|at| u64::from_le_bytes(pose[at..at + 8].try_into().unwrap()));
        if epoch != ROBOT {
            return;
        }
        let (trip, slot) = ((now.0 - echoed).saturating_sub(sent - received), now.0 / (500 * MS));
        let own = &mut self.slots[slot as usize % 16];
        *own = Some((slot, own.filter(|(at, _)| *at == slot).map_or(trip, |(_, least)| least.min(trip))));
    }

    /// Half of the fastest one that is 8 s old at most, and what clocks do to each other in that time.
    fn doubt(&self, now: MonoTime) -> Duration {
        let oldest = (now.0 / (500 * MS)).saturating_sub(16);
        let trips = self.slots.iter().flatten().filter(|(slot, _)| *slot >= oldest).map(|(_, trip)| *trip);
        Duration::from_nanos(trips.min().unwrap_or(u64::MAX / 4) / 2) + DRIFT
    }
}

/// What came of one.
#[derive(Clone, Copy, Default)]
struct Outcome {
    ticks: u64,
    followed: u64,
    holds: u64,
    engaged: u64,
    /// True age of what was played, s: the sum over the ticks that followed, and the largest.
    age: f64,
    oldest: f64,
    playout: f64,
    /// The true age of a pose on arrival was beyond the limit, and it was obeyed; the largest of those obeyed, s.
    stale: u64,
    obeyed: f64,
    /// Holds although a good pose had come in time.
    causeless: u64,
    /// Poses that came too late and were not obeyed.
    late: u64,
    /// From the last good pose's arrival to holding, s.
    silence: f64,
    /// What of that was beyond the watchdog's time, s.
    overshoot: f64,
}

fn nanos(time: Duration) -> u64 {
    time.as_nanos() as u64
}

/// With `all_ticks` also those in which nothing changes.
fn run(combination: &Combination, seed: u64, poses: &[MasterPose], all_ticks: bool) -> Outcome {
    let shared = Arc::<Shared>::default();
    let lease = LeaseParams { max_age: MAX_AGE, release_after: Duration::from_secs(2), takeover: Takeover::Never };
    let (input, mut admitted) = rtrb::RingBuffer::new(64);
    let mut receiver = Receiver::new(ROBOT, lease, input, Arc::clone(&shared));
    let mut machine = Machine::new(MachineParams { hold_after: HOLD_AFTER, relax_after: None, engage_ramp: RAMP });
    let mut playout = Playout::new(PlayoutParams::default());
    let feedback = Feedback::new(OPERATOR);
    let pilot = Pilot::new(ClutchBy::Auto, OperatorName::default(), false);
    let (mut pose_stamps, mut state_stamps) = (Stamper::new(OPERATOR), Stamper::new(ROBOT));
    let network = if combination.is_stream() { Network::stream } else { Network::new };
    let mut network = network(&combination.link(), seed);
    let drift = DRIFTS[combination.0[5]];
    let robot_clock = |time: Duration| MonoTime(ROBOT_ZERO + nanos(time));
    let operator_clock =
        |time: Duration| MonoTime(OPERATOR_ZERO + (time.as_secs_f64() * (1.0 + drift * 1e-6) * 1e9) as u64);
    let joints = pack_joints(&HandModel::allegro_v4(HandSide::Right).home());
    let mut trips = RoundTrips::default();

    let (mut next_pose, mut next_state) = (Duration::ZERO, Duration::from_millis(3));
    // Poses are numbered from 1, one every period.
    let captured = |sequence: u64| PERIOD * (sequence - 1) as u32;
    let mut sample: Option<PoseSample> = None;
    // A good pose was refused since the last that passed.
    let mut refused_good = false;
    let mut out = Outcome::default();
    // The next tick in which something changes: after a pose passed, or when the watchdog's time is over.
    let mut due = all_ticks.then_some(1);
    let end = Duration::from_secs(SECONDS);
    loop {
        let tick = due.map_or(Duration::MAX, |number| TICK * number as u32);
        let arrival = network.next().unwrap_or(Duration::MAX);
        let now = next_pose.min(next_state).min(arrival);
        if now.min(tick) >= end {
            break;
        }
        if now <= tick {
            if arrival == now {
                let packet = network.take().unwrap();
                let payload = Ok(packet.bytes.as_slice());
                if !packet.up {
                    feedback.on_joints(Arrival { payload, at: operator_clock(now) });
                    continue;
                }
                receiver.on_pose(Arrival { payload, at: robot_clock(now) });
                let sequence = u64::from_le_bytes(packet.bytes[16..24].try_into().unwrap());
                let age = now - captured(sequence);
                trips.push(robot_clock(now), &packet.bytes);
                let doubt = trips.doubt(robot_clock(now));
                if let Ok(passed) = admitted.pop() {
                    out.stale += u64::from(age > MAX_AGE + doubt);
                    out.obeyed = out.obeyed.max(age.as_secs_f64());
                    playout.push(passed.captured, passed.received, &passed.pose);
                    (sample, refused_good) = (Some(passed), false);
                    if !all_ticks {
                        due = Some(nanos(now).div_ceil(nanos(TICK)));
                    }
                } else {
                    let newer = sample.is_some_and(|last| sequence > last.sequence);
                    refused_good |= newer && age + doubt < MAX_AGE;
                    out.late += u64::from(age > MAX_AGE);
                }
            } else if next_pose == now {
                let at = operator_clock(now);
                pilot.step(at, feedback.snapshot(at).authority);
                feedback.on_sent(at);
                let header = pose_stamps.header::<PoseMessage>(at);
                let pose = &poses[(header.seq as usize - 1) % poses.len()];
                network.send(now, true, &PoseMessage::new(header, feedback.echo(at), at, pose, pilot.intent()));
                next_pose += PERIOD;
            } else {
                let at = robot_clock(now);
                let message = JointStateMessage {
                    header: state_stamps.header::<JointStateMessage>(at),
                    echo: receiver.echo(),
                    mode: machine.mode().to_wire(),
                    joints: 16,
                    tick: out.ticks,
                    wall_offset_ns: 0,
                    pose_epoch: sample.map_or(0, |sample| sample.epoch),
                    pose_seq: sample.map_or(0, |sample| sample.sequence),
                    pose_captured: sample.map_or(MonoTime(0), |sample| sample.captured_remote),
                    q: joints,
                    dq: [0.0; _],
                    tau: [0.0; _],
                    q_command: joints,
                    stop: 0,
                    holder: receiver.holder(at).map_or(0, |(epoch, _)| epoch),
                };
                network.send(now, false, &message);
                next_state += PERIOD;
            }
            continue;
        }
        let at = robot_clock(tick);
        let before = machine.mode();
        let heard = sample.map(|sample| Heard {
            epoch: sample.epoch,
            sequence: sample.sequence,
            captured: sample.captured_remote,
            received: sample.received,
            clutch: sample.intent.clutch,
        });
        let patience = machine.patience();
        let mode = machine.step(at, heard.as_ref(), Latch::default());
        out.ticks += 1;
        out.engaged += u64::from(mode.follows() && !before.follows());
        let next = nanos(tick) / nanos(TICK) + 1;
        due = all_ticks.then_some(next);
        let Some(sample) = sample else { continue };
        let silence = at.since(sample.received);
        let over = nanos(tick) + nanos(machine.patience().saturating_sub(silence));
        if !all_ticks {
            due = (silence <= machine.patience()).then_some(over / nanos(TICK) + 1);
        }
        if mode == Mode::Holding && before != mode {
            out.causeless += u64::from(refused_good);
            out.silence = out.silence.max(silence.as_secs_f64());
            out.overshoot = out.overshoot.max(silence.saturating_sub(patience).as_secs_f64());
        }
        if silence <= machine.patience()
            && let Some(played) = playout.play(at)
            && mode.follows()
        {
            out.followed += 1;
            // By the world's clock: the robot's estimate of the capture is its own affair.
            let estimated = sample.captured.0 as i128 - ROBOT_ZERO as i128;
            let error = nanos(captured(sample.sequence)) as i128 - estimated;
            let age = (at.0 as i128 - played.captured.0 as i128 - error) as f64 * 1e-9;
            out.age += age;
            out.oldest = out.oldest.max(age);
            out.playout = out.playout.max(playout.delay().as_secs_f64());
        }
    }
    out.holds = machine.holds();
    out
}

/// The operator's motion.
fn tour() -> Vec<MasterPose> {
    (0..(Gesture::Tour.duration() * 100.0) as u32)
        .map(|n| Gesture::Tour.sample(f64::from(n) * 0.01))
        .map(|q| MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None })
        .collect()
}

/// All combinations, on two threads.
fn sweep(all: &[Combination]) -> Vec<Outcome> {
    let poses = tour();
    let next = AtomicUsize::new(0);
    let worker = || {
        let mut own = Vec::new();
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            let Some(combination) = all.get(number) else { return own };
            own.push((number, run(combination, number as u64, &poses, false)));
        }
    };
    let mut outcomes = vec![Outcome::default(); all.len()];
    std::thread::scope(|scope| {
        for thread in [scope.spawn(worker), scope.spawn(worker)] {
            for (number, outcome) in thread.join().unwrap() {
                outcomes[number] = outcome;
            }
        }
    });
    outcomes
}

/// A row of the table: what of the combinations `chosen` is worst, or their mean or sum.
fn row(name: &str, chosen: &[&Outcome]) -> String {
    let sum = |value: fn(&Outcome) -> f64| chosen.iter().map(|own| value(own)).sum::<f64>();
    let most = |value: fn(&Outcome) -> f64| chosen.iter().map(|own| value(own)).fold(0.0, f64::max);
    let followed = sum(|own| own.followed as f64);
    format!(
        "| {name} | {:.0} | {:.0} | {:.0} | {:.0} | {:.1} | {:.1} | {:.0} | {:.1} | {} | {} | {} |\n",
        1e3 * sum(|own| own.age) / followed,
        1e3 * most(|own| own.oldest),
        1e3 * most(|own| own.playout),
        1e3 * most(|own| own.obeyed),
        sum(|own| own.holds as f64) / chosen.len() as f64,
        sum(|own| own.engaged as f64) / chosen.len() as f64,
        1e3 * most(|own| own.silence),
        1e3 * most(|own| own.overshoot),
        sum(|own| own.causeless as f64),
        sum(|own| own.late as f64),
        sum(|own| own.stale as f64),
    )
}

#[test]
fn every_combination_of_what_a_link_can_do() {
    let began = Instant::now();
    let all = Combination::all();
    let outcomes = sweep(&all);
    let real = began.elapsed().as_secs_f64();
    let names: [Vec<String>; 6] = [
        DELAYS.map(|ms| format!("delay {ms} ms")).into(),
        JITTERS.map(|ms| format!("jitter +- {ms} ms")).into(),
        LOSSES.map(|share| format!("{:.0} % lost", 100.0 * share)).into(),
        ORDERS
            .map(|late| late.map_or_else(|| "stream".into(), |late| format!("{:.0} % late by 30 ms", 100.0 * late)))
            .into(),
        BLACKOUTS
            .map(|dark| dark.map_or_else(|| "never dark".into(), |(s, every)| format!("dark {s} s every {every} s")))
            .into(),
        DRIFTS.map(|ppm| format!("clock {ppm:+} ppm")).into(),
    ];
    let mut table = format!(
        "# The protocol path over every combination of what a link can do, in virtual time\n\n\
         {} combinations, {SECONDS} s each, 100 poses a second; a row is of all those with that level of one factor; made by\n\
         `tests/tests/sweep.rs`. *Age* is from capture to play, by the world's clock; *playout* the largest delay that the\n\
         buffer chose; *obeyed* the largest true age, on arrival, of a pose that was obeyed: the limit of 250 ms holds for the\n\
         age by the estimated clock, which is uncertain by half of the fastest round trip; *holds* and *engaged* are per\n\
         minute; *silence* is the longest from the last good pose to holding, and *beyond* what of it was beyond the\n\
         watchdog's time, which ends with the next tick (3.0 ms); *without cause* are holds although a pose had come in that\n\
         time that was newer and, for all that clocks allow to know, young enough; *late* are poses that were too old and were\n\
         not obeyed; *stale* those that were, and were older than the limit and the uncertainty. A *stream* brings what is\n\
         lost, or sent while the link is dark, late instead of never, and all behind it. After a hold the clutch closes again\n\
         a second after poses are good.\n\n\
         | level | age mean ms | max ms | playout ms | obeyed ms | holds | engaged | silence ms | beyond ms | without cause | late | stale |\n\
         |---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n",
        all.len()
    );
    for (factor, names) in names.iter().enumerate() {
        for (level, name) in names.iter().enumerate() {
            let chosen: Vec<_> =
                all.iter().zip(&outcomes).filter(|(own, _)| own.0[factor] == level).map(|(_, out)| out).collect();
            table += &row(name, &chosen);
        }
    }
    table += &row("all", &outcomes.iter().collect::<Vec<_>>());
    for (own, out) in all.iter().zip(&outcomes) {
        assert_eq!((out.stale, out.causeless), (0, 0), "{:?}", own.0);
        // Whatever the two ways are like.
        assert!(out.obeyed <= (2 * MAX_AGE + DRIFT).as_secs_f64(), "{:?}: obeyed at {} s", own.0, out.obeyed);
        assert!(out.overshoot <= TICK.as_secs_f64(), "{:?}: {} s beyond the watchdog's time", own.0, out.overshoot);
        assert!(out.engaged > 0 && out.followed > 1000 || own.is_stream(), "{:?}: it never followed", own.0);
    }
    let simulated = all.len() as f64 * SECONDS as f64;
    let ticks: u64 = outcomes.iter().map(|out| out.ticks).sum();
    println!(
        "{table}
{simulated} virtual seconds in {real:.1} s on two threads: {:.0} per real second; {ticks} ticks",
        simulated / real
    );
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/sweep.md");
    if std::env::var_os("TELEOP_UPDATE").is_some() {
        std::fs::write(path, &table).unwrap();
    }
    let expected = std::fs::read_to_string(path).unwrap_or_default();
    assert_eq!(table, expected, "the behaviour changed: read the table above, then run this with TELEOP_UPDATE=1");
}

#[test]
fn ticks_that_are_left_out_would_change_nothing() {
    let poses = tour();
    for (number, combination) in Combination::all().iter().enumerate().step_by(41) {
        let [few, all] = [false, true].map(|all| run(combination, number as u64, &poses, all));
        assert!(all.ticks > 19_900 && few.ticks < 8000);
        let counts = |out: &Outcome| [out.holds, out.engaged, out.stale, out.causeless];
        assert_eq!(counts(&few), counts(&all), "{:?}", combination.0);
        assert_eq!((few.silence, few.overshoot), (all.silence, all.overshoot), "{:?}", combination.0);
    }
}
