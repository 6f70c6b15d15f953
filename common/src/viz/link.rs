//! Keeps a stream to the viewer alive.
//!
//! Rerun's client blocks in `log` once the viewer stops reading, and never connects again after a viewer is gone. So
//! two threads share the work: the writer drains the queue into one stream and may hang; the supervisor looks every
//! second whether the viewer answers, gives up a writer whose stream is dead (it ends by itself, whenever that may
//! be), and starts the next one with a new stream, which sends the layout and everything static again.

use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rerun::external::re_log_types::LogMsg;
use rerun::log::ChunkBatcherConfig;
use rerun::sink::{FileSink, FileSinkOptions, GrpcSink, GrpcSinkConnectionState, LogSink, SinkFlushError};
use rerun::{RecordingStream, RecordingStreamBuilder, RecordingStreamResult};

use super::hub::{Hub, HubError, HubOptions, answers};
use super::queue::Feed;
use super::scene::{Scene, Writer};
use super::status::{Shared, Status};
use super::viewer::ViewerUrl;
use super::{APPLICATION, Viewer, VizError, blueprint};

/// How often the supervisor looks.
const LOOK: Duration = Duration::from_secs(1);
/// Looks in a row at which a connected viewer's port may be silent.
const PATIENCE: u32 = 3;
/// How long a new stream may take to connect.
const CONNECT: Duration = Duration::from_secs(5);
/// How long a connected viewer may keep the writer waiting before people are told.
const HANG: Duration = Duration::from_secs(3);
/// How often the writer drains the queue.
const DRAIN: Duration = Duration::from_millis(10);
/// How long data may wait to be sent together, to a viewer and to a file.
const LIVE_FLUSH: Duration = Duration::from_millis(30);
const FILE_FLUSH: Duration = Duration::from_millis(500);

/// A session's threads.
#[derive(Debug)]
pub(super) struct Handle {
    /// Dropping it, or sending the time that is left, ends the session.
    stop: mpsc::Sender<Duration>,
    supervisor: JoinHandle<bool>,
}

impl Handle {
    pub(super) fn start(viewer: Viewer, scene: Arc<Scene>, feed: Arc<Feed>, status: Shared) -> Result<Self, VizError> {
        let (stop, stopped) = mpsc::channel();
        let job: Box<dyn FnOnce() -> bool + Send> = match viewer {
            Viewer::Save(path) => {
                // The footer's index would grow in memory for as long as the run lasts.
                let options = FileSinkOptions { write_footer: false };
                let sink = FileSink::with_options(&path, options)
                    .map_err(|error| VizError::Save { path: path.clone(), reason: error.to_string() })?;
                let link = Link::start(Box::new(sink), scene, feed, None)?;
                status.set(Status::Saving(path));
                Box::new(move || {
                    let limit = stopped.recv().unwrap_or_default();
                    link.finish(limit)
                })
            }
            Viewer::Web(options) => {
                let place = Place::Hub(options);
                Box::new(move || Supervisor::new(place, scene, feed, status).run(&stopped))
            }
            Viewer::Connect(url) => {
                let place = Place::Elsewhere(url);
                Box::new(move || Supervisor::new(place, scene, feed, status).run(&stopped))
            }
            Viewer::Off => Box::new(|| true),
        };
        let supervisor = thread::Builder::new().name("viewer".to_owned()).spawn(job)?;
        Ok(Self { stop, supervisor })
    }

    /// Ends the session; false if something was left unwritten after `limit`.
    pub(super) fn finish(self, limit: Duration) -> bool {
        let start = Instant::now();
        self.stop.send(limit).ok();
        while !self.supervisor.is_finished() {
            // The supervisor may be resolving a name; it is not worth more than the limit either.
            if start.elapsed() > limit + Duration::from_millis(100) {
                return false;
            }
            thread::sleep(Duration::from_millis(5));
        }
        self.supervisor.join().unwrap_or(false)
    }
}

/// Where the viewer should be.
enum Place {
    /// On this machine; hosted here if nobody else does.
    Hub(HubOptions),
    /// Somewhere else.
    Elsewhere(ViewerUrl),
}

struct Supervisor {
    place: Place,
    scene: Arc<Scene>,
    feed: Arc<Feed>,
    status: Shared,
    hub: Option<Hub>,
    link: Option<Link>,
    silent: u32,
}

impl Supervisor {
    const fn new(place: Place, scene: Arc<Scene>, feed: Arc<Feed>, status: Shared) -> Self {
        Self { place, scene, feed, status, hub: None, link: None, silent: 0 }
    }

    fn run(mut self, stopped: &mpsc::Receiver<Duration>) -> bool {
        loop {
            self.look();
            match stopped.recv_timeout(LOOK) {
                Err(RecvTimeoutError::Timeout) => {}
                Ok(limit) => return self.link.take().is_none_or(|link| link.finish(limit)),
                Err(RecvTimeoutError::Disconnected) => return false,
            }
        }
    }

    fn look(&mut self) {
        let url = self.url();
        let address = url.authority();
        let answering = first_answering(&url);
        self.silent = if answering { 0 } else { self.silent + 1 };
        if let Some(link) = &self.link {
            let state = link.state();
            if state == State::Open && self.silent < PATIENCE {
                let status = if link.hangs() {
                    Status::Waiting { address, reason: "it is connected, but does not read".to_owned() }
                } else {
                    self.connected(address)
                };
                return self.status.set(status);
            }
            if state == State::Opening && answering {
                return self.status.set(Status::Waiting { address, reason: "connecting".to_owned() });
            }
            // Dead, or as good as dead.
            let refused = state == State::Refused;
            self.link = None;
            if refused && answering {
                let reason = "what answers there is no Rerun viewer; end it, or choose another with connect=URL";
                self.status.set(Status::Waiting { address, reason: reason.to_owned() });
                return;
            }
        }
        if !answering && !self.host(&address) {
            return;
        }
        match self.open(&self.url()) {
            Ok(link) => self.link = Some(link),
            Err(reason) => self.status.set(Status::Waiting { address, reason }),
        }
    }

    /// The viewer does not answer: become it if that is our business. True if it answers now.
    fn host(&mut self, address: &str) -> bool {
        let Place::Hub(options) = &self.place else {
            let reason = "nothing answers; start a viewer there (robot viewer, or rerun --serve-grpc)".to_owned();
            self.status.set(Status::Waiting { address: address.to_owned(), reason });
            return false;
        };
        self.hub = None;
        match Hub::open(options) {
            Ok(hub) => self.hub = Some(hub),
            // Someone was faster: join.
            Err(HubError::Taken(taken)) if answers(taken) => {}
            Err(error) => {
                self.status.set(Status::Waiting { address: address.to_owned(), reason: error.to_string() });
                return false;
            }
        }
        self.silent = 0;
        true
    }

    fn connected(&self, address: String) -> Status {
        match &self.hub {
            Some(hub) => Status::Hosting { page: hub.page().to_owned() },
            None => Status::Joined { address },
        }
    }

    fn url(&self) -> ViewerUrl {
        match &self.place {
            Place::Hub(options) => ViewerUrl::at(options.grpc()),
            Place::Elsewhere(url) => url.clone(),
        }
    }

    fn open(&self, url: &ViewerUrl) -> Result<Link, String> {
        let client = Arc::new(GrpcSink::new(url.uri()));
        let sink = Box::new(Watched(Arc::clone(&client)));
        Link::start(sink, Arc::clone(&self.scene), Arc::clone(&self.feed), Some(client)).map_err(|e| e.to_string())
    }
}

fn first_answering(url: &ViewerUrl) -> bool {
    let addresses: Vec<SocketAddr> = url.authority().to_socket_addrs().map(Iterator::collect).unwrap_or_default();
    addresses.into_iter().take(4).any(answers)
}

/// A stream for `scene` into `sink`, the layout first.
fn open_stream(scene: &Scene, sink: Box<dyn LogSink>) -> RecordingStreamResult<RecordingStream> {
    blueprint::send(sink.as_ref())?;
    let batching = ChunkBatcherConfig {
        // Live: as often as the 3D views move. In a file, larger chunks are smaller on the whole.
        flush_tick: if sink.defers_finalization_to_shutdown() { FILE_FLUSH } else { LIVE_FLUSH },
        max_bytes_in_flight: 8 << 20,
        ..ChunkBatcherConfig::DEFAULT
    };
    let stream = RecordingStreamBuilder::new(APPLICATION)
        .recording_id(scene.recording())
        .enabled(true)
        .batcher_config(batching)
        .buffered()?;
    stream.set_sink(sink);
    Ok(stream)
}

/// A client whose connection can still be watched when the stream owns it.
struct Watched(Arc<GrpcSink>);

impl LogSink for Watched {
    fn send(&self, message: LogMsg) {
        self.0.send(message);
    }

    fn flush_blocking(&self, timeout: Duration) -> Result<(), SinkFlushError> {
        self.0.flush_blocking(timeout)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Connecting.
    Opening,
    /// Connected.
    Open,
    /// Was connected.
    Closed,
    /// Never got connected.
    Refused,
}

/// One stream and the thread that writes it.
struct Link {
    client: Option<Arc<GrpcSink>>,
    order: Arc<AtomicU8>,
    since: Instant,
    /// When the writer last was through with the queue, ms after `since`.
    beat: Arc<AtomicU64>,
    was_open: AtomicBool,
    writer: JoinHandle<()>,
}

/// What the writer shall do.
mod order {
    pub(super) const WRITE: u8 = 0;
    /// Write what is queued, then end.
    pub(super) const FINISH: u8 = 1;
    /// End at once: the stream is dead and the queue belongs to another writer.
    pub(super) const ABANDON: u8 = 2;
}

impl Link {
    fn start(
        sink: Box<dyn LogSink>,
        scene: Arc<Scene>,
        feed: Arc<Feed>,
        client: Option<Arc<GrpcSink>>,
    ) -> Result<Self, std::io::Error> {
        let order = Arc::new(AtomicU8::new(order::WRITE));
        let (since, beat) = (Instant::now(), Arc::new(AtomicU64::new(0)));
        let (theirs, alive) = (Arc::clone(&order), Arc::clone(&beat));
        let beat_now = move || alive.store(since.elapsed().as_millis() as u64, Ordering::Relaxed);
        let writer = thread::Builder::new().name("viewer-writer".to_owned()).spawn(move || {
            let written = open_stream(&scene, sink).and_then(|stream| {
                let result = write(&stream, &scene, &feed, &theirs, &beat_now);
                // Waits for the data to go out, for ever if need be: nobody waits for this thread.
                drop(stream);
                result
            });
            if let Err(error) = written {
                tracing::warn!(target: "viewer", "{error}");
            }
        })?;
        Ok(Self { client, order, since, beat, was_open: AtomicBool::new(false), writer })
    }

    fn state(&self) -> State {
        let was_open = self.was_open.load(Ordering::Relaxed);
        match self.client.as_ref().map(|client| client.status()) {
            _ if self.writer.is_finished() => State::Closed,
            None => State::Open,
            Some(GrpcSinkConnectionState::Connected) => {
                self.was_open.store(true, Ordering::Relaxed);
                State::Open
            }
            Some(GrpcSinkConnectionState::Connecting { .. }) if self.since.elapsed() < CONNECT => State::Opening,
            Some(GrpcSinkConnectionState::Disconnected(_)) if was_open => State::Closed,
            Some(_) => State::Refused,
        }
    }

    /// True if the writer has been stuck for a while: the viewer does not read.
    fn hangs(&self) -> bool {
        let beat = Duration::from_millis(self.beat.load(Ordering::Relaxed));
        !self.writer.is_finished() && self.since.elapsed().saturating_sub(beat) > HANG
    }

    /// Writes what is queued; false if that took longer than `limit`.
    fn finish(self, limit: Duration) -> bool {
        let start = Instant::now();
        self.order.store(order::FINISH, Ordering::Release);
        while !self.writer.is_finished() {
            if start.elapsed() > limit {
                return false;
            }
            thread::sleep(Duration::from_millis(5));
        }
        true
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        // An order to finish stays.
        self.order.compare_exchange(order::WRITE, order::ABANDON, Ordering::AcqRel, Ordering::Relaxed).ok();
    }
}

/// The writer: drains the queue into the stream. Blocks for as long as the viewer does; calls `beat` whenever not.
fn write(
    stream: &RecordingStream,
    scene: &Scene,
    feed: &Feed,
    order: &AtomicU8,
    beat: &dyn Fn(),
) -> RecordingStreamResult<()> {
    let mut writer = Writer::new(scene, stream)?;
    loop {
        let finish = order.load(Ordering::Acquire) == order::FINISH;
        while order.load(Ordering::Acquire) != order::ABANDON
            && let Some(frame) = feed.pop()
        {
            writer.frame(&frame)?;
        }
        if order.load(Ordering::Acquire) == order::ABANDON {
            return Ok(());
        }
        while let Some(line) = feed.pop_line() {
            writer.line(&line)?;
        }
        if finish {
            writer.finish()?;
            if let Err(error) = stream.flush_with_timeout(Duration::from_secs(5)) {
                tracing::debug!(target: "viewer", "last data not written: {error}");
            }
            return Ok(());
        }
        beat();
        thread::sleep(DRAIN);
    }
}
