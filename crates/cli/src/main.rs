//! The program `vergence`.
//!
//! Machine output is one JSON document on standard output (`--json`), people get text; logs and
//! progress go to standard error. Exit status: 0 when the thing asked for was achieved, 1 when not
//! (the output says why), 2 for misuse.

mod bench;
mod bonds;
mod commands;
mod drivers;
mod failure;
mod interrupt;
mod light;
mod out;
mod output;
mod progress;
mod radio;
mod robot;
mod save;
mod signing;

use std::process::ExitCode;

use clap::Parser;

/// Find, recognise and grasp an object by asking it.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    match commands::run(Cli::parse().command) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(failure) => {
            eprintln!("{failure}");
            ExitCode::from(failure.status)
        }
    }
}
