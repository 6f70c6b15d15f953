use rerun::{Color, RecordingStream, RecordingStreamResult, Scalars, SeriesLines, TimeColumn};

use super::super::TIMELINE;

/// Samples sent together: at 50 Hz five chunks a second and entity instead of fifty.
const BATCH: usize = 10;

/// One line of a plot.
pub(super) struct Curve {
    pub(super) name: String,
    pub(super) color: Color,
    pub(super) width: f32,
}

impl Curve {
    pub(super) fn new(name: impl Into<String>, color: Color) -> Self {
        Self { name: name.into(), color, width: 1.6 }
    }

    pub(super) fn thin(name: impl Into<String>, color: Color) -> Self {
        Self { name: name.into(), color, width: 0.8 }
    }
}

impl Curve {
    /// A band, for a state that is there or not.
    pub(super) fn band(name: impl Into<String>, color: Color) -> Self {
        Self { name: name.into(), color, width: 9.0 }
    }
}

/// The curves of one entity, sent column-wise.
pub(super) struct Series {
    path: String,
    width: usize,
    times: Vec<i64>,
    values: Vec<f64>,
}

impl Series {
    /// Sends names and colours.
    pub(super) fn new(
        path: impl Into<String>,
        curves: &[Curve],
        stream: &RecordingStream,
    ) -> RecordingStreamResult<Self> {
        let path = path.into();
        let style = SeriesLines::new()
            .with_names(curves.iter().map(|curve| curve.name.as_str()))
            .with_colors(curves.iter().map(|curve| curve.color))
            .with_widths(curves.iter().map(|curve| curve.width));
        stream.log_static(path.as_str(), &style)?;
        Ok(Self { path, width: curves.len(), times: Vec::new(), values: Vec::new() })
    }

    /// Adds a sample; missing values become gaps, values without a curve are left out.
    pub(super) fn push(
        &mut self,
        time: i64,
        values: impl IntoIterator<Item = f64>,
        stream: &RecordingStream,
    ) -> RecordingStreamResult<()> {
        self.times.push(time);
        self.values.extend(values.into_iter().chain(std::iter::repeat(f64::NAN)).take(self.width));
        if self.times.len() >= BATCH { self.flush(stream) } else { Ok(()) }
    }

    /// Sends the samples collected so far.
    pub(super) fn flush(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        if self.times.is_empty() {
            return Ok(());
        }
        let count = self.times.len();
        let times = TimeColumn::new_timestamp_nanos_since_epoch(TIMELINE, self.times.drain(..));
        let columns = Scalars::new(self.values.drain(..)).columns(std::iter::repeat_n(self.width, count))?;
        stream.send_columns(self.path.as_str(), [times], columns)
    }
}
