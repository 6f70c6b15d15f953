//! Recordings, CSV and JSON lines: refused with the line's number, or frames that are the same again when they are
//! written and read. Bounded memory.
#![no_main]

use libfuzzer_sys::fuzz_target;
use teleop_common::recording::{
    Frame, FrameData, LastLine, RecordingError, RecordingHeader, RecordingReader, RecordingWriter,
};
use teleop_fuzz::{brief, within};

fuzz_target!(|bytes: &[u8]| {
    let whole = read(bytes, LastLine::Whole);
    let (header, frames, error) = read(bytes, LastLine::MayBeCut);
    if let Some(error) = &error {
        brief(error);
    }
    if let (_, all, None) = &whole
        && error.is_none()
    {
        // The last line may be left out, and nothing else.
        assert!(all.len() - frames.len() <= 1 && all[..frames.len()] == frames[..]);
    }
    assert!(frames.iter().all(|frame| frame.t.is_finite()) && frames.windows(2).all(|pair| pair[0].t < pair[1].t));
    // The JSON parser may be off by a digit of the last place, which is nothing but where frames follow each other as closely.
    if frames.windows(2).any(|pair| !is_larger(pair[0].t, pair[1].t)) {
        return;
    }
    let mut writer = RecordingWriter::new(Vec::new(), &header).expect("a header that was read can be written");
    for frame in &frames {
        writer.write(frame).expect("a frame that was read can be written");
    }
    let (again, same, error) = read(&writer.into_inner(), LastLine::Whole);
    assert!(error.is_none(), "what was written cannot be read: {error:?}");
    assert!((again.side, &again.source) == (header.side, &header.source));
    assert!(again.geometry.is_some() == header.geometry.is_some() && again.tuning.is_some() == header.tuning.is_some());
    assert_eq!(same.len(), frames.len());
    for (now, before) in same.iter().zip(&frames) {
        let (now, before) = (numbers(now), numbers(before));
        assert!(
            now.len() == before.len() && now.iter().zip(&before).all(|(a, b)| !is_larger(*a, *b) && !is_larger(*b, *a))
        );
    }
});

fn is_larger(a: f64, b: f64) -> bool {
    b - a > 4.0 * f64::EPSILON * b.abs().max(a.abs())
}

fn numbers(frame: &Frame) -> Vec<f64> {
    match &frame.data {
        FrameData::Joints(q) => [&[frame.t], &q[..]].concat(),
        FrameData::Keypoints(keypoints) => [&[frame.t], keypoints.points().as_flattened()].concat(),
    }
}

fn read(bytes: &[u8], last_line: LastLine) -> (RecordingHeader, Vec<Frame>, Option<RecordingError>) {
    // A first line may be any JSON; its longest fills a line of 64 KiB.
    let room = 64 * bytes.len() + (1 << 16);
    let mut reader = match within(room, || RecordingReader::new(bytes, last_line)) {
        Ok(reader) => reader,
        Err(error) => return (RecordingHeader::default(), Vec::new(), Some(error)),
    };
    let mut frames = Vec::new();
    loop {
        match within(room, || reader.next()) {
            None => return (reader.header().clone(), frames, None),
            Some(Ok(frame)) => frames.push(frame),
            Some(Err(error)) => {
                assert!(reader.next().is_none(), "it goes on after an error");
                return (reader.header().clone(), frames, Some(error));
            }
        }
    }
}
