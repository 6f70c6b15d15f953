//! Ending the process in order: one flag, which threads can wait on.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Tells all threads that the end has come, and passes SIGUSR1 on. Cheap to clone.
#[derive(Clone, Default)]
pub struct Shutdown(Arc<(Mutex<bool>, Condvar)>, Arc<Mutex<Option<Nudged>>>);

type Nudged = Box<dyn Fn() + Send>;

impl Shutdown {
    /// Asks everybody to end.
    pub fn request(&self) {
        let (flag, changed) = &*self.0;
        *flag.lock().unwrap_or_else(PoisonError::into_inner) = true;
        changed.notify_all();
    }

    /// Whether the end has come.
    #[must_use]
    pub fn requested(&self) -> bool {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Calls `nudged` at every [`Shutdown::nudge`] from now on, in place of whatever was called before.
    pub fn on_nudge(&self, nudged: impl Fn() + Send + 'static) {
        *self.1.lock().unwrap_or_else(PoisonError::into_inner) = Some(Box::new(nudged));
    }

    /// The process got SIGUSR1.
    pub fn nudge(&self) {
        if let Some(nudged) = self.1.lock().unwrap_or_else(PoisonError::into_inner).as_ref() {
            nudged();
        }
    }

    /// Waits for the end, at most for `timeout`; true if it has come.
    #[must_use]
    pub fn wait(&self, timeout: Duration) -> bool {
        let (flag, changed) = &*self.0;
        let deadline = Instant::now() + timeout;
        let mut requested = flag.lock().unwrap_or_else(PoisonError::into_inner);
        while !*requested {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            requested = changed.wait_timeout(requested, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        *requested
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_wakes_those_who_wait() {
        let shutdown = Shutdown::default();
        assert!(!shutdown.wait(Duration::from_millis(5)));
        let waiter = {
            let shutdown = shutdown.clone();
            std::thread::spawn(move || shutdown.wait(Duration::from_secs(20)))
        };
        let start = Instant::now();
        shutdown.request();
        assert!(waiter.join().unwrap());
        assert!(start.elapsed() < Duration::from_secs(10) && shutdown.requested());
    }
}
