//! The paper's figures as a recording: clouds to turn, motions to play.

use std::path::Path;

use nalgebra::Vector3;
use rerun::blueprint::components::PlayState;
use rerun::sink::FileSink;
use rerun::{
    Color, LineStrips3D, Points3D, RecordingStream, RecordingStreamBuilder, RecordingStreamResult, Scalars,
    SeriesLines, TextDocument, TimeColumn,
};

use super::blueprint::{self, Eye, Layout, Node};
use super::scene::space::{from_master, point};
use super::{APPLICATION, VizError, palette};
use crate::hand::{Finger, HandModel, HandSide, MAX_FINGER_JOINTS};
use crate::mapping::FingerSignals;
use crate::master::MasterGeometry;
use crate::paper::motion::Sample;
use crate::paper::table1::points;

/// The time line of the motions, s from their start.
const TIMELINE: &str = "t";
/// Where the human hand is drawn beside the robot's, m.
const BESIDE: f64 = 0.22;

/// Values over the cube of three phalanx lengths.
#[derive(Clone, Debug)]
pub struct PaperCloud {
    /// Name, one word.
    pub name: String,
    /// Lengths (m) and value.
    pub points: Vec<([f64; 3], f64)>,
}

/// A motion under the mapping.
#[derive(Clone, Debug)]
pub struct PaperRun<'a> {
    /// Name, one word.
    pub name: String,
    /// Its samples, in order.
    pub samples: &'a [Sample],
}

/// Writes clouds and motions into an `.rrd` file.
///
/// # Errors
/// A file that cannot be written.
pub fn save_paper(path: &Path, hand: &HandModel, clouds: &[PaperCloud], runs: &[PaperRun<'_>]) -> Result<(), VizError> {
    let fail = |reason: String| VizError::Save { path: path.to_owned(), reason };
    let sink = FileSink::new(path).map_err(|error| fail(error.to_string()))?;
    write(sink, hand, clouds, runs).map_err(|error| fail(error.to_string()))
}

fn write(sink: FileSink, hand: &HandModel, clouds: &[PaperCloud], runs: &[PaperRun<'_>]) -> RecordingStreamResult<()> {
    blueprint::send_layout(&sink, &layout(clouds, runs))?;
    let stream = RecordingStreamBuilder::new(APPLICATION).recording_id("paper").enabled(true).buffered()?;
    stream.set_log_time_enabled(false);
    stream.set_sink(Box::new(sink));
    stream.log_static("about", &TextDocument::from_markdown(ABOUT))?;
    clouds.iter().try_for_each(|cloud| self::cloud(cloud, &stream))?;
    for run in runs {
        motion(run, hand, &stream)?;
        signals(run, &stream)?;
    }
    stream.flush_blocking().ok();
    Ok(())
}

const ABOUT: &str = "# The paper's figures\n\n\
**Fig. 2**: the axes are the phalanx lengths a1, a2, a3 of the slave's index, 10 to 50 mm; yellow is the largest \
magnitude, violet the smallest.\n\n\
**Fig. 8**: the human hand left, the robot's right, over the time line *t*. Targets of the robot's tips: p_C red \
(Cartesian mapping), p_Q white (joint mapping), p_input yellow (their blend).\n";

fn layout(clouds: &[PaperCloud], runs: &[PaperRun<'_>]) -> Layout {
    let mut tabs = Vec::new();
    for run in runs {
        let name = &run.name;
        let signals = [("k", "k"), ("e_Q", "e_Q [rad]"), ("e_C", "e_C [mm]"), ("delta", "thumb to finger, human [mm]")];
        let end = run.samples.last().map_or(0, |sample| (sample.t * 1e9) as i64);
        let plots =
            signals.map(|(signal, title)| (1.0, blueprint::whole_plot(title, &format!("/{name}/{signal}"), end)));
        let eye = Eye { target: [-0.06, 0.04, 0.03], distance: 0.62 };
        let hands = blueprint::space("both hands", &format!("{name}/hands"), eye);
        let plots = Node::Column(plots.into_iter().collect());
        tabs.push(Node::Row(vec![(1.1, hands), (1.0, plots)]).titled(name));
    }
    // Quantities beside each other, postures below each other.
    let columns = clouds.len().div_ceil(3).max(1);
    let rows = clouds.chunks(columns).map(|row| {
        let views = row.iter().map(|cloud| {
            (1.0, blueprint::view("3D", &cloud.name.replace('_', " "), &format!("/fig2/{}", cloud.name), &["$origin"]))
        });
        (1.0, Node::Row(views.collect()))
    });
    tabs.push(Node::Column(rows.collect()).titled("fig2"));
    tabs.push(blueprint::view("TextDocument", "about", "/about", &["$origin"]));
    Layout { root: Node::Tabs(tabs, 0), timeline: TIMELINE, play: PlayState::Paused }
}

fn cloud(cloud: &PaperCloud, stream: &RecordingStream) -> RecordingStreamResult<()> {
    let largest = cloud.points.iter().map(|(_, value)| value.abs()).fold(f64::MIN_POSITIVE, f64::max);
    let path = format!("fig2/{}", cloud.name);
    // In mm: the cube of 10 to 50.
    let places = cloud.points.iter().map(|(lengths, _)| lengths.map(|length| (length * 1e3) as f32));
    let colors = cloud.points.iter().map(|(_, value)| {
        let [r, g, b] = palette::heat(value.abs() / largest);
        palette::rgb(r, g, b)
    });
    let labels = cloud.points.iter().map(|(_, value)| format!("{value:.2}"));
    let points =
        Points3D::new(places).with_colors(colors).with_radii([1.1]).with_labels(labels).with_show_labels(false);
    stream.log_static(format!("{path}/values"), &points)?;
    let axes = [[60.0, 5.0, 5.0], [5.0, 60.0, 5.0], [5.0, 5.0, 60.0]];
    let strips = axes.map(|end| vec![[5.0, 5.0, 5.0], end]);
    let axes = LineStrips3D::new(strips).with_labels(["a1 [mm]", "a2 [mm]", "a3 [mm]"]).with_colors([palette::FAINT]);
    stream.log_static(format!("{path}/axes"), &axes)
}

/// Both hands and the targets, over time.
fn motion(run: &PaperRun<'_>, hand: &HandModel, stream: &RecordingStream) -> RecordingStreamResult<()> {
    let root = format!("{}/hands", run.name);
    let strip = |points: Vec<Vector3<f64>>, offset: f64| -> Vec<[f32; 3]> {
        let place = |p: Vector3<f64>| point(&(from_master(&p, hand.side) + Vector3::x() * offset));
        points.into_iter().map(place).collect()
    };
    // The thumbs point to each other's side: the human hand stands on the side of the robot's little finger.
    let offset = if hand.side == HandSide::Right { -BESIDE } else { BESIDE };
    let human = MasterGeometry::PARADIGMATIC.bases.map(Vector3::from);
    let robot = hand.fingers.iter().filter_map(|chain| points(hand, chain, &[0.0; MAX_FINGER_JOINTS]).first().copied());
    for (name, bases, offset) in [("human_palm", human.to_vec(), offset), ("robot_palm", robot.collect(), 0.0)] {
        let spokes = bases.into_iter().map(|base| strip(vec![Vector3::zeros(), base], offset));
        let strips = LineStrips3D::new(spokes).with_colors([palette::PALM]).with_radii([0.003]);
        stream.log_static(format!("{root}/{name}"), &strips)?;
    }
    for sample in run.samples {
        stream.set_duration_secs(TIMELINE, sample.t);
        let human = Finger::ALL.map(|finger| {
            let points = sample.pose.geometry.finger_points(finger, &sample.pose.finger(finger));
            strip(points.to_vec(), offset)
        });
        let strips = LineStrips3D::new(human).with_colors(Finger::ALL.map(palette::finger)).with_radii([0.005]);
        stream.log(format!("{root}/human"), &strips)?;
        let fingers = || hand.fingers.iter().map(|chain| chain.finger);
        let robot = hand.fingers.iter().map(|chain| strip(points(hand, chain, &chain.select(&sample.output.q)), 0.0));
        let strips = LineStrips3D::new(robot).with_colors(fingers().map(palette::finger)).with_radii([0.007]);
        stream.log(format!("{root}/robot"), &strips)?;
        type Target = (&'static str, Color, fn(&FingerSignals) -> Vector3<f64>);
        let targets: [Target; 3] = [
            ("p_C", palette::CARTESIAN, |signals| signals.p_cartesian),
            ("p_Q", palette::JOINT, |signals| signals.p_joint),
            ("p_input", palette::BLEND, |signals| signals.p_input),
        ];
        for (name, color, value) in targets {
            let places = sample.output.fingers().iter().map(|signals| hand.anatomical_from_palm * value(signals));
            let points = Points3D::new(strip(places.collect(), 0.0)).with_colors([color]).with_radii([0.004]);
            stream.log(format!("{root}/{name}"), &points)?;
        }
    }
    Ok(())
}

/// Gains and errors, over time.
fn signals(run: &PaperRun<'_>, stream: &RecordingStream) -> RecordingStreamResult<()> {
    let Some(first) = run.samples.first() else { return Ok(()) };
    let fingers: Vec<Finger> = first.output.fingers().iter().map(|signals| signals.finger).collect();
    type Signal = (&'static str, fn(&FingerSignals) -> f64);
    let curves: [Signal; 4] = [
        ("k", |signals| signals.k),
        ("e_Q", |signals| signals.e_q),
        ("e_C", |signals| signals.e_c * 1e3),
        ("delta", |signals| signals.delta * 1e3),
    ];
    for (name, value) in curves {
        let path = format!("{}/{name}", run.name);
        let style = SeriesLines::new()
            .with_names(fingers.iter().map(|finger| finger.name()))
            .with_colors(fingers.iter().map(|finger| palette::finger(*finger)))
            .with_widths(fingers.iter().map(|_| 1.6));
        stream.log_static(path.as_str(), &style)?;
        let times = TimeColumn::new_duration_secs(TIMELINE, run.samples.iter().map(|sample| sample.t));
        let values = run.samples.iter().flat_map(|sample| sample.output.fingers().iter().map(value));
        let columns = Scalars::new(values).columns(std::iter::repeat_n(fingers.len(), run.samples.len()))?;
        stream.send_columns(path.as_str(), [times], columns)?;
    }
    Ok(())
}
