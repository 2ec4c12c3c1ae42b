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

use clap::{Command, CommandFactory, FromArgMatches, Parser};

/// Find, recognise and grasp an object by asking it.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    let matches = with_negative_numbers(Cli::command()).get_matches();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    match commands::run(cli.command) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(failure) => {
            eprintln!("{failure}");
            ExitCode::from(failure.status)
        }
    }
}

/// A negative number is a value, wherever it stands: what should stand there is for the option to say.
fn with_negative_numbers(command: Command) -> Command {
    command.allow_negative_numbers(true).mut_subcommands(with_negative_numbers)
}
