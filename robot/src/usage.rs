//! What is wrong usage, as opposed to a failure while running.

use teleop_common::net::NetError;

use crate::config::ConfigError;

/// Something on the command line, or in a file it names, that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

/// Whether the user can mend this cause of an error on the command line or in a file.
#[must_use]
pub fn is_usage(cause: &(dyn std::error::Error + 'static)) -> bool {
    let of_network = |error: &NetError| error.is_usage();
    cause.is::<ConfigError>() || cause.is::<UsageError>() || cause.downcast_ref().is_some_and(of_network)
}
