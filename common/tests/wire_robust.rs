//! The codec door against everything that is not a valid message: it says no, without panic and without allocating.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod samples;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use proptest::prelude::*;
use samples::{control, health, joint_state, mapping, master_pose, pose};
use teleop_common::mapping::Tuning;
use teleop_common::master::MasterPose;
use teleop_common::time::MonoTime;
use teleop_common::wire::{
    Checked, ControlMessage, Header, HealthMessage, JointStateMessage, MAX_MESSAGE, MappingMessage, Message, PROTOCOL,
    PoseMessage, TuningMessage, WireError, decode, encode_into,
};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// Counts what each thread allocates.
struct Counting;

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ended = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's contract is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's contract is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let _ended = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's contract is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[track_caller]
fn without_allocating<T>(work: impl FnOnce() -> T) -> T {
    let before = ALLOCATIONS.get();
    let out = work();
    assert_eq!(ALLOCATIONS.get() - before, 0, "allocations");
    out
}

fn encoded<M: Message>(message: &M) -> Vec<u8> {
    let mut buffer = [0; MAX_MESSAGE];
    let len = without_allocating(|| encode_into(message, &mut buffer)).unwrap();
    buffer[..len].to_vec()
}

/// Decodes as every kind; whatever is accepted encodes to the same bytes but for the flags, which are ignored.
fn decode_all(bytes: &[u8]) {
    fn one<M: Message>(bytes: &[u8]) {
        if let Ok(message) = without_allocating(|| decode::<M>(bytes)) {
            assert_eq!(encoded(&*message), bytes);
        }
    }
    one::<PoseMessage>(bytes);
    one::<JointStateMessage>(bytes);
    one::<MappingMessage>(bytes);
    one::<HealthMessage>(bytes);
    one::<ControlMessage>(bytes);
}

#[test]
fn the_counter_counts() {
    let before = ALLOCATIONS.get();
    drop(std::hint::black_box(vec![1_u8; 100]));
    assert!(ALLOCATIONS.get() > before);
}

#[test]
fn truncation_and_trailing_bytes() {
    fn one<M: Message>(message: &M) {
        let bytes = encoded(message);
        for len in 0..bytes.len() {
            let error = without_allocating(|| decode::<M>(&bytes[..len]).map(|_| ()).unwrap_err());
            let expected = if len < Header::LEN {
                WireError::TooShort { found: len }
            } else {
                WireError::Length { kind: M::KIND, expected: M::LEN, found: len }
            };
            assert_eq!(error, expected);
        }
        for extra in [1, 3, 1000, 1 << 20] {
            let mut long = bytes.clone();
            long.resize(bytes.len() + extra, 0);
            let error = without_allocating(|| decode::<M>(&long).map(|_| ()).unwrap_err());
            assert_eq!(error, WireError::Length { kind: M::KIND, expected: M::LEN, found: long.len() });
        }
        for len in 0..bytes.len() {
            let error = encode_into(message, &mut vec![0; len]).unwrap_err();
            assert_eq!(error, WireError::Buffer { expected: M::LEN, found: len });
        }
    }
    one(&pose());
    one(&joint_state());
    one(&mapping());
    one(&health());
    one(&control());
}

#[test]
fn every_bit_flip() {
    for bytes in
        [encoded(&pose()), encoded(&joint_state()), encoded(&mapping()), encoded(&health()), encoded(&control())]
    {
        for bit in 0..8 * bytes.len() {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            // Flags are the one thing receivers ignore; see `decode_all` for the rest.
            decode_all(&flipped);
        }
    }
}

#[test]
fn header_errors_say_what_is_wrong() {
    let mut bytes = encoded(&pose());
    bytes[4] = 9;
    let error = decode::<PoseMessage>(&bytes).unwrap_err();
    assert_eq!(error, WireError::Protocol { ours: PROTOCOL, theirs: 9 });
    let text = format!("peer speaks wire protocol 9, this side speaks {PROTOCOL}: run the same release on both ends");
    assert_eq!(error.to_string(), text);
    bytes[0] = b'X';
    assert_eq!(decode::<PoseMessage>(&bytes).unwrap_err(), WireError::Magic { found: *b"XLGT" });

    let bytes = encoded(&health());
    let error = decode::<PoseMessage>(&bytes).unwrap_err().to_string();
    assert_eq!(error, "message kind 4 where Pose (1) belongs");

    let mut message = pose();
    message.header = Header::new::<HealthMessage>(1, 1, MonoTime(1));
    assert!(matches!(encode_into(&message, &mut [0; MAX_MESSAGE]), Err(WireError::Kind { found: 4, .. })));
}

/// Overwrites bytes of an encoded message and gives what decoding says.
fn poisoned<M: Message>(message: &M, at: usize, value: &[u8]) -> Result<Checked<M>, WireError> {
    let mut bytes = encoded(message);
    bytes[at..at + value.len()].copy_from_slice(value);
    decode::<M>(&bytes)
}

#[track_caller]
fn bad_pose(at: usize, value: f32, says: &str) {
    let error = poisoned(&pose(), at, &value.to_le_bytes()).unwrap_err();
    assert!(matches!(error, WireError::Pose(_)) && error.to_string().contains(says), "{error}");
}

#[track_caller]
fn rejected<M: Message>(message: &M, at: usize, value: &[u8], field: &str) {
    let error = poisoned(message, at, value).map(|_| ()).unwrap_err();
    let (WireError::Value { field: found, .. } | WireError::Code { field: found, .. }) = error else {
        panic!("{error}")
    };
    assert_eq!(found, field, "{error}");
}

/// The offsets of all floats of each kind, from WIRE.md.
#[test]
fn every_float_must_be_finite() {
    fn one<M: Message>(message: &M, floats: impl IntoIterator<Item = usize>) {
        for at in floats {
            for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN] {
                let error = poisoned(message, at, &value.to_le_bytes()).map(|_| ()).unwrap_err();
                let value = matches!(error, WireError::Value { .. } | WireError::Code { .. } | WireError::Pose(_));
                assert!(value, "{at}: {error}");
            }
        }
    }
    let row = |start: usize, count: usize| (0..count).map(move |index| start + 4 * index);
    one(&pose(), row(64, 62));
    one(&joint_state(), row(98, 100));
    let signals = (0..5).flat_map(|finger| row(150 + 70 * finger + 1, 16).chain([150 + 70 * finger + 66]));
    one(&mapping(), [40, 44].into_iter().chain(row(50, 25)).chain(signals));
    one(&health(), row(50, 4).chain(row(154, 4)).chain([178]).chain(row(198, 20)));
}

#[test]
fn values_out_of_range() {
    let f = |value: f32| value.to_le_bytes();
    bad_pose(64, 6.3, "joint 0 of the thumb");
    bad_pose(204, 0.0029, "phalanx 0 of the thumb");
    bad_pose(204 + 12 * 4 + 8, 0.151, "phalanx 2 of the little");
    bad_pose(144, 0.251, "base of the thumb");
    bad_pose(144 + 4, 0.249, "base of the thumb"); // with its x of 0.037 the norm is 0.2517
    bad_pose(144 + 12 * 2, 0.0241, "index"); // middle beyond index
    bad_pose(144 + 12 * 3, 0.008, "ring"); // ring where middle is
    bad_pose(144 + 12 * 4, 0.0, "little"); // little beyond ring
    bad_pose(264 + 4, 10.1, "scale of the index");
    bad_pose(284, 0.0, "r1");
    bad_pose(288, 0.0205, "r2 of the thumb is 0.0205");
    bad_pose(292 + 4 * 4, -0.001, "contact of the little");
    bad_pose(292 + 4, 0.021, "contact of the index"); // beyond r1
    let state = joint_state();
    rejected(&state, 56, &[8], "mode");
    rejected(&state, 57, &[0], "joints");
    rejected(&state, 57, &[26], "joints");
    rejected(&state, 57, &[15], "q"); // a value beyond the hand's joints
    rejected(&state, 398 + 4 * 24, &f(0.5), "q_command");
    let mapping = mapping();
    rejected(&mapping, 44, &f(0.019), "r2");
    rejected(&mapping, 48, &[0], "fingers");
    rejected(&mapping, 48, &[6], "fingers");
    rejected(&mapping, 48, &[3], "finger"); // signals beyond the hand's fingers
    rejected(&mapping, 49, &[26], "joints");
    rejected(&mapping, 150, &[1], "finger"); // two index fingers
    rejected(&mapping, 150 + 3 * 70, &[5], "finger");
    rejected(&mapping, 150 + 5, &f(1.01), "k");
    rejected(&mapping, 150 + 1, &f(-0.01), "delta");
    rejected(&mapping, 150 + 65, &[4], "ik");
    rejected(&health(), 32, &[8], "mode");
    rejected(&health(), 178, &f(-1.0), "rate_hz");
    rejected(&pose(), 316, &[4], "request");
    rejected(&control(), 32, &[0], "request");
    rejected(&control(), 32, &[3], "request");
    for name in [&b"a\x07"[..], b"\0a"] {
        let errors = [poisoned(&pose(), 317, name).map(|_| ()), poisoned(&health(), 182, name).map(|_| ())];
        assert_eq!(errors, [Err(WireError::Name { field: "operator" }); 2]);
    }
}

#[test]
fn nothing_invalid_is_sent() {
    let mut message = pose();
    message.q[7] = f32::NAN;
    let error = encode_into(&message, &mut [0; MAX_MESSAGE]).unwrap_err();
    assert_eq!(error.to_string(), "joint 3 of the index is NaN rad; angles are finite and within +-2 pi");
}

#[test]
fn flags_are_ignored() {
    assert!(poisoned(&pose(), 7, &[0xff]).is_ok());
}

#[test]
fn pose_survives_in_single_precision() {
    let sent = master_pose();
    let got: MasterPose = decode::<PoseMessage>(&encoded(&pose())).unwrap().pose();
    let numbers = |pose: &MasterPose| {
        let geometry = pose.geometry;
        let Tuning { scale, r1, r2, contact } = pose.tuning.unwrap();
        let hand = [&pose.q[..], geometry.bases.as_flattened(), geometry.phalanges.as_flattened()].concat();
        [&hand[..], &scale, &[r1, r2], &contact].concat()
    };
    for (sent, got) in numbers(&sent).iter().zip(numbers(&got)) {
        assert!((sent - got).abs() <= 6e-8 * sent.abs(), "{sent} {got}");
    }
    // Without a tuning, twelve zeros.
    let mut message = pose();
    message.tuning = TuningMessage::default();
    assert_eq!(decode::<PoseMessage>(&encoded(&message)).unwrap().pose().tuning, None);
}

#[test]
fn mapping_survives_in_single_precision() {
    let sent = samples::mapping_output();
    let got = decode::<MappingMessage>(&encoded(&mapping())).unwrap();
    assert_eq!(got.fingers().len(), 4);
    assert_eq!(got.q_joint().len(), 16);
    for (sent, got) in sent.fingers().iter().zip(got.fingers()) {
        let got = got.signals().unwrap();
        assert_eq!((sent.finger, sent.ik.status), (got.finger, got.ik.status));
        assert!((sent.p_cartesian - got.p_cartesian).norm() < 1e-7);
        assert!((sent.e_q - got.e_q).abs() < 1e-7 && (sent.k - got.k).abs() < 1e-7);
    }
}

proptest! {
    #[test]
    fn pose_round_trip(
        q in prop::array::uniform20(-6.2_f32..6.2),
        radial in prop::array::uniform5(-0.01_f32..0.01),
        phalanges in prop::collection::vec(0.0031_f32..0.149, 15),
        stamps in prop::array::uniform6(any::<u64>()),
    ) {
        let mut message = pose();
        message.q = q;
        for (finger, base) in message.bases.iter_mut().enumerate() {
            *base = [0.1 - 0.03 * finger as f32 + radial[finger], 0.05 + radial[finger], radial[4 - finger]];
        }
        message.phalanges = std::array::from_fn(|finger| std::array::from_fn(|bone| phalanges[3 * finger + bone]));
        message.header = Header::new::<PoseMessage>(stamps[0], stamps[1], MonoTime(stamps[2]));
        message.echo.epoch = stamps[3];
        message.echo.sent = MonoTime(stamps[4]);
        message.captured = MonoTime(stamps[5]);
        let bytes = encoded(&message);
        prop_assert_eq!(*without_allocating(|| decode::<PoseMessage>(&bytes)).unwrap(), message);
    }

    #[test]
    fn joint_state_round_trip(
        joints in 1..=25_usize,
        values in prop::collection::vec(-99.0_f32..99.0, 25),
        mode in 0..8_u8,
        counts in prop::array::uniform4(any::<u64>()),
        wall in any::<i64>(),
    ) {
        let mut message = joint_state();
        let row = |gain: f32| std::array::from_fn(|joint| if joint < joints { gain * values[joint] } else { 0.0 });
        (message.q, message.dq, message.tau, message.q_command) = (row(1.0), row(10.0), row(-2.0), row(-1.0));
        (message.mode, message.joints, message.wall_offset_ns) = (mode, joints as u8, wall);
        [message.tick, message.pose_epoch, message.pose_seq, message.pose_captured.0] = counts;
        let bytes = encoded(&message);
        let got = decode::<JointStateMessage>(&bytes).unwrap();
        prop_assert_eq!(*got, message);
        prop_assert_eq!(got.q_command().len(), joints);
    }

    #[test]
    fn health_round_trip(counts in prop::collection::vec(any::<u64>(), 13), times in prop::array::uniform7(0.0_f32..1e6)) {
        let mut message = health();
        [message.ticks, message.overruns, message.poses_accepted, message.telemetry_dropped] =
            std::array::from_fn(|index| counts[index]);
        message.rejected = std::array::from_fn(|index| counts[4 + index]);
        (message.tick_us.p50, message.age_ms.max, message.rate_hz) = (times[0], times[1], times[2]);
        let bytes = encoded(&message);
        prop_assert_eq!(*decode::<HealthMessage>(&bytes).unwrap(), message);
    }

    #[test]
    fn garbage(bytes in prop::collection::vec(any::<u8>(), 0..1100)) {
        decode_all(&bytes);
    }

    /// Garbage behind a right header and of the right length, which reaches the values.
    #[test]
    fn garbage_values(kind in 1..=5_u8, bytes in prop::collection::vec(any::<u8>(), 500)) {
        let mut bytes = bytes;
        bytes.truncate([333, 510, 500, 278, 45][usize::from(kind) - 1]);
        bytes[..8].copy_from_slice(b"ALGT\x03\x00\x00\x00");
        bytes[6] = kind;
        decode_all(&bytes);
    }
}
