//! A flash in memory, for tags that live in a process.

use core::convert::Infallible;

use embedded_storage_async::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

/// Erase block (bytes), as of an nRF52840.
pub const BLOCK: usize = 4096;

/// A NOR flash of some erase blocks, erased at first.
pub struct MemoryFlash(Vec<u8>);

/// An access outside the flash or across its words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OutOfBounds;

impl From<Infallible> for OutOfBounds {
    fn from(never: Infallible) -> Self {
        match never {}
    }
}

impl NorFlashError for OutOfBounds {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::OutOfBounds
    }
}

impl MemoryFlash {
    /// A flash of this many erase blocks.
    pub fn new(blocks: usize) -> Self {
        MemoryFlash(vec![0xFF; blocks * BLOCK])
    }

    /// All its bytes.
    pub fn range(&self) -> core::ops::Range<u32> {
        0..self.0.len() as u32
    }
}

impl ErrorType for MemoryFlash {
    type Error = OutOfBounds;
}

impl ReadNorFlash for MemoryFlash {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), OutOfBounds> {
        let from = offset as usize;
        bytes.copy_from_slice(self.0.get(from..from + bytes.len()).ok_or(OutOfBounds)?);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.0.len()
    }
}

impl NorFlash for MemoryFlash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = BLOCK;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), OutOfBounds> {
        self.0.get_mut(from as usize..to as usize).ok_or(OutOfBounds)?.fill(0xFF);
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), OutOfBounds> {
        let from = offset as usize;
        let words = self.0.get_mut(from..from + bytes.len()).ok_or(OutOfBounds)?;
        // Programming only clears bits.
        words.iter_mut().zip(bytes).for_each(|(word, byte)| *word &= byte);
        Ok(())
    }
}
