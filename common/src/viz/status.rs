use std::fmt;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// Where the data goes, for people.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Status {
    /// Nowhere: the viewer is off.
    #[default]
    Off,
    /// To a viewer that this process hosts.
    Hosting {
        /// Address to open in a browser.
        page: String,
    },
    /// To a viewer that someone else hosts.
    Joined {
        /// Its gRPC address.
        address: String,
    },
    /// Nowhere yet.
    Waiting {
        /// The gRPC address that should answer.
        address: String,
        /// What is wrong, and what helps.
        reason: String,
    },
    /// Into a file.
    Saving(PathBuf),
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Off => f.write_str("off"),
            Self::Hosting { page } => write!(f, "open {page}"),
            Self::Joined { address } => write!(f, "joined the viewer at {address}"),
            Self::Waiting { address, reason } => write!(f, "waiting for the viewer at {address}: {reason}"),
            Self::Saving(path) => write!(f, "saving to {}", path.display()),
        }
    }
}

/// A [`Status`] that one thread sets and others read.
#[derive(Clone, Debug, Default)]
pub(super) struct Shared(Arc<Mutex<Status>>);

impl Shared {
    pub(super) fn get(&self) -> Status {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sets the status; a change is told to the process's log once.
    pub(super) fn set(&self, status: Status) {
        let mut current = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if *current != status {
            tracing::info!(target: "viewer", "{status}");
            *current = status;
        }
    }
}
