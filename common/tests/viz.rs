//! The Rerun shell against real servers and files on this machine; the browser's side is looked at elsewhere.
#![cfg(feature = "viz")]
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use teleop_common::hand::{HandModel, HandSide};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::{MasterGeometry, MasterPose, OPEN};
use teleop_common::mode::Mode;
use teleop_common::viz::{
    Hub, HubError, HubOptions, Level, Logger, OperatorFrame, RobotFrame, Scene, Status, Viewer, Viz,
};

/// Options for a hub on free ports of this machine.
fn options() -> HubOptions {
    let free = || TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap().port();
    HubOptions { bind: Ipv4Addr::LOCALHOST.into(), grpc_port: free(), page_port: free() }
}

fn pose() -> MasterPose {
    MasterPose { q: OPEN, geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

fn operator_frame(time: i64) -> OperatorFrame {
    OperatorFrame { time, pose: pose(), r1: 0.02, r2: 0.08, residual: None, round_trip: Some(0.002) }
}

fn robot_frame(time: i64) -> RobotFrame {
    let hand = HandModel::allegro_v4(HandSide::Right);
    let output = Retargeter::new(hand, MappingParams::default()).unwrap().map(&pose());
    RobotFrame {
        time,
        q: output.q,
        dq: output.q,
        q_command: output.q,
        mapping: Some(output),
        mode: Mode::Engaged,
        pose_age: Some(0.004),
        tick: None,
    }
}

/// Logs operator frames until `done` or the time is up.
fn log_until(logger: &Logger, limit: Duration, mut done: impl FnMut() -> bool) -> bool {
    let start = Instant::now();
    let mut time = 1_700_000_000_000_000_000;
    while start.elapsed() < limit {
        if done() {
            return true;
        }
        logger.log_operator(operator_frame(time));
        time += 10_000_000;
        std::thread::sleep(Duration::from_millis(10));
    }
    false
}

fn operator(options: HubOptions) -> Viz {
    Viz::start(Viewer::Web(options), Scene::operator("test", HandSide::Right)).unwrap()
}

fn robot(viewer: Viewer) -> Viz {
    Viz::start(viewer, Scene::robot("test", &HandModel::allegro_v4(HandSide::Right))).unwrap()
}

fn hosting(viz: &Viz) -> bool {
    matches!(viz.status(), Status::Hosting { .. })
}

fn joined(viz: &Viz) -> bool {
    matches!(viz.status(), Status::Joined { .. })
}

#[test]
fn off_costs_nothing() {
    let viz = robot(Viewer::Off);
    assert!(!viz.logger().enabled() && !Logger::off().enabled());
    viz.logger().log_robot(robot_frame(0));
    assert_eq!((viz.status(), viz.dropped()), (Status::Off, 0));
    assert!(viz.shutdown(Duration::ZERO));
}

#[test]
fn a_file_gets_every_entity_of_both_scenes() {
    let folder = std::env::temp_dir().join(format!("teleop-viz-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let read = |name: &str, viz: &dyn Fn(Viewer) -> Viz, log: &dyn Fn(&Logger)| {
        let path = folder.join(name);
        let viz = viz(Viewer::Save(path.clone()));
        log(&viz.logger());
        viz.logger().log_text(0, Level::Warn, "a line");
        assert!(viz.shutdown(Duration::from_secs(10)), "not written");
        entities(&path)
    };
    let robot_paths =
        read("robot.rrd", &robot, &|logger| (0..20).for_each(|i| logger.log_robot(robot_frame(i * 20_000_000))));
    for path in
        ["hand", "hand/targets", "mapping/k", "mapping/e_C", "mapping/e_Q", "joints/ring", "mode", "timing", "log"]
    {
        assert!(robot_paths.contains(&format!("/robot/{path}")), "{path} is missing in {robot_paths:?}");
    }
    let start = |viewer| Viz::start(viewer, Scene::operator("test", HandSide::Left)).unwrap();
    let operator_paths = read("operator.rrd", &start, &|logger| {
        (0..20).for_each(|i| logger.log_operator(operator_frame(i * 20_000_000)))
    });
    for path in ["hand", "hand/palm", "hand/spheres", "distance", "network", "connection", "log"] {
        assert!(operator_paths.contains(&format!("/operator/{path}")), "{path} is missing in {operator_paths:?}");
    }
    std::fs::remove_dir_all(&folder).unwrap();
}

/// Entity paths in an `.rrd` file.
fn entities(path: &std::path::Path) -> std::collections::BTreeSet<String> {
    use rerun::external::re_log_encoding::DecoderApp;
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    DecoderApp::decode_lazy(file)
        .filter_map(|message| match message.unwrap() {
            rerun::log::LogMsg::ArrowMsg(_, message) => {
                Some(rerun::log::Chunk::from_arrow_msg(&message).unwrap().entity_path().to_string())
            }
            _ => None,
        })
        .collect()
}

#[test]
fn a_file_that_cannot_be_written_is_an_error() {
    let error =
        Viz::start(Viewer::Save("/nowhere/run.rrd".into()), Scene::operator("test", HandSide::Right)).unwrap_err();
    assert!(error.to_string().contains("/nowhere/run.rrd"), "{error}");
}

#[test]
fn the_first_hosts_the_second_joins_and_takes_over() {
    let options = options();
    let first = operator(options);
    assert!(log_until(&first.logger(), Duration::from_secs(10), || hosting(&first)), "{}", first.status());
    let second = robot(Viewer::Web(options));
    let logger = second.logger();
    assert!(log_until(&first.logger(), Duration::from_secs(10), || joined(&second)), "{}", second.status());
    assert!(first.shutdown(Duration::from_secs(5)));
    logger.log_robot(robot_frame(0));
    assert!(log_until(&Logger::off(), Duration::from_secs(15), || hosting(&second)), "{}", second.status());
    // The page is there again, too.
    assert!(TcpStream::connect((options.bind, options.page_port)).is_ok());
    assert!(second.shutdown(Duration::from_secs(5)));
}

#[test]
fn two_that_start_together_end_up_in_one_viewer() {
    let options = options();
    let (a, b) = (operator(options), robot(Viewer::Web(options)));
    let settled = || (hosting(&a) && joined(&b)) || (hosting(&b) && joined(&a));
    assert!(log_until(&a.logger(), Duration::from_secs(15), settled), "{} and {}", a.status(), b.status());
}

#[test]
fn a_joined_stream_survives_a_hub_that_goes_and_comes_back() {
    let options = options();
    let url = format!("connect=127.0.0.1:{}", options.grpc_port);
    let viz = robot(url.parse().unwrap());
    let waiting = || matches!(viz.status(), Status::Waiting { .. });
    assert!(log_until(&viz.logger(), Duration::from_secs(5), waiting));
    for _ in 0..2 {
        let hub = Hub::open(&options).unwrap();
        assert!(log_until(&Logger::off(), Duration::from_secs(10), || joined(&viz)), "{}", viz.status());
        drop(hub);
        assert!(log_until(&Logger::off(), Duration::from_secs(10), waiting), "{}", viz.status());
    }
    assert!(viz.shutdown(Duration::from_secs(2)));
}

#[test]
fn a_viewer_that_hangs_blocks_neither_the_logger_nor_the_end() {
    // Accepts connections and never reads.
    let silent = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address: SocketAddr = silent.local_addr().unwrap();
    let viz = robot(format!("connect={address}").parse().unwrap());
    let logger = viz.logger();
    let mut slowest = Duration::ZERO;
    let frame = robot_frame(0);
    for i in 0..600 {
        let start = Instant::now();
        logger.log_robot(RobotFrame { time: i * 3_000_000, ..frame });
        slowest = slowest.max(start.elapsed());
        std::thread::sleep(Duration::from_millis(3));
    }
    assert!(slowest < Duration::from_millis(50), "{slowest:?}");
    let start = Instant::now();
    viz.shutdown(Duration::from_millis(300));
    assert!(start.elapsed() < Duration::from_secs(2), "{:?}", start.elapsed());
}

#[test]
fn a_hub_says_what_is_wrong() {
    let mut options = options();
    let taken = TcpListener::bind((options.bind, options.grpc_port)).unwrap();
    let error = Hub::open(&options).unwrap_err();
    assert!(matches!(error, HubError::Taken(_)) && error.to_string().contains("connect="), "{error}");
    drop(taken);
    options.bind = [192, 0, 2, 1].into();
    let error = Hub::open(&options).unwrap_err();
    assert!(error.to_string().contains("192.0.2.1"), "{error}");
}

#[test]
fn a_taken_page_port_gives_the_next() {
    let options = options();
    let _taken = TcpListener::bind((options.bind, options.page_port)).unwrap();
    let hub = Hub::open(&options).unwrap();
    assert!(!hub.page().contains(&format!(":{}/", options.page_port)), "{}", hub.page());
    assert!(hub.page().ends_with(&format!("%3A{}%2Fproxy", options.grpc_port)), "{}", hub.page());
}
