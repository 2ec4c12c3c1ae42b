//! `vergence experiment`: the paper's experiments over many seeds, judged by the simulator's truth.

use std::path::PathBuf;

use clap::Args;

use super::find::MethodArg;
use crate::failure::Failure;

mod grasp;
mod recognise;

/// Run one of the paper's experiments in the simulated workcell, with statistics.
#[derive(Args)]
pub struct Experiment {
    /// Which experiment: 1 finds, 2 grasps.
    #[arg(value_parser = clap::value_parser!(u8).range(1..=2))]
    number: u8,
    /// Number of workcells, each from a seed of its own.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    seeds: u64,
    /// Which recognition is used; experiment 2 grasps by the directional one only.
    #[arg(long, value_enum, default_value_t)]
    method: MethodArg,
    /// Folder for pictures and recordings: of experiment 1 from the first seed, as in the paper's
    /// figure 11; of experiment 2 from every seed, as in figure 12.
    #[arg(long, value_name = "DIR")]
    save: Option<PathBuf>,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Experiment) -> Result<bool, Failure> {
    match args.number {
        1 => recognise::run(args),
        _ => grasp::run(args),
    }
}

/// The smallest value that at least a share `q` of the values do not exceed.
fn quantile(values: impl Iterator<Item = f64>, q: f64) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let rank = (q * values.len() as f64).ceil() as usize;
    values.get(rank.saturating_sub(1)).copied()
}
