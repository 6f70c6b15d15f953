use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use zenoh::Wait;
use zenoh::liveliness::LivelinessToken;
use zenoh::sample::{Sample, SampleKind};

use super::NetError;
use super::session::failed;

/// Most tokens that [`now`] lists.
const MAX_TOKENS: usize = 64;

/// Shows that this process is alive, until it is dropped.
#[derive(Debug)]
pub struct LiveToken {
    _zenoh: LivelinessToken,
}

impl LiveToken {
    pub(super) fn declare(session: &zenoh::Session, key: &str) -> Result<Self, NetError> {
        let token = session.liveliness().declare_token(key.to_owned()).wait();
        Ok(Self { _zenoh: token.map_err(|error| failed("declare the liveliness token", key, &error))? })
    }
}

/// Watches liveliness tokens, until it is dropped.
#[derive(Debug)]
pub struct LiveWatch {
    _zenoh: zenoh::pubsub::Subscriber<()>,
}

impl LiveWatch {
    pub(super) fn declare<F>(session: &zenoh::Session, keys: &str, callback: F) -> Result<Self, NetError>
    where
        F: FnMut(&str, bool) + Send + 'static,
    {
        let callback = Mutex::new(callback);
        let watch = session
            .liveliness()
            .declare_subscriber(keys.to_owned())
            .history(true)
            .callback(move |sample: Sample| {
                let mut callback = callback.lock().unwrap_or_else(PoisonError::into_inner);
                callback(sample.key_expr().as_str(), sample.kind() == SampleKind::Put);
            })
            .wait();
        Ok(Self { _zenoh: watch.map_err(|error| failed("watch the liveliness tokens", keys, &error))? })
    }
}

pub(super) fn now(session: &zenoh::Session, keys: &str, timeout: Duration) -> Result<Vec<String>, NetError> {
    let found = Arc::new(Mutex::new(Vec::new()));
    // The callback, and with it the sender, is dropped when all answers are in.
    let (running, done) = std::sync::mpsc::channel::<()>();
    let list = Arc::clone(&found);
    session
        .liveliness()
        .get(keys.to_owned())
        .timeout(timeout)
        .callback(move |reply| {
            let _keep = &running;
            let mut list = list.lock().unwrap_or_else(PoisonError::into_inner);
            if let Ok(sample) = reply.result()
                && list.len() < MAX_TOKENS
            {
                list.push(sample.key_expr().as_str().to_owned());
            }
        })
        .wait()
        .map_err(|error| failed("list the liveliness tokens", keys, &error))?;
    // Either way the list has what has come; nothing is ever sent through the channel.
    let _end = done.recv_timeout(timeout);
    let mut list = found.lock().unwrap_or_else(PoisonError::into_inner);
    Ok(std::mem::take(&mut *list))
}
