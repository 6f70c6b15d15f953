//! The live picture without processes and network: one gesture, mapped and shown.
//!
//! `cargo run --release --example viz_demo --features viz -- [VIEWER] [SECONDS] [GESTURE] [right|left]`

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use teleop_common::hand::{HandModel, HandSide};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::mode::Mode;
use teleop_common::viz::{Level, OperatorFrame, RobotFrame, Scene, Viewer, Viz};

#[allow(clippy::print_stdout, reason = "an example talks to its user")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let viewer: Viewer = args.next().as_deref().unwrap_or("web").parse()?;
    let seconds: f64 = args.next().as_deref().unwrap_or("60").parse()?;
    let gesture = Gesture::parse(args.next().as_deref().unwrap_or("tour"))?;
    let side = if args.next().as_deref() == Some("left") { HandSide::Left } else { HandSide::Right };

    let hand = HandModel::allegro_v4(side);
    let params = MappingParams::default();
    let (r1, r2) = (params.r1, params.r2);
    let mut retargeter = Retargeter::new(hand.clone(), params)?;
    let robot = Viz::start(viewer.clone(), Scene::robot("demo", &hand))?;
    // A file takes one stream; a hub takes both.
    let second = match viewer {
        Viewer::Save(path) => Viewer::Save(path.with_extension("operator.rrd")),
        viewer => viewer,
    };
    let operator = Viz::start(second, Scene::operator("demo", side))?;
    let (log_robot, log_operator) = (robot.logger(), operator.logger());

    let start = Instant::now();
    let (mut q, mut dq) = (hand.home(), hand.home());
    let mut said = None;
    let mut slowest = Duration::ZERO;
    let mut tick = 0_u32;
    while start.elapsed().as_secs_f64() < seconds {
        let t = f64::from(tick) * 0.003;
        let time = i64::try_from(SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos())?;
        let pose = MasterPose { q: gesture.sample(t % gesture.duration()), geometry: MasterGeometry::PARADIGMATIC };
        let output = retargeter.map(&pose);
        for (i, target) in output.q.iter().enumerate() {
            // A hand that follows with a lag of 40 ms.
            dq[i] = (target - q[i]) / 0.04;
            q[i] += dq[i] * 0.003;
        }
        let frame = RobotFrame {
            time,
            q,
            dq,
            q_command: output.q,
            mapping: Some(output),
            mode: if t < 1.0 { Mode::Idle } else { Mode::Engaged },
            pose_age: Some(0.004 + 0.002 * (t * 7.0).sin()),
            tick: Some(0.000_2),
        };
        let before = Instant::now();
        log_robot.log_robot(frame);
        if tick.is_multiple_of(3) {
            let round_trip = Some(0.003 + 0.001 * (t * 5.0).cos());
            log_operator.log_operator(OperatorFrame { time, pose, r1, r2, residual: None, round_trip });
        }
        slowest = slowest.max(before.elapsed());
        if tick == 0 {
            log_robot.log_text(time, Level::Info, "allegro-v4: following");
            log_operator.log_text(time, Level::Warn, "this is a demonstration without a network");
        }
        let status = (robot.status(), operator.status());
        if said.as_ref() != Some(&status) {
            println!("robot: {}\noperator: {}", status.0, status.1);
            said = Some(status);
        }
        tick += 1;
        let next = start + Duration::from_secs_f64(f64::from(tick) * 0.003);
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
    println!("slowest log call {slowest:?}, dropped {} and {}", robot.dropped(), operator.dropped());
    let left = Duration::from_secs(2);
    println!("written: {} {}", operator.shutdown(left), robot.shutdown(left));
    Ok(())
}
