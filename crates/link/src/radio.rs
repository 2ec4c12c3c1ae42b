//! What all radios can do with tags, beyond what finding an object needs.

use std::time::Duration;

use vergence_devices::{DeviceError, TagAddress, TagLink, TagState};
use vergence_tag::Pattern;

use crate::hci::HciLink;
use crate::job::{Bond, TagInfo};

/// A tag radio for the owner of tags: it also writes records and pairs.
pub trait TagRadio: TagLink {
    /// What the tag tells of itself.
    fn info(&mut self, tag: TagAddress, timeout: Duration) -> Result<TagInfo, DeviceError>;

    /// Gives the tag a new record. It is checked here first, and by the tag once more.
    fn write_record(
        &mut self,
        tag: TagAddress,
        record: &[u8],
        timeout: Duration,
    ) -> Result<(), DeviceError>;

    /// Plays a pattern no longer than `limit`, whatever the tag's own longest time is.
    fn play_for(
        &mut self,
        tag: TagAddress,
        pattern: Pattern,
        limit: Duration,
        timeout: Duration,
    ) -> Result<TagState, DeviceError>;

    /// Pairs with a tag: with the passkey that is printed on it, or ("Just Works") with none. The bond
    /// is in force at once; a radio that gives one wants it back after a restart, by
    /// [`TagRadio::add_bond`], others keep it themselves.
    fn pair(&mut self, tag: TagAddress, passkey: Option<u32>) -> Result<Option<Bond>, DeviceError>;

    /// Takes up a bond of an earlier run.
    fn add_bond(&mut self, bond: Bond) -> Result<(), DeviceError>;

    /// Bonds outlast the process without being given back.
    fn keeps_bonds(&self) -> bool;

    /// Ends the link that is held for a tag whose light plays; the light goes out.
    fn release(&mut self, tag: TagAddress) -> Result<(), DeviceError>;
}

impl TagRadio for HciLink {
    fn info(&mut self, tag: TagAddress, timeout: Duration) -> Result<TagInfo, DeviceError> {
        HciLink::info(self, tag, timeout)
    }

    fn write_record(
        &mut self,
        tag: TagAddress,
        record: &[u8],
        timeout: Duration,
    ) -> Result<(), DeviceError> {
        HciLink::write_record(self, tag, record, timeout)
    }

    fn play_for(
        &mut self,
        tag: TagAddress,
        pattern: Pattern,
        limit: Duration,
        timeout: Duration,
    ) -> Result<TagState, DeviceError> {
        HciLink::play_for(self, tag, pattern, limit, timeout)
    }

    fn pair(&mut self, tag: TagAddress, passkey: Option<u32>) -> Result<Option<Bond>, DeviceError> {
        HciLink::pair(self, tag, passkey)
    }

    fn add_bond(&mut self, bond: Bond) -> Result<(), DeviceError> {
        HciLink::add_bond(self, bond)
    }

    fn keeps_bonds(&self) -> bool {
        false
    }

    fn release(&mut self, tag: TagAddress) -> Result<(), DeviceError> {
        HciLink::release(self, tag)
    }
}
