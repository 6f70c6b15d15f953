//! The Rerun shell: both processes' signals in one live picture.
//!
//! A process [starts](Viz::start) one session with a [`Viewer`] (where to) and a [`Scene`] (what it draws) and hands
//! out [`Logger`]s. Logging copies a frame into a bounded queue that drops its oldest entry when full, and returns: no
//! lock, no wait, no allocation. Everything that can take long, or hang, happens on threads of this module: Rerun's
//! own `log` blocks for ever once a viewer stops reading, and its client never reconnects.
//!
//! Operator and robot write into one recording, `operator/...` and `robot/...`, on one time line, [`TIMELINE`]. The
//! callers put the times of both on the robot's clock, so that the picture is right across hosts.
//!
//! | module | one line |
//! |---|---|
//! | [`viewer`](Viewer) | `web`, `connect=URL`, `save=FILE`, `off` |
//! | [`hub`](Hub) | the web page and the gRPC server that all processes feed |
//! | `link` | keeps a stream to the hub alive: probes, reconnects, takes over |
//! | [`frame`](RobotFrame) | what the processes log |
//! | `queue` | bounded, drops the oldest, counts |
//! | `scene` | frames to Rerun's archetypes |
//! | `blueprint` | the layout of the first view |
//! | `paper` | the paper's figures as a recording |

mod blueprint;
mod frame;
mod hub;
mod link;
mod palette;
mod paper;
mod queue;
mod scene;
mod status;
mod viewer;

use std::sync::Arc;
use std::time::Duration;

pub use frame::{Level, OperatorFrame, RobotFrame};
pub use hub::{GRPC_PORT, Hub, HubError, HubOptions, PAGE_PORT};
pub use palette::{finger_rgb, heat};
pub use paper::{PaperCloud, PaperRun, save_paper};
pub use scene::Scene;
pub use status::Status;
pub use viewer::{Viewer, ViewerError};

use crate::viz::frame::Frame;
use crate::viz::queue::Feed;

/// Application id of every recording.
pub const APPLICATION: &str = "allegro-teleop";
/// The one time line: UNIX time on the robot's clock.
pub const TIMELINE: &str = "time";

/// Failure to start logging.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum VizError {
    /// The recording file cannot be written.
    #[error("cannot write the recording {path:?}: {reason}")]
    Save {
        /// The file.
        path: std::path::PathBuf,
        /// Why not.
        reason: String,
    },
    /// No thread could be started.
    #[error("cannot start the viewer thread: {0}")]
    Thread(#[from] std::io::Error),
}

/// A running session; dropping it ends the session within a second.
#[derive(Debug)]
pub struct Viz {
    feed: Option<Arc<Feed>>,
    link: Option<link::Handle>,
    status: status::Shared,
}

impl Viz {
    /// Starts logging `scene` to `viewer`.
    ///
    /// A viewer that is not there yet is no error: the session waits for it. See [`Viz::status`].
    ///
    /// # Errors
    /// A recording file that cannot be created, or no thread.
    pub fn start(viewer: Viewer, scene: Scene) -> Result<Self, VizError> {
        let status = status::Shared::default();
        if viewer == Viewer::Off {
            return Ok(Self { feed: None, link: None, status });
        }
        let feed = Arc::new(Feed::default());
        let link = link::Handle::start(viewer, Arc::new(scene), Arc::clone(&feed), status.clone())?;
        Ok(Self { feed: Some(feed), link: Some(link), status })
    }

    /// A handle to log with.
    #[must_use]
    pub fn logger(&self) -> Logger {
        Logger { feed: self.feed.clone() }
    }

    /// Where the data goes now.
    #[must_use]
    pub fn status(&self) -> Status {
        self.status.get()
    }

    /// Frames and lines that were not shown: thrown away because the viewer was slow or absent.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.feed.as_ref().map_or(0, |feed| feed.dropped())
    }

    /// Writes out what is queued and ends the session, giving up after `timeout`.
    ///
    /// Returns whether everything was written in time.
    pub fn shutdown(mut self, timeout: Duration) -> bool {
        self.link.take().is_none_or(|link| link.finish(timeout))
    }
}

impl Drop for Viz {
    fn drop(&mut self) {
        if let Some(link) = self.link.take() {
            link.finish(Duration::from_secs(1));
        }
    }
}

/// Logs frames. Cheap to clone; never blocks.
#[derive(Clone, Debug, Default)]
pub struct Logger {
    feed: Option<Arc<Feed>>,
}

impl Logger {
    /// A logger that logs nothing.
    #[must_use]
    pub fn off() -> Self {
        Self::default()
    }

    /// False if the viewer is off, so that the caller can spare itself making frames.
    #[must_use]
    pub fn enabled(&self) -> bool {
        self.feed.is_some()
    }

    /// Logs a state of the operator's side. No allocation, lock or wait: copies the frame.
    pub fn log_operator(&self, frame: OperatorFrame) {
        if let Some(feed) = &self.feed {
            feed.push(Frame::Operator(frame));
        }
    }

    /// Logs a state of the robot. No allocation, lock or wait: copies the frame.
    pub fn log_robot(&self, frame: RobotFrame) {
        if let Some(feed) = &self.feed {
            feed.push(Frame::Robot(frame));
        }
    }

    /// Logs a line for people at `time`, ns since the UNIX epoch. Allocates: not for a control thread.
    pub fn log_text(&self, time: i64, level: Level, message: &str) {
        if let Some(feed) = &self.feed {
            feed.push_line(frame::Line::new(time, level, message));
        }
    }
}
