use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};
use rerun::{
    Boxes3D, Color, Cylinders3D, Ellipsoids3D, FillMode, LineStrips3D, Points3D, RecordingStream,
    RecordingStreamResult, StateConfiguration,
};

use super::series::{Curve, Series};
use super::space::{from_palm, point, quaternion};
use super::{Lane, PLOT_PERIOD, Pace, SPACE_PERIOD};
use crate::hand::{HandModel, MAX_FINGER_JOINTS, Shape};
use crate::mapping::MappingOutput;
use crate::mode::Mode;
use crate::viz::frame::RobotFrame;
use crate::viz::{TIMELINE, palette};

/// The shapes of one kind: the link each sits on, and where.
type Places = Vec<(usize, Isometry3<f64>)>;

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
}

impl<'a> Drawing<'a> {
    pub(super) fn new(hand: &'a HandModel, stream: &RecordingStream) -> RecordingStreamResult<Self> {
        let per_finger = |what: &str, unit: &str| -> Vec<Curve> {
            let name = |finger: &str| format!("{what} {finger}{unit}");
            hand.fingers.iter().map(|f| Curve::new(name(f.finger.name()), palette::finger(f.finger))).collect()
        };
        let distances: Vec<Curve> = per_finger("robot", " [mm]").into_iter().skip(1).collect();
        let mut joints = Vec::with_capacity(hand.fingers.len());
        for finger in &hand.fingers {
            let name = |slot: usize, what: &str| format!("q{slot} {what} [rad]");
            let slots = 0..finger.joints.len();
            let measured = slots.clone().map(|slot| Curve::new(name(slot, "measured"), palette::joint(slot)));
            let commanded =
                slots.map(|slot| Curve::thin(name(slot, "commanded"), palette::fade(palette::joint(slot), 0.55)));
            let curves: Vec<Curve> = commanded.chain(measured).collect();
            joints.push(Series::new(format!("robot/joints/{}", finger.finger.name()), &curves, stream)?);
        }
        let speeds: Vec<Curve> = hand
            .fingers
            .iter()
            .flat_map(|f| {
                let color = palette::finger(f.finger);
                (0..f.joints.len()).map(move |slot| Curve::thin(format!("{} q{slot} [rad/s]", f.finger.name()), color))
            })
            .collect();
        let timing =
            [Curve::new("age of the pose [ms]", palette::joint(1)), Curve::new("control tick [ms]", palette::joint(2))];
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
            k: Series::new("robot/mapping/k", &per_finger("k", ""), stream)?,
            e_c: Series::new("robot/mapping/e_C", &per_finger("e_C", " [mm]"), stream)?,
            e_q: Series::new("robot/mapping/e_Q", &per_finger("e_Q", " [rad]"), stream)?,
            distance: Series::new("robot/mapping/distance", &distances, stream)?,
            joints,
            speed: Series::new("robot/joints/speed", &speeds, stream)?,
            timing: Series::new("robot/timing", &timing, stream)?,
            mode: Lane::new("robot/mode"),
        })
    }

    pub(super) fn draw(&mut self, frame: &RobotFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        stream.set_timestamp_nanos_since_epoch(TIMELINE, frame.time);
        self.mode.set(frame.mode.name(), stream)?;
        if self.plots.due(frame.time) {
            self.plot(frame, stream)?;
        }
        if self.space.due(frame.time) {
            self.pose(frame, stream)?;
            self.command(frame, stream)?;
            if let Some(mapping) = &frame.mapping {
                self.targets(mapping, stream)?;
            }
        }
        Ok(())
    }

    pub(super) fn finish(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let mapping = [&mut self.k, &mut self.e_c, &mut self.e_q, &mut self.distance];
        for series in mapping.into_iter().chain(&mut self.joints).chain([&mut self.speed, &mut self.timing]) {
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
            let tips: Vec<_> = self
                .hand
                .fingers
                .iter()
                .map(|f| f.tip(&f.select(&self.padded(&frame.q)), crate::hand::TipFrame::Pole))
                .collect();
            if let Some((thumb, others)) = tips.split_first() {
                self.distance.push(time, others.iter().map(|tip| (tip - thumb).norm() * 1e3), stream)?;
            }
        }
        for (finger, series) in self.hand.fingers.iter().zip(&mut self.joints) {
            let value = |values: &[f64], joint: usize| values.get(joint).copied().unwrap_or(f64::NAN);
            let commanded = finger.joints.iter().map(|joint| value(&frame.q_command, joint.joint));
            let measured = finger.joints.iter().map(|joint| value(&frame.q, joint.joint));
            series.push(time, commanded.chain(measured), stream)?;
        }
        let speeds = self.hand.fingers.iter().flat_map(|finger| &finger.joints);
        let speeds = speeds.map(|joint| frame.dq.get(joint.joint).copied().unwrap_or(f64::NAN));
        self.speed.push(time, speeds, stream)?;
        let milli = |value: Option<f64>| value.map_or(f64::NAN, |value| value * 1e3);
        self.timing.push(time, [milli(frame.pose_age), milli(frame.tick)], stream)
    }

    /// `q` with as many values as the hand has joints.
    fn padded(&self, q: &[f64]) -> crate::hand::JointVector {
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
        stream.log("robot/hand/boxes", &boxes)?;
        let (centers, turns) = place(&self.cylinders);
        let cylinders = Cylinders3D::update_fields().with_centers(centers).with_quaternions(turns);
        stream.log("robot/hand/cylinders", &cylinders)?;
        let (centers, _) = place(&self.spheres);
        stream.log("robot/hand/spheres", &Ellipsoids3D::update_fields().with_centers(centers))
    }

    /// The commanded posture as a skeleton: hidden inside the fingers while they follow, in sight when they do not.
    fn command(&self, frame: &RobotFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let q = self.padded(&frame.q_command);
        let strips: Vec<Vec<[f32; 3]>> = self
            .hand
            .fingers
            .iter()
            .map(|finger| {
                let (mut position, mut rotation) = (Vector3::zeros(), Matrix3::identity());
                let mut strip = Vec::with_capacity(MAX_FINGER_JOINTS + 1);
                for (joint, angle) in finger.joints.iter().zip(finger.select(&q)) {
                    position += rotation * joint.translation;
                    rotation *= joint.rotation_at(angle);
                    strip.push(point(&(self.view_from_palm * position)));
                }
                strip.push(point(&(self.view_from_palm * (position + rotation * finger.pole))));
                strip
            })
            .collect();
        let lines = LineStrips3D::new(strips).with_colors([palette::COMMAND]).with_radii([0.0012]);
        stream.log("robot/hand/command", &lines)
    }

    /// p_Q, p_C and p_input of every finger: p_input runs along the line from p_Q to p_C as k grows.
    fn targets(&self, mapping: &MappingOutput, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let show = |p: &Vector3<f64>| point(&(self.view_from_palm * p));
        // Out of the thumb's reach p_C steers nothing, and far outside the hand it would only distract.
        let active: Vec<_> = mapping.fingers().iter().filter(|f| f.k > 0.0).collect();
        let lines = LineStrips3D::new(active.iter().map(|f| [show(&f.p_joint), show(&f.p_cartesian)]))
            .with_colors(active.iter().map(|f| palette::fade(palette::finger(f.finger), 0.4 + 0.6 * f.k)))
            .with_radii([0.0008]);
        stream.log("robot/hand/blend", &lines)?;
        let mut dots: Vec<([f32; 3], Color, f32)> = Vec::with_capacity(3 * mapping.fingers().len());
        dots.extend(mapping.fingers().iter().map(|f| (show(&f.p_joint), palette::JOINT, 0.0032)));
        dots.extend(active.iter().map(|f| (show(&f.p_cartesian), palette::CARTESIAN, 0.0036)));
        dots.extend(active.iter().map(|f| (show(&f.p_input), palette::BLEND, 0.0044)));
        let points = Points3D::new(dots.iter().map(|dot| dot.0))
            .with_colors(dots.iter().map(|dot| dot.1))
            .with_radii(dots.iter().map(|dot| dot.2));
        stream.log("robot/hand/targets", &points)
    }
}

/// Sends sizes and colours of the hand's shapes.
fn shapes(hand: &HandModel, stream: &RecordingStream) -> RecordingStreamResult<(Places, Places, Places)> {
    let (mut boxes, mut cylinders, mut spheres) = (Places::new(), Places::new(), Places::new());
    let (mut halves, mut lengths, mut radii, mut balls) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut colors: [Vec<Color>; 3] = Default::default();
    for (index, link) in hand.links.iter().enumerate() {
        for visual in &link.visuals {
            let [r, g, b, a] = visual.rgba.map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8);
            let color = palette::rgba(r, g, b, a);
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
    let boxes3d = Boxes3D::from_half_sizes(halves).with_colors(of_boxes).with_fill_mode(FillMode::Solid);
    stream.log_static("robot/hand/boxes", &boxes3d)?;
    let cylinders3d = Cylinders3D::from_lengths_and_radii(lengths, radii).with_colors(of_cylinders);
    stream.log_static("robot/hand/cylinders", &cylinders3d.with_fill_mode(FillMode::Solid))?;
    let spheres3d = Ellipsoids3D::from_radii(balls).with_colors(of_spheres).with_fill_mode(FillMode::Solid);
    stream.log_static("robot/hand/spheres", &spheres3d)?;
    Ok((boxes, cylinders, spheres))
}

/// Sends the colours of the modes.
fn modes(stream: &RecordingStream) -> RecordingStreamResult<()> {
    let style =
        StateConfiguration::new().with_values(Mode::ALL.map(Mode::name)).with_colors(Mode::ALL.map(
            |mode| match mode {
                Mode::Idle => palette::FAINT,
                Mode::Engaged => palette::rgb(40, 200, 140),
                Mode::Holding => palette::rgb(240, 170, 40),
                Mode::Faulted => palette::rgb(235, 64, 52),
            },
        ));
    stream.log_static("robot/mode", &style)
}
