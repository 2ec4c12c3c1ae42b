//! What can be wrong with a simulated workcell.

use vergence_devices::{ConfigError, DescriptionError, DeviceError};
use vergence_tag::cbor::MAX_BYTES;
use vergence_tag::record::Invalid;

/// Why a workcell could not be built.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The configuration file was refused.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The robot's description was refused.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// An unknown or missing key in `[sim]`.
    #[error("[sim]: {0}")]
    Table(String),
    /// A number that the models cannot bear.
    #[error("[sim] {key} = {value}: must lie between {low} and {high}")]
    Range {
        /// Which key.
        key: &'static str,
        /// What it was.
        value: f64,
        /// Smallest.
        low: f64,
        /// Largest.
        high: f64,
    },
    /// A tag's record that cannot be true.
    #[error("[sim] object \"{id}\": {why}")]
    Record {
        /// Which object.
        id: String,
        /// What is wrong.
        why: Invalid,
    },
    /// A shape that cannot be drawn.
    #[error("[sim] object \"{0}\": its vertices enclose nothing")]
    Shape(String),
    /// A record that no tag can hold.
    #[error("[sim] object \"{id}\": its record has {bytes} bytes, a tag holds {MAX_BYTES}")]
    RecordSize {
        /// Which object.
        id: String,
        /// Bytes of the encoded record.
        bytes: usize,
    },
    /// The radio of the tags could not be started.
    #[error("[sim.radio]: {0}")]
    Radio(DeviceError),
    /// No place was found.
    #[error("[sim] object \"{0}\": no free place on the table; fewer or smaller objects needed")]
    NoPlace(String),
}
