//! Why the program ends other than well, and its exit code.

use std::process::ExitCode;

use teleop_common::net::{NetError, Session, SessionConfig};

/// Why the program ends other than well.
#[derive(Debug)]
pub enum Failure {
    /// It was asked for something that cannot be.
    Usage(anyhow::Error),
    /// It failed while running.
    Runtime(anyhow::Error),
}

impl Failure {
    /// 2 for wrong usage or configuration, 1 for the rest.
    #[must_use]
    pub fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Usage(_) => 2,
            Self::Runtime(_) => 1,
        })
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (Self::Usage(error) | Self::Runtime(error)) = self;
        error.fmt(f)
    }
}

pub(crate) trait OrFail<T> {
    /// The failure is in what the user asked for.
    fn or_usage(self) -> Result<T, Failure>;
    /// The failure came while running.
    fn or_runtime(self) -> Result<T, Failure>;
}

impl<T, E: Into<anyhow::Error>> OrFail<T> for Result<T, E> {
    fn or_usage(self) -> Result<T, Failure> {
        self.map_err(|error| Failure::Usage(error.into()))
    }

    fn or_runtime(self) -> Result<T, Failure> {
        self.map_err(|error| Failure::Runtime(error.into()))
    }
}

/// The failure of a session that does not open: a bad endpoint is wrong usage, a taken port is not.
pub(crate) fn not_open(error: NetError) -> Failure {
    if error.is_usage() { Failure::Usage(error.into()) } else { Failure::Runtime(error.into()) }
}

/// Opens a session that only listens.
pub(crate) fn listening_session(listen: &[String]) -> Result<Session, Failure> {
    Session::open(&SessionConfig { listen: listen.to_vec(), ..SessionConfig::default() }).map_err(not_open)
}
