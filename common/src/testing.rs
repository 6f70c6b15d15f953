//! Where tests find recordings that are not part of the repository.

use std::path::{Path, PathBuf};

/// A file of the shared data folder, or `None` (with a printed line) where that folder does not exist.
///
/// The folder is `$TELEOP_SHARED/data`, by default `shared` beside the repository.
///
/// # Panics
/// If the file is missing and `TELEOP_REQUIRE_SHARED=1`, as in continuous integration, where skipping would hide it.
#[must_use]
#[allow(clippy::print_stdout, clippy::panic, reason = "for tests only")]
pub fn shared_data(file: &str) -> Option<PathBuf> {
    let root = std::env::var_os("TELEOP_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared"), PathBuf::from);
    let path = root.join("data").join(file);
    if path.is_file() {
        return Some(path);
    }
    assert!(
        std::env::var_os("TELEOP_REQUIRE_SHARED").is_none_or(|value| value != "1"),
        "{} is missing but TELEOP_REQUIRE_SHARED=1",
        path.display()
    );
    println!("skipped: needs {}", path.display());
    None
}
