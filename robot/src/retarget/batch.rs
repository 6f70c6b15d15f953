//! Which recordings are mapped, to where, and on which thread.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;

use anyhow::Context as _;

use crate::usage::UsageError;

/// A recording and its output.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) input: PathBuf,
    pub(super) output: PathBuf,
}

/// The recordings named by `inputs`: files, and of folders the `.csv` and `.jsonl` files in them, by name. One file is
/// mapped to the file `output`; several, or any into a folder that is there, to `output/NAME.jsonl`.
///
/// # Errors
/// A folder without recordings, two recordings of one name, or a folder that cannot be made.
pub(super) fn jobs(inputs: &[PathBuf], output: &Path) -> anyhow::Result<Vec<Job>> {
    let mut files = Vec::new();
    for input in inputs {
        if input.is_dir() {
            let before = files.len();
            let entries = std::fs::read_dir(input).with_context(|| format!("cannot read {}", input.display()))?;
            for entry in entries {
                let path = entry.with_context(|| format!("cannot read {}", input.display()))?.path();
                let known = path.extension().is_some_and(|ending| ending == "csv" || ending == "jsonl");
                if known && path.is_file() {
                    files.push(path);
                }
            }
            if files.len() == before {
                return Err(UsageError(format!("{} has no .csv or .jsonl files", input.display())).into());
            }
            files[before..].sort();
        } else {
            files.push(input.clone());
        }
    }
    if let ([file], false) = (&files[..], output.is_dir() || inputs.iter().any(|input| input.is_dir())) {
        return Ok(vec![Job { input: file.clone(), output: output.to_owned() }]);
    }
    std::fs::create_dir_all(output).with_context(|| format!("cannot make the folder {}", output.display()))?;
    let mut names: HashMap<PathBuf, PathBuf> = HashMap::new();
    let mut jobs = Vec::with_capacity(files.len());
    for input in files {
        let stem = input.file_stem().with_context(|| format!("{} is no file name", input.display()))?;
        let output = output.join(stem).with_extension("jsonl");
        if let Some(other) = names.insert(output.clone(), input.clone()) {
            let (one, two, path) = (other.display(), input.display(), output.display());
            let text = format!("{one} and {two} would both be written to {path}: rename one");
            return Err(UsageError(text).into());
        }
        if output == input {
            return Err(
                UsageError(format!("{} would overwrite itself: choose another --output", input.display())).into()
            );
        }
        jobs.push(Job { input, output });
    }
    Ok(jobs)
}

/// The results of `work` on each of `jobs`, in their order, on so many threads.
pub(super) fn each<T: Send>(jobs: &[Job], threads: usize, work: impl Fn(&Job) -> T + Sync) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let (sender, receiver) = mpsc::channel();
    std::thread::scope(|scope| {
        for _ in 0..threads {
            let (sender, next, work) = (sender.clone(), &next, &work);
            scope.spawn(move || {
                while let Some((index, job)) = {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    jobs.get(index).map(|job| (index, job))
                } {
                    // Only gone if this whole scope unwinds.
                    let _ = sender.send((index, work(job)));
                }
            });
        }
    });
    drop(sender);
    let mut results: Vec<_> = receiver.into_iter().collect();
    results.sort_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}
