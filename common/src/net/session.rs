use std::time::Duration;

use zenoh::Wait;

use super::error::words;
use super::{Arrival, LiveToken, LiveWatch, NetError, Publisher, Role, Server, SessionConfig, Stream, Subscriber};
use super::{live, query, runtime};

/// An open zenoh session. Cheap to clone; the last clone that is dropped closes it.
#[derive(Clone, Debug)]
pub struct Session {
    zenoh: zenoh::Session,
}

impl Session {
    /// Opens a session. With endpoints to connect to it returns within about half a second whether or not anybody is
    /// there, and keeps trying.
    ///
    /// # Errors
    /// [`NetError`] naming the endpoint, file or setting; an endpoint to listen on that is taken is an error.
    pub fn open(config: &SessionConfig) -> Result<Self, NetError> {
        let endpoints = config.listen.iter().chain(&config.connect);
        if runtime::needs_one_thread(endpoints) && !runtime::is_chosen() {
            tracing::warn!("tls/ links are not safe in several threads, see `net::runtime`: set ZENOH_RUNTIME");
        }
        let zenoh = zenoh::open(config.zenoh()?).wait().map_err(|error| {
            let (listen, connect, reason) = (config.listen.clone(), config.connect.clone(), words(&error));
            if config.role == Role::Client {
                NetError::NoRouter { connect, reason }
            } else {
                NetError::Open { listen, connect, reason }
            }
        })?;
        Ok(Self { zenoh })
    }

    /// The endpoints this session really listens on, with the ports the system chose.
    #[must_use]
    pub fn locators(&self) -> Vec<String> {
        self.zenoh.info().locators().wait().iter().map(ToString::to_string).collect()
    }

    /// How many other processes this session is connected to.
    #[must_use]
    pub fn peers(&self) -> usize {
        let info = self.zenoh.info();
        info.peers_zid().wait().count() + info.routers_zid().wait().count()
    }

    /// A publisher on `key`.
    ///
    /// # Errors
    /// [`NetError::Key`]
    pub fn publisher(&self, key: &str, stream: Stream) -> Result<Publisher, NetError> {
        Publisher::declare(&self.zenoh, key, stream)
    }

    /// Calls `callback` with each payload that arrives on `key`, until the subscriber is dropped.
    ///
    /// # Errors
    /// [`NetError::Key`]
    pub fn subscribe<F>(&self, key: &str, callback: F) -> Result<Subscriber, NetError>
    where
        F: FnMut(Arrival<'_>) + Send + 'static,
    {
        Subscriber::declare(&self.zenoh, key, callback)
    }

    /// Answers each query on `key` with what `answer` returns, until the server is dropped.
    ///
    /// `answer` runs in a thread of its own; queries that come faster than it answers are dropped.
    ///
    /// # Errors
    /// [`NetError::Key`]
    pub fn serve<F>(&self, key: &str, answer: F) -> Result<Server, NetError>
    where
        F: Fn() -> Vec<u8> + Send + 'static,
    {
        Server::declare(&self.zenoh, key, answer)
    }

    /// Asks `key` and gives the first answer.
    ///
    /// # Errors
    /// [`NetError::NoAnswer`], at once if nobody serves the key; [`NetError::LongAnswer`]; [`NetError::Key`], also
    /// with the words of a server that refuses.
    pub fn get(&self, key: &str, timeout: Duration) -> Result<Vec<u8>, NetError> {
        query::get(&self.zenoh, key, timeout)
    }

    /// Shows others that this process is alive, until the token is dropped.
    ///
    /// # Errors
    /// [`NetError::Key`]
    pub fn live_token(&self, key: &str) -> Result<LiveToken, NetError> {
        LiveToken::declare(&self.zenoh, key)
    }

    /// Calls `callback` with key and `true` for each token that matches `keys`, now or later, and with `false` when
    /// one is gone.
    ///
    /// A lost link shows after 0.85 of the lease only: this is for people, not for stopping a robot.
    ///
    /// # Errors
    /// [`NetError::Key`]
    pub fn watch_live<F>(&self, keys: &str, callback: F) -> Result<LiveWatch, NetError>
    where
        F: FnMut(&str, bool) + Send + 'static,
    {
        LiveWatch::declare(&self.zenoh, keys, callback)
    }

    /// The tokens that match `keys` now, at most 64.
    ///
    /// # Errors
    /// [`NetError::Key`]
    pub fn live_now(&self, keys: &str, timeout: Duration) -> Result<Vec<String>, NetError> {
        live::now(&self.zenoh, keys, timeout)
    }

    /// Closes the session for all its clones.
    ///
    /// # Errors
    /// [`NetError::Close`]
    pub fn close(&self) -> Result<(), NetError> {
        self.zenoh.close().wait().map_err(|error| NetError::Close(words(&error)))
    }
}

/// The error of an `action` on `key`.
pub(super) fn failed(action: &'static str, key: &str, reason: &impl ToString) -> NetError {
    NetError::Key { action, key: key.to_owned(), reason: words(reason) }
}
