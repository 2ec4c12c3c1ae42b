//! One module a command: its arguments and what it does. Adding a command is a module here, a
//! variant of [`Command`] and a line in [`run`].

mod blink;
mod pose;

use clap::Subcommand;

use crate::failure::Failure;

/// What the program can do.
#[derive(Subcommand)]
pub enum Command {
    /// Find blinking landmarks in a recording.
    Blink(blink::Args),
    /// Recognise objects of known size in a set of pictures.
    Pose(pose::PoseArgs),
}

/// Runs a command; `true` when the thing asked for was achieved.
pub fn run(command: Command) -> Result<bool, Failure> {
    match command {
        Command::Blink(args) => blink::run(args),
        Command::Pose(args) => pose::run(args),
    }
}
