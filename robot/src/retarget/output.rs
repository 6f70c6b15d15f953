//! The rows of the output, and the file that appears only when it is complete.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use serde::ser::{Serialize, SerializeMap as _, Serializer};
use teleop_common::hand::Finger;
use teleop_common::mapping::{FingerSignals, MappingOutput};
use teleop_common::master::MasterPose;

/// One frame of the output.
#[derive(serde::Serialize)]
pub(super) struct Row<'a> {
    t: f64,
    q_master: [f64; 20],
    q_joint: &'a [f64],
    q: &'a [f64],
    delta: PerFinger<'a>,
    k: PerFinger<'a>,
    p_joint: PerFinger<'a>,
    p_cartesian: PerFinger<'a>,
    p_input: PerFinger<'a>,
    p: PerFinger<'a>,
    e_q: PerFinger<'a>,
    e_c: PerFinger<'a>,
}

impl<'a> Row<'a> {
    pub(super) fn new(t: f64, pose: &MasterPose, mapping: &'a MappingOutput) -> Self {
        let all = |value| PerFinger { signals: mapping.fingers(), value };
        Self {
            t,
            q_master: pose.q,
            q_joint: &mapping.q_joint,
            q: &mapping.q,
            delta: all(Value::Delta),
            k: all(Value::Scalar(|signals| signals.k)),
            p_joint: all(Value::Point(|signals| signals.p_joint.into())),
            p_cartesian: all(Value::Point(|signals| signals.p_cartesian.into())),
            p_input: all(Value::Point(|signals| signals.p_input.into())),
            p: all(Value::Point(|signals| signals.p.into())),
            e_q: all(Value::Scalar(|signals| signals.e_q)),
            e_c: all(Value::Scalar(|signals| signals.e_c)),
        }
    }
}

/// One signal of all fingers, as an object keyed by finger.
struct PerFinger<'a> {
    signals: &'a [FingerSignals],
    value: Value,
}

enum Value {
    /// Distance from the thumb: of the opposing fingers only.
    Delta,
    Scalar(fn(&FingerSignals) -> f64),
    Point(fn(&FingerSignals) -> [f64; 3]),
}

impl Serialize for PerFinger<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        for signals in self.signals {
            let name = signals.finger.name();
            match self.value {
                Value::Delta if signals.finger == Finger::Thumb => {}
                Value::Delta => map.serialize_entry(name, &signals.delta)?,
                Value::Scalar(value) => map.serialize_entry(name, &value(signals))?,
                Value::Point(value) => map.serialize_entry(name, &value(signals))?,
            }
        }
        map.end()
    }
}

/// A file that is written beside its place and moved there when complete.
pub(super) struct Partial {
    path: PathBuf,
    partial: PathBuf,
    file: Option<BufWriter<File>>,
}

impl Partial {
    pub(super) fn create(path: &Path) -> anyhow::Result<Self> {
        let mut name = path.file_name().with_context(|| format!("{} is no file name", path.display()))?.to_owned();
        name.push(format!(".partial-{}", std::process::id()));
        let partial = path.with_file_name(name);
        let file = File::create(&partial).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { path: path.to_owned(), partial, file: Some(BufWriter::with_capacity(1 << 16, file)) })
    }

    pub(super) fn write(&mut self, row: &Row<'_>) -> anyhow::Result<()> {
        let Some(file) = &mut self.file else { return Ok(()) };
        let written = serde_json::to_writer(&mut *file, row).map_err(std::io::Error::from);
        written.and_then(|()| file.write_all(b"\n")).with_context(|| format!("cannot write {}", self.path.display()))
    }

    pub(super) fn complete(mut self) -> anyhow::Result<()> {
        if let Some(mut file) = self.file.take() {
            let moved = file.flush().and_then(|()| std::fs::rename(&self.partial, &self.path));
            if moved.is_err() {
                std::fs::remove_file(&self.partial).ok();
            }
            moved.with_context(|| format!("cannot write {}", self.path.display()))?;
        }
        Ok(())
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        if self.file.take().is_some() {
            std::fs::remove_file(&self.partial).ok();
        }
    }
}
