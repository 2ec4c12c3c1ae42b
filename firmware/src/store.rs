//! What a tag keeps over a power cut: its record and its bonds.
//!
//! Both are items of one log-structured map in flash (`sequential-storage`): a new value is written
//! behind the old one with a checksum and counts from the moment it is complete. A power cut at any
//! write or erase leaves the old value or the new one, never a mixture; the tests cut at every step.

use embedded_storage_async::nor_flash::NorFlash;
use sequential_storage::cache::{Cache, Uncached};
use sequential_storage::map::{MapConfig, MapStorage};
use trouble_host::connection::SecurityLevel;
use trouble_host::prelude::{AddrKind, BdAddr};
use trouble_host::{Address, BondInformation, Identity, IdentityResolvingKey, LongTermKey};
use vergence_tag::cbor::MAX_BYTES;

/// Most robots that a tag remembers; the oldest of the weakest makes room.
pub const BONDS: usize = 8;

/// Bytes that hold the longest item: a record, its key, and the rounding to a flash word.
const ITEM: usize = MAX_BYTES + 64;
/// Bytes of a stored bond.
pub const BOND_BYTES: usize = 16 + 7 + 16 + 1;

const RECORD_KEY: u8 = 0;
const AGES_KEY: u8 = 1;
const FIRST_BOND_KEY: u8 = 16;

type Map<F> = MapStorage<u8, F, Cache<Uncached, Uncached, Uncached, u8>>;

/// Why the store does not work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    /// The flash area is too small or does not begin and end at its erase blocks.
    #[error("the flash area cannot be used")]
    Area,
    /// The flash failed, or holds what cannot be read.
    #[error("the flash failed")]
    Flash,
}

/// The tag's memory in a range of a flash.
pub struct Store<F: NorFlash> {
    map: Map<F>,
    buffer: [u8; ITEM],
}

impl<F: NorFlash> Store<F> {
    /// Opens the memory in a range of bytes: three erase blocks or more are good, two will do.
    pub fn new(flash: F, range: core::ops::Range<u32>) -> Result<Self, StoreError> {
        let config = MapConfig::try_new(range).map_err(|_| StoreError::Area)?;
        let map = MapStorage::new(flash, config, Cache::new_uncached());
        Ok(Store { map, buffer: [0; ITEM] })
    }

    /// The flash, for a board that uses other ranges of it.
    pub fn into_flash(self) -> F {
        self.map.destroy().0
    }

    /// Copies the record into `out` and returns its length; `None` when there is none.
    pub async fn record(&mut self, out: &mut [u8; MAX_BYTES]) -> Result<Option<usize>, StoreError> {
        let stored = self.get(RECORD_KEY).await?;
        let Some(stored) = stored.filter(|s| s.len() <= MAX_BYTES) else { return Ok(None) };
        out[..stored.len()].copy_from_slice(stored);
        Ok(Some(stored.len()))
    }

    /// Keeps a record in place of the one before.
    pub async fn set_record(&mut self, record: &[u8]) -> Result<(), StoreError> {
        self.put(RECORD_KEY, record).await
    }

    /// One of the bonds, counted from 0 to [`BONDS`].
    pub async fn bond(&mut self, index: usize) -> Result<Option<BondInformation>, StoreError> {
        let stored = self.get(FIRST_BOND_KEY + (index % BONDS) as u8).await?;
        Ok(stored.and_then(decode_bond))
    }

    /// This very bond is kept.
    pub async fn holds(&mut self, bond: &BondInformation) -> Result<bool, StoreError> {
        let wanted = encode_bond(bond);
        for index in 0..BONDS as u8 {
            if self.get(FIRST_BOND_KEY + index).await? == Some(&wanted[..]) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Keeps a bond: in the place of an older one of the same peer, else of the oldest among the
    /// weakest. False when it would cost a stronger one: whoever pairs without the passkey, maybe
    /// under another's address, must not push out a robot that proved itself.
    pub async fn add_bond(&mut self, bond: &BondInformation) -> Result<bool, StoreError> {
        let strength = bond.security_level;
        let mut strengths = [SecurityLevel::NoEncryption; BONDS];
        let mut own = None;
        for (index, kept) in strengths.iter_mut().enumerate() {
            let Some(stored) = self.bond(index).await? else { continue };
            *kept = stored.security_level;
            if stored.identity.match_identity(&bond.identity) {
                if *kept > strength {
                    return Ok(false);
                }
                own = Some(index as u8);
            }
        }
        let place = match own {
            Some(place) => place,
            None => {
                let ages = self.ages().await?;
                let strength_of = |place: &u8| strengths[usize::from(*place)];
                let place = ages.iter().copied().min_by_key(strength_of).unwrap_or(0);
                if strength_of(&place) > strength {
                    return Ok(false);
                }
                let mut next = ages.iter().copied().filter(|other| *other != place);
                let ages: [u8; BONDS] = core::array::from_fn(|_| next.next().unwrap_or(place));
                self.put(AGES_KEY, &ages).await?;
                place
            }
        };
        self.put(FIRST_BOND_KEY + place, &encode_bond(bond)).await?;
        Ok(true)
    }

    /// The places of the bonds, that of the oldest first.
    async fn ages(&mut self) -> Result<[u8; BONDS], StoreError> {
        let in_order = core::array::from_fn(|place| place as u8);
        let stored = self.get(AGES_KEY).await?.and_then(|ages| <[u8; BONDS]>::try_from(ages).ok());
        let complete = |ages: &[u8; BONDS]| in_order.iter().all(|place| ages.contains(place));
        Ok(stored.filter(complete).unwrap_or(in_order))
    }

    /// Forgets all bonds.
    pub async fn forget_bonds(&mut self) -> Result<(), StoreError> {
        for index in 0..BONDS as u8 {
            self.put(FIRST_BOND_KEY + index, &[]).await?;
        }
        Ok(())
    }

    async fn get(&mut self, key: u8) -> Result<Option<&[u8]>, StoreError> {
        self.map.fetch_item::<&[u8]>(&mut self.buffer, &key).await.map_err(|_| StoreError::Flash)
    }

    async fn put(&mut self, key: u8, value: &[u8]) -> Result<(), StoreError> {
        self.map.store_item(&mut self.buffer, &key, &value).await.map_err(|_| StoreError::Flash)
    }
}

/// A bond as it is stored.
pub fn encode_bond(bond: &BondInformation) -> [u8; BOND_BYTES] {
    let mut bytes = [0; BOND_BYTES];
    bytes[..16].copy_from_slice(&bond.ltk.to_le_bytes());
    bytes[16] = bond.identity.addr.kind.as_raw();
    bytes[17..23].copy_from_slice(bond.identity.addr.addr.raw());
    if let Some(irk) = bond.identity.irk {
        bytes[23..39].copy_from_slice(&irk.to_le_bytes());
    }
    bytes[39] = match bond.security_level {
        SecurityLevel::NoEncryption => 0,
        SecurityLevel::Encrypted => 1,
        SecurityLevel::EncryptedAuthenticated => 2,
    };
    bytes
}

/// Reads a stored bond; `None` when it is none.
pub fn decode_bond(bytes: &[u8]) -> Option<BondInformation> {
    let bytes: &[u8; BOND_BYTES] = bytes.try_into().ok()?;
    let (mut ltk, mut address, mut irk) = ([0; 16], [0; 6], [0; 16]);
    ltk.copy_from_slice(&bytes[..16]);
    address.copy_from_slice(&bytes[17..23]);
    irk.copy_from_slice(&bytes[23..39]);
    let kind = if bytes[16] & 1 == 0 { AddrKind::PUBLIC } else { AddrKind::RANDOM };
    let identity = Identity {
        addr: Address::new(kind, BdAddr::new(address)),
        irk: IdentityResolvingKey::from_le_bytes(irk),
    };
    let level = match bytes[39] {
        1 => SecurityLevel::Encrypted,
        2 => SecurityLevel::EncryptedAuthenticated,
        _ => return None,
    };
    Some(BondInformation::new(identity, LongTermKey::from_le_bytes(ltk), level, true))
}
