//! From what a source gives to poses of the master hand.

use std::time::Duration;

use teleop_common::hand::HandSide;
use teleop_common::mapping::Tuning;
use teleop_common::master::{
    Calibration, CalibrationError, Calibrator, Diagnosis, Filter, FilterSettings, Fitter, Inspector, MIN_FRAMES,
    MasterGeometry, MasterPose,
};
use teleop_common::recording::FrameData;

use crate::robot_hand::RobotHand;

/// How long a hand is measured before it is followed, unless it was calibrated before.
pub const MEASURE: Duration = Duration::from_secs(3);
/// A gap in the stream after which the fit does not start from the last posture.
const GAP: Duration = Duration::from_millis(300);

/// What became of a frame.
#[derive(Clone, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "lives on the stack for one frame; a box would allocate for each")]
pub enum Posed {
    /// A pose.
    Pose {
        /// The pose.
        pose: MasterPose,
        /// Fit residual of keypoints (root mean square), m.
        residual: Option<f64>,
    },
    /// The hand is still being measured.
    Measuring {
        /// How far, 0 to 1.
        done: f64,
    },
    /// The hand cannot be followed.
    Refused(Refusal),
}

/// Why a hand cannot be followed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// It is not the hand it should be.
    #[error("{0}; calibrate with this hand, or turn off mirroring in the tracker")]
    Diagnosis(Diagnosis),
    /// It could not be measured; the next attempt has begun.
    #[error("the hand could not be measured, trying again")]
    Calibration(#[source] CalibrationError),
}

/// Makes poses of what a source gives.
#[derive(Debug)]
pub struct PoseFinder {
    /// For joint angles.
    geometry: MasterGeometry,
    filtered: bool,
    tuning: Option<Tuning>,
    /// For keypoints.
    robot_hand: RobotHand,
    tracker: Tracker,
    last: Option<Duration>,
}

/// What keypoints need.
#[derive(Debug)]
enum Tracker {
    /// Not known whose hand it is.
    Measuring { calibrator: Box<Calibrator>, since: Option<Duration> },
    /// A known hand.
    Following { fitter: Box<Fitter>, filter: Box<Filter>, inspector: Inspector, side: HandSide, tuning: Option<Tuning> },
}

impl Tracker {
    fn measuring() -> Self {
        Self::Measuring { calibrator: Box::default(), since: None }
    }

    fn following(calibration: &Calibration) -> Self {
        Self::Following {
            filter: Box::new(Filter::new(calibration.geometry, FilterSettings::default())),
            fitter: Box::new(Fitter::new(calibration.geometry, calibration.side)),
            inspector: Inspector::default(),
            side: calibration.side,
            tuning: calibration.tuning.as_ref().map(|tuning| tuning.values),
        }
    }
}

impl PoseFinder {
    /// For joint angles of this hand; keypoints, should they come, are measured for [`MEASURE`] first.
    #[must_use]
    pub fn new(geometry: MasterGeometry) -> Self {
        Self {
            geometry,
            filtered: true,
            tuning: None,
            robot_hand: RobotHand::default(),
            tracker: Tracker::measuring(),
            last: None,
        }
    }

    /// With what is known about the operator of the joint angles, and the robot hand that a hand will be tuned for after
    /// it was measured.
    #[must_use]
    pub fn with_tuning(self, tuning: Option<Tuning>, robot_hand: RobotHand) -> Self {
        Self { tuning, robot_hand, ..self }
    }

    /// For joint angles or keypoints of a person that was measured.
    #[must_use]
    pub fn calibrated(calibration: &Calibration) -> Self {
        Self { tracker: Tracker::following(calibration), ..Self::new(calibration.geometry) }
    }

    /// The same with or without the [`Filter`], which takes the tracker's noise out of keypoints; it is on at first.
    #[must_use]
    pub fn filtered(mut self, filtered: bool) -> Self {
        self.filtered = filtered;
        self
    }

    /// The pose of `hand`, seen `time` after the start; `jump` if it need not be near the one before.
    pub fn pose(&mut self, time: Duration, hand: &FrameData, jump: bool) -> Posed {
        let since = time.saturating_sub(self.last.replace(time).unwrap_or(time));
        let gap = jump || since > GAP;
        let keypoints = match hand {
            FrameData::Joints(q) => {
                return Posed::Pose {
                    pose: MasterPose { q: *q, geometry: self.geometry, tuning: self.tuning },
                    residual: None,
                };
            }
            FrameData::Keypoints(keypoints) => keypoints,
        };
        match &mut self.tracker {
            Tracker::Measuring { calibrator, since } => {
                calibrator.push(keypoints);
                let elapsed = time.saturating_sub(*since.get_or_insert(time));
                if elapsed < MEASURE {
                    return Posed::Measuring { done: elapsed.as_secs_f64() / MEASURE.as_secs_f64() };
                }
                match calibrator.finish() {
                    Ok(mut calibration) => {
                        self.robot_hand.tune_and_log(&mut calibration);
                        let report: Vec<String> = calibration.report().into_iter().take(2).collect();
                        tracing::info!("measured: {}", report.join(", "));
                        self.tracker = Tracker::following(&calibration);
                        Posed::Measuring { done: 1.0 }
                    }
                    // A slow tracker needs more time, not another attempt.
                    Err(CalibrationError::TooFewFrames { frames, .. }) => {
                        Posed::Measuring { done: frames as f64 / MIN_FRAMES as f64 }
                    }
                    Err(error) => {
                        self.tracker = Tracker::measuring();
                        Posed::Refused(Refusal::Calibration(error))
                    }
                }
            }
            Tracker::Following { fitter, filter, inspector, side, tuning } => {
                inspector.push(keypoints);
                if let Some(diagnosis) = inspector.diagnose(*side, false) {
                    filter.reset();
                    return Posed::Refused(Refusal::Diagnosis(diagnosis));
                }
                if gap {
                    fitter.reset();
                    filter.reset();
                }
                let fit = fitter.fit(keypoints);
                let mut pose = MasterPose { q: fit.q, geometry: *fitter.geometry(), tuning: *tuning };
                if self.filtered {
                    pose.q = filter.apply(since.as_secs_f64(), keypoints, &fit.q);
                }
                Posed::Pose { pose, residual: Some(fit.residual()) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use teleop_common::hand::Finger;
    use teleop_common::master::{Gesture, Keypoints};

    /// Keypoints of the paradigmatic right hand, exact.
    fn keypoints(q: &[f64; 20]) -> Keypoints {
        let geometry = MasterGeometry::PARADIGMATIC;
        let mut points = [[0.0; 3]; 21];
        for finger in Finger::ALL {
            let f = finger.index();
            let angles = [q[4 * f], q[4 * f + 1], q[4 * f + 2], q[4 * f + 3]];
            for (k, point) in geometry.finger_points(finger, &angles).into_iter().enumerate() {
                points[1 + 4 * f + k] = point.into();
            }
        }
        Keypoints::new(points).unwrap()
    }

    fn frame(time: Duration) -> FrameData {
        FrameData::Keypoints(keypoints(&Gesture::Fist.sample(time.as_secs_f64())))
    }

    fn distance_errors(finder: &mut PoseFinder, from: Duration) -> f64 {
        let mut worst = 0.0_f64;
        for i in 0..200 {
            let time = from + Duration::from_millis(10) * i;
            let truth = MasterPose {
                q: Gesture::Fist.sample(time.as_secs_f64()),
                geometry: MasterGeometry::PARADIGMATIC,
                tuning: None,
            };
            let Posed::Pose { pose, residual } = finder.pose(time, &frame(time), false) else {
                panic!("no pose at {time:?}")
            };
            assert!(residual.unwrap() < 1e-3, "residual {residual:?}");
            // The measured palm is turned a little against the true one, so distances are compared, not places.
            for finger in &Finger::ALL[1..] {
                let distance = |pose: &MasterPose| (pose.tip(*finger) - pose.tip(Finger::Thumb)).norm();
                worst = worst.max((distance(&pose) - distance(&truth)).abs());
            }
        }
        worst
    }

    #[test]
    fn an_unknown_hand_is_measured_for_three_seconds_and_then_followed() {
        let mut finder = PoseFinder::new(MasterGeometry::PARADIGMATIC);
        let mut done = -1.0;
        for i in 0..=300 {
            let time = Duration::from_secs(7) + Duration::from_millis(10) * i;
            match finder.pose(time, &frame(time), false) {
                Posed::Measuring { done: now } => {
                    assert!(now > done, "{now} after {done}");
                    done = now;
                }
                other => panic!("{other:?} while measuring"),
            }
        }
        assert_eq!(done, 1.0);
        let worst = distance_errors(&mut finder, Duration::from_secs(10));
        assert!(worst < 2e-3, "thumb-finger distances {worst} m off");
    }

    #[test]
    fn a_hand_that_does_not_move_is_named_and_measured_again() {
        let mut finder = PoseFinder::new(MasterGeometry::PARADIGMATIC);
        let still = FrameData::Keypoints(keypoints(&Gesture::Fist.sample(2.0)));
        let refusals: Vec<String> = (0..=650_u32)
            .filter_map(|i| match finder.pose(Duration::from_millis(10) * i, &still, false) {
                Posed::Refused(refusal) => Some(crate::terminal::chain(&refusal)),
                Posed::Measuring { .. } => None,
                Posed::Pose { .. } => panic!("followed"),
            })
            .collect();
        assert_eq!(refusals.len(), 2, "one per attempt: {refusals:?}");
        assert!(refusals[0].contains("the hand moved only 0.0 mm"), "{refusals:?}");
    }

    #[test]
    fn the_other_hand_is_refused_by_name() {
        let mut finder = PoseFinder::new(MasterGeometry::PARADIGMATIC);
        let at = |i: u32| Duration::from_millis(10) * i;
        for i in 0..=300 {
            finder.pose(at(i), &frame(at(i)), false);
        }
        let mirrored = |i: u32| match frame(at(i)) {
            FrameData::Keypoints(keypoints) => FrameData::Keypoints(keypoints.mirrored()),
            FrameData::Joints(_) => unreachable!(),
        };
        let last = (301..800).map(|i| finder.pose(at(i), &mirrored(i), false)).last().unwrap();
        let Posed::Refused(refusal) = last else { panic!("{last:?}") };
        assert!(refusal.to_string().contains("left hand"), "{refusal}");
    }

    #[test]
    fn a_slow_tracker_is_given_the_time_it_needs() {
        let mut finder = PoseFinder::new(MasterGeometry::PARADIGMATIC);
        let at = |i: u32| Duration::from_millis(200) * i;
        let posed: Vec<Posed> = (0..40).map(|i| finder.pose(at(i), &frame(at(i)), false)).collect();
        let measuring = posed.iter().take_while(|posed| matches!(posed, Posed::Measuring { .. })).count();
        assert_eq!(measuring, MIN_FRAMES, "{posed:?}");
        assert!(posed[measuring..].iter().all(|posed| matches!(posed, Posed::Pose { .. })));
    }

    #[test]
    fn joint_angles_need_no_measuring() {
        let q = Gesture::Tripod.sample(2.0);
        let pose = MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None };
        let posed = PoseFinder::new(pose.geometry).pose(Duration::ZERO, &FrameData::Joints(q), false);
        assert_eq!(posed, Posed::Pose { pose, residual: None });
    }
}
