//! `operator list`: which robots there are, what they do, and for whom.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;
use teleop_common::key::Keys;
use teleop_common::mode::Mode;
use teleop_common::net::clock::now;
use teleop_common::net::{NetError, Session};

use crate::feedback::Feedback;
use crate::robot_link::hear;
use crate::shutdown::Shutdown;
use crate::terminal::say;

/// Time that a link gets to come about: a handshake over a satellite.
pub const LINK_TIMEOUT: Duration = Duration::from_secs(5);
/// Time that the others get once one link is there.
const GRACE: Duration = Duration::from_millis(1500);
const LOOK: Duration = Duration::from_millis(20);
/// Time robots get to show that they are alive.
const LIVE_TIMEOUT: Duration = Duration::from_secs(1);
/// Most robots that are listed.
const MAX_ROBOTS: usize = 64;

/// A robot and what it told.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Name.
    pub robot: String,
    /// Where it was found, if it was looked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub endpoint: Option<String>,
    mode: Option<&'static str>,
    operator: String,
    latency_ms_p50: Option<f32>,
    latency_ms_p99: Option<f32>,
    rate_hz: Option<f32>,
    holds: Option<u64>,
}

/// The robots that `session`, which connects to `links` places, reaches, after `time` of listening to them. `None` if
/// nobody at all answers.
///
/// # Errors
/// The session is closed.
pub fn list(
    session: &Session,
    links: usize,
    time: Duration,
    shutdown: &Shutdown,
) -> Result<Option<Vec<Row>>, NetError> {
    let begin = now();
    // Those that answer later than the first get a little more.
    while session.peers() < links && now().since(begin) < if session.peers() == 0 { LINK_TIMEOUT } else { GRACE } {
        if shutdown.wait(LOOK) {
            return Ok(None);
        }
    }
    if session.peers() == 0 {
        return Ok(None);
    }
    let mut robots = BTreeMap::new();
    for key in session.live_now(&Keys::all_live_robots(), LIVE_TIMEOUT)? {
        if let Some(keys) = Keys::of_live_robot(&key)
            && robots.len() < MAX_ROBOTS
        {
            // It only listens, so its epoch is nobody's.
            let feedback = Arc::new(Feedback::new(0));
            let subscribers = hear(session, &keys, &feedback)?;
            robots.insert(keys.name().to_owned(), (feedback, subscribers));
        }
    }
    if !robots.is_empty() {
        let _ended = shutdown.wait(time);
    }
    Ok(Some(robots.iter().map(|(name, (feedback, _))| row(name, feedback)).collect()))
}

/// Prints them: a table, or a line of JSON each.
///
/// # Errors
/// Nobody reads.
pub fn show(rows: &[Row], json: bool) -> std::io::Result<()> {
    let lines =
        if json { rows.iter().filter_map(|row| serde_json::to_string(row).ok()).collect() } else { table(rows) };
    lines.iter().try_for_each(|line| say(line))
}

fn row(name: &str, feedback: &Feedback) -> Row {
    let snapshot = feedback.snapshot(now());
    let health = snapshot.health;
    let driven = health.filter(|health| health.total_ms.max > 0.0);
    Row {
        robot: name.to_owned(),
        endpoint: None,
        mode: snapshot.authority.map(|(mode, _)| Mode::name(mode)),
        operator: health.map(|health| health.operator.to_string()).unwrap_or_default(),
        latency_ms_p50: driven.map(|health| health.total_ms.p50),
        latency_ms_p99: driven.map(|health| health.total_ms.p99),
        rate_hz: health.map(|health| health.rate_hz),
        holds: health.map(|health| health.holds),
    }
}

fn table(rows: &[Row]) -> Vec<String> {
    if rows.is_empty() {
        return vec!["no robots".to_owned()];
    }
    let number = |value: Option<f32>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.1}"));
    let cells = rows.iter().map(|row| {
        let operator = if row.operator.is_empty() { "-" } else { &row.operator };
        [
            row.robot.clone(),
            row.mode.unwrap_or("silent").to_owned(),
            operator.to_owned(),
            number(row.latency_ms_p50),
            number(row.latency_ms_p99),
            number(row.rate_hz),
            row.holds.map_or_else(|| "-".to_owned(), |holds| holds.to_string()),
            row.endpoint.clone().unwrap_or_default(),
        ]
    });
    let found = if rows.iter().any(|row| row.endpoint.is_some()) { "endpoint" } else { "" };
    let heads =
        ["robot", "mode", "operator", "latency p50 ms", "p99 ms", "control Hz", "holds", found].map(str::to_owned);
    let all: Vec<_> = std::iter::once(heads).chain(cells).collect();
    let width = |column: usize| all.iter().map(|row| row[column].len()).max().unwrap_or(0);
    let widths: [usize; 8] = std::array::from_fn(width);
    let line = |row: &[String; 8]| {
        let cells: Vec<_> = row.iter().zip(widths).map(|(cell, width)| format!("{cell:<width$}")).collect();
        cells.join("  ").trim_end().to_owned()
    };
    all.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_longest_cell() {
        let row = |robot: &str, mode| Row {
            robot: robot.to_owned(),
            endpoint: None,
            mode,
            operator: "ada".to_owned(),
            latency_ms_p50: Some(3.25),
            latency_ms_p99: None,
            rate_hz: Some(333.0),
            holds: Some(2),
        };
        let lines = table(&[row("left", Some("engaged")), row("a-long-name", None)]);
        assert_eq!(lines[0], "robot        mode     operator  latency p50 ms  p99 ms  control Hz  holds");
        assert_eq!(lines[1], "left         engaged  ada       3.2             -       333.0       2");
        assert_eq!(lines[2], "a-long-name  silent   ada       3.2             -       333.0       2");
        assert_eq!(table(&[]), ["no robots"]);
        let found = Row { endpoint: Some("udp/192.168.0.7:7447".to_owned()), ..row("left", Some("engaged")) };
        let lines = table(&[found]);
        assert!(lines[0].ends_with("  endpoint") && lines[1].ends_with("  udp/192.168.0.7:7447"), "{lines:?}");
    }
}
