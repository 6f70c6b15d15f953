use nalgebra::Vector3;
use rerun::{
    AsComponents, Capsules3D, Ellipsoids3D, FillMode, LineStrips3D, RecordingStream, RecordingStreamResult,
    StateConfiguration,
};

use super::series::{Curve, Series};
use super::space::{along, from_master, point, quaternion};
use super::{Lane, PLOT_PERIOD, Pace, SPACE_PERIOD};
use crate::hand::{Finger, HandSide};
use crate::mapping::{Gain, GainShape};
use crate::master::MasterGeometry;
use crate::viz::frame::OperatorFrame;
use crate::viz::{TIMELINE, palette};

/// Radii of the phalanges, m: of flesh, not of the model.
const RADII: [[f64; 3]; 5] = [
    [0.0085, 0.0080, 0.0072],
    [0.0078, 0.0068, 0.0062],
    [0.0080, 0.0070, 0.0064],
    [0.0078, 0.0068, 0.0062],
    [0.0068, 0.0060, 0.0050],
];
const METACARPAL_RADIUS: f64 = 0.0088;

const CONNECTED: &str = "connected";
const ALONE: &str = "not connected";

/// The human hand and the operator's plots.
pub(super) struct Drawing<'a> {
    side: HandSide,
    opposing: &'a [Finger],
    space: Pace,
    plots: Pace,
    /// The hand whose sizes have been sent.
    geometry: Option<MasterGeometry>,
    /// The radii that have been sent.
    radii: Option<[f64; 2]>,
    delta: Series,
    network: Series,
    connection: Lane,
    connection_band: Series,
}

impl<'a> Drawing<'a> {
    pub(super) fn new(side: HandSide, opposing: &'a [Finger], stream: &RecordingStream) -> RecordingStreamResult<Self> {
        let distances: Vec<Curve> = opposing
            .iter()
            .map(|finger| Curve::thin(format!("human {}", finger.name()), palette::finger(*finger)))
            .collect();
        let network =
            [Curve::new("round trip", palette::joint(0)), Curve::new("keypoint residual [mm]", palette::joint(3))];
        let states = [(CONNECTED, palette::finger(Finger::Index)), (ALONE, palette::FAINT)];
        let style =
            StateConfiguration::new().with_values(states.map(|state| state.0)).with_colors(states.map(|state| state.1));
        let bands = [Curve::band("operator connected", palette::finger(Finger::Index))];
        stream.log_static("operator/connection", &style)?;
        Ok(Self {
            side,
            opposing,
            space: Pace::new(SPACE_PERIOD),
            plots: Pace::new(PLOT_PERIOD),
            geometry: None,
            radii: None,
            delta: Series::new("operator/distance", &distances, stream)?,
            network: Series::new("operator/network", &network, stream)?,
            connection: Lane::new("operator/connection"),
            connection_band: Series::new("operator/band", &bands, stream)?,
        })
    }

    pub(super) fn draw(&mut self, frame: &OperatorFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        stream.set_timestamp_nanos_since_epoch(TIMELINE, frame.time);
        let connection = if frame.round_trip.is_some() { CONNECTED } else { ALONE };
        self.connection.set(frame.time, connection, stream)?;
        if self.plots.due(frame.time) {
            let band = if frame.round_trip.is_some() { 0.0 } else { f64::NAN };
            self.connection_band.push(frame.time, [band], stream)?;
            let thumb = frame.pose.tip(Finger::Thumb);
            let delta = self.opposing.iter().map(|finger| (frame.pose.tip(*finger) - thumb).norm() * 1e3);
            self.delta.push(frame.time, delta, stream)?;
            let milli = |value: Option<f64>| value.map_or(f64::NAN, |value| value * 1e3);
            self.network.push(frame.time, [milli(frame.round_trip), milli(frame.residual)], stream)?;
        }
        if self.space.due(frame.time) {
            self.hand(frame, stream)?;
            self.neighbourhood(frame, stream)?;
        }
        Ok(())
    }

    pub(super) fn finish(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        self.delta.flush(stream)?;
        self.connection_band.flush(stream)?;
        self.network.flush(stream)
    }

    fn hand(&mut self, frame: &OperatorFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        if self.geometry != Some(frame.pose.geometry) {
            self.geometry = Some(frame.pose.geometry);
            self.sizes(&frame.pose.geometry, stream)?;
        }
        let mut places = Vec::with_capacity(15);
        let mut turns = Vec::with_capacity(15);
        for finger in Finger::ALL {
            let points = frame.pose.geometry.finger_points(finger, &frame.pose.finger(finger));
            let points = points.map(|p| from_master(&p, self.side));
            for pair in points.windows(2) {
                places.push(point(&pair[0]));
                turns.push(quaternion(&along(&(pair[1] - pair[0]))));
            }
        }
        let moved = Capsules3D::update_fields().with_translations(places).with_quaternions(turns);
        stream.log("operator/hand", &moved)
    }

    /// The parts of the hand that change with the person only: lengths, radii, the palm.
    fn sizes(&self, geometry: &MasterGeometry, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let mut lengths = Vec::with_capacity(15);
        let mut radii = Vec::with_capacity(15);
        let mut colors = Vec::with_capacity(15);
        for finger in Finger::ALL {
            let i = finger.index();
            for (slot, (&length, &radius)) in geometry.phalanges[i].iter().zip(&RADII[i]).enumerate() {
                // The fingertip is the far end of the last cap, so that tips that meet are seen to touch.
                let shown = if slot == 2 { (length - radius).max(0.0) } else { length };
                lengths.push(shown as f32);
                radii.push(radius as f32);
                colors.push(palette::finger(finger));
            }
        }
        let fingers =
            Capsules3D::from_lengths_and_radii(lengths, radii).with_colors(colors).with_fill_mode(FillMode::Solid);
        stream.log_static("operator/hand", &fingers)?;

        let mut places = Vec::new();
        let mut turns = Vec::new();
        let mut lengths = Vec::new();
        let mut bone = |from: Vector3<f64>, to: Vector3<f64>| {
            let (from, to) = (from_master(&from, self.side), from_master(&to, self.side));
            places.push(point(&from));
            turns.push(quaternion(&along(&(to - from))));
            lengths.push((to - from).norm() as f32);
        };
        let bases = geometry.bases.map(Vector3::from);
        for finger in Finger::ALL {
            let base = bases[finger.index()];
            let wrist = match finger {
                Finger::Thumb => Vector3::new(0.012, 0.012, 0.0),
                _ => Vector3::new(0.55 * base.x, 0.006, 0.0),
            };
            bone(wrist, base);
        }
        for pair in bases[1..].windows(2) {
            bone(pair[0], pair[1]);
        }
        let count = lengths.len();
        let palm = Capsules3D::from_lengths_and_radii(lengths, vec![METACARPAL_RADIUS as f32; count])
            .with_translations(places)
            .with_quaternions(turns)
            .with_colors([palette::PALM])
            .with_fill_mode(FillMode::Solid);
        stream.log_static("operator/hand/palm", &palm)
    }

    /// The spheres r1 and r2 around the thumb tip, and lines to the fingertips inside r2, in the finger's colour by k.
    fn neighbourhood(&mut self, frame: &OperatorFrame, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let radii = [frame.r1, frame.r2];
        if self.radii != Some(radii) {
            self.radii = Some(radii);
            let spheres = Ellipsoids3D::from_radii(radii.map(|radius| radius as f32))
                .with_colors([palette::BLEND, palette::FAINT])
                .with_line_radii([0.0003, 0.0002])
                .with_fill_mode(FillMode::MajorWireframe);
            stream.log_static("operator/hand/spheres", &spheres)?;
        }
        let thumb = frame.pose.tip(Finger::Thumb);
        let center = point(&from_master(&thumb, self.side));
        let spheres = Ellipsoids3D::update_fields().with_centers([center, center]);

        let gain = Gain { r1: frame.r1, r2: frame.r2, shape: GainShape::Cosine };
        let (mut strips, mut colors, mut labels) = (Vec::new(), Vec::new(), Vec::new());
        for &finger in self.opposing {
            let tip = frame.pose.tip(finger);
            let delta = (tip - thumb).norm();
            let k = gain.at(delta);
            if k > 0.0 {
                strips.push([center, point(&from_master(&tip, self.side))]);
                colors.push(palette::fade(palette::finger(finger), k));
                labels.push(format!("{:.0} mm", delta * 1e3));
            }
        }
        let lines = LineStrips3D::new(strips)
            .with_colors(colors)
            .with_labels(labels)
            .with_show_labels(true)
            .with_radii([0.0006]);
        stream.log("operator/hand/spheres", &[&spheres as &dyn AsComponents, &lines])
    }
}
