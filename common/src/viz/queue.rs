use std::sync::atomic::{AtomicU64, Ordering};

use crossbeam_queue::ArrayQueue;

use super::frame::{Frame, Line};

/// Frames that wait for the viewer: 0.8 s of a 333 Hz control loop.
const FRAMES: usize = 256;
/// Lines that wait for the viewer.
const LINES: usize = 64;

/// What the loggers feed and the viewer's thread drains: bounded, newest wins.
#[derive(Debug)]
pub(super) struct Feed {
    frames: ArrayQueue<Frame>,
    lines: ArrayQueue<Line>,
    dropped: AtomicU64,
}

impl Default for Feed {
    fn default() -> Self {
        Self { frames: ArrayQueue::new(FRAMES), lines: ArrayQueue::new(LINES), dropped: AtomicU64::new(0) }
    }
}

impl Feed {
    pub(super) fn push(&self, frame: Frame) {
        if self.frames.force_push(frame).is_some() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    pub(super) fn push_line(&self, line: Line) {
        if self.lines.force_push(line).is_some() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    pub(super) fn pop(&self) -> Option<Frame> {
        self.frames.pop()
    }

    pub(super) fn pop_line(&self) -> Option<Line> {
        self.lines.pop()
    }

    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::master::{MasterGeometry, MasterPose};
    use crate::viz::{Level, OperatorFrame};

    fn frame(time: i64) -> Frame {
        Frame::Operator(OperatorFrame {
            time,
            pose: MasterPose { q: [0.0; 20], geometry: MasterGeometry::PARADIGMATIC, tuning: None },
            r1: 0.02,
            r2: 0.08,
            residual: None,
            round_trip: None,
        })
    }

    #[test]
    fn a_full_queue_drops_its_oldest_and_counts() {
        let feed = Feed::default();
        for time in 0..FRAMES as i64 + 10 {
            feed.push(frame(time));
        }
        for time in 0..LINES as i64 + 3 {
            feed.push_line(Line::new(time, Level::Info, "hello"));
        }
        assert_eq!(feed.dropped(), 13);
        let times: Vec<i64> = std::iter::from_fn(|| feed.pop())
            .map(|frame| match frame {
                Frame::Operator(frame) => frame.time,
                Frame::Robot(frame) => frame.time,
            })
            .collect();
        assert_eq!(times, (10..FRAMES as i64 + 10).collect::<Vec<_>>());
        assert_eq!(feed.pop_line().map(|line| line.time), Some(3));
    }

    #[test]
    fn a_long_line_is_cut_between_characters() {
        let line = Line::new(0, Level::Warn, &"é".repeat(2000));
        assert_eq!(line.message.len(), 1024);
        let odd = Line::new(0, Level::Warn, &format!("x{}", "é".repeat(2000)));
        assert_eq!(odd.message.len(), 1023);
    }
}
