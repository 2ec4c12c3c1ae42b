//! Machine output: one JSON document on standard output.

use serde::Serialize;

use crate::failure::Failure;

/// Prints a value as one JSON document.
pub fn json(value: &impl Serialize) -> Result<(), Failure> {
    let text = serde_json::to_string_pretty(value)
        .map_err(|error| Failure::failed(error, "report this as a defect"))?;
    println!("{text}");
    Ok(())
}
