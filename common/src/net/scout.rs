use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use zenoh::config::WhatAmI;
use zenoh::scouting::Hello;
use zenoh::{Config, Wait};

use super::NetError;
use super::config::set;
use super::error::words;

/// Let zenoh choose the network interface.
pub const AUTO_INTERFACE: &str = "auto";
/// Most processes that are listed, and endpoints of each.
const MAX_FOUND: usize = 64;
const MAX_ENDPOINTS: usize = 16;

/// Asks all of the local network by multicast, for `time`, who is there, and gives the endpoints of each process that
/// answers. Those of this project answer only if they were told to, see [`super::SessionConfig::lan`].
///
/// `interface`: an interface's name, one of its addresses, or [`AUTO_INTERFACE`]. Anybody on that network may answer
/// anything: what is connected to is to be judged as if a stranger had named it.
///
/// # Errors
/// [`NetError::Interface`], [`NetError::Scout`]
pub fn scout(interface: &str, time: Duration) -> Result<Vec<Vec<String>>, NetError> {
    let mut config = Config::default();
    set_interface(&mut config, interface)?;
    let found = Arc::new(Mutex::new(BTreeMap::new()));
    let inbox = Arc::clone(&found);
    let running = zenoh::scout(WhatAmI::Peer, config)
        .callback(move |hello: Hello| {
            let mut found = inbox.lock().unwrap_or_else(PoisonError::into_inner);
            let id = hello.zid().to_string();
            if found.len() < MAX_FOUND || found.contains_key(&id) {
                let endpoints = hello.locators().iter().map(ToString::to_string).take(MAX_ENDPOINTS).collect();
                found.insert(id, endpoints);
            }
        })
        .wait()
        .map_err(|error| NetError::Scout { interface: interface.to_owned(), reason: words(&error) })?;
    std::thread::sleep(time);
    running.stop();
    let mut found = found.lock().unwrap_or_else(PoisonError::into_inner);
    Ok(std::mem::take(&mut *found).into_values().collect())
}

/// Where multicast goes to and comes from.
pub(super) fn set_interface(config: &mut Config, interface: &str) -> Result<(), NetError> {
    let exists = interface == AUTO_INTERFACE
        || interface.parse::<IpAddr>().is_ok()
        || (!interface.is_empty()
            && !interface.contains(['/', '.', ','])
            && std::path::Path::new("/sys/class/net").join(interface).exists());
    if !exists {
        return Err(NetError::Interface { interface: interface.to_owned(), known: interfaces() });
    }
    set(config, "scouting/multicast/interface", &serde_json::Value::from(interface).to_string())
}

fn interfaces() -> String {
    let names = std::fs::read_dir("/sys/class/net").into_iter().flatten().flatten();
    let mut names: Vec<_> = names.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort_unstable();
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interfaces_are_looked_up() {
        let mut config = Config::default();
        for good in ["auto", "127.0.0.1", "lo"] {
            set_interface(&mut config, good).unwrap();
        }
        for bad in ["", "none0", "../lo", "lo,none0"] {
            let error = set_interface(&mut config, bad).unwrap_err().to_string();
            assert!(error.contains(&format!("{bad:?}")) && error.contains("lo"), "{error}");
        }
    }
}
