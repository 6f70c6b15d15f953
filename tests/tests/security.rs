//! What others on the network may try: commands without the right to, no or foreign certificates, recordings of a real
//! session, liveliness of somebody else, floods, garbage. And that bad certificates are told at once.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::io::Write as _;
use std::net::{TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use teleop_common::authority::{Clutch, Intent};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::mode::Mode;
use teleop_common::net::{Session, SessionConfig, Stream, Tls, clock};
use teleop_common::wire::{ControlMessage, Echo, Header, MAX_MESSAGE, PoseMessage, Rejection, Request, Stamper};
use teleop_common::wire::{HealthMessage, Message, encode_into};
use teleop_tests::certificates::Certificates;
use teleop_tests::eventually;
use teleop_tests::judge::spread;
use teleop_tests::probe::{Probe, State, moved};
use teleop_tests::process::{Process, Robot, Signal, config, free_endpoint, run, strs};
use zenoh::Wait as _;
use zenoh::qos::{CongestionControl, Priority};

const PROTOCOLS: [&str; 2] = ["quic/127.0.0.1:0", "tls/127.0.0.1:0"];

/// A robot that ada may drive and olga may watch and stop, and that anybody of those who may drive can take over.
struct Guarded {
    certificates: Certificates,
    robot: Robot,
    _config: tempfile::TempDir,
}

impl Guarded {
    fn listening(endpoint: &str) -> Self {
        let certificates = Certificates::of(&["robot", "ada", "olga", "eve"]);
        let (folder, config) = config("[authority]\ntakeover = \"always\"\nhold_after_s = 1.5\nmax_age_s = 1.5");
        let mut options = certificates.flags("robot");
        let access = ["--config", &config, "--allow-operator", "ada", "--allow-observer", "olga"];
        options.extend(access.map(str::to_owned));
        let robot = Robot::listening(&[endpoint], &strs(&options));
        Self { certificates, robot, _config: folder }
    }

    fn probe(&self) -> Probe {
        Probe::open(&self.certificates.session("olga", self.robot.endpoint()))
    }

    fn attacker(&self, name: &str) -> Attacker {
        Attacker::connect(self.robot.endpoint(), Some(self.certificates.tls(name)))
    }

    fn session(&self, name: &str) -> Session {
        let session = Session::open(&self.certificates.session(name, self.robot.endpoint())).unwrap();
        eventually("there is a link", || session.peers() == 1);
        session
    }

    fn operator(&self, name: &str, more: &[&str]) -> Process {
        let mut options = self.certificates.flags(name);
        options.extend(more.iter().map(|option| (*option).to_owned()));
        Process::operator(self.robot.endpoint(), "wave", &strs(&options))
    }

    /// `operator COMMAND` by `name`.
    fn run(&self, name: &str, command: &[&str]) -> std::process::Output {
        let flags = self.certificates.flags(name);
        run("operator", &[command, &["--connect", self.robot.endpoint()], &strs(&flags)].concat())
    }
}

/// Expects that in all `states` the hand followed `driver`, and moved.
#[track_caller]
fn assert_driven(states: &[State], driver: u64) {
    assert!(states.len() >= 20, "only {} states to judge by", states.len());
    for state in states {
        assert_eq!((state.follows(), state.pose_epoch, state.stop), (true, driver, 0), "at tick {}", state.tick);
    }
    assert!(moved(states, 0.2) >= 3, "it hardly moved");
}

/// Expects that in all `states` nobody had the robot, and nothing moved.
#[track_caller]
fn assert_idle(states: &[State]) {
    assert!(states.len() >= 20, "only {} states to judge by", states.len());
    for state in states {
        assert_eq!((state.mode(), state.holder), (Some(Mode::Disarmed), 0), "at tick {}", state.tick);
    }
    let commands: Vec<_> = states.iter().map(|state| state.q_command()).collect();
    assert_eq!(spread(commands.iter()), 0.0, "the command moves");
}

/// Somebody who sends whatever he likes. The sessions of this project do not even send what nobody has subscribed to, and
/// who has no access is not told of subscriptions; a zenoh client sends all the same.
struct Attacker(zenoh::Session);

impl Attacker {
    fn connect(endpoint: &str, tls: Option<Tls>) -> Self {
        let mut settings = serde_json::json!({
            "mode": "client",
            "connect": { "endpoints": [endpoint] },
            "scouting": { "multicast": { "enabled": false } },
        });
        if let Some(tls) = tls {
            settings["transport"] = tls_settings(&tls);
        }
        let session = zenoh::open(zenoh::Config::from_json5(&settings.to_string()).unwrap()).wait().unwrap();
        Self(session)
    }

    fn put(&self, key: &str, bytes: &[u8]) {
        let put = self.0.put(key, bytes).congestion_control(CongestionControl::Drop).priority(Priority::RealTime);
        put.express(true).wait().unwrap();
    }

    /// Asks, in the most demanding way, and does not care for the answer.
    fn ask(&self, key: &str) {
        let get = self.0.get(key).timeout(Duration::from_secs(1)).congestion_control(CongestionControl::Block);
        get.priority(Priority::RealTime).callback(drop).wait().unwrap();
    }

    fn send<M: Message>(&self, key: &str, message: &M) {
        let mut bytes = [0; MAX_MESSAGE];
        let len = encode_into(message, &mut bytes).unwrap();
        self.put(key, &bytes[..len]);
    }
}

fn tls_settings(tls: &Tls) -> serde_json::Value {
    let Tls { ca, certificate, key } = tls;
    serde_json::json!({ "link": { "tls": {
        "root_ca_certificate": ca, "enable_mtls": true, "listen_certificate": certificate, "listen_private_key": key,
        "connect_certificate": certificate, "connect_private_key": key,
    } } })
}

/// For `duration` drives as well as anybody could who knows all that the robot publishes: right echoes, the clutch moved
/// as it must be, takeover asked for. And stops, if `stops`.
fn forge(attacker: &Attacker, probe: &Probe, epoch: u64, duration: Duration, stops: bool) {
    let keys = &probe.keys;
    let (mut stamper, mut clutch, start) = (Stamper::new(epoch), Clutch::default(), Instant::now());
    while start.elapsed() < duration {
        if let Some(state) = probe.last() {
            // This machine's clock is the robot's.
            let now = clock::now();
            let echo = Echo { epoch: state.header.epoch, sent: state.header.sent, received: state.at };
            clutch = if state.holder == epoch { clutch.eager(state.mode().unwrap()) } else { Clutch::default() };
            let intent = Intent { clutch, takeover: true, ..Intent::default() };
            let q = Gesture::Fist.sample(start.elapsed().as_secs_f64());
            let pose = MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None };
            let header = stamper.header::<PoseMessage>(now);
            attacker.send(&keys.pose(), &PoseMessage::new(header, echo, now, &pose, intent));
        }
        if stops {
            attacker.send(&keys.stop(), &stop_message(epoch));
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn stop_message(epoch: u64) -> ControlMessage {
    ControlMessage::new(Header::new::<ControlMessage>(epoch, 1, clock::now()), 0, Request::Stop)
}

#[test]
fn a_forger_with_access_drives() {
    // What the next test shows to be refused would otherwise work.
    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    probe.wait_for_more(5);
    let attacker = Attacker::connect(robot.endpoint(), None);
    forge(&attacker, &probe, 77, Duration::from_secs(4), false);
    assert!(probe.states().iter().any(|state| state.mode() == Some(Mode::Engaged) && state.pose_epoch == 77));
    forge(&attacker, &probe, 77, Duration::from_millis(300), true);
    probe.wait_for(Mode::Stopped);
}

#[test]
fn only_the_named_operator_commands() {
    for endpoint in PROTOCOLS {
        let guarded = Guarded::listening(endpoint);
        let probe = guarded.probe();
        probe.wait_for(Mode::Disarmed);

        // Before anybody drives.
        let eve = guarded.attacker("eve");
        let mark = probe.mark();
        forge(&eve, &probe, 66, Duration::from_secs(1), true);
        // Who may watch may not drive.
        forge(&guarded.attacker("olga"), &probe, 67, Duration::from_secs(1), false);
        assert_idle(&probe.since(mark));
        let health = probe.health().unwrap();
        assert_eq!((health.poses_accepted, health.rejected.iter().sum::<u64>()), (0, 0), "{health:?}");

        // While somebody does.
        let mut ada = guarded.operator("ada", &[]);
        probe.wait_for(Mode::Engaged);
        probe.wait_for_motion(0.3);
        let driver = probe.last().unwrap().pose_epoch;
        let (mark, refused) = (probe.mark(), refusals(&probe));
        let mut second = guarded.operator("eve", &["--takeover"]);
        forge(&eve, &probe, 66, Duration::from_secs(2), true);
        let watch = guarded.run("eve", &["watch", "--timeout", "1"]);
        assert_eq!(watch.status.code(), Some(1), "who is not named sees nothing");
        let stop = guarded.run("eve", &["stop"]);
        assert_eq!(stop.status.code(), Some(1), "{}", String::from_utf8_lossy(&stop.stdout));
        let list = guarded.run("eve", &["list"]);
        assert!(String::from_utf8_lossy(&list.stdout).contains("no robots"), "{list:?}");
        assert_driven(&probe.since(mark), driver);
        assert_eq!(refusals(&probe), refused, "{:?}", probe.health());
        second.stop(Signal::Term);
        assert!(second.stdout().contains("no echo from the robot"), "{}", second.stdout());

        // The observer sees the robot, and may stop it.
        let list = guarded.run("olga", &["list"]);
        assert!(String::from_utf8_lossy(&list.stdout).contains("engag"), "{list:?}");
        let stop = guarded.run("olga", &["stop"]);
        assert_eq!(stop.status.code(), Some(0), "{}", String::from_utf8_lossy(&stop.stderr));
        probe.wait_for(Mode::Stopped);
        // But not reset the stop, though it knows all that the operator's own reset would say.
        let (olga, stopped) = (guarded.attacker("olga"), probe.last().unwrap());
        assert_eq!((stopped.holder, stopped.stop), (driver, 1));
        let request = Request::Reset { stop: stopped.stop };
        let mut stamper = Stamper::new(driver);
        for _ in 0..50 {
            for key in [probe.keys.reset(), probe.keys.stop()] {
                let header = stamper.header::<ControlMessage>(clock::now());
                olga.send(&key, &ControlMessage::new(header, stopped.header.epoch, request));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        assert_eq!(probe.last().unwrap().mode(), Some(Mode::Stopped));
        // The same by who may drive does.
        let header = stamper.header::<ControlMessage>(clock::now());
        let ada_herself = guarded.attacker("ada");
        eventually("it is reset", || {
            ada_herself.send(&probe.keys.reset(), &ControlMessage::new(header, stopped.header.epoch, request));
            std::thread::sleep(Duration::from_millis(50));
            probe.last().unwrap().mode() != Some(Mode::Stopped)
        });
        ada.stop(Signal::Term);
        guarded.robot.process.assert_no_panic();
        println!("{endpoint}: {}", guarded.robot.endpoint());
        assert_eq!(guarded.robot.endpoint().ends_with("?mixed_rel=auto"), endpoint.starts_with("quic"));
    }
}

#[test]
fn no_link_without_a_certificate_of_the_authority() {
    for endpoint in PROTOCOLS {
        let guarded = Guarded::listening(endpoint);
        let endpoint = guarded.robot.endpoint();
        let probe = guarded.probe();
        probe.wait_for(Mode::Disarmed);
        let foreign = Certificates::of(&["ada"]);
        // It trusts the robot's authority as well, so that only the robot can refuse.
        let both = ["ca.pem"].map(|ca| {
            [guarded.certificates.file(ca), foreign.file(ca)]
                .map(|path| std::fs::read_to_string(path).unwrap())
                .concat()
        });
        std::fs::write(foreign.file("both.pem"), &both[0]).unwrap();
        let stranger = SessionConfig {
            tls: Some(Tls { ca: foreign.file("both.pem"), ..foreign.tls("ada") }),
            ..SessionConfig::connecting([endpoint])
        };
        // And one that shows nothing at all.
        let ca = guarded.certificates.file("ca.pem");
        let tls = serde_json::json!({ "transport": { "link": { "tls": { "root_ca_certificate": ca } } } });
        let file = foreign.file("zenoh.json5");
        std::fs::write(&file, tls.to_string()).unwrap();
        let nobody = SessionConfig { zenoh_config_file: Some(file), ..SessionConfig::connecting([endpoint]) };
        for config in [stranger, nobody] {
            let session = Session::open(&config).unwrap();
            let start = Instant::now();
            while start.elapsed() < Duration::from_secs(2) {
                assert_eq!(session.peers(), 0, "{config:?}");
                std::thread::sleep(Duration::from_millis(20));
            }
            session.close().unwrap();
        }
        // The right one needs less than that.
        guarded.session("eve").close().unwrap();
        probe.wait_for_more(20);
        assert_idle(&probe.states());
        guarded.robot.process.assert_no_panic();
    }
}

#[test]
fn bad_certificates_are_told_at_once() {
    let certificates = Certificates::of(&["robot", "ada"]);
    let foreign = Certificates::of(&["ada"]);
    let file = |name: &str| certificates.file(name).to_str().unwrap().to_owned();
    let (ca, cert, key) = (file("ca.pem"), file("robot.pem"), file("robot.key"));
    let (other, missing) = (foreign.file("ada.pem").to_str().unwrap().to_owned(), file("none.pem"));
    let other_key = foreign.file("ada.key").to_str().unwrap().to_owned();
    let expired = file("expired.pem");
    let make = "echo basicConstraints=CA:FALSE >extensions && openssl req -new -key robot.key -subj /CN=robot |
        openssl x509 -req -CA ca.pem -CAkey ca.key -set_serial 1 -days -1 -extfile extensions -out expired.pem";
    let folder = certificates.file("");
    let made = std::process::Command::new("sh").args(["-c", make]).current_dir(folder).output().unwrap();
    assert!(made.status.success(), "{made:?}");
    let quic = "quic/127.0.0.1:0";
    let tls = |cert: &str, key: &str| -> Vec<String> {
        ["--tls-ca", &ca, "--tls-cert", cert, "--tls-key", key].map(str::to_owned).to_vec()
    };
    let owned = |list: &[&str]| -> Vec<String> { list.iter().map(|text| (*text).to_owned()).collect() };
    let good = tls(&cert, &key);
    let cases: Vec<(Vec<String>, Vec<&str>)> = vec![
        (vec![], vec![quic, "--tls-ca", "deploy/certificates"]),
        (owned(&["--tls-ca", &ca]), vec!["--tls-cert", "--tls-key"]),
        (tls(&missing, &key), vec![&missing, "No such file"]),
        (tls(&key, &key), vec![&key, "no certificate"]),
        (tls(&cert, &cert), vec![&cert, "no private key"]),
        (tls(&cert, &other_key), vec![&other_key, "not the key of", &cert]),
        (tls(&other, &other_key), vec![&other, "not signed by", &ca]),
        (tls(&expired, &key), vec![&expired, "expired"]),
    ];
    for (options, words) in &cases {
        for command in
            [["robot", "run", "--listen"], ["operator", "run", "--connect"], ["operator", "watch", "--connect"]]
        {
            let [program, command, at] = command;
            let mut arguments = vec![command, at, quic];
            arguments.extend(strs(options));
            refused(program, &arguments, words);
        }
    }
    let access: [(&[&str], &[String], &[&str]); 3] = [
        (&["--allow-operator", "ada"], &[], &["--allow-operator", "--tls-ca"]),
        (&["--allow-observer", "ada", "--listen", "tcp/127.0.0.1:0"], &good, &["tcp/127.0.0.1:0", "not encrypted"]),
        (&["--allow-operator", ""], &good, &["--allow-operator"]),
    ];
    for (options, tls, words) in access {
        refused("robot", &[options, &strs(tls)].concat(), words);
    }
}

/// Expects that the program ends with wrong usage and says why.
#[track_caller]
fn refused(program: &str, arguments: &[&str], words: &[&str]) {
    let output = run(program, arguments);
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{program} {arguments:?}:\n{text}");
    assert!(text.starts_with("error: "), "{program} {arguments:?}:\n{text}");
    for word in words {
        assert!(text.contains(word), "{program} {arguments:?} does not say {word}:\n{text}");
    }
}

#[test]
fn a_recording_of_a_session_moves_nothing() {
    let endpoint = free_endpoint();
    let (folder, config) = config("[authority]\nhold_after_s = 1.5\ntakeover = \"always\"");
    let mut robot = Robot::listening(&[&endpoint], &["--config", &config]);
    let probe = Probe::connect(&endpoint);
    // The operator is connected to the thief as well, who hears the very bytes, and sends each again at once.
    let thief = Session::open(&SessionConfig::listening(["tcp/127.0.0.1:0"])).unwrap();
    let here = thief.locators().remove(0);
    let stolen = Arc::<Mutex<Vec<Vec<u8>>>>::default();
    let keep = Arc::clone(&stolen);
    let _ear = thief.subscribe(&probe.keys.pose(), move |arrival| {
        keep.lock().unwrap().push(arrival.payload.unwrap().to_vec());
    });
    let again = probe.session.publisher(&probe.keys.pose(), Stream::Command).unwrap();
    eventually("the robot listens", || again.has_subscribers());

    let mut operator = Process::operator(&endpoint, "wave", &["--connect", &here]);
    probe.wait_for(Mode::Engaged);
    let (mark, mut sent) = (probe.mark(), stolen.lock().unwrap().len());
    let driver = probe.last().unwrap().pose_epoch;
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(4) {
        let fresh: Vec<_> = stolen.lock().unwrap()[sent..].to_vec();
        sent += fresh.len();
        // Each twice.
        for bytes in fresh.iter().chain(&fresh) {
            again.put(bytes).unwrap();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_driven(&probe.since(mark), driver);
    let twice = probe.rejected(Rejection::Sequence);
    assert!(twice >= 200, "{:?}", probe.health().unwrap().rejected);
    operator.stop(Signal::Term);
    probe.wait_for(Mode::Disarmed);

    // After the operator left.
    let stolen = stolen.lock().unwrap().clone();
    assert!(stolen.len() >= 400, "{}", stolen.len());
    let before = probe.health().unwrap();
    std::thread::sleep(Duration::from_millis(1000));
    let mark = probe.mark();
    let replay = |pause: Duration| {
        for bytes in &stolen {
            again.put(bytes).unwrap();
            std::thread::sleep(pause);
        }
    };
    replay(Duration::from_millis(10));
    replay(Duration::from_micros(200));
    eventually("they are counted", || refusals(&probe) >= before.rejected.iter().sum::<u64>() + stolen.len() as u64);
    assert_idle(&probe.since(mark));
    println!("replayed {}: {:?}", stolen.len(), probe.health().unwrap().rejected);
    assert_eq!(probe.health().unwrap().poses_accepted, before.poses_accepted);

    // To a robot that knows nothing of that operator.
    let epoch = probe.last().unwrap().header.epoch;
    robot.process.kill();
    let robot = Robot::listening(&[&endpoint], &["--config", &config]);
    eventually("another robot is seen", || probe.last().is_some_and(|state| state.header.epoch != epoch));
    eventually("it listens", || again.has_subscribers());
    eventually("its health is seen", || probe.health().is_some_and(|health| health.header.epoch != epoch));
    let mark = probe.mark();
    replay(Duration::from_millis(10));
    eventually("they are counted", || refusals(&probe) >= stolen.len() as u64 * 9 / 10);
    assert_idle(&probe.since(mark));
    let health = probe.health().unwrap();
    println!("to a new robot: {:?}", health.rejected);
    assert_eq!(health.poses_accepted, 0);
    robot.process.assert_no_panic();
    drop(folder);
}

fn refusals(probe: &Probe) -> u64 {
    probe.health().map_or(0, |health| health.rejected.iter().sum())
}

#[test]
fn false_liveliness_changes_nothing() {
    let (folder, config) = config("[authority]\nhold_after_s = 1.5");
    let robot = Robot::start(&["--config", &config]);
    let probe = Probe::connect(robot.endpoint());
    let _operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for(Mode::Engaged);
    let (driver, mark) = (probe.last().unwrap().pose_epoch, probe.mark());
    let ghost = Session::open(&SessionConfig::connecting([robot.endpoint()])).unwrap();
    let keys = &probe.keys;
    for _ in 0..20 {
        // The driver's own, others', another robot of this name; here and gone.
        let epochs = [driver, driver ^ 1, 0, u64::MAX];
        let tokens: Vec<_> = epochs
            .iter()
            .flat_map(|epoch| {
                [ghost.live_token(&keys.live_operator(*epoch)), ghost.live_token(&keys.live_robot(*epoch))]
            })
            .map(Result::unwrap)
            .collect();
        std::thread::sleep(Duration::from_millis(50));
        drop(tokens);
        std::thread::sleep(Duration::from_millis(50));
    }
    ghost.close().unwrap();
    assert_driven(&probe.since(mark), driver);
    robot.process.assert_no_panic();
    drop(folder);
}

/// Memory in use by a process, MiB.
fn memory(process: &Process) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", process.id())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.split_whitespace().next().unwrap().parse::<f64>().unwrap() / 1024.0
}

/// What control ticks and memory did while `body` ran.
#[derive(Debug)]
struct Cost {
    ticks: u64,
    overruns: u64,
    grown: f64,
}

fn cost(robot: &Robot, probe: &Probe, body: impl FnOnce()) -> Cost {
    let fresh = || {
        let seq = probe.health().map_or(0, |health| health.header.seq);
        eventually("health comes", || probe.health().is_some_and(|health| health.header.seq > seq));
        *probe.health().unwrap()
    };
    let (before, size): (HealthMessage, _) = (fresh(), memory(&robot.process));
    body();
    let after = fresh();
    Cost {
        ticks: after.ticks - before.ticks,
        overruns: after.overruns - before.overruns,
        grown: memory(&robot.process) - size,
    }
}

/// Sends as fast as it can for `duration`: poses that look right, controls that do not, garbage, what is far too long,
/// queries.
/// Gives how many it sent.
fn flood(attacker: &Attacker, probe: &Probe, duration: Duration) -> u64 {
    let [pose_key, control, unknown] = [probe.keys.pose(), probe.keys.stop(), probe.keys.hand_input()];
    let pose = MasterPose { q: Gesture::Fist.sample(1.0), geometry: MasterGeometry::PARADIGMATIC, tuning: None };
    let mut bytes = [0; MAX_MESSAGE];
    let intent = Intent { clutch: Clutch(1), takeover: true, ..Intent::default() };
    let header = Header::new::<PoseMessage>(5, 1, clock::now());
    let message = PoseMessage::new(header, Echo::NONE, clock::now(), &pose, intent);
    let len = encode_into(&message, &mut bytes).unwrap();
    let (junk, long) = ([0x5a; ControlMessage::LEN], vec![0xa5; 60_000]);
    let (start, mut sent) = (Instant::now(), 0_u64);
    // Another epoch each time: the robot must not keep something for each.
    while start.elapsed() < duration {
        for _ in 0..100 {
            bytes[8..16].copy_from_slice(&(sent + 1).to_le_bytes());
            attacker.put(&pose_key, &bytes[..len]);
            attacker.put(&pose_key, &bytes[..len / 2]);
            attacker.put(&control, &junk);
            attacker.put(&unknown, &junk);
            sent += 4;
        }
        attacker.put(&control, &long);
        attacker.ask(&probe.keys.describe());
    }
    sent
}

/// Floods a robot that an operator drives meanwhile, and judges.
fn assert_flood(robot: &Robot, probe: &Probe, attacker: &Attacker, reaches: bool) {
    const FOR: Duration = Duration::from_secs(10);
    probe.wait_for(Mode::Engaged);
    let driver = probe.last().unwrap().pose_epoch;
    let quiet = cost(robot, probe, || std::thread::sleep(FOR));
    let mark = probe.mark();
    let refused = refusals(probe);
    let mut sent = 0;
    let loud = cost(robot, probe, || sent = flood(attacker, probe, FOR));
    let refused = refusals(probe) - refused;
    println!("{sent} messages in {FOR:?}, {refused} poses refused\n  before {quiet:?}\n  during {loud:?}");
    assert!(sent > 10_000, "that was no flood: {sent}");
    if reaches {
        assert!(refused > 1000, "it did not arrive: {refused}");
    } else {
        assert_eq!(refused, 0, "it got in");
    }
    assert!(loud.ticks as f64 > 0.9 * quiet.ticks as f64, "the control loop got slower");
    assert!(loud.overruns as f64 <= quiet.overruns as f64 + 0.01 * loud.ticks as f64, "ticks were missed");
    assert!(loud.grown < 64.0, "memory grew by {} MiB", loud.grown);
    assert_driven(&probe.since(mark), driver);
    robot.process.assert_no_panic();
}

#[test]
fn a_flood_by_anybody_disturbs_no_tick() {
    // On a link without certificates anybody's messages are looked at.
    let (folder, config) = config("[authority]\nhold_after_s = 1.5\nmax_age_s = 1.5");
    let robot = Robot::start(&["--config", &config]);
    let probe = Probe::connect(robot.endpoint());
    let _operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for(Mode::Engaged);
    let driver = probe.last().unwrap().pose_epoch;
    let attacker = Attacker::connect(robot.endpoint(), None);

    // A burst of 2,000 poses.
    let mark = probe.mark();
    let pose = MasterPose { q: Gesture::Fist.sample(1.0), geometry: MasterGeometry::PARADIGMATIC, tuning: None };
    let mut stamper = Stamper::new(5);
    let burst = cost(&robot, &probe, || {
        let start = Instant::now();
        for _ in 0..2000 {
            let now = clock::now();
            let header = stamper.header::<PoseMessage>(now);
            attacker.send(&probe.keys.pose(), &PoseMessage::new(header, Echo::NONE, now, &pose, Intent::default()));
        }
        println!("2,000 poses in {:?}", start.elapsed());
        std::thread::sleep(Duration::from_millis(500));
    });
    println!("burst {burst:?}, {} poses refused", refusals(&probe));
    assert!(refusals(&probe) > 100, "it did not arrive");
    assert!(burst.overruns as f64 <= 0.01 * burst.ticks as f64, "ticks were missed");
    assert_driven(&probe.since(mark), driver);

    assert_flood(&robot, &probe, &attacker, true);
    drop(folder);
}

#[test]
fn a_flood_by_somebody_without_access_disturbs_no_tick() {
    for endpoint in PROTOCOLS {
        println!("{endpoint}");
        let guarded = Guarded::listening(endpoint);
        let probe = guarded.probe();
        let _ada = guarded.operator("ada", &[]);
        assert_flood(&guarded.robot, &probe, &guarded.attacker("eve"), false);
    }
}

#[test]
fn connections_that_say_nothing_or_nonsense_disturb_nothing() {
    let certificates = Certificates::of(&["robot", "ada"]);
    let (folder, config) = config("[authority]\nhold_after_s = 1.5");
    let mut options = certificates.flags("robot");
    options.extend(["--config".to_owned(), config]);
    let listen = ["tcp/127.0.0.1:0", "tls/127.0.0.1:0", "quic/127.0.0.1:0", "udp/127.0.0.1:0"];
    let robot = Robot::listening(&listen, &strs(&options));
    let probe = Probe::connect(robot.endpoint());
    let _operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for(Mode::Engaged);
    let (driver, mark) = (probe.last().unwrap().pose_epoch, probe.mark());
    let address = |protocol: usize| {
        let endpoint = &robot.endpoints[protocol];
        endpoint.split(['/', '?']).nth(1).unwrap().to_owned()
    };
    let stop = AtomicBool::new(false);
    let cost = cost(&robot, &probe, || {
        let mut silent = Vec::new();
        std::thread::scope(|scope| {
            for protocol in [2, 3] {
                let (to, stop) = (address(protocol), &stop);
                scope.spawn(move || {
                    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
                    let mut bytes = [0_u8; 1200];
                    let mut dice = 1_u64;
                    while !stop.load(Ordering::Relaxed) {
                        for byte in &mut bytes {
                            dice ^= dice << 13;
                            dice ^= dice >> 7;
                            dice ^= dice << 17;
                            *byte = dice as u8;
                        }
                        // The robot may have no room for more.
                        socket.send_to(&bytes, &to).ok();
                        std::thread::sleep(Duration::from_micros(200));
                    }
                });
            }
            for round in 0..100_u32 {
                for protocol in [0, 1] {
                    let Ok(mut stream) = TcpStream::connect(address(protocol)) else { continue };
                    // Nothing; a length of 65,535 and then nothing; what is no message; half a handshake.
                    let bytes: &[u8] = match round % 4 {
                        0 => &[],
                        1 => &[0xff, 0xff],
                        2 => &[0x5a; 3000],
                        _ => b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
                    };
                    stream.write_all(bytes).ok();
                    silent.push(stream);
                }
                std::thread::sleep(Duration::from_millis(30));
            }
            stop.store(true, Ordering::Relaxed);
        });
    });
    println!("200 bad connections and two bad streams of packets: {cost:?}");
    assert_driven(&probe.since(mark), driver);
    assert!(cost.overruns as f64 <= 0.01 * cost.ticks as f64, "ticks were missed");
    assert!(cost.grown < 64.0, "memory grew by {} MiB", cost.grown);
    // And the next one can connect.
    for endpoint in &robot.endpoints {
        let session = Session::open(&certificates.session("ada", endpoint)).unwrap();
        eventually("the next one is connected", || session.peers() == 1);
        session.close().unwrap();
    }
    robot.process.assert_no_panic();
    drop(folder);
}
