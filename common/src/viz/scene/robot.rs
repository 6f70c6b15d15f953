use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};
use rerun::{
    AsComponents, Boxes3D, Color, Cylinders3D, Ellipsoids3D, FillMode, LineStrips3D, Points3D, RecordingStream,
    RecordingStreamResult, StateConfiguration,
};

use super::series::{Curve, Series};
use super::space::{from_palm, point, quaternion};
use super::{Lane, PLOT_PERIOD, Pace, SPACE_PERIOD};
use crate::hand::{Finger, FingerChain, HandModel, JointVector, Shape, TipFrame};
use crate::mode::Mode;
use crate::viz::frame::RobotFrame;
use crate::viz::{TIMELINE, palette};

/// The shapes of one kind: the link each sits on, and where.
type Places = Vec<(usize, Isometry3<f64>)>;

/// The modes in the order of their legend, which may be cut short.
const BANDS: [Mode; 8] = [
    Mode::Engaged,
    Mode::Engaging,
    Mode::Armed,
    Mode::Holding,
    Mode::Relaxed,
    Mode::Stopped,
    Mode::Faulted,
    Mode::Disarmed,
];

/// The robot's hand and plots.
pub(super) struct Drawing<'a> {
    hand: &'a HandModel,
    view_from_palm: UnitQuaternion<f64>,
    boxes: Places,
    cylinders: Places,
    spheres: Places,
    /// Scratch for the link poses.
    poses: Vec<Isometry3<f64>>,
    space: Pace,
    plots: Pace,
    k: Series,
    e_c: Series,
    e_q: Series,
    distance: Series,
    joints: Vec<Series>,
    speed: Series,
    timing: Series,
    mode: Lane,
    mode_band: Series,
}

impl<'a> Drawing<'a> {
    pub(super) fn new(hand: &'a HandModel, stream: &RecordingStream) -> RecordingStreamResult<Self> {
        let per_finger = |what: &str| -> Vec<Curve> {
            let name = |finger: &str| format!("{what} {finger}");
            hand.fingers.iter().map(|f| Curve::new(name(f.finger.name()), palette::finger(f.finger))).collect()
        };
        let distances: Vec<Curve> = per_finger("robot").into_iter().skip(1).collect();
        let mut joints = Vec::with_capacity(hand.fingers.len());
        for finger in &hand.fingers {
            let slots = 0..finger.joints.len();
            let measured = slots.clone().map(|slot| Curve::new(format!("q{slot}"), palette::joint(slot)));
            let commanded = slots.map(|slot| Curve::thin(format!("q{slot} command"), palette::joint(slot)));
            let curves: Vec<Curve> = measured.chain(commanded).collect();
            joints.push(Series::new(format!("robot/joints/{}", finger.finger.name()), &curves, stream)?);
        }
        let speeds: Vec<Curve> = hand
            .fingers
            .iter()
            .flat_map(|f| {
                let color = palette::finger(f.finger);
                (0..f.joints.len()).map(move |slot| Curve::thin(format!("{} q{slot}", f.finger.name()), color))
            })
            .collect();
        let timing = [Curve::new("pose age", palette::joint(1)), Curve::new("control tick", palette::joint(2))];
        modes(stream)?;
        let (boxes, cylinders, spheres) = shapes(hand, stream)?;
        Ok(Self {
            hand,
            view_from_palm: from_palm(hand),
            boxes,
            cylinders,
            spheres,
            poses: Vec::with_capacity(hand.links.len()),
            space: Pace::new(SPACE_PERIOD),
            plots: Pace::new(PLOT_PERIOD),
            k: Series::new("robot/mapping/k", &per_finger("k"), stream)?,
            e_c: Series::new("robot/mapping/e_C", &per_finger("e_C"), stream)?,
            e_q: Series::new("robot/mapping/e_Q", &per_finger("e_Q"), stream)?,
            distance: Series::new("robot/mapping/distance", &distances, stream)?,
            joints,
            speed: Series::new("robot/joints/speed", &speeds, stream)?,
            timing: Series::new("robot/timing", &timing, stream)?,
            mode: Lane::new("robot/mode"),
            mode_band: Series::new(
                "robot/band",
                &BANDS.map(|mode| Curve::band(mode.name(), mode_color(mode))),
                stream,
            )?,
        })
    }

    pub(super) fn draw(&mut self, frame: &RobotFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        stream.set_timestamp_nanos_since_epoch(TIMELINE, frame.time);
        self.mode.set(frame.time, frame.mode.name(), stream)?;
        if self.plots.due(frame.time) {
            self.plot(frame, stream)?;
        }
        if self.space.due(frame.time) {
            self.pose(frame, stream)?;
            self.targets(frame, stream)?;
        }
        Ok(())
    }

    pub(super) fn finish(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let mapping = [&mut self.k, &mut self.e_c, &mut self.e_q, &mut self.distance];
        for series in
            mapping.into_iter().chain(&mut self.joints).chain([&mut self.speed, &mut self.timing, &mut self.mode_band])
        {
            series.flush(stream)?;
        }
        Ok(())
    }

    fn plot(&mut self, frame: &RobotFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let time = frame.time;
        if let Some(mapping) = &frame.mapping {
            let fingers = mapping.fingers();
            self.k.push(time, fingers.iter().map(|f| f.k), stream)?;
            self.e_c.push(time, fingers.iter().map(|f| f.e_c * 1e3), stream)?;
            self.e_q.push(time, fingers.iter().map(|f| f.e_q), stream)?;
            // What the hand really does, not what the mapping asks for.
            let tips: Vec<_> =
                self.hand.fingers.iter().map(|f| f.tip(&f.select(&self.padded(&frame.q)), TipFrame::Pole)).collect();
            if let Some((thumb, others)) = tips.split_first() {
                self.distance.push(time, others.iter().map(|tip| (tip - thumb).norm() * 1e3), stream)?;
            }
        }
        for (finger, series) in self.hand.fingers.iter().zip(&mut self.joints) {
            let value = |values: &[f64], joint: usize| values.get(joint).copied().unwrap_or(f64::NAN);
            let commanded = finger.joints.iter().map(|joint| value(&frame.q_command, joint.joint));
            let measured = finger.joints.iter().map(|joint| value(&frame.q, joint.joint));
            series.push(time, measured.chain(commanded), stream)?;
        }
        let speeds = self.hand.fingers.iter().flat_map(|finger| &finger.joints);
        let speeds = speeds.map(|joint| frame.dq.get(joint.joint).copied().unwrap_or(f64::NAN));
        self.speed.push(time, speeds, stream)?;
        let band = BANDS.map(|mode| if mode == frame.mode { 1.0 } else { f64::NAN });
        self.mode_band.push(time, band, stream)?;
        let milli = |value: Option<f64>| value.map_or(f64::NAN, |value| value * 1e3);
        self.timing.push(time, [milli(frame.pose_age), milli(frame.tick)], stream)
    }

    /// `q` with as many values as the hand has joints.
    fn padded(&self, q: &[f64]) -> JointVector {
        let mut out = self.hand.home();
        for (value, &angle) in out.iter_mut().zip(q) {
            *value = angle;
        }
        out
    }

    fn pose(&mut self, frame: &RobotFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        self.hand.link_poses(&frame.q, &mut self.poses);
        let place = |places: &Places| -> (Vec<[f32; 3]>, Vec<rerun::Quaternion>) {
            places
                .iter()
                .filter_map(|(link, origin)| Some(self.poses.get(*link)? * origin))
                .map(|pose| {
                    let place = self.view_from_palm * pose.translation.vector;
                    (point(&place), quaternion(&(self.view_from_palm * pose.rotation)))
                })
                .unzip()
        };
        let (centers, turns) = place(&self.boxes);
        let boxes = Boxes3D::update_fields().with_centers(centers).with_quaternions(turns);
        let (centers, turns) = place(&self.cylinders);
        let cylinders = Cylinders3D::update_fields().with_centers(centers).with_quaternions(turns);
        let (centers, _) = place(&self.spheres);
        let spheres = Ellipsoids3D::update_fields().with_centers(centers);
        stream.log("robot/hand", &[&boxes as &dyn AsComponents, &cylinders, &spheres])
    }

    /// The commanded posture as a skeleton, hidden inside the fingers while they follow, and p_Q, p_C and p_input of
    /// every finger: p_input runs along the line from p_Q to p_C as k grows.
    fn targets(&self, frame: &RobotFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let show = |p: &Vector3<f64>| point(&(self.view_from_palm * p));
        let q = self.padded(&frame.q_command);
        let mut strips: Vec<(Vec<[f32; 3]>, Color, f32)> = Vec::new();
        for finger in &self.hand.fingers {
            let skeleton = skeleton(finger, &finger.select(&q)).iter().map(show).collect();
            strips.push((skeleton, palette::COMMAND, 0.0012));
        }
        let mut dots: Vec<([f32; 3], Color, f32)> = Vec::new();
        for signals in frame.mapping.iter().flat_map(|mapping| mapping.fingers()) {
            let (p_joint, p_cartesian) = (show(&signals.p_joint), show(&signals.p_cartesian));
            dots.push((p_joint, palette::JOINT, 0.0032));
            // Outside the spheres p_C steers nothing, and far from the hand it would only distract.
            if signals.k > 0.0 {
                let color = palette::fade(palette::finger(signals.finger), 0.4 + 0.6 * signals.k);
                strips.push((vec![p_joint, p_cartesian], color, 0.0009));
                dots.push((p_cartesian, palette::CARTESIAN, 0.0036));
                dots.push((show(&signals.p_input), palette::BLEND, 0.0044));
            }
        }
        let lines = LineStrips3D::new(strips.iter().map(|strip| strip.0.as_slice()))
            .with_colors(strips.iter().map(|strip| strip.1))
            .with_radii(strips.iter().map(|strip| strip.2));
        let points = Points3D::new(dots.iter().map(|dot| dot.0))
            .with_colors(dots.iter().map(|dot| dot.1))
            .with_radii(dots.iter().map(|dot| dot.2));
        stream.log("robot/hand/targets", &[&lines as &dyn AsComponents, &points])
    }
}

/// The joint centres and the tip of a finger in the palm frame, m; `q` are the finger's own angles.
fn skeleton(finger: &FingerChain, q: &[f64]) -> Vec<Vector3<f64>> {
    let (mut position, mut rotation) = (Vector3::zeros(), Matrix3::identity());
    let mut points = Vec::with_capacity(finger.joints.len() + 1);
    for (joint, &angle) in finger.joints.iter().zip(q) {
        position += rotation * joint.translation;
        rotation *= joint.rotation_at(angle);
        points.push(position);
    }
    points.push(position + rotation * finger.pole);
    points
}

/// Sends sizes and colours of the hand's shapes.
fn shapes(hand: &HandModel, stream: &RecordingStream) -> RecordingStreamResult<(Places, Places, Places)> {
    let (mut boxes, mut cylinders, mut spheres) = (Places::new(), Places::new(), Places::new());
    let (mut halves, mut lengths, mut radii, mut balls) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut colors: [Vec<Color>; 3] = Default::default();
    for (index, link) in hand.links.iter().enumerate() {
        for visual in &link.visuals {
            let color = match finger_of(hand, index) {
                // The light rubber of the fingertips, so that the fingers can be told apart.
                Some(finger) if visual.rgba[..3].iter().all(|&c| c > 0.6) => palette::finger(finger),
                _ => {
                    let [r, g, b, a] = visual.rgba.map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8);
                    palette::rgba(r, g, b, a)
                }
            };
            match visual.shape {
                Shape::Box { size } => {
                    boxes.push((index, visual.origin));
                    halves.push(size.map(|edge| (edge / 2.0) as f32));
                    colors[0].push(color);
                }
                Shape::Cylinder { radius, length } => {
                    cylinders.push((index, visual.origin));
                    lengths.push(length as f32);
                    radii.push(radius as f32);
                    colors[1].push(color);
                }
                Shape::Sphere { radius } => {
                    spheres.push((index, visual.origin));
                    balls.push(radius as f32);
                    colors[2].push(color);
                }
            }
        }
    }
    let [of_boxes, of_cylinders, of_spheres] = colors;
    let fill = FillMode::Solid;
    let boxes3d = Boxes3D::from_half_sizes(halves).with_colors(of_boxes).with_fill_mode(fill);
    let cylinders3d = Cylinders3D::from_lengths_and_radii(lengths, radii).with_colors(of_cylinders);
    let cylinders3d = cylinders3d.with_fill_mode(fill);
    let spheres3d = Ellipsoids3D::from_radii(balls).with_colors(of_spheres).with_fill_mode(fill);
    stream.log_static("robot/hand", &[&boxes3d as &dyn AsComponents, &cylinders3d, &spheres3d])?;
    Ok((boxes, cylinders, spheres))
}

/// The finger that carries a link.
fn finger_of(hand: &HandModel, mut link: usize) -> Option<Finger> {
    loop {
        let current = hand.links.get(link)?;
        let carried = |finger: &&FingerChain| finger.joints.iter().any(|joint| Some(joint.joint) == current.joint);
        if let Some(finger) = hand.fingers.iter().find(carried) {
            return Some(finger.finger);
        }
        link = current.parent?;
    }
}

/// Sends the colours of the modes.
fn modes(stream: &RecordingStream) -> RecordingStreamResult<()> {
    let style = StateConfiguration::new().with_values(Mode::ALL.map(Mode::name)).with_colors(Mode::ALL.map(mode_color));
    stream.log_static("robot/mode", &style)
}

const fn mode_color(mode: Mode) -> Color {
    match mode {
        Mode::Disarmed => palette::FAINT,
        Mode::Armed => palette::rgb(120, 160, 220),
        Mode::Engaging => palette::rgb(140, 210, 120),
        Mode::Engaged => palette::rgb(40, 200, 140),
        Mode::Holding => palette::rgb(240, 170, 40),
        Mode::Relaxed => palette::rgb(200, 140, 80),
        Mode::Stopped => palette::rgb(230, 90, 150),
        Mode::Faulted => palette::rgb(235, 64, 52),
    }
}
