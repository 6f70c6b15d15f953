//! Entry point of the `robot` process.

use std::process::ExitCode;

use clap::Parser as _;

fn main() -> ExitCode {
    let cli = teleop_robot::cli::Cli::parse();
    if cli.needs_one_thread() {
        // SAFETY: this is the only thread so far.
        unsafe { teleop_common::net::runtime::use_one_thread() };
    }
    teleop_robot::app::main(cli)
}
