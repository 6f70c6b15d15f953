//! M_Q as the description writes it: rows by joint name, each map possibly extending another.

use std::collections::BTreeMap;

use super::description::{JointMapEntry, RowEntry};
use super::load::check_name;
use super::{Finger, HandError, Joint, JointMap, JointMapTerm};

/// Largest factor of a term.
const MAX_GAIN: f64 = 100.0;
/// Largest offset and threshold, rad.
const MAX_ANGLE: f64 = 6.3;
/// Most maps, and most terms of a row.
const MAX_COUNT: usize = 20;

pub(super) fn joint_maps(
    entries: &BTreeMap<String, JointMapEntry>,
    joints: &[Joint],
) -> Result<Vec<JointMap>, HandError> {
    if entries.is_empty() || entries.len() > MAX_COUNT {
        let problem = format!("{} maps; a hand needs 1 to {MAX_COUNT}", entries.len());
        return Err(HandError::description("joint_map", problem));
    }
    let mut maps = Vec::with_capacity(entries.len());
    for (name, entry) in entries {
        let element = format!("joint_map.{name}");
        check_name(&element, name)?;
        if let Some(unknown) = entry.rows.keys().find(|row| joints.iter().all(|joint| joint.name != **row)) {
            let problem = format!("row for joint '{unknown}', which is not in joints.order");
            return Err(HandError::description(element, problem));
        }
        let lineage = lineage(entries, &element, entry)?;
        let mut rows = Vec::with_capacity(joints.len());
        for joint in joints {
            let Some(row) = lineage.iter().find_map(|map| map.rows.get(&joint.name)) else {
                return Err(HandError::description(element, format!("no row for joint '{}'; add one", joint.name)));
            };
            rows.push(check_row(&element, &joint.name, row)?);
        }
        maps.push(JointMap { name: name.clone(), rows });
    }
    Ok(maps)
}

/// The map and what it extends, nearest first.
fn lineage<'a>(
    entries: &'a BTreeMap<String, JointMapEntry>,
    element: &str,
    entry: &'a JointMapEntry,
) -> Result<Vec<&'a JointMapEntry>, HandError> {
    let mut lineage = vec![entry];
    let mut at = entry;
    while let Some(parent) = &at.extends {
        let Some(next) = entries.get(parent) else {
            return Err(HandError::description(element, format!("extends '{parent}', which does not exist")));
        };
        if lineage.len() == entries.len() {
            return Err(HandError::description(element, "extends itself by way of others; break the circle"));
        }
        lineage.push(next);
        at = next;
    }
    Ok(lineage)
}

fn check_row(element: &str, joint: &str, row: &RowEntry) -> Result<(f64, Vec<JointMapTerm>), HandError> {
    let fail = |problem: String| HandError::description(format!("{element}.rows.\"{joint}\""), problem);
    let check = |what: &str, value: f64, largest: f64| {
        if value.abs() <= largest { Ok(value) } else { Err(fail(format!("{what} {value} must be within {largest}"))) }
    };
    if row.terms.len() > MAX_COUNT {
        return Err(fail(format!("{} terms are more than the {MAX_COUNT} allowed", row.terms.len())));
    }
    let terms = row.terms.iter().map(|term| {
        let master = master_joint(&term.from).ok_or_else(|| {
            fail(format!("'{}' is no master joint; write for example \"thumb.1\", joints 0 to 3", term.from))
        })?;
        let above = term.above.map(|above| check("above", above, MAX_ANGLE)).transpose()?;
        Ok(JointMapTerm { master, gain: check("gain", term.gain, MAX_GAIN)?, above })
    });
    Ok((check("offset", row.offset, MAX_ANGLE)?, terms.collect::<Result<_, _>>()?))
}

/// Index into the master's 20 joints of `finger.0` to `finger.3`.
fn master_joint(name: &str) -> Option<usize> {
    let (finger, joint) = name.split_once('.')?;
    let finger = Finger::ALL.into_iter().find(|candidate| candidate.name() == finger)?;
    let joint = ["0", "1", "2", "3"].iter().position(|digit| *digit == joint)?;
    Some(finger.index() * 4 + joint)
}
