//! Entry point of the `robot` process.

use std::process::ExitCode;

use clap::Parser as _;

fn main() -> ExitCode {
    teleop_robot::app::main(teleop_robot::cli::Cli::parse())
}
