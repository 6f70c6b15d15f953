//! Offline mapping of whole recordings.
use crate::cli::RetargetArgs;
/// Maps a recording.
///
/// # Errors
/// Not yet.
pub fn run(args: &RetargetArgs) -> anyhow::Result<()> {
    anyhow::bail!("{}", args.input.display())
}
