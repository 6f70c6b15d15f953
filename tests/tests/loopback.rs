//! Two sessions over real zenoh on localhost, directly and through a bad network.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::net::{SocketAddr, TcpListener};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use teleop_common::authority::Intent;
use teleop_common::key::Keys;
use teleop_common::master::{MasterGeometry, MasterPose};
use teleop_common::net::{NetError, Publisher, Session, SessionConfig, Stream, Subscriber, clock};
use teleop_common::time::{ClockOffset, Histogram, MonoTime};
use teleop_common::wire::{
    Echo, HealthMessage, JointStateMessage, PoseMessage, REJECTIONS, Rejection, Stamper, pack_joints,
};
use teleop_link::{Impairment, Relay};

const POSE: MasterPose = MasterPose { q: [0.25; 20], geometry: MasterGeometry::PARADIGMATIC, tuning: None };
const PATIENCE: Duration = Duration::from_secs(20);
const MS: Duration = Duration::from_millis(1);

fn keys() -> Keys {
    Keys::new("allegro").unwrap()
}

fn listen(endpoint: &str) -> (Session, String) {
    let session = Session::open(&SessionConfig::listening([endpoint])).unwrap();
    let locators = session.locators();
    assert_eq!(locators.len(), 1, "{locators:?}");
    (session, locators[0].clone())
}

fn connect(endpoint: &str) -> Session {
    Session::open(&SessionConfig::connecting([endpoint])).unwrap()
}

/// Waits for something that must come, however slow the machine.
#[track_caller]
fn eventually(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "waited {PATIENCE:?} in vain until {what}");
        std::thread::sleep(5 * MS);
    }
}

/// Receives poses as a robot does: what is accepted, and what is rejected for which reason.
#[derive(Clone, Default)]
struct Inbox(Arc<Mutex<Received>>);

#[derive(Default)]
struct Received {
    accepted: Vec<(u64, u64)>,
    rejected: [u64; REJECTIONS],
}

impl Inbox {
    fn subscribe(&self, session: &Session) -> Subscriber {
        let inbox = Arc::clone(&self.0);
        session
            .subscribe(&keys().pose(), move |arrival| {
                let mut inbox = inbox.lock().unwrap();
                match arrival.decode::<PoseMessage>() {
                    Ok(message) => inbox.accepted.push((message.header.epoch, message.header.seq)),
                    Err(error) => inbox.rejected[Rejection::from(&error).index()] += 1,
                }
            })
            .unwrap()
    }

    fn accepted(&self) -> Vec<(u64, u64)> {
        self.0.lock().unwrap().accepted.clone()
    }

    fn rejected(&self, reason: Rejection) -> u64 {
        self.0.lock().unwrap().rejected[reason.index()]
    }
}

struct Operator {
    publisher: Publisher,
    stamper: Stamper,
}

impl Operator {
    fn new(session: &Session, epoch: u64) -> Self {
        let publisher = session.publisher(&keys().pose(), Stream::Command).unwrap();
        Self { publisher, stamper: Stamper::new(epoch) }
    }

    fn send(&mut self) {
        let now = clock::now();
        let header = self.stamper.header::<PoseMessage>(now);
        self.publisher.send(&PoseMessage::new(header, Echo::NONE, now, &POSE, Intent::default())).unwrap();
    }
}

#[test]
fn poses_arrive_in_order() {
    let (robot, locator) = listen("tcp/127.0.0.1:0");
    let inbox = Inbox::default();
    let _subscriber = inbox.subscribe(&robot);
    let session = connect(&locator);
    let mut operator = Operator::new(&session, 1);
    eventually("the robot listens", || operator.publisher.has_subscribers());
    assert_eq!((session.peers(), robot.peers()), (1, 1));
    for _ in 0..200 {
        operator.send();
        std::thread::sleep(MS);
    }
    eventually("the last pose is there", || inbox.accepted().last() == Some(&(1, 200)));
    let accepted = inbox.accepted();
    assert!(accepted.windows(2).all(|pair| pair[0].1 < pair[1].1), "out of order: {accepted:?}");
    assert!(accepted.len() >= 100, "only {} of 200 came over a perfect link", accepted.len());
}

#[test]
fn late_join_and_restarts_of_either_end() {
    // A port that is free now, for a robot that comes later.
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let endpoint = format!("tcp/{address}");
    let session = connect(&endpoint);
    let stop = Arc::new(AtomicBool::new(false));
    let stream = {
        let (mut operator, stop) = (Operator::new(&session, 1), Arc::clone(&stop));
        std::thread::spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                operator.send();
                std::thread::sleep(10 * MS);
            }
        })
    };
    std::thread::sleep(100 * MS);

    // The robot joins late, goes, and comes back: the operator's session finds it each time by itself.
    let mut last = 0;
    for _start in 0..2 {
        let (robot, _) = listen(&endpoint);
        let inbox = Inbox::default();
        let _subscriber = inbox.subscribe(&robot);
        eventually("poses arrive", || inbox.accepted().len() >= 10);
        let accepted = inbox.accepted();
        assert!(accepted[0].1 > last, "old poses came first: {accepted:?}");
        last = accepted[accepted.len() - 1].1;
        robot.close().unwrap();
        eventually("the operator sees it gone", || session.peers() == 0);
    }
    stop.store(true, Ordering::Relaxed);
    stream.join().unwrap();

    // The operator's process is replaced by another: a new epoch, from 1.
    let (robot, _) = listen(&endpoint);
    let inbox = Inbox::default();
    let _subscriber = inbox.subscribe(&robot);
    session.close().unwrap();
    let session = connect(&endpoint);
    let mut operator = Operator::new(&session, 2);
    eventually("a pose of the new operator arrives", || {
        operator.send();
        inbox.accepted().last().is_some_and(|(epoch, _)| *epoch == 2)
    });
}

#[test]
fn garbage_is_counted_and_disturbs_nothing() {
    let (robot, locator) = listen("tcp/127.0.0.1:0");
    let inbox = Inbox::default();
    let _subscriber = inbox.subscribe(&robot);
    let (good, bad) = (connect(&locator), connect(&locator));
    let mut operator = Operator::new(&good, 1);
    let vandal = bad.publisher(&keys().pose(), Stream::Slow).unwrap();
    eventually("the robot listens to both", || operator.publisher.has_subscribers() && vandal.has_subscribers());

    let mut valid = [0; 1024];
    let message = PoseMessage::new(
        Stamper::new(9).header::<PoseMessage>(MonoTime(1)),
        Echo::NONE,
        MonoTime(1),
        &POSE,
        Intent::default(),
    );
    let len = teleop_common::wire::encode_into(&message, &mut valid).unwrap();
    let mut nan = valid;
    nan[64..68].copy_from_slice(&f32::NAN.to_le_bytes());
    let mut version = valid;
    version[4] += 1;
    let junk = vec![0x5a; 20_000];
    let long = vec![0x5a; 60_000];
    let rounds = 20;
    for _ in 0..rounds {
        for payload in [&[][..], b"{\"q\": []}", &valid[..len - 1], &valid[..len + 1], &junk, &long] {
            vandal.put(payload).unwrap();
        }
        vandal.put(&nan[..len]).unwrap();
        vandal.put(&version[..len]).unwrap();
        operator.send();
        std::thread::sleep(2 * MS);
    }
    eventually("all garbage is counted", || {
        inbox.rejected(Rejection::Malformed) == 6 * rounds
            && inbox.rejected(Rejection::Value) == rounds
            && inbox.rejected(Rejection::Protocol) == rounds
    });
    eventually("the last pose is there", || inbox.accepted().last() == Some(&(1, rounds)));
    assert!(inbox.accepted().iter().all(|(epoch, _)| *epoch == 1), "{:?}", inbox.accepted());

    // More than zenoh may put together: the link may go, the session must not.
    vandal.put(&vec![0; 1 << 20]).unwrap();
    eventually("poses still flow", || {
        operator.send();
        inbox.accepted().last().is_some_and(|(_, seq)| *seq > rounds)
    });
}

/// One end of a link that measures the other's clock; `ahead` makes this process look like another host.
struct End {
    epoch: u64,
    ahead: u64,
    state: Mutex<EndState>,
}

#[derive(Default)]
struct EndState {
    echo: Echo,
    offset: ClockOffset,
    refused: u64,
    received: u64,
    last_seq: u64,
    age: Histogram,
}

impl End {
    fn now(&self) -> MonoTime {
        MonoTime(clock::now().0 + self.ahead)
    }

    fn receive(&self, header: &teleop_common::wire::Header, echo: &Echo, stamp: MonoTime) {
        let now = self.now();
        let mut state = self.state.lock().unwrap();
        state.received += 1;
        assert!(header.seq > state.last_seq, "{} after {}", header.seq, state.last_seq);
        state.last_seq = header.seq;
        state.echo = Echo::of(header, now);
        if let Some(exchange) = echo.exchange(self.epoch, header, now)
            && state.offset.update(header.epoch, exchange).is_err()
        {
            state.refused += 1;
        }
        if let Some(age) = state.offset.age(now, stamp) {
            state.age.record_ns(age.max(0) as u64);
        }
    }

    /// Checks the estimate against the truth, which is known as both ends run on one clock.
    fn check(&self, name: &str, peer: &Self, sent: u64) {
        let state = self.state.lock().unwrap();
        let estimate = state.offset.estimate(self.now()).unwrap();
        let truth = peer.ahead as i64 - self.ahead as i64;
        let error = Duration::from_nanos(estimate.offset_ns.abs_diff(truth));
        println!(
            "{name}: {} of {sent} messages, age p50 {:?} p99 {:?} max {:?}, round trip min {:?}, clock error {error:?} \
             of at most {:?}, {} exchanges refused",
            state.received,
            state.age.p50(),
            state.age.p99(),
            state.age.max(),
            estimate.rtt_min,
            estimate.uncertainty,
            state.refused,
        );
        assert!(error <= estimate.uncertainty, "{error:?} > {:?}", estimate.uncertainty);
        assert!(estimate.rtt_min >= 30 * MS, "faster than the relay: {:?}", estimate.rtt_min);
        assert_eq!(state.refused, 0);
        assert!(state.received * 10 >= sent * 5, "{} of {sent} came", state.received);
        assert!(state.received < sent, "nothing was lost");
        // The true age is 15 ms or more, the estimated one as far off as the clock.
        assert!(state.age.p50() + error >= 15 * MS, "{:?}", state.age.p50());
    }
}

#[test]
fn udp_with_delay_jitter_and_loss() {
    let (robot_session, locator) = listen("udp/127.0.0.1:0");
    let target: SocketAddr = locator.trim_start_matches("udp/").parse().unwrap();
    let relay = Relay::udp(target, 42).unwrap();
    let operator_session = connect(&format!("udp/{}", relay.address()));

    let end = |epoch, ahead| Arc::new(End { epoch, ahead, state: Mutex::default() });
    let (operator, robot) = (end(11, 0), end(22, 3_600_000_000_000));
    let (from_robot, from_operator) = (Arc::clone(&operator), Arc::clone(&robot));
    let _states = operator_session
        .subscribe(&keys().joints(), move |arrival| {
            let message = arrival.decode::<JointStateMessage>().unwrap();
            from_robot.receive(&message.header, &message.echo, message.header.sent);
        })
        .unwrap();
    let _poses = robot_session
        .subscribe(&keys().pose(), move |arrival| {
            let message = arrival.decode::<PoseMessage>().unwrap();
            from_operator.receive(&message.header, &message.echo, message.captured);
        })
        .unwrap();
    let poses = operator_session.publisher(&keys().pose(), Stream::Command).unwrap();
    let states = robot_session.publisher(&keys().joints(), Stream::State).unwrap();
    eventually("both ends listen", || poses.has_subscribers() && states.has_subscribers());
    relay.set(Impairment { delay: 20 * MS, jitter: 5 * MS, loss: 0.01, ..Impairment::default() });

    let (mut pose_stamps, mut state_stamps) = (Stamper::new(operator.epoch), Stamper::new(robot.epoch));
    let mut exchange = |rounds: u64| {
        for _ in 0..rounds {
            let now = operator.now();
            let echo = operator.state.lock().unwrap().echo;
            let header = pose_stamps.header::<PoseMessage>(now);
            poses.send(&PoseMessage::new(header, echo, now, &POSE, Intent::default())).unwrap();

            let echo = robot.state.lock().unwrap().echo;
            let message = JointStateMessage {
                header: state_stamps.header::<JointStateMessage>(robot.now()),
                echo,
                mode: 1,
                joints: 16,
                tick: 0,
                wall_offset_ns: 0,
                pose_epoch: 0,
                pose_seq: 0,
                pose_captured: MonoTime(0),
                q: pack_joints(&[0.1; 16]),
                dq: pack_joints(&[0.0; 16]),
                tau: pack_joints(&[0.0; 16]),
                q_command: pack_joints(&[0.1; 16]),
                stop: 0,
                holder: 0,
            };
            states.send(&message).unwrap();
            std::thread::sleep(5 * MS);
        }
    };
    exchange(800);
    operator.check("operator", &robot, 800);
    robot.check("robot", &operator, 800);
    println!("relay: {:?}", relay.stats());

    // A short outage: nothing that was sent in it arrives, what is sent after it does.
    let before = robot.state.lock().unwrap().last_seq;
    std::thread::sleep(100 * MS);
    relay.blackout(true);
    exchange(40);
    relay.blackout(false);
    std::thread::sleep(100 * MS);
    let within = robot.state.lock().unwrap().last_seq;
    assert!(within <= before.max(800) + 1, "{before} to {within}: something came through the outage");
    eventually("poses flow again", || {
        exchange(1);
        robot.state.lock().unwrap().last_seq > 840
    });
}

#[test]
fn liveliness_tokens_come_and_go() {
    let (robot, locator) = listen("tcp/127.0.0.1:0");
    let seen: Arc<Mutex<Vec<(String, bool)>>> = Arc::default();
    let session = connect(&locator);
    let early = robot.live_token(&keys().live_robot(0xa)).unwrap();
    let log = Arc::clone(&seen);
    let _watch = session
        .watch_live(&keys().live_robots(), move |key, alive| log.lock().unwrap().push((key.to_owned(), alive)))
        .unwrap();
    let has = |epoch: u64, alive: bool| seen.lock().unwrap().contains(&(keys().live_robot(epoch), alive));
    eventually("a token declared before is seen", || has(0xa, true));
    let late = robot.live_token(&keys().live_robot(0xb)).unwrap();
    eventually("a token declared after is seen", || has(0xb, true));
    let mut now = session.live_now(&keys().live_robots(), PATIENCE).unwrap();
    now.sort();
    assert_eq!(now, [keys().live_robot(0xa), keys().live_robot(0xb)]);
    assert_eq!(keys().live_epoch(&now[1]), Some(0xb));
    assert!(!has(0xa, false) && !has(0xb, false));
    drop(early);
    eventually("a dropped token is gone", || has(0xa, false));
    robot.close().unwrap();
    eventually("the token of a closed session is gone", || has(0xb, false));
    drop(late);
    assert_eq!(session.live_now(&keys().live_robots(), PATIENCE).unwrap(), Vec::<String>::new());
}

#[test]
fn queries_are_answered() {
    let (robot, locator) = listen("tcp/127.0.0.1:0");
    let session = connect(&locator);
    let key = keys().describe();
    // Nobody serves the key: an answer at once, not after the timeout.
    let start = Instant::now();
    let error = session.get(&key, PATIENCE).unwrap_err();
    assert!(matches!(error, NetError::NoAnswer { .. }) && error.to_string().contains(&key), "{error}");
    assert!(start.elapsed() < PATIENCE / 2);

    let asked = Arc::new(AtomicU64::new(0));
    let count = Arc::clone(&asked);
    let server = robot
        .serve(&key, move || format!("{{\"asked\": {}}}", count.fetch_add(1, Ordering::Relaxed)).into_bytes())
        .unwrap();
    let mut answer = Err(NetError::Close(String::new()));
    eventually("the query is answered", || {
        answer = session.get(&key, Duration::from_secs(2));
        answer.is_ok()
    });
    assert_eq!(answer.unwrap(), format!("{{\"asked\": {}}}", asked.load(Ordering::Relaxed) - 1).into_bytes());
    drop(server);
    eventually("the key is no longer served", || session.get(&key, Duration::from_secs(2)).is_err());
}

#[test]
fn a_taken_port_is_a_clear_error() {
    let (_robot, locator) = listen("tcp/127.0.0.1:0");
    let error = Session::open(&SessionConfig::listening([&locator])).unwrap_err();
    assert!(matches!(error, NetError::Open { .. }), "{error}");
    assert!(error.to_string().contains(&locator), "{error}");
}

#[test]
fn an_invalid_message_is_not_sent() {
    let (robot, _) = listen("tcp/127.0.0.1:0");
    let publisher = robot.publisher(&keys().health(), Stream::Slow).unwrap();
    let mut message = HealthMessage {
        header: Stamper::new(1).header::<HealthMessage>(clock::now()),
        mode: 0,
        fault: 0,
        ticks: 0,
        overruns: 0,
        tick_us: Default::default(),
        poses_accepted: 0,
        rejected: [0; REJECTIONS],
        holds: 0,
        age_ms: Default::default(),
        telemetry_dropped: 0,
        rate_hz: 333.0,
        operator: Default::default(),
        stages: Default::default(),
        total_ms: Default::default(),
    };
    publisher.send(&message).unwrap();
    message.rate_hz = f32::NAN;
    let error = publisher.send(&message).unwrap_err().to_string();
    assert!(error.contains("rate_hz") && error.contains(&keys().health()), "{error}");
    robot.close().unwrap();
    message.rate_hz = 1.0;
    assert!(matches!(publisher.send(&message), Err(NetError::Key { .. })));
}
