//! Single keys from the terminal, without Enter.

use std::io::Read as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use rustix::termios::{LocalModes, OptionalActions, SpecialCodeIndex, Termios, isatty, tcgetattr, tcsetattr};

/// The terminal's settings before a [`Keyboard`] changed them.
static BEFORE: Mutex<Option<Termios>> = Mutex::new(None);

/// Listens to the keys of the terminal until dropped; then the terminal is as it was.
#[derive(Debug)]
pub struct Keyboard {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Keyboard {
    /// Calls `on_key` with every byte that is typed. `None` if standard input is no terminal, or the process is not in
    /// its foreground. Ctrl-C stays a signal.
    pub fn listen(mut on_key: impl FnMut(u8) + Send + 'static) -> Option<Self> {
        let input = std::io::stdin();
        if !isatty(&input) || !in_foreground() {
            return None;
        }
        let before = tcgetattr(&input).ok()?;
        let mut raw = before.clone();
        raw.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
        // A read ends after a tenth of a second without a key.
        raw.special_codes[SpecialCodeIndex::VMIN] = 0;
        raw.special_codes[SpecialCodeIndex::VTIME] = 1;
        tcsetattr(&input, OptionalActions::Now, &raw).ok()?;
        *BEFORE.lock().unwrap_or_else(PoisonError::into_inner) = Some(before);
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let body = move || {
            let mut input = std::io::stdin();
            let mut key = [0];
            while !stopped.load(Ordering::Relaxed) {
                // To read from the background would suspend the process.
                if !in_foreground() {
                    std::thread::sleep(std::time::Duration::from_millis(100));
                } else if matches!(input.read(&mut key), Ok(1)) {
                    on_key(key[0]);
                }
            }
        };
        let thread = std::thread::Builder::new().name("keyboard".to_owned()).spawn(body);
        if thread.is_err() {
            restore();
        }
        Some(Self { stop, thread: Some(thread.ok()?) })
    }
}

impl Drop for Keyboard {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
        restore();
    }
}

/// Gives the terminal back as it was; for a process that ends without dropping its [`Keyboard`].
pub fn restore() {
    let before = BEFORE.lock().unwrap_or_else(PoisonError::into_inner).take();
    if let Some(before) = before.filter(|_| in_foreground()) {
        tcsetattr(std::io::stdin(), OptionalActions::Now, &before).ok();
    }
}

/// Whether this process's group is the terminal's foreground group; true where the system does not say.
fn in_foreground() -> bool {
    let Ok(stat) = std::fs::read_to_string("/proc/self/stat") else { return true };
    // Fields 5 and 8, counted from 1; the second is the name in parentheses, which may contain anything.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    fields.get(2) == fields.get(5)
}
