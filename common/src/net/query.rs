use std::sync::mpsc::sync_channel;
use std::time::Duration;

use zenoh::Wait;
use zenoh::query::Query;

use super::NetError;
use super::session::failed;

/// Longest answer that [`super::Session::get`] takes, bytes.
pub const MAX_ANSWER: usize = 65_536;

/// Queries that wait to be answered.
const QUERIES: usize = 8;

/// Answers queries on one key, until it is dropped.
#[derive(Debug)]
pub struct Server {
    _zenoh: zenoh::query::Queryable<()>,
}

impl Server {
    pub(super) fn declare<F>(session: &zenoh::Session, key: &str, answer: F) -> Result<Self, NetError>
    where
        F: Fn() -> Vec<u8> + Send + 'static,
    {
        let own_key = key.to_owned();
        // An answer may wait for a peer that does not read, for as long as that peer's query says. So a thread of its own
        // gives it, not the one that receives; who asks when the queue is full gets none, and asks again.
        let (queries, inbox) = sync_channel::<Query>(QUERIES);
        let body = move || {
            for query in inbox {
                if let Err(error) = query.reply(own_key.as_str(), answer()).wait() {
                    tracing::debug!(key = own_key, %error, "query not answered");
                }
            }
        };
        let thread = std::thread::Builder::new().name("answers".to_owned()).spawn(body);
        thread.map_err(|error| failed("serve", key, &error))?;
        let zenoh = session
            .declare_queryable(key.to_owned())
            .complete(true)
            .callback(move |query: Query| {
                queries.try_send(query).ok();
            })
            .wait()
            .map_err(|error| failed("serve", key, &error))?;
        Ok(Self { _zenoh: zenoh })
    }
}

pub(super) fn get(session: &zenoh::Session, key: &str, timeout: Duration) -> Result<Vec<u8>, NetError> {
    // The first answer counts; the callback never waits for the receiver.
    let (sender, receiver) = sync_channel(1);
    session
        .get(key.to_owned())
        .timeout(timeout)
        .callback(move |reply| {
            let answer = match reply.result() {
                Ok(sample) if sample.payload().len() > MAX_ANSWER => Err(Refusal::Long(sample.payload().len())),
                Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
                Err(error) if error.payload().len() > MAX_ANSWER => Err(Refusal::Long(error.payload().len())),
                Err(error) => Err(Refusal::Said(String::from_utf8_lossy(&error.payload().to_bytes()).into_owned())),
            };
            let _kept = sender.try_send(answer);
        })
        .wait()
        .map_err(|error| failed("query", key, &error))?;
    match receiver.recv_timeout(timeout + Duration::from_millis(100)) {
        Ok(Ok(answer)) => Ok(answer),
        Ok(Err(Refusal::Said(reason))) => Err(failed("query", key, &reason)),
        Ok(Err(Refusal::Long(found))) => Err(NetError::LongAnswer { key: key.to_owned(), found, allowed: MAX_ANSWER }),
        Err(_nothing_came) => Err(NetError::NoAnswer { key: key.to_owned(), timeout_ms: timeout.as_millis() }),
    }
}

enum Refusal {
    Said(String),
    Long(usize),
}
