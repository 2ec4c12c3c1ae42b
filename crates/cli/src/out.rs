//! `--out FILE`: the file in which a command that works for long keeps what came out.

use std::fs::{self, File};
use std::path::Path;

use crate::failure::Failure;

/// Refuses a file that cannot be written, before the work; what is in it stays as it is.
pub fn check(path: &Path) -> Result<(), Failure> {
    let new = match path.metadata() {
        // Who reads a pipe would take the trial for its end.
        Ok(there) if !there.is_file() && !there.is_dir() => return Ok(()),
        there => there.is_err(),
    };
    let opened = File::options().append(true).create(true).open(path);
    // A link may lead to a file that is not there yet: the link stays.
    let made = || fs::canonicalize(path).and_then(fs::remove_file);
    opened.and_then(|_| if new { made() } else { Ok(()) }).map_err(|e| refused(path, e))
}

/// What is said of such a file that cannot be written.
pub fn refused(path: &Path, error: std::io::Error) -> Failure {
    Failure::failed(
        format!("cannot write {}: {error}", path.display()),
        "give --out a file that can be written, in a folder that exists",
    )
}
