//! `vergence workcell DIR`: the built-in robot and workcell as files to copy and edit.

use std::path::PathBuf;

use clap::Args;

use crate::failure::Failure;
use crate::output::outln;

/// Write the built-in workcell (workcell.toml, workcell.urdf) to a folder, to edit and use with
/// --config.
#[derive(Args)]
pub struct Workcell {
    /// Folder; made when it does not exist. Files that exist are not overwritten.
    dir: PathBuf,
}

/// Runs the command.
pub fn run(args: &Workcell) -> Result<bool, Failure> {
    let hint = "choose a folder that you may write to and that holds no workcell yet";
    let failed = |error: std::io::Error| {
        Failure::failed(format!("cannot write to {}: {error}", args.dir.display()), hint)
    };
    std::fs::create_dir_all(&args.dir).map_err(failed)?;
    let files = [
        ("workcell.toml", vergence_sim::EMBEDDED_CONFIG),
        ("workcell.urdf", vergence_sim::EMBEDDED_URDF),
    ];
    if let Some((name, _)) = files.iter().find(|(name, _)| args.dir.join(name).exists()) {
        let path = args.dir.join(name);
        return Err(Failure::failed(format!("{} exists already", path.display()), hint));
    }
    for (name, text) in files {
        std::fs::write(args.dir.join(name), text).map_err(failed)?;
    }
    outln!("{0}: try `vergence find cup --config {0}`", args.dir.join("workcell.toml").display());
    Ok(true)
}
