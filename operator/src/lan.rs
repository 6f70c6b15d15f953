//! Robots on the local network: found by multicast, then asked for their names over a connection each.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::anyhow;
use teleop_common::key::Keys;
use teleop_common::net::clock::now;
use teleop_common::net::{NetError, Session, SessionConfig, scout};

use crate::cli::{LinkArgs, RobotArgs};
use crate::failure::{Failure, not_open};
use crate::shutdown::Shutdown;

/// How long the network is listened to: whoever is there answers at once, and is asked three times.
const LISTEN: Duration = Duration::from_millis(1000);
/// How long an endpoint gets to come about, within a local network, ...
const LINK_TIMEOUT: Duration = Duration::from_millis(700);
/// ... and the robot there to say its name.
const LIVE_TIMEOUT: Duration = Duration::from_millis(500);
const LOOK: Duration = Duration::from_millis(10);

/// The robots on the local network of `interface`: where each of them can be reached, by name. Two robots of one name are
/// both listed.
///
/// # Errors
/// There is no such interface, or certificates are bad.
pub fn find(link: &LinkArgs, interface: &str, shutdown: &Shutdown) -> Result<Vec<(String, String)>, Failure> {
    let processes = scout(interface, LISTEN).map_err(not_open)?;
    // All at once, because most endpoints of a process with several interfaces lead nowhere.
    let found = std::thread::scope(|scope| {
        let ask = |endpoints| scope.spawn(move || robots_at(link, endpoints, shutdown));
        let asked: Vec<_> = processes.into_iter().map(ask).collect();
        asked.into_iter().map(|thread| thread.join().unwrap_or_else(|_| Ok(Vec::new()))).collect::<Result<Vec<_>, _>>()
    })?;
    let mut found = found.concat();
    found.sort_unstable();
    Ok(found)
}

/// The robots of one process, over the first of its endpoints that works.
fn robots_at(
    link: &LinkArgs,
    mut endpoints: Vec<String>,
    shutdown: &Shutdown,
) -> Result<Vec<(String, String)>, Failure> {
    for endpoint in &mut endpoints {
        // How it is used is the operator's own choice.
        endpoint.truncate(endpoint.find(['?', '#']).unwrap_or(endpoint.len()));
    }
    endpoints
        .retain(|endpoint| link.tls_ca.is_some() || !(endpoint.starts_with("quic/") || endpoint.starts_with("tls/")));
    endpoints.sort_by_key(|endpoint| is_unlikely(endpoint));
    for endpoint in endpoints {
        let config = SessionConfig { open_timeout: LINK_TIMEOUT, ..link.session(std::slice::from_ref(&endpoint)) };
        let session = match Session::open(&config) {
            Ok(session) => session,
            // Anybody may have named it.
            Err(NetError::Endpoint { .. } | NetError::Open { .. }) => continue,
            Err(error) => return Err(not_open(error)),
        };
        let end = now() + LINK_TIMEOUT;
        while session.peers() == 0 && now() < end && !shutdown.wait(LOOK) {}
        if session.peers() > 0 {
            let live = session.live_now(&Keys::all_live_robots(), LIVE_TIMEOUT).unwrap_or_default();
            // By name, since a process that tells of others may tell twice.
            let names: BTreeMap<_, _> = live
                .iter()
                .filter_map(|key| Some((Keys::of_live_robot(key)?.name().to_owned(), endpoint.clone())))
                .collect();
            session.close().ok();
            return Ok(names.into_iter().collect());
        }
        session.close().ok();
        if shutdown.requested() {
            break;
        }
    }
    Ok(Vec::new())
}

/// Addresses that lead to the robot from its own machine alone, or from one interface.
fn is_unlikely(endpoint: &str) -> bool {
    ["/127.", "/[::1]", "/[fe80"].iter().any(|start| endpoint.contains(start))
}

/// Where the robot of this name is, if it is to be looked for on the local network.
///
/// # Errors
/// It is not there, or there are two of this name.
pub fn locate(args: &mut RobotArgs, shutdown: &Shutdown) -> Result<(), Failure> {
    let Some(interface) = &args.link.lan else { return Ok(()) };
    let found = find(&args.link, interface, shutdown)?;
    let here: Vec<_> = found.iter().filter(|(name, _)| *name == args.name).map(|(_, at)| at.clone()).collect();
    match here.as_slice() {
        [endpoint] => {
            tracing::info!("robot {} is at {endpoint}", args.name);
            args.connect = here;
            Ok(())
        }
        [] => {
            let others: Vec<_> = found.into_iter().map(|(name, _)| name).collect();
            let others = if others.is_empty() { "none".to_owned() } else { others.join(", ") };
            Err(Failure::Runtime(anyhow!(
                "no robot {} on the local network (found: {others}): was it started with --lan, is it on this network, \
                 and does its link need certificates?",
                args.name
            )))
        }
        several => Err(Failure::Runtime(anyhow!(
            "two robots are called {}: choose one with --connect {}",
            args.name,
            several.join(" or --connect ")
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_other_machines_come_first() {
        let mut endpoints =
            ["udp/127.0.0.1:7447", "udp/[fe80::1]:7447", "udp/192.168.0.7:7447", "udp/[2001:db8::1]:7447"];
        endpoints.sort_by_key(|endpoint| is_unlikely(endpoint));
        assert_eq!(endpoints[..2], ["udp/192.168.0.7:7447", "udp/[2001:db8::1]:7447"]);
    }
}
