//! Entry point of the `operator` process.

use std::process::ExitCode;

use clap::Parser as _;
use teleop_operator::{app, cli::Cli};

fn main() -> ExitCode {
    match app::main(Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("error: {failure:#}");
            failure.exit_code()
        }
    }
}
