//! Entry point of the `operator` process.

use std::io::Write as _;
use std::process::ExitCode;

use clap::Parser as _;
use teleop_operator::{app, cli::Cli};

fn main() -> ExitCode {
    match app::main(Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            writeln!(std::io::stderr(), "error: {failure:#}").ok();
            failure.exit_code()
        }
    }
}
