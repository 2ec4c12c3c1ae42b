//! Grasps cups over seeds: `cargo run --release -p vergence-physics --example cups -- [SEEDS]`.

use std::path::Path;
use std::time::Instant;

use vergence_grasp::Config;
use vergence_physics::experiment::{self, Cell, Conditions};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let seeds: u64 = std::env::args().nth(1).map_or(Ok(30), |s| s.parse())?;
    let urdf = include_str!("../../grasp/assets/arm.urdf");
    let cell = Cell::parse(urdf, Path::new("arm.urdf"))?;
    let began = Instant::now();
    let clock = || began.elapsed().as_secs_f64();
    for seed in 0..seeds {
        let start = clock();
        let (trial, _) =
            experiment::run(&cell, seed, &Conditions::default(), &Config::default(), &clock)?;
        match (&trial.plan, &trial.verdict) {
            (Ok(plan), Some(v)) => println!(
                "{seed:3} {} {:5} hold {:5} F {:4.1}/{:4.1} risen {:6.1} mm slip {:5.2} centred {:5.2} {:5.1} s plan {:.3} wall {:.1} {:?}",
                if v.succeeded { "ok  " } else { "FAIL" },
                plan.grasp.hold.name(),
                v.believed,
                v.force,
                plan.force,
                v.risen * 1e3,
                v.slipped * 1e3,
                v.centred * 1e3,
                v.duration,
                trial.planning,
                clock() - start,
                v.collision
            ),
            (Err(why), _) => println!("{seed:3} refused: {why}  plan {:.3}", trial.planning),
            _ => println!("{seed:3} ?"),
        }
    }
    Ok(())
}
