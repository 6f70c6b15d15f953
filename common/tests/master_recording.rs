//! Recordings: both formats, their errors, cut files, garbage.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod master_support;

use std::fs;
use std::io::Cursor;

use master_support::keypoints;
use proptest::prelude::*;
use teleop_common::hand::HandSide;
use teleop_common::mapping::MappingParams;
use teleop_common::master::{Gesture, KEYPOINT_NAMES, MasterGeometry, OPEN};
use teleop_common::recording::{
    Frame, FrameData, FrameError, LastLine, MAX_LINE, MAX_MESSAGE, RecordingError, RecordingHeader, RecordingReader,
    RecordingWriter, parse_hand_json,
};
use teleop_common::testing::shared_data;

type Frames = Result<Vec<Frame>, RecordingError>;

fn read(text: impl AsRef<[u8]>) -> Frames {
    RecordingReader::new(Cursor::new(text), LastLine::Whole)?.collect()
}

fn error(text: impl AsRef<[u8]>) -> String {
    read(text).unwrap_err().to_string()
}

fn frames() -> Vec<Frame> {
    (0..20)
        .map(|i| {
            let t = f64::from(i) / 30.0 + 0.1;
            let q = Gesture::Tour.sample(t);
            let data = if i % 3 == 0 {
                FrameData::Keypoints(keypoints(&MasterGeometry::PARADIGMATIC, &q))
            } else {
                FrameData::Joints(q)
            };
            Frame { t, data }
        })
        .collect()
}

fn header() -> RecordingHeader {
    RecordingHeader {
        side: Some(HandSide::Right),
        geometry: Some(MasterGeometry::PARADIGMATIC),
        tuning: Some(MappingParams::default().tuned(None)),
        source: Some("tour".into()),
    }
}

fn written() -> Vec<u8> {
    let mut writer = RecordingWriter::new(Vec::new(), &header()).unwrap();
    frames().iter().for_each(|frame| writer.write(frame).unwrap());
    writer.into_inner()
}

/// Every number of `a`, time first.
fn numbers(a: &Frame) -> Vec<f64> {
    let mut numbers = vec![a.t];
    match &a.data {
        FrameData::Joints(q) => numbers.extend(q),
        FrameData::Keypoints(keypoints) => numbers.extend(keypoints.points().as_flattened()),
    }
    numbers
}

/// Equal up to the last digit, which JSON's fast float parser may miss.
fn assert_same(a: &[Frame], b: &[Frame]) {
    assert_eq!(a.len(), b.len());
    for (a, b) in a.iter().zip(b) {
        let (x, y) = (numbers(a), numbers(b));
        assert_eq!(x.len(), y.len(), "joints against keypoints");
        assert!(x.iter().zip(y).all(|(x, y)| (x - y).abs() <= 2.0 * f64::EPSILON * x.abs()), "{a:?} {b:?}");
    }
}

fn joints(q: &[f64]) -> String {
    format!("{q:?}")
}

fn csv_header() -> String {
    let columns: Vec<String> =
        KEYPOINT_NAMES.iter().flat_map(|name| ["x", "y", "z"].map(|axis| format!("{name}_{axis}"))).collect();
    format!("frame,time_s,{}\n", columns.join(","))
}

fn csv_row(frame: u32, t: f64) -> String {
    let points = *keypoints(&MasterGeometry::PARADIGMATIC, &OPEN).points();
    let values: Vec<String> = points.as_flattened().iter().map(|x| format!("{x:.7}")).collect();
    format!("{frame},{t},{}\n", values.join(","))
}

#[test]
fn what_is_written_is_read() {
    let bytes = written();
    let mut reader = RecordingReader::new(Cursor::new(&bytes), LastLine::Whole).unwrap();
    assert_eq!(reader.header(), &header());
    let read: Vec<Frame> = reader.by_ref().map(Result::unwrap).collect();
    assert_same(&read, &frames());
    assert!(!reader.is_cut());
    assert!(bytes.starts_with(br#"{"format":"allegro-teleop-recording","version":1,"#));
}

#[test]
fn cut_anywhere_all_whole_lines_are_read() {
    let bytes = written();
    let first = bytes.iter().position(|&b| b == b'\n').unwrap() + 1;
    for end in first..bytes.len() {
        let whole = bytes[..end].iter().filter(|&&b| b == b'\n').count() - 1;
        let mut reader = RecordingReader::new(Cursor::new(&bytes[..end]), LastLine::MayBeCut).unwrap();
        assert_eq!(reader.by_ref().map(Result::unwrap).count(), whole, "cut at {end}");
        assert_eq!(reader.is_cut(), bytes[end - 1] != b'\n', "cut at {end}");
        if bytes[end - 1] == b'\n' || bytes[end] == b'\n' {
            assert!(read(&bytes[..end]).is_ok(), "a whole last line needs no line feed");
        } else {
            let line = whole as u64 + 2;
            assert!(matches!(read(&bytes[..end]), Err(RecordingError::Cut { line: l }) if l == line), "cut at {end}");
        }
    }
}

#[test]
fn json_lines_without_header() {
    let text = format!("{{\"t\":0.5,\"q\":{}}}\r\n\n{{\"q\":{},\"t\":1}}\n", joints(&OPEN), joints(&OPEN));
    let frames = read(text).unwrap();
    assert_eq!(frames.iter().map(|frame| frame.t).collect::<Vec<_>>(), [0.5, 1.0]);
    assert!(frames.iter().all(|frame| frame.data == FrameData::Joints(OPEN)));
}

#[test]
fn json_errors_name_line_and_field() {
    let good = format!("{{\"t\":0,\"q\":{}}}\n", joints(&OPEN));
    let second = |line: &str| error(format!("{good}{line}\n"));
    assert_eq!(second(r#"{"t":1}"#), "line 2: missing field `q` or `keypoints`");
    assert_eq!(second(&format!("{{\"q\":{}}}", joints(&OPEN))), "line 2: missing field `t`");
    assert_eq!(second(r#"{"t":1,"q":[0,0]}"#), "line 2: `q` has 2 elements; expected 20");
    assert_eq!(second(r#"{"t":1,"keypoints":[[0,0,0]]}"#), "line 2: `keypoints` has 1 elements; expected 21");
    let points = vec!["[0,0]"; 21].join(",");
    let short = second(&format!("{{\"t\":1,\"keypoints\":[{points}]}}"));
    assert_eq!(short, "line 2: `keypoints[0]` has 2 elements; expected 3");
    let unknown = second(r#"{"t":1,"joints":[]}"#);
    assert!(unknown.starts_with("line 2: unknown field `joints`, expected one of `t`, `q`, `keypoints`"), "{unknown}");
    let mut q = OPEN;
    q[7] = 90.0;
    let degrees = second(&format!("{{\"t\":1,\"q\":{}}}", joints(&q)));
    assert_eq!(degrees, "line 2: `q[7]` is 90; expected a finite angle within +-2 pi rad (degrees?)");
    let huge = second(r#"{"t":1e999,"q":[]}"#);
    assert!(huge.starts_with("line 2: number out of range"), "{huge}");
    let both = format!("{{\"t\":1,\"q\":{},\"keypoints\":[]}}", joints(&OPEN));
    assert_eq!(second(&both), "line 2: both `q` and `keypoints`; a frame has one of them");
    assert_eq!(second(good.trim_end()), "line 2: time 0 s does not come after 0 s");
    assert!(second("nonsense").starts_with("line 2: expected"), "{}", second("nonsense"));
    let mut points = *keypoints(&MasterGeometry::PARADIGMATIC, &OPEN).points();
    points[12] = points[11];
    let coincide = second(&format!("{{\"t\":1,\"keypoints\":{points:?}}}"));
    assert!(coincide.starts_with("line 2: middle_dip and middle_tip are 0 m apart"), "{coincide}");
}

#[test]
fn header_errors() {
    assert!(matches!(read(""), Err(RecordingError::Empty)));
    assert!(matches!(read("\n\n"), Err(RecordingError::Empty)));
    let version = error("{\"format\":\"allegro-teleop-recording\",\"version\":9}\n");
    assert_eq!(version, "line 1: recording has version 9; this program reads version 1");
    assert!(matches!(read("{\"format\":\"rosbag\"}\n"), Err(RecordingError::Format { found }) if found == "rosbag"));
    let unknown = error("{\"format\":\"allegro-teleop-recording\",\"version\":1,\"colour\":3}\n");
    assert!(unknown.contains("line 1") && unknown.contains("`colour`"), "{unknown}");
    let mut header = header();
    header.geometry.as_mut().unwrap().phalanges[0][0] = 25.0;
    let bytes = RecordingWriter::new(Vec::new(), &header).unwrap().into_inner();
    assert!(matches!(read(bytes), Err(RecordingError::Geometry(_))));
}

#[test]
fn csv_errors_name_line_and_column() {
    let good = csv_header() + &csv_row(0, 0.0);
    assert_eq!(read(&good).unwrap().len(), 1);
    assert_eq!(read(good.trim_end()).unwrap().len(), 1);
    let wrong = error(good.replacen("index_pip_y", "index_pip_w", 1));
    assert_eq!(wrong, "line 1: column 22 is `index_pip_w`, expected `index_pip_y`");
    assert_eq!(error("a,b\n"), "line 1: column 1 is `a`, expected `frame`");
    assert!(matches!(read(csv_header().replace('\n', ",more\n")), Err(RecordingError::Columns { line: 1, found: 66 })));
    assert!(matches!(read(good.clone() + "1,2,3\n"), Err(RecordingError::Columns { line: 3, found: 3 })));
    for bad in ["x", "NaN", "inf", ""] {
        let row = csv_row(1, 1.0).replacen("0.1550000", bad, 1);
        assert_eq!(error(good.clone() + &row), format!("line 3: index_tip_y is `{bad}`, expected a finite number"));
    }
    let error = error(good.clone() + &csv_row(1, -1.0));
    assert_eq!(error, "line 3: time -1 s does not come after 0 s");
    let cut = good.clone() + &csv_row(1, 1.0)[..300];
    assert!(matches!(read(&cut), Err(RecordingError::Cut { line: 3 })));
    let mut reader = RecordingReader::new(Cursor::new(cut), LastLine::MayBeCut).unwrap();
    assert_eq!((reader.by_ref().map(Result::unwrap).count(), reader.is_cut()), (1, true));
}

#[test]
fn lines_are_bounded_and_text() {
    let long = format!("{{\"t\":0,\"q\":[{}]}}\n", "0,".repeat(MAX_LINE));
    assert!(matches!(read(long), Err(RecordingError::LineTooLong { line: 1 })));
    assert!(matches!(read(b"{\"t\":\xff}\n"), Err(RecordingError::NotUtf8 { line: 1 })));
    let mut reader =
        RecordingReader::new(Cursor::new(csv_header() + "x\n" + &csv_row(0, 0.0)), LastLine::Whole).unwrap();
    assert!(reader.next().unwrap().is_err());
    assert!(reader.next().is_none(), "nothing comes after an error");
}

#[test]
fn writer_refuses_what_the_reader_would() {
    let mut writer = RecordingWriter::new(Vec::new(), &RecordingHeader::default()).unwrap();
    let frame = |t| Frame { t, data: FrameData::Joints(OPEN) };
    assert!(writer.write(&frame(f64::NAN)).is_err());
    writer.write(&frame(1.0)).unwrap();
    assert!(matches!(writer.write(&frame(1.0)), Err(RecordingError::Time { line: 3, .. })));
    let mut q = OPEN;
    q[0] = f64::INFINITY;
    assert!(writer.write(&Frame { t: 2.0, data: FrameData::Joints(q) }).is_err());
    assert_eq!(read(writer.into_inner()).unwrap().len(), 1, "refused frames leave no trace");
}

#[test]
fn messages() {
    let message = format!("{{\"q\":{}}}", joints(&OPEN));
    assert_eq!(parse_hand_json(message.as_bytes()), Ok(FrameData::Joints(OPEN)));
    let hand = keypoints(&MasterGeometry::PARADIGMATIC, &OPEN);
    let message = format!("{{\"t\": 3, \"keypoints\":{:?}}}", hand.points());
    let data = parse_hand_json(message.as_bytes()).unwrap();
    assert_same(&[Frame { t: 3.0, data }], &[Frame { t: 3.0, data: FrameData::Keypoints(hand) }]);
    assert_eq!(parse_hand_json(b"{}"), Err(FrameError::Missing("q` or `keypoints")));
    assert!(matches!(parse_hand_json(&[b' '; MAX_MESSAGE + 1]), Err(FrameError::TooLong { .. })));
    assert!(matches!(parse_hand_json(b"\xff\x00"), Err(FrameError::Json(_))));
    assert!(matches!(parse_hand_json(b"[[[[[["), Err(FrameError::Json(_))));
}

#[test]
fn the_recording_is_read() {
    let Some(path) = shared_data("human_hand_right.csv") else { return };
    let bytes = fs::read(path).unwrap();
    let frames = read(&bytes).unwrap();
    assert_eq!(frames.len(), 400);
    assert!((frames[399].t - 13.3).abs() < 1e-3);
    // And through the project's own format.
    let mut writer = RecordingWriter::new(Vec::new(), &RecordingHeader::default()).unwrap();
    frames.iter().for_each(|frame| writer.write(frame).unwrap());
    assert_same(&read(writer.into_inner()).unwrap(), &frames);
}

proptest! {
    #[test]
    fn garbage_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = read(&bytes);
        let _ = parse_hand_json(&bytes);
    }

    #[test]
    fn damaged_recordings_never_panic(position in any::<prop::sample::Index>(), byte in any::<u8>(), csv in any::<bool>()) {
        let mut bytes = if csv { (csv_header() + &csv_row(0, 0.0) + &csv_row(1, 1.0)).into_bytes() } else { written() };
        let position = position.index(bytes.len());
        bytes[position] = byte;
        let _ = read(&bytes);
    }

    #[test]
    fn angles_survive(q in prop::array::uniform20(-6.0f64..6.0), t in 0.0f64..1e6) {
        let mut writer = RecordingWriter::new(Vec::new(), &RecordingHeader::default()).unwrap();
        let frame = Frame { t, data: FrameData::Joints(q) };
        writer.write(&frame).unwrap();
        assert_same(&read(writer.into_inner()).unwrap(), &[frame]);
    }
}
