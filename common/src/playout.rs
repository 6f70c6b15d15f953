//! The playout buffer: poses that arrive unevenly are played evenly, in the time in which they were captured.
//!
//! A pose captured at `c` arrives at `r`. To play the way from one pose to the next, captured at `c_i` and `c_j`, with a
//! delay `D` behind the capture, the later one must be there when the way begins: `r_j <= c_i + D`. So the *needs*
//! `r_j - c_i` of the last poses say how much delay makes a smooth motion of them: their 95 % quantile. It contains the
//! network's delay, its jitter, the source's period, and the gaps that losses leave.
//!
//! On a good link all that is smooth already, and a delay of a period would be for nothing. So [`PlayoutMode::Auto`]
//! plays the newest pose at once ([`Playout::delay`] is zero) until the needs exceed the least possible one by
//! [`PlayoutParams::tolerance`], and goes back when they no longer do. The delay changes slowly, as time running a little
//! faster or slower, and never by a jump. Over a gap that the delay does not cover the motion goes on a little, and comes
//! to rest.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::master::{MAX_ANGLE, MasterPose};
use crate::time::MonoTime;

/// Poses kept: more than the longest delay holds at 200 Hz.
const POSES: usize = 64;
/// Needs looked at.
const WINDOW: usize = 128;
/// They say nothing after this time.
const MEMORY: Duration = Duration::from_secs(4);
/// A source slower than this has gaps, not a period.
const MAX_NEED: Duration = Duration::from_millis(500);
/// How fast the delay grows and falls, s/s.
const GROWS: f64 = 0.1;
const FALLS: f64 = 0.05;
/// No prediction is faster, rad/s, because no finger is. Two stamps that lie closely together, as when the clock offset
/// is corrected between two poses, would make it any speed.
pub const MAX_SPEED: f64 = 30.0;
/// Once buffering, the needs must be this share of the tolerance to go back.
const CALM: f64 = 0.5;

/// How the delay is chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlayoutMode {
    /// None on a good link, as much as needed on another.
    #[default]
    Auto,
    /// The newest pose at once, always.
    Direct,
    /// [`PlayoutParams::max_delay`] behind the capture, always.
    Fixed,
}

/// Parameters of the playout.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlayoutParams {
    /// How the delay is chosen.
    pub mode: PlayoutMode,
    /// Largest delay that is added to the least that the link takes.
    pub max_delay: Duration,
    /// Unevenness that is played as it comes.
    pub tolerance: Duration,
    /// Time constant of the prediction over a gap, while there is a delay: the motion goes on, slower and slower. Zero:
    /// the last pose stays. The default is the best for a recorded hand (`tests/playout.rs`): over gaps of 33, 67 and
    /// 100 ms its error is 29, 21 and 16 % below that of holding.
    pub predict: Duration,
}

impl Default for PlayoutParams {
    fn default() -> Self {
        Self {
            mode: PlayoutMode::Auto,
            max_delay: Duration::from_millis(200),
            tolerance: Duration::from_millis(8),
            predict: Duration::from_millis(40),
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    captured: MonoTime,
    pose: MasterPose,
}

/// What is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Played {
    /// The pose.
    pub pose: MasterPose,
    /// When the hand was in it, own clock.
    pub captured: MonoTime,
}

/// The buffer of one operator. No allocation after [`Playout::new`].
#[derive(Clone, Debug)]
pub struct Playout {
    params: PlayoutParams,
    // In the order of capture, the oldest first.
    poses: Vec<Entry>,
    needs: [(MonoTime, f64, f64); WINDOW],
    next: usize,
    count: usize,
    buffers: bool,
    delay: f64,
    last: Option<MonoTime>,
    // What was played last was captured then; it never gets less.
    reached: MonoTime,
}

impl Playout {
    /// An empty buffer.
    #[must_use]
    pub fn new(params: PlayoutParams) -> Self {
        Self {
            params,
            poses: Vec::with_capacity(POSES),
            needs: [(MonoTime(0), 0.0, 0.0); WINDOW],
            next: 0,
            count: 0,
            buffers: false,
            delay: 0.0,
            last: None,
            reached: MonoTime(0),
        }
    }

    /// Forgets everything, for another operator.
    pub fn reset(&mut self) {
        self.poses.clear();
        (self.next, self.count, self.buffers, self.delay, self.last) = (0, 0, false, 0.0, None);
        self.reached = MonoTime(0);
    }

    /// The delay behind the capture that is being played; zero: the newest pose is.
    #[must_use]
    pub fn delay(&self) -> Duration {
        Duration::from_secs_f64(self.delay)
    }

    /// Takes a pose, captured and received at these times of the own clock. One that is not newer than the last is
    /// left out.
    pub fn push(&mut self, captured: MonoTime, received: MonoTime, pose: &MasterPose) {
        if let Some(last) = self.poses.last() {
            if captured <= last.captured {
                return;
            }
            let need = received.since(last.captured);
            if need <= MAX_NEED {
                // The least that would do on an even link: its delay and the period.
                let even = captured.since(last.captured).as_secs_f64();
                self.needs[self.next] = (received, need.as_secs_f64(), even);
                self.next = (self.next + 1) % WINDOW;
                self.count = (self.count + 1).min(WINDOW);
            }
        }
        if self.poses.len() == POSES {
            self.poses.remove(0);
        }
        self.poses.push(Entry { captured, pose: *pose });
    }

    /// What to play at `now`, which does not run backwards; `None` if no pose has come.
    pub fn play(&mut self, now: MonoTime) -> Option<Played> {
        let newest = *self.poses.last()?;
        let passed = self.last.map_or(0.0, |last| now.since(last).as_secs_f64());
        self.last = Some(now);
        let wanted = self.wanted(now);
        self.delay += (wanted - self.delay).clamp(-FALLS * passed, GROWS * passed);
        let time = MonoTime(now.0.saturating_sub((self.delay * 1e9) as u64)).max(self.reached);
        let played = self.at(newest, time);
        self.reached = played.captured;
        Some(played)
    }

    /// What to play of `time`.
    fn at(&self, newest: Entry, time: MonoTime) -> Played {
        let after = self.poses.partition_point(|entry| entry.captured <= time);
        if after == self.poses.len() {
            return self.predict(newest, time);
        }
        let later = self.poses[after];
        let Some(earlier) = after.checked_sub(1).map(|index| self.poses[index]) else {
            return Played { pose: later.pose, captured: later.captured };
        };
        let whole = later.captured.since(earlier.captured).as_secs_f64();
        let share = time.since(earlier.captured).as_secs_f64() / whole;
        // What the hand is like changes at once, where it is does not.
        let mut pose = newest.pose;
        for (joint, angle) in pose.q.iter_mut().enumerate() {
            *angle = earlier.pose.q[joint] + (later.pose.q[joint] - earlier.pose.q[joint]) * share;
        }
        Played { pose, captured: time }
    }

    /// Beyond the newest pose: that, or a little farther the way it went.
    fn predict(&self, newest: Entry, time: MonoTime) -> Played {
        let tau = self.params.predict.as_secs_f64();
        let before = self.poses.len().checked_sub(2).map(|index| self.poses[index]);
        let (mut pose, mut captured) = (newest.pose, newest.captured);
        // Where the delay has just ended, the prediction stays where it is until poses have caught up with it.
        let mut ahead = self.reached.since(newest.captured).as_secs_f64();
        if self.delay > 0.0 && tau > 0.0 {
            ahead = ahead.max(tau * (1.0 - (-time.since(newest.captured).as_secs_f64() / tau).exp()));
        }
        if let Some(before) = before.filter(|_| ahead > 0.0) {
            let period = newest.captured.since(before.captured).as_secs_f64();
            for (joint, angle) in pose.q.iter_mut().enumerate() {
                let speed = ((*angle - before.pose.q[joint]) / period).clamp(-MAX_SPEED, MAX_SPEED);
                *angle = (*angle + speed * ahead).clamp(-MAX_ANGLE, MAX_ANGLE);
            }
            captured = captured + Duration::from_secs_f64(ahead);
        }
        Played { pose, captured }
    }

    /// The delay that would be right now, s.
    fn wanted(&mut self, now: MonoTime) -> f64 {
        let most = self.params.max_delay.as_secs_f64();
        match self.params.mode {
            PlayoutMode::Direct => return 0.0,
            PlayoutMode::Fixed => return most,
            PlayoutMode::Auto => {}
        }
        let mut needs = [0.0; WINDOW];
        let (mut count, mut transit, mut period) = (0, f64::INFINITY, f64::INFINITY);
        for &(at, need, even) in &self.needs[..self.count] {
            if now.since(at) <= MEMORY {
                needs[count] = need;
                count += 1;
                transit = transit.min(need - even);
                period = period.min(even);
            }
        }
        if count < WINDOW / 16 {
            return 0.0;
        }
        let needs = &mut needs[..count];
        let rank = (count * 95).div_ceil(100) - 1;
        let need = *needs.select_nth_unstable_by(rank, f64::total_cmp).1;
        let uneven = need - (transit + period);
        let tolerance = self.params.tolerance.as_secs_f64();
        self.buffers = uneven > if self.buffers { CALM * tolerance } else { tolerance };
        if self.buffers { need.min(transit + most) } else { 0.0 }
    }
}
