//! One message of each kind, every field with a value of its own.

#![allow(dead_code, unreachable_pub, reason = "each test takes what it needs")]

use nalgebra::Vector3;
use teleop_common::authority::{Clutch, Intent, OperatorName};
use teleop_common::hand::{Finger, JointVector};
use teleop_common::ik::{IkReport, IkStatus};
use teleop_common::mapping::{FingerSignals, MappingOutput, Tuning};
use teleop_common::master::{MasterGeometry, MasterPose};
use teleop_common::time::MonoTime;
use teleop_common::wire::{
    ControlMessage, Echo, Header, HealthMessage, JointStateMessage, MappingMessage, PoseMessage, Quantiles, Request,
    pack_joints,
};

pub const EPOCH: u64 = 0x0123_4567_89ab_cdef;
pub const PEER: u64 = 0xfedc_ba98_7654_3210;

pub fn echo() -> Echo {
    Echo { epoch: PEER, sent: MonoTime(1_000_000_007), received: MonoTime(2_000_000_011) }
}

pub fn master_pose() -> MasterPose {
    let tuning = Tuning {
        scale: [1.5, 1.625, 1.75, 1.875, 2.0],
        r1: 0.020,
        r2: 0.075,
        contact: [0.0, 0.016, 0.017, 0.018, 0.019],
    };
    MasterPose {
        q: std::array::from_fn(|joint| 0.05 * joint as f64 - 0.25),
        geometry: MasterGeometry::PARADIGMATIC,
        tuning: Some(tuning),
    }
}

pub fn intent() -> Intent {
    Intent { clutch: Clutch(7), takeover: true, leaving: false, operator: OperatorName::new("ada@lab").unwrap() }
}

pub fn control() -> ControlMessage {
    ControlMessage::new(
        Header::new::<ControlMessage>(EPOCH, 46, MonoTime(7_000_000_047)),
        PEER,
        Request::Reset { stop: 5 },
    )
}

pub fn pose() -> PoseMessage {
    let header = Header::new::<PoseMessage>(EPOCH, 42, MonoTime(3_000_000_019));
    PoseMessage::new(header, echo(), MonoTime(2_999_000_000), &master_pose(), intent())
}

pub fn joint_state() -> JointStateMessage {
    let ramp = |start: f64| pack_joints(&std::array::from_fn::<f64, 16, _>(|joint| start + 0.125 * joint as f64));
    JointStateMessage {
        header: Header::new::<JointStateMessage>(EPOCH, 43, MonoTime(4_000_000_037)),
        echo: echo(),
        mode: 1,
        joints: 16,
        tick: 123_456,
        wall_offset_ns: -1_700_000_000_123_456_789,
        pose_epoch: PEER,
        pose_seq: 41,
        pose_captured: MonoTime(1_999_000_000),
        q: ramp(-1.0),
        dq: ramp(-0.5),
        tau: ramp(0.25),
        q_command: ramp(0.5),
        stop: 3,
        holder: PEER,
    }
}

pub fn mapping_output() -> MappingOutput {
    let signals = [Finger::Thumb, Finger::Index, Finger::Middle, Finger::Ring].map(|finger| {
        let base = 0.01 * (1.0 + finger.index() as f64);
        FingerSignals {
            finger,
            delta: base,
            k: 0.25 * finger.index() as f64,
            p_joint: Vector3::new(base, -base, 0.5),
            p_cartesian: Vector3::new(base, base, 0.25),
            p_input: Vector3::new(-base, base, 0.125),
            p: Vector3::new(-base, -base, 0.0625),
            e_q: base * 10.0,
            e_c: base * 0.5,
            ik: IkReport {
                status: [IkStatus::Skipped, IkStatus::Reached, IkStatus::Unreachable, IkStatus::Budget][finger.index()],
                residual: base * 0.1,
                ..IkReport::default()
            },
        }
    });
    let q = JointVector::from_slice(&std::array::from_fn::<f64, 16, _>(|joint| 0.1 * joint as f64 - 0.5));
    MappingOutput::new(q, q, &signals)
}

pub fn mapping() -> MappingMessage {
    let header = Header::new::<MappingMessage>(EPOCH, 44, MonoTime(5_000_000_041));
    MappingMessage::new(header, 123_457, 0.02, 0.04, &mapping_output())
}

pub fn health() -> HealthMessage {
    HealthMessage {
        header: Header::new::<HealthMessage>(EPOCH, 45, MonoTime(6_000_000_043)),
        mode: 2,
        fault: 7,
        ticks: 1_000_001,
        overruns: 17,
        tick_us: Quantiles { p50: 21.5, p95: 33.5, p99: 40.25, max: 97.75 },
        poses_accepted: 9_001,
        rejected: [1, 2, 3, 4, 5, 6, 7, 8, 9],
        holds: 3,
        age_ms: Quantiles { p50: 20.5, p95: 24.5, p99: 26.25, max: 31.75 },
        telemetry_dropped: 11,
        rate_hz: 333.25,
        operator: OperatorName::new("ada@lab").unwrap(),
        stages: [0.5, 1.5, 2.5, 3.5].map(|p50| Quantiles { p50, p95: p50 + 4.0, p99: p50 + 8.0, max: p50 + 16.0 }),
        total_ms: Quantiles { p50: 8.0, p95: 16.0, p99: 24.0, max: 32.0 },
    }
}
