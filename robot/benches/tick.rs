//! Time of a whole control tick with the simulated hand: `cargo bench -p teleop-robot --bench tick`.
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs, reason = "a bench reports on the terminal")]

#[path = "../../common/benches/speed/suite.rs"]
mod suite;

use std::hint::black_box;
use std::time::Duration;

use suite::Suite;
use teleop_common::authority::{Clutch, Latch};
use teleop_common::hand::{HandModel, HandSide, TipFrame};
use teleop_common::mapping::MappingParams;
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::time::MonoTime;
use teleop_robot::control::{ControlParams, Controller, PoseSample};
use teleop_robot::driver::{HandDriver, SimHand};

/// Ticks between two poses: about 100 poses a second.
const EVERY: u64 = 3;

fn main() {
    let mut suite = Suite::from_args();
    let hand = HandModel::allegro_v4(HandSide::Right);
    let params = ControlParams::default();
    let ticks: Vec<u64> = (0..(Gesture::Tour.duration() * params.rate) as u64).collect();
    suite.run("FK + Jacobian, four tips", &ticks[..2000], |_| {
        for chain in &hand.fingers {
            black_box(chain.tip_and_jacobian(&chain.select(&hand.home()), TipFrame::Pole));
        }
    });
    let mut driver = SimHand::new(&hand, 1.0 / params.rate);
    driver.start().unwrap();
    let mut controller = Controller::new(hand.clone(), MappingParams::default(), params).unwrap();
    let (mut now, mut sequence, mut clutch) = (MonoTime(1_000_000_000), 0, Clutch::default());
    suite.run("tick: mode, playout, mapping, guards, limits, torques; tour", &ticks, |tick| {
        now = now + Duration::from_secs_f64(1.0 / params.rate);
        let state = driver.read(Duration::ZERO).unwrap();
        if tick.is_multiple_of(EVERY) {
            sequence += 1;
            clutch = clutch.eager(controller.mode());
            let q = Gesture::Tour.sample(*tick as f64 / params.rate);
            let pose = MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None };
            controller.admit(&PoseSample::instant(now, sequence, pose, clutch));
        }
        let record = controller.tick(now, Latch::default(), &state);
        driver.write(&record.command).unwrap();
        black_box(&record);
    });
}
