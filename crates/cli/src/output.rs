//! Standard output: text for people, or one JSON document for machines.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write};

use serde::Serialize;
use serde_json::Value;

use crate::failure::Failure;

/// Prints a value as one JSON document.
pub fn json(value: &impl Serialize) -> Result<(), Failure> {
    let text = serde_json::to_string_pretty(value)
        .map_err(|error| Failure::failed(error, "report this as a defect"))?;
    outln!("{text}");
    Ok(())
}

/// Under `--json` exit status 1 comes with a document that says why: this prints it for a command that failed
/// before it had anything to tell. `document` holds what the command's own one says in that case. Misuse is
/// for the person who typed it.
pub fn told<T>(
    result: Result<T, Failure>,
    as_json: bool,
    mut document: Value,
) -> Result<T, Failure> {
    if let Err(failure) = &result
        && as_json
        && failure.status == 1
    {
        document["reason"] = failure.message.as_str().into();
        document["hint"] = failure.hint.as_str().into();
        json(&document)?;
    }
    result
}

/// The number as people read it with so many decimals: what rounds to zero is zero and not minus zero.
pub fn rounded(value: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    (value * scale).round() / scale + 0.0
}

/// `print!` for a reader who may have left.
macro_rules! out {
    ($($text:tt)*) => { $crate::output::write(format_args!($($text)*)) };
}

/// The same with the end of a line.
macro_rules! outln {
    () => { $crate::output::write(format_args!("\n")) };
    ($($text:tt)*) => { $crate::output::write(format_args!("{}\n", format_args!($($text)*))) };
}

pub(crate) use {out, outln};

/// Writes to standard output. A reader who has seen enough (`| head`) ends the program quietly;
/// output that cannot be kept (a full disk) ends it with a message and exit status 1.
pub fn write(text: Arguments) {
    let mut out = std::io::stdout().lock();
    let Err(error) = out.write_fmt(text).and_then(|()| out.flush()) else { return };
    if error.kind() == ErrorKind::BrokenPipe {
        std::process::exit(0);
    }
    let failure = Failure::failed(
        format!("cannot write to standard output: {error}"),
        "make room where the output goes",
    );
    eprintln!("{failure}");
    std::process::exit(failure.status.into());
}
