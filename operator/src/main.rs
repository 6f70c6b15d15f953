//! Entry point of the `operator` process.

use std::io::Write as _;
use std::process::ExitCode;

use clap::Parser as _;
use teleop_common::net::runtime;
use teleop_operator::{app, cli::Cli};

fn main() -> ExitCode {
    let cli = Cli::parse();
    if cli.needs_one_thread() {
        // SAFETY: this is the only thread so far.
        unsafe { runtime::use_one_thread() };
    }
    match app::main(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            writeln!(std::io::stderr(), "error: {failure:#}").ok();
            failure.exit_code()
        }
    }
}
