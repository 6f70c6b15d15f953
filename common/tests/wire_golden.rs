//! The bytes of each kind of message, so that no change of a layout goes unnoticed: if one of these fails, raise
//! `PROTOCOL`. Regenerate a vector only after that, with `cargo test -p teleop-common --test wire_golden -- --nocapture`.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod samples;

use std::fmt::Write as _;

use samples::{control, health, joint_state, mapping, pose};
use teleop_common::wire::{MAX_MESSAGE, Message, decode, encode_into};

#[track_caller]
fn golden<M: Message + PartialEq + std::fmt::Debug>(message: &M, file: &str, expected: &str) {
    let mut buffer = [0; MAX_MESSAGE];
    let len = encode_into(message, &mut buffer).unwrap();
    assert_eq!(len, M::LEN);
    let hex = buffer[..len].chunks(32).fold(String::new(), |mut out, line| {
        line.iter().for_each(|byte| write!(out, "{byte:02x}").unwrap());
        out + "\n"
    });
    assert_eq!(hex, expected, "bytes of {file} changed; now they are:\n{hex}");
    assert_eq!(*decode::<M>(&buffer[..len]).unwrap(), *message);
}

#[test]
fn pose_bytes() {
    golden(&pose(), "pose.hex", include_str!("golden/pose.hex"));
}

#[test]
fn joint_state_bytes() {
    golden(&joint_state(), "joint_state.hex", include_str!("golden/joint_state.hex"));
}

#[test]
fn mapping_bytes() {
    golden(&mapping(), "mapping.hex", include_str!("golden/mapping.hex"));
}

#[test]
fn control_bytes() {
    golden(&control(), "control.hex", include_str!("golden/control.hex"));
}

#[test]
fn health_bytes() {
    golden(&health(), "health.hex", include_str!("golden/health.hex"));
}

/// Bytes at the offsets that WIRE.md gives, read without the codec.
#[test]
fn offsets_of_the_document() {
    let mut bytes = [0; MAX_MESSAGE];
    let u64_at = |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    let f32_at = |bytes: &[u8], at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());

    let message = pose();
    encode_into(&message, &mut bytes).unwrap();
    assert_eq!(&bytes[..8], b"ALGT\x04\x00\x01\x00");
    assert_eq!(u64_at(&bytes, 8), message.header.epoch);
    assert_eq!(u64_at(&bytes, 16), message.header.seq);
    assert_eq!(u64_at(&bytes, 24), message.header.sent.0);
    assert_eq!(u64_at(&bytes, 32), message.echo.epoch);
    assert_eq!(u64_at(&bytes, 40), message.echo.sent.0);
    assert_eq!(u64_at(&bytes, 48), message.echo.received.0);
    assert_eq!(u64_at(&bytes, 56), message.captured.0);
    assert_eq!(f32_at(&bytes, 64 + 4 * 19), message.q[19]);
    assert_eq!(f32_at(&bytes, 144 + 12 * 4), message.bases[4][0]);
    assert_eq!(f32_at(&bytes, 204 + 12 * 4 + 8), message.phalanges[4][2]);

    assert_eq!(f32_at(&bytes, 264 + 4 * 4), message.tuning.scale[4]);
    assert_eq!(f32_at(&bytes, 284), message.tuning.r1);
    assert_eq!(f32_at(&bytes, 288), message.tuning.r2);
    assert_eq!(f32_at(&bytes, 292 + 4 * 4), message.tuning.contact[4]);

    assert_eq!(bytes[312..317], [7, 0, 0, 0, 1]);
    assert_eq!(&bytes[317..333], b"ada@lab\0\0\0\0\0\0\0\0\0");

    let message = control();
    encode_into(&message, &mut bytes).unwrap();
    assert_eq!(bytes[32], 2);
    assert_eq!(u64_at(&bytes, 33), message.robot);
    assert_eq!(bytes[41..45], [5, 0, 0, 0]);

    let message = joint_state();
    encode_into(&message, &mut bytes).unwrap();
    assert_eq!(&bytes[56..58], &[1, 16]);
    assert_eq!(u64_at(&bytes, 58), message.tick);
    assert_eq!(u64_at(&bytes, 66), message.wall_offset_ns as u64);
    assert_eq!(u64_at(&bytes, 74), message.pose_epoch);
    assert_eq!(u64_at(&bytes, 82), message.pose_seq);
    assert_eq!(u64_at(&bytes, 90), message.pose_captured.0);
    for (at, values) in [(98, message.q), (198, message.dq), (298, message.tau), (398, message.q_command)] {
        assert_eq!(f32_at(&bytes, at + 4 * 15), values[15]);
    }

    assert_eq!(bytes[498..502], [3, 0, 0, 0]);
    assert_eq!(u64_at(&bytes, 502), message.holder);

    let message = mapping();
    encode_into(&message, &mut bytes).unwrap();
    assert_eq!(u64_at(&bytes, 32), message.tick);
    assert_eq!(f32_at(&bytes, 40), message.r1);
    assert_eq!(f32_at(&bytes, 44), message.r2);
    assert_eq!(&bytes[48..50], &[4, 16]);
    assert_eq!(f32_at(&bytes, 50), message.q_joint[0]);
    let ring = 150 + 3 * 70;
    let signals = &message.signals[3];
    assert_eq!(bytes[ring], 3);
    assert_eq!(f32_at(&bytes, ring + 1), signals.delta);
    assert_eq!(f32_at(&bytes, ring + 5), signals.k);
    for (at, point) in [(9, signals.p_joint), (21, signals.p_cartesian), (33, signals.p_input), (45, signals.p)] {
        assert_eq!(f32_at(&bytes, ring + at + 8), point[2]);
    }
    assert_eq!(f32_at(&bytes, ring + 57), signals.e_q);
    assert_eq!(f32_at(&bytes, ring + 61), signals.e_c);
    assert_eq!(bytes[ring + 65], signals.ik);
    assert_eq!(f32_at(&bytes, ring + 66), signals.residual);

    let message = health();
    encode_into(&message, &mut bytes).unwrap();
    assert_eq!(&bytes[32..34], &[2, 7]);
    assert_eq!(u64_at(&bytes, 34), message.ticks);
    assert_eq!(u64_at(&bytes, 42), message.overruns);
    assert_eq!(f32_at(&bytes, 58), message.tick_us.p99);
    assert_eq!(u64_at(&bytes, 66), message.poses_accepted);
    assert_eq!(u64_at(&bytes, 74 + 8 * 8), message.rejected[8]);
    assert_eq!(u64_at(&bytes, 146), message.holds);
    assert_eq!(f32_at(&bytes, 154), message.age_ms.p50);
    assert_eq!(u64_at(&bytes, 170), message.telemetry_dropped);
    assert_eq!(f32_at(&bytes, 178), message.rate_hz);
    assert_eq!(&bytes[182..189], b"ada@lab");
    assert_eq!(f32_at(&bytes, 198 + 3 * 16 + 4), message.stages[3].p95);
    assert_eq!(f32_at(&bytes, 262 + 12), message.total_ms.max);
}
