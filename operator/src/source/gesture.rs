use std::time::Duration;

use teleop_common::master::Gesture;
use teleop_common::recording::FrameData;

use super::{Poll, SourceFrame};

/// A scripted gesture, over and over, at a steady rate.
///
/// The frame of index n is due n / rate after the start, whatever happened before it: the pace does not drift, and
/// after a stall the frames that were missed are passed over.
#[derive(Debug)]
pub struct GestureSource {
    gesture: Gesture,
    rate: f64,
    next: u64,
}

impl GestureSource {
    /// `gesture` at `rate` frames per second.
    #[must_use]
    pub fn new(gesture: Gesture, rate: f64) -> Self {
        Self { gesture, rate, next: 0 }
    }

    fn due(&self, index: u64) -> Duration {
        Duration::from_secs_f64(index as f64 / self.rate)
    }

    pub(super) fn poll(&mut self, elapsed: Duration) -> Poll {
        let due = self.due(self.next);
        if elapsed < due {
            return Poll::WaitUntil(due);
        }
        let mut index = ((elapsed.as_secs_f64() * self.rate) as u64).max(self.next);
        // The division above may round up to a frame that is not due yet.
        if index > self.next && self.due(index) > elapsed {
            index -= 1;
        }
        let skipped = index - self.next;
        self.next = index + 1;
        let time = self.due(index);
        let hand = FrameData::Joints(self.gesture.sample(time.as_secs_f64()));
        Poll::Frame(SourceFrame { time, captured: None, hand, skipped, jump: false })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs the source on a virtual clock that wakes up exactly when asked, or `late` after it.
    fn run(source: &mut GestureSource, mut now: Duration, until: Duration, late: Duration) -> Vec<(Duration, u64)> {
        let mut frames = Vec::new();
        while now < until {
            match source.poll(now) {
                Poll::Frame(frame) => frames.push((frame.time, frame.skipped)),
                Poll::WaitUntil(due) => {
                    assert!(due > now, "a wait must end in the future");
                    now = due + late;
                }
                Poll::Idle | Poll::End => unreachable!("a gesture never rests"),
            }
        }
        frames
    }

    #[test]
    fn an_hour_at_an_odd_rate_does_not_drift() {
        let hour = Duration::from_secs(3600);
        let frames = run(&mut GestureSource::new(Gesture::Tour, 77.0), Duration::ZERO, hour, Duration::from_micros(80));
        assert_eq!(frames.len(), 77 * 3600);
        assert!(frames.iter().all(|(_, skipped)| *skipped == 0));
        let last = Duration::from_secs_f64((77.0 * 3600.0 - 1.0) / 77.0);
        assert_eq!(frames.last().unwrap().0, last);
    }

    #[test]
    fn after_a_stall_there_is_one_frame_and_no_burst() {
        let mut source = GestureSource::new(Gesture::Fist, 100.0);
        let second = Duration::from_secs(1);
        assert_eq!(run(&mut source, Duration::ZERO, second, Duration::ZERO).len(), 100);
        // Stopped from 1 s to 6.123 s.
        let frames = run(&mut source, Duration::from_millis(6123), 7 * second, Duration::ZERO);
        assert_eq!(frames[0], (Duration::from_millis(6120), 512), "the newest frame due, the others skipped");
        assert_eq!(frames[1], (Duration::from_millis(6130), 0));
        assert_eq!(frames.len(), 88);
    }

    #[test]
    fn a_machine_too_slow_for_the_rate_sends_the_newest_frames_only() {
        let mut source = GestureSource::new(Gesture::Fist, 1000.0);
        let late = Duration::from_micros(2500);
        let frames = run(&mut source, Duration::ZERO, Duration::from_secs(1), late);
        assert!(frames[1..].iter().all(|(_, skipped)| (1..=3).contains(skipped)), "{frames:?}");
        assert!(frames.windows(2).all(|pair| pair[0].0 < pair[1].0));
    }
}
