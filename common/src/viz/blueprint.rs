//! The layout of the first view.
//!
//! Rerun's own blueprint builder cannot set a 3D camera or the time window of a plot, so this writes the blueprint's
//! entities itself. All ids are fixed: both processes send the same blueprint, in any order.

use rerun::blueprint::components::{
    ActiveTab, BackgroundKind, ColumnShare, ContainerKind, Corner2D, Eye3DKind, IncludedContent, PanelState, PlayState,
    QueryExpression, RootContainer, RowShare, ViewClass, VisibleTimeRange,
};
use rerun::datatypes::{self, TimeInt, TimeRange, TimeRangeBoundary, Uuid};
use rerun::external::re_log_types::{BlueprintActivationCommand, LogMsg};
use rerun::external::re_sdk_types::blueprint::archetypes::{
    Background, ContainerBlueprint, EyeControls3D, LineGrid3D, PanelBlueprint, PlotLegend, ScalarAxis, TimeAxis,
    TimePanelBlueprint, ViewBlueprint, ViewContents, ViewportBlueprint, VisibleTimeRanges,
};
use rerun::sink::LogSink;
use rerun::{AsComponents, RecordingStream, RecordingStreamBuilder, RecordingStreamResult, SerializedComponentBatch};

use super::{APPLICATION, TIMELINE, palette};

/// What the plots show, ns.
const WINDOW: i64 = 20_000_000_000;

/// Sends the blueprint into `sink`, ahead of the recording: a viewer that sees the recording first makes up a layout of
/// its own and stays with it. A layout that a person has arranged stays too: this one becomes the default, and active
/// only where there is no other.
pub(super) fn send(sink: &dyn LogSink) -> RecordingStreamResult<()> {
    send_layout(sink, &Layout { root: layout(), timeline: TIMELINE, play: PlayState::Following })
}

/// What a viewer shows first.
pub(super) struct Layout {
    pub(super) root: Node,
    pub(super) timeline: &'static str,
    pub(super) play: PlayState,
}

/// Sends a layout as [`send`] does.
pub(super) fn send_layout(sink: &dyn LogSink, layout: &Layout) -> RecordingStreamResult<()> {
    let messages = messages(layout)?;
    if let Some(id) = messages.first().map(|message| message.store_id().clone()) {
        sink.send_blueprint(messages, BlueprintActivationCommand::make_default(id));
    }
    Ok(())
}

fn messages(layout: &Layout) -> RecordingStreamResult<Vec<LogMsg>> {
    let (stream, storage) =
        RecordingStreamBuilder::new(APPLICATION).recording_id("layout").blueprint().enabled(true).memory()?;
    stream.set_log_time_enabled(false);
    stream.set_time_sequence("blueprint", 0);
    let mut ids = 0;
    let root = write(&layout.root, &mut ids, &stream)?;
    let viewport = ViewportBlueprint::new()
        .with_root_container(RootContainer(Uuid { bytes: uuid_bytes(root.id) }))
        .with_auto_layout(false)
        .with_auto_views(false);
    stream.log("viewport", &viewport)?;
    let collapsed = PanelBlueprint::new().with_state(PanelState::Collapsed);
    stream.log("blueprint_panel", &collapsed)?;
    stream.log("selection_panel", &collapsed)?;
    let time = TimePanelBlueprint::new()
        .with_state(PanelState::Collapsed)
        .with_timeline(layout.timeline)
        .with_play_state(layout.play);
    stream.log("time_panel", &time)?;
    Ok(storage.take())
}

fn layout() -> Node {
    let human = space("human hand", "operator/hand", Eye { target: [0.026, 0.080, 0.020], distance: 0.275 });
    let robot = space("robot hand", "robot/hand", Eye { target: [0.010, 0.020, 0.030], distance: 0.46 });
    // The lanes of a StateTimelineView stay where they were when it was opened; a plot of bands moves with the time.
    let mode = plot("mode (above), operator connected (below)", &["/robot/band", "/operator/band"], Some([-0.6, 1.6]));
    let history = view("StateTimeline", "since the start", "/", &["/robot/mode", "/operator/connection"]);
    let joints = ["thumb", "index", "middle", "ring"]
        .map(|finger| plot(&format!("{finger} [rad]"), &[&format!("/robot/joints/{finger}")], None))
        .into_iter()
        .chain([plot("speed [rad/s]", &["/robot/joints/speed"], None)]);
    let bottom = Node::Row(vec![
        (1.0, plot("latency [ms]", &["/operator/network", "/robot/timing"], None)),
        (1.3, view("TextLog", "log", "/", &["/operator/log", "/robot/log"])),
    ]);
    Node::Row(vec![
        (
            1.25,
            Node::Column(vec![
                (4.2, Node::Row(vec![(1.0, human), (1.0, robot)])),
                (0.95, Node::Tabs(vec![mode, history], 0)),
                (1.35, bottom),
            ]),
        ),
        (
            1.0,
            Node::Column(vec![
                (1.0, plot("k: 0 joint, 1 Cartesian mapping", &["/robot/mapping/k"], Some([-0.05, 1.05]))),
                (1.0, plot("e_Q: distance from the joint mapping [rad]", &["/robot/mapping/e_Q"], None)),
                (1.0, plot("e_C: distance from the Cartesian mapping [mm]", &["/robot/mapping/e_C"], None)),
                (1.0, plot("thumb to finger tip [mm]", &["/operator/distance", "/robot/mapping/distance"], None)),
                (1.2, Node::Tabs(joints.collect(), 1)),
            ]),
        ),
    ])
}

/// A container with the share of each child, or a view.
pub(super) enum Node {
    Row(Vec<(f32, Self)>),
    Column(Vec<(f32, Self)>),
    /// Children and the one in front.
    Tabs(Vec<Self>, usize),
    View(View),
    /// A container with a name of its own, for a tab.
    Titled(String, Box<Self>),
}

impl Node {
    pub(super) fn titled(self, title: &str) -> Self {
        Self::Titled(title.to_owned(), Box::new(self))
    }
}

pub(super) struct View {
    class: &'static str,
    name: String,
    origin: String,
    contents: Vec<String>,
    properties: Vec<(&'static str, Vec<SerializedComponentBatch>)>,
}

impl View {
    fn with(mut self, name: &'static str, property: &dyn AsComponents) -> Self {
        self.properties.push((name, property.as_serialized_batches()));
        self
    }
}

pub(super) struct Eye {
    pub(super) target: [f32; 3],
    pub(super) distance: f32,
}

fn bare(class: &'static str, name: &str, origin: &str, contents: &[&str]) -> View {
    let contents = contents.iter().map(|path| format!("{path}/**")).collect();
    View { class, name: name.to_owned(), origin: origin.to_owned(), contents, properties: Vec::new() }
}

/// A view with the viewer's own settings.
pub(super) fn view(class: &'static str, name: &str, origin: &str, contents: &[&str]) -> Node {
    Node::View(bare(class, name, origin, contents))
}

/// A 3D view on a hand, from the front, a little from the thumb's side and from above.
pub(super) fn space(name: &str, root: &str, eye: Eye) -> Node {
    // A unit vector towards the eye.
    const FROM: [f32; 3] = [0.42, 0.18, 0.889];
    let position: [f32; 3] = std::array::from_fn(|i| eye.target[i] + FROM[i] * eye.distance);
    let controls = EyeControls3D::new()
        .with_kind(Eye3DKind::Orbital)
        .with_position(position)
        .with_look_target(eye.target)
        .with_eye_up([0.0, 1.0, 0.0]);
    let background = Background::new(BackgroundKind::SolidColor).with_color(palette::rgb(44, 48, 57));
    let origin = format!("/{root}");
    Node::View(
        bare("3D", name, &origin, &["$origin"])
            .with("EyeControls3D", &controls)
            .with("Background", &background)
            .with("LineGrid3D", &LineGrid3D::new().with_visible(false)),
    )
}

/// A plot of the last [`WINDOW`].
fn plot(name: &str, contents: &[&str], range: Option<[f64; 2]>) -> Node {
    let view = windowed(bare("TimeSeries", name, "/", contents))
        .with("PlotLegend", &PlotLegend::new().with_corner(Corner2D::LeftTop));
    Node::View(match range {
        Some(range) => view.with("ScalarAxis", &ScalarAxis::new().with_range(range)),
        None => view,
    })
}

/// A plot from 0 to `end`, ns.
pub(super) fn whole_plot(name: &str, contents: &str, end: i64) -> Node {
    let [start, end] = [0, end].map(|time| TimeRangeBoundary::Absolute(TimeInt(time)));
    let legend = PlotLegend::new().with_corner(Corner2D::LeftTop);
    let view = bare("TimeSeries", name, "/", &[contents]).with("PlotLegend", &legend);
    Node::View(view.with("TimeAxis", &TimeAxis::new().with_view_range(TimeRange { start, end })))
}

fn windowed(view: View) -> View {
    let window = TimeRange {
        start: TimeRangeBoundary::CursorRelative(TimeInt(-WINDOW)),
        end: TimeRangeBoundary::CursorRelative(TimeInt(0)),
    };
    let query = VisibleTimeRange(datatypes::VisibleTimeRange { timeline: TIMELINE.into(), range: window });
    view.with("TimeAxis", &TimeAxis::new().with_view_range(window))
        .with("VisibleTimeRanges", &VisibleTimeRanges::new([query]))
}

/// A node that has been written.
struct Written {
    id: u64,
    path: String,
}

fn uuid_bytes(id: u64) -> [u8; 16] {
    // Any fixed bytes do; the version and variant bits make them a valid random UUID.
    let mut bytes = [0x74, 0x65, 0x6c, 0x65, 0x6f, 0x70, 0x40, 0x00, 0x80, 0, 0, 0, 0, 0, 0, 0];
    bytes[8..].copy_from_slice(&(id | 0x80 << 56).to_be_bytes());
    bytes
}

fn uuid_text(id: u64) -> String {
    let hex: Vec<String> = uuid_bytes(id).iter().map(|byte| format!("{byte:02x}")).collect();
    [&hex[..4], &hex[4..6], &hex[6..8], &hex[8..10], &hex[10..]].map(<[String]>::concat).join("-")
}

fn write(node: &Node, ids: &mut u64, stream: &RecordingStream) -> RecordingStreamResult<Written> {
    *ids += 1;
    let id = *ids;
    let container = |kind: ContainerKind, children: Vec<Written>, shares: Vec<f32>, front: Option<usize>| {
        let path = format!("/container/{}", uuid_text(id));
        let mut blueprint = ContainerBlueprint::new(kind);
        blueprint = match kind {
            ContainerKind::Horizontal => {
                blueprint.with_col_shares(shares.into_iter().map(|share| ColumnShare(share.into())))
            }
            ContainerKind::Vertical => {
                blueprint.with_row_shares(shares.into_iter().map(|share| RowShare(share.into())))
            }
            _ => blueprint,
        };
        if let Some(child) = front.and_then(|front| children.get(front)) {
            blueprint = blueprint.with_active_tab(ActiveTab(child.path.as_str().into()));
        }
        let contents = children.into_iter().map(|child| IncludedContent(child.path.into()));
        stream.log(path.as_str(), &blueprint.with_contents(contents))?;
        Ok(Written { id, path })
    };
    let mut split = |children: &[(f32, Node)]| -> RecordingStreamResult<(Vec<Written>, Vec<f32>)> {
        let written = children.iter().map(|(_, child)| write(child, ids, stream)).collect::<RecordingStreamResult<_>>();
        Ok((written?, children.iter().map(|(share, _)| *share).collect()))
    };
    match node {
        Node::Row(children) => {
            let (children, shares) = split(children)?;
            container(ContainerKind::Horizontal, children, shares, None)
        }
        Node::Column(children) => {
            let (children, shares) = split(children)?;
            container(ContainerKind::Vertical, children, shares, None)
        }
        Node::Tabs(children, front) => {
            let written = children.iter().map(|child| write(child, ids, stream)).collect::<RecordingStreamResult<_>>();
            container(ContainerKind::Tabs, written?, Vec::new(), Some(*front))
        }
        Node::Titled(title, node) => {
            let written = write(node, ids, stream)?;
            stream
                .log(written.path.as_str(), &ContainerBlueprint::update_fields().with_display_name(title.as_str()))?;
            Ok(written)
        }
        Node::View(view) => {
            let path = format!("/view/{}", uuid_text(id));
            let contents = view.contents.iter().map(|query| QueryExpression(query.as_str().into()));
            stream.log(format!("{path}/ViewContents"), &ViewContents::new(contents))?;
            let blueprint = ViewBlueprint::new(ViewClass(view.class.into()))
                .with_display_name(view.name.as_str())
                .with_space_origin(view.origin.as_str());
            stream.log(path.as_str(), &blueprint)?;
            for (name, batches) in &view.properties {
                stream.log_serialized_batches(format!("{path}/{name}"), false, batches.iter().cloned())?;
            }
            Ok(Written { id, path })
        }
    }
}
