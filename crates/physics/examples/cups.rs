//! Grasps cups over seeds and prints what the physics says.
//!
//! `cargo run -p vergence-physics --example cups -- [SEEDS] [DIRECTORY]`; with a directory each trial is
//! written there as JSON for `scripts/replay_mujoco.py`. Exit status 1 when a success was false.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use vergence_grasp::Config;
use vergence_physics::experiment::{self, Cell, Conditions};
use vergence_physics::recording;

fn main() -> Result<ExitCode, Box<dyn std::error::Error>> {
    let seeds: u64 = std::env::args().nth(1).map_or(Ok(30), |s| s.parse())?;
    let directory = std::env::args().nth(2).map(PathBuf::from);
    let urdf = include_str!("../../grasp/assets/arm.urdf");
    let cell = Cell::parse(urdf, Path::new("arm.urdf"))?;
    let began = Instant::now();
    let clock = || began.elapsed().as_secs_f64();
    let (conditions, config) = (Conditions::default(), Config::default());
    let (mut lifted, mut refused, mut bumped, mut false_successes) = (0, 0, 0, 0);
    let (mut planning, mut closing) = (Vec::new(), Vec::new());
    for seed in 0..seeds {
        let (trial, _) = experiment::run(&cell, seed, &conditions, &config, &clock)?;
        planning.push(trial.planning);
        if let (Some(directory), Some(json)) = (&directory, recording::of_trial(&trial)) {
            std::fs::create_dir_all(directory)?;
            std::fs::write(directory.join(format!("{seed:03}.json")), json.to_string())?;
        }
        let (plan, verdict) = match (&trial.plan, &trial.verdict) {
            (Ok(plan), Some(verdict)) => (plan, verdict),
            (Err(why), _) => {
                refused += 1;
                println!("{seed:3} refused: {why}");
                continue;
            }
            (Ok(_), None) => continue,
        };
        lifted += u32::from(verdict.succeeded);
        bumped += u32::from(verdict.collision.is_some());
        false_successes += u32::from(verdict.believed && !verdict.succeeded);
        closing.push(verdict.centred * 1e3);
        println!(
            "{seed:3} {} {} grasp, {:.0} N, rose {:.0} mm, slipped {:.1} mm, closing moved it {:.1} mm, {:.0} s{}",
            if verdict.succeeded { "lifted" } else { "FAILED" },
            plan.grasp.hold.name(),
            verdict.force,
            verdict.risen * 1e3,
            verdict.slipped * 1e3,
            verdict.centred * 1e3,
            verdict.duration,
            verdict.collision.as_ref().map_or(String::new(), |t| {
                format!(", {} touched {} with {:.1} N", t.link, t.other, t.force)
            }),
        );
    }
    println!(
        "{lifted} of {seeds} lifted, {refused} refused, {bumped} collisions, {false_successes} false successes; \
         median planning {:.0} ms, median closing error {:.1} mm",
        median(&mut planning) * 1e3,
        median(&mut closing),
    );
    Ok(if false_successes == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
