//! One module a command: its arguments and what it does. Adding a command is a module here, a
//! variant of [`Command`] and a line in [`run`].

mod blink;
mod calibrate;
mod evaluate;
mod experiment;
mod find;
mod grasp;
mod pose;
mod sim;
mod tag;
mod tags;
mod workcell;

use clap::Subcommand;

use crate::failure::Failure;

/// What the program can do.
#[derive(Subcommand)]
pub enum Command {
    /// Find an object and recognise its pose.
    Find(find::Find),
    /// Find an object, grasp it and lift it.
    Grasp(grasp::Grasp),
    /// List the tags in radio range with their records.
    Tags(tags::Tags),
    /// Work on one tag: write its record, blink its light, pair with it, ask what it is.
    Tag(tag::Tag),
    /// Run one of the paper's experiments in the simulated workcell, with statistics.
    Experiment(experiment::Experiment),
    /// Measure how accurate and fast a part of the system is, in simulation.
    Evaluate(evaluate::Evaluate),
    /// Write the built-in workcell to a folder, to edit and use with --config.
    Workcell(workcell::Workcell),
    /// Calibrate the heads from a blinking light.
    Calibrate(calibrate::Calibrate),
    /// Offer the simulated workcell's devices over the wires of real ones.
    Sim(sim::Sim),
    /// Find blinking landmarks in a recording.
    Blink(blink::Args),
    /// Recognise objects of known size in a set of pictures.
    Pose(pose::PoseArgs),
}

/// Runs a command; `true` when the thing asked for was achieved.
pub fn run(command: Command) -> Result<bool, Failure> {
    match command {
        Command::Find(args) => find::run(&args),
        Command::Grasp(args) => grasp::run(&args),
        Command::Tags(args) => tags::run(&args),
        Command::Tag(args) => tag::run(&args),
        Command::Experiment(args) => experiment::run(&args),
        Command::Evaluate(args) => evaluate::run(args),
        Command::Workcell(args) => workcell::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Sim(args) => sim::run(&args),
        Command::Blink(args) => blink::run(args),
        Command::Pose(args) => pose::run(args),
    }
}
