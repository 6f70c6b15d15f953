//! The recording of what is streamed: a thread of its own behind a bounded queue.
//!
//! Each frame is written as one line at once, so that a process that is killed leaves a file that can be read up to
//! its last line.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use teleop_common::hand::HandSide;
use teleop_common::recording::{Frame, FrameData, RecordingError, RecordingHeader, RecordingWriter};
use teleop_common::time::MonoTime;

use crate::stream::Outgoing;

/// Frames that wait for the disk: ten seconds at 100 Hz.
const QUEUE: usize = 1024;

/// A recording that cannot be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// The file cannot be made.
    #[error("cannot record into {}: {error}{}", path.display(), hint(error))]
    Create {
        /// The file.
        path: PathBuf,
        /// Why.
        error: std::io::Error,
    },
    /// No thread.
    #[error("cannot start the recording thread: {0}")]
    Thread(std::io::Error),
}

fn hint(error: &std::io::Error) -> &'static str {
    match error.kind() {
        std::io::ErrorKind::AlreadyExists => "; a recording is never overwritten, choose another name",
        std::io::ErrorKind::NotFound => "; make its folder first",
        _ => "",
    }
}

#[derive(Debug, Default)]
struct Counters {
    written: AtomicU64,
    lost: AtomicU64,
}

/// The source's end: takes frames, never waits.
pub struct RecordSender {
    queue: SyncSender<Outgoing>,
    counters: Arc<Counters>,
}

impl RecordSender {
    /// Records `outgoing`, unless the disk is too far behind; then the frame is lost and counted.
    pub fn record(&self, outgoing: &Outgoing) {
        if self.queue.try_send(*outgoing).is_err() {
            lose(&self.counters, &"the disk is too slow");
        }
    }
}

/// Counts a frame lost; the first is told at once, since data is lost.
fn lose(counters: &Counters, why: &dyn std::fmt::Display) {
    if counters.lost.fetch_add(1, Ordering::Relaxed) == 0 {
        tracing::error!("the recording loses frames: {why} (more of them are counted, not told)");
    }
}

/// The running recording.
pub struct Recorder {
    counters: Arc<Counters>,
    thread: JoinHandle<()>,
}

impl Recorder {
    /// Starts recording frames of a hand of this side, given by `source`, into a new file.
    ///
    /// # Errors
    /// [`RecordError::Create`] if there is such a file already, or it cannot be made.
    pub fn create(path: &Path, source: &str, side: Option<HandSide>) -> Result<(Self, RecordSender), RecordError> {
        let file = File::create_new(path).map_err(|error| RecordError::Create { path: path.to_owned(), error })?;
        let header = RecordingHeader { side, source: Some(source.to_owned()), ..RecordingHeader::default() };
        let (queue, frames) = sync_channel(QUEUE);
        let counters = Arc::new(Counters::default());
        let count = Arc::clone(&counters);
        let thread = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || write(file, header, &frames, &count))
            .map_err(RecordError::Thread)?;
        Ok((Self { counters: Arc::clone(&counters), thread }, RecordSender { queue, counters }))
    }

    /// Frames lost so far.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.counters.lost.load(Ordering::Relaxed)
    }

    /// Waits until everything is written, which takes the end of the sender, and says how many frames were written
    /// and how many lost.
    #[must_use]
    pub fn finish(self) -> (u64, u64) {
        if self.thread.join().is_err() {
            tracing::error!("the recording thread panicked");
        }
        (self.counters.written.load(Ordering::Relaxed), self.counters.lost.load(Ordering::Relaxed))
    }
}

fn write(file: File, mut header: RecordingHeader, frames: &Receiver<Outgoing>, counters: &Counters) {
    // The hand's sizes and tuning are known with the first pose.
    let first = frames.recv().ok();
    header.geometry = first.map(|outgoing| outgoing.pose.geometry);
    header.tuning = first.and_then(|outgoing| outgoing.pose.tuning);
    let mut writer = match RecordingWriter::new(&file, &header) {
        Ok(writer) => Some(writer),
        Err(error) => {
            tracing::error!("the recording cannot be written: {error}");
            None
        }
    };
    let Some(first) = first else { return };
    let start = first.captured;
    for outgoing in std::iter::once(first).chain(frames.iter()) {
        let written = writer.as_mut().map(|writer| writer.write(&frame(&outgoing, start)));
        match written {
            Some(Ok(())) => {
                counters.written.fetch_add(1, Ordering::Relaxed);
            }
            Some(Err(error)) => {
                lose(counters, &error);
                // After half a line nothing could be read any more.
                if matches!(error, RecordingError::Io(_)) {
                    writer = None;
                }
            }
            None => lose(counters, &"an error before"),
        }
    }
    if let Err(error) = file.sync_all() {
        tracing::error!("the recording may not be on the disk: {error}");
    }
}

fn frame(outgoing: &Outgoing, start: MonoTime) -> Frame {
    Frame { t: outgoing.captured.since(start).as_secs_f64(), data: FrameData::Joints(outgoing.pose.q) }
}
