//! The real binaries as child processes: started, read, signalled, waited for, and killed when the test ends.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::io::{BufRead, BufReader, Read};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::eventually;

/// The binary `name` of the profile this test was built in.
///
/// # Panics
/// If it was not built: a test of this package builds the libraries of the others, not their binaries.
#[must_use]
pub fn binary(name: &str) -> PathBuf {
    // This test is target/<profile>/deps/<test>.
    let test = std::env::current_exe().unwrap();
    let path = test.ancestors().nth(2).unwrap().join(name);
    assert!(path.is_file(), "{} is missing: run `cargo build --release` first", path.display());
    path
}

/// The binary `name`, whose wall clock goes wrong by as many seconds as `file` says (such as `+3600`), whenever that is
/// written. Its monotonic clock stays right.
///
/// # Panics
/// Without libfaketime (Debian's package `faketime`, which `deploy/setup --test` installs).
#[must_use]
pub fn with_clock(name: &str, file: &Path) -> Command {
    let library = std::fs::read_dir("/usr/lib")
        .unwrap()
        .flatten()
        .map(|entry| entry.path().join("faketime/libfaketimeMT.so.1"))
        .find(|path| path.is_file());
    let mut command = Command::new(binary(name));
    command.env("LD_PRELOAD", library.expect("libfaketime is missing: deploy/setup --test installs it"));
    command.env("FAKETIME_TIMESTAMP_FILE", file).env("FAKETIME_NO_CACHE", "1");
    command.env("FAKETIME_DONT_FAKE_MONOTONIC", "1").env("DONT_FAKE_MONOTONIC", "1");
    command
}

/// The binary `name` on a disk that takes no file of more than `kib` KiB: from there on writes fail, as on a full disk.
#[must_use]
pub fn with_full_disk(name: &str, kib: u32) -> Command {
    let mut command = Command::new("bash");
    // Without the signal, whose default is to end the process: a full disk sends none.
    let script = format!("trap '' XFSZ; ulimit -f {kib}; exec \"$@\"");
    command.args(["-c", &script, "bash"]).arg(binary(name));
    command
}

/// A TCP endpoint on this machine that nobody listens on now.
#[must_use]
pub fn free_endpoint() -> String {
    format!("tcp/{}", TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap())
}

/// Arguments as a process takes them.
#[must_use]
pub fn strs(list: &[String]) -> Vec<&str> {
    list.iter().map(String::as_str).collect()
}

/// A configuration file of the robot, in a folder that is removed when it is dropped.
///
/// # Panics
/// If it cannot be written.
#[must_use]
pub fn config(text: &str) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot.toml");
    std::fs::write(&path, text).unwrap();
    (folder, path.to_str().unwrap().to_owned())
}

/// Runs a binary to its end, with what it printed.
#[must_use]
pub fn run(name: &str, arguments: &[&str]) -> Output {
    let mut process = Process::start(name, arguments);
    let status = process.wait(Duration::from_secs(60));
    Output { status, stdout: process.stdout().into_bytes(), stderr: process.stderr().into_bytes() }
}

/// A signal to a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// SIGTERM
    Term,
    /// SIGINT, as from Ctrl-C
    Int,
    /// SIGKILL
    Kill,
    /// SIGSTOP
    Stop,
    /// SIGCONT
    Cont,
    /// SIGUSR1
    Usr1,
    /// SIGUSR2
    Usr2,
}

/// A child process; dropping it kills it.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    stdout: Text,
    stderr: Text,
}

/// What a process prints, read by a thread.
#[derive(Debug)]
struct Text {
    text: Arc<Mutex<String>>,
    thread: Option<JoinHandle<()>>,
}

impl Text {
    fn read(stream: impl Read + Send + 'static) -> Self {
        let text = Arc::new(Mutex::new(String::new()));
        let sink = Arc::clone(&text);
        let thread = std::thread::spawn(move || {
            let mut stream = BufReader::new(stream);
            let mut line = Vec::new();
            while stream.read_until(b'\n', &mut line).is_ok_and(|read| read > 0) {
                sink.lock().unwrap_or_else(PoisonError::into_inner).push_str(&String::from_utf8_lossy(&line));
                line.clear();
            }
        });
        Self { text, thread: Some(thread) }
    }

    fn get(&self) -> String {
        self.text.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Reads to the end, which comes when the process ends.
    fn finish(&mut self) {
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }
}

impl Process {
    /// Starts a binary.
    ///
    /// # Panics
    /// If it is not there or cannot be started.
    #[must_use]
    pub fn start(name: &str, arguments: &[&str]) -> Self {
        Self::spawn(Command::new(binary(name)), arguments)
    }

    /// Starts a command that is a binary in some environment, such as [`with_clock`] and [`with_full_disk`] make.
    ///
    /// # Panics
    /// If it is not there or cannot be started.
    #[must_use]
    pub fn spawn(mut command: Command, arguments: &[&str]) -> Self {
        // What tests set for zenoh inside themselves is not for the binaries.
        command.args(arguments).env_remove("RUST_LOG").env_remove("ZENOH_RUNTIME");
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let (stdout, stderr) = (Text::read(child.stdout.take().unwrap()), Text::read(child.stderr.take().unwrap()));
        let name = command.get_program().to_string_lossy().into_owned();
        Self { name: format!("{name} {}", arguments.join(" ")), child, stdout, stderr }
    }

    /// An operator that streams `source` to the robot at `endpoint`, without viewer, and closes the clutch whenever the
    /// robot is ready.
    #[must_use]
    pub fn operator(endpoint: &str, source: &str, more: &[&str]) -> Self {
        Self::operator_by(Command::new(binary("operator")), endpoint, source, more)
    }

    /// The same, started by this command.
    #[must_use]
    pub fn operator_by(command: Command, endpoint: &str, source: &str, more: &[&str]) -> Self {
        let mut arguments =
            vec!["run", "--viewer", "off", "--clutch", "auto", "--connect", endpoint, "--source", source];
        arguments.extend(more);
        Self::spawn(command, &arguments)
    }

    /// Everything it has written to standard output so far.
    #[must_use]
    pub fn stdout(&self) -> String {
        self.stdout.get()
    }

    /// Everything it has written to standard error so far.
    #[must_use]
    pub fn stderr(&self) -> String {
        self.stderr.get()
    }

    /// Its process number.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The names of its threads.
    ///
    /// # Panics
    /// If it is gone.
    #[must_use]
    pub fn threads(&self) -> Vec<String> {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", self.id())).unwrap().flatten();
        // One may end meanwhile.
        tasks.filter_map(|task| std::fs::read_to_string(task.path().join("comm")).ok()).collect()
    }

    /// Whether it still runs.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Sends a signal.
    ///
    /// # Panics
    /// If the process is gone.
    pub fn signal(&self, signal: Signal) {
        // The shell's own `kill` is on every machine, the program of this name is not.
        let kill = format!("kill -{} {}", format!("{signal:?}").to_uppercase(), self.id());
        assert!(Command::new("sh").args(["-c", &kill]).status().unwrap().success(), "{kill} of {}", self.name);
    }

    /// Waits for its end.
    ///
    /// # Panics
    /// If it does not end within `timeout`.
    #[track_caller]
    pub fn wait(&mut self, timeout: Duration) -> ExitStatus {
        let start = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                self.stdout.finish();
                self.stderr.finish();
                return status;
            }
            assert!(start.elapsed() < timeout, "`{}` did not end within {timeout:?}", self.name);
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Sends a signal and expects a clean end.
    ///
    /// # Panics
    /// If the process does not end soon with exit code 0.
    #[track_caller]
    pub fn stop(&mut self, signal: Signal) {
        self.signal(signal);
        let status = self.wait(Duration::from_secs(10));
        assert_eq!(status.code(), Some(0), "`{}` after {signal:?}: {status}\n{}", self.name, self.stderr());
        self.assert_no_panic();
    }

    /// Ends it at once, without a chance to say goodbye.
    ///
    /// # Panics
    /// If it is gone already.
    pub fn kill(&mut self) {
        self.signal(Signal::Kill);
        self.wait(Duration::from_secs(10));
    }

    /// Expects that it never panicked in any of its threads.
    ///
    /// # Panics
    /// If it did.
    #[track_caller]
    pub fn assert_no_panic(&self) {
        let log = self.stderr();
        assert!(!log.contains("panicked"), "`{}` panicked:\n{log}", self.name);
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let running = self.is_running();
        if running {
            // Only fails if it has ended meanwhile.
            let _gone = self.child.kill();
            let _status = self.child.wait();
        }
        if std::thread::panicking() {
            let (out, err) = (self.stdout(), self.stderr());
            eprintln!("--- `{}`, {}\n{out}{err}---", self.name, if running { "running" } else { "ended" });
        }
    }
}

/// A running robot.
#[derive(Debug)]
pub struct Robot {
    /// The process.
    pub process: Process,
    /// Where operators connect, by protocol in the order of `--listen`.
    pub endpoints: Vec<String>,
}

impl Robot {
    /// Starts a robot on a free port, without viewer.
    #[must_use]
    pub fn start(more: &[&str]) -> Self {
        Self::listening(&["tcp/127.0.0.1:0"], more)
    }

    /// Starts a robot that listens on `endpoints`, without viewer.
    ///
    /// # Panics
    /// If it is not ready soon.
    #[must_use]
    pub fn listening(endpoints: &[&str], more: &[&str]) -> Self {
        Self::listening_by(Command::new(binary("robot")), endpoints, more)
    }

    /// The same, started by this command.
    ///
    /// # Panics
    /// If it is not ready soon.
    #[must_use]
    pub fn listening_by(command: Command, endpoints: &[&str], more: &[&str]) -> Self {
        let mut arguments = vec!["run"];
        if !more.contains(&"--viewer") {
            arguments.extend(["--viewer", "off"]);
        }
        arguments.extend(endpoints.iter().flat_map(|endpoint| ["--listen", *endpoint]));
        arguments.extend(more);
        let mut process = Process::spawn(command, &arguments);
        let mut found = Vec::new();
        eventually("the robot says where it listens", || {
            let log = process.stderr();
            if let Some((_, rest)) = log.split_once("operators connect to ") {
                let line = rest.lines().next().unwrap_or_default();
                found = line.split(", ").map(str::to_owned).collect();
            }
            assert!(process.is_running() || !found.is_empty(), "the robot ended at once:\n{log}");
            !found.is_empty()
        });
        assert_eq!(found.len(), endpoints.len(), "{found:?}");
        // The robot lists them in any order.
        let protocol = |endpoint: &str| endpoint.split('/').next().unwrap_or_default().to_owned();
        found.sort_by_key(|found| endpoints.iter().position(|asked| protocol(asked) == protocol(found)));
        Self { process, endpoints: found }
    }

    /// Where operators connect.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        &self.endpoints[0]
    }
}

/// A running `robot router`.
#[derive(Debug)]
pub struct Router {
    /// The process.
    pub process: Process,
    /// Where robots, operators and other routers connect.
    pub endpoint: String,
}

impl Router {
    /// Starts a router that listens on one endpoint.
    ///
    /// # Panics
    /// If it is not ready soon.
    #[must_use]
    pub fn listening(endpoint: &str, more: &[&str]) -> Self {
        let process = Process::start("robot", &[&["router", "--listen", endpoint], more].concat());
        let mut found = String::new();
        eventually("the router says where it listens", || {
            let log = process.stderr();
            let line = log.split_once("operators connect to ").and_then(|(_, rest)| rest.lines().next());
            found = line.unwrap_or_default().to_owned();
            !found.is_empty()
        });
        Self { process, endpoint: found }
    }
}
