//! A NOR flash in a file: what the tag keeps outlives the process and the power.
//!
//! The file is made whole (written beside, synced, renamed): one block that says what it is and holds
//! the tag's Bluetooth address, drawn once, then the erase blocks of the flash. Every write is synced
//! before it counts as done, so that the log in the flash (`vergence_firmware::Store`) is on the disk
//! in the order in which it was written; a disk that writes a sector wholly or not at all then loses
//! no record. The file is locked: two tags must not share one.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use embedded_storage_async::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

/// Erase block (bytes): a page of a file system.
const BLOCK: usize = 4096;
/// Erase blocks: the record and all bonds with room to spare.
const BLOCKS: usize = 4;
/// First bytes of the file.
const MAGIC: &[u8; 10] = b"vergence\x00\x01";

/// The flash.
#[derive(Debug)]
pub struct FileFlash {
    file: File,
    address: [u8; 6],
}

/// The file could not be read or written, or an access was outside of the flash.
#[derive(Debug)]
pub struct FlashFailed(#[allow(dead_code)] io::Error); // Shown by `Debug`.

impl NorFlashError for FlashFailed {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl FileFlash {
    /// Opens the flash in a file, which is made if there is none.
    pub fn open(path: &Path) -> io::Result<Self> {
        if !path.exists() {
            create(path)?;
        }
        let file = File::options().read(true).write(true).open(path)?;
        file.try_lock().map_err(|_| {
            io::Error::new(io::ErrorKind::ResourceBusy, "another tag holds this file")
        })?;
        let foreign = io::Error::new(io::ErrorKind::InvalidData, "this is not a tag's memory");
        if file.metadata()?.len() != ((1 + BLOCKS) * BLOCK) as u64 {
            return Err(foreign);
        }
        let (mut magic, mut address) = ([0; MAGIC.len()], [0; 6]);
        file.read_exact_at(&mut magic, 0)?;
        file.read_exact_at(&mut address, MAGIC.len() as u64)?;
        if magic != *MAGIC {
            return Err(foreign);
        }
        Ok(FileFlash { file, address })
    }

    /// The tag's static random address, least significant byte first.
    pub fn address(&self) -> [u8; 6] {
        self.address
    }

    /// All bytes of the flash.
    pub fn range(&self) -> std::ops::Range<u32> {
        0..(BLOCKS * BLOCK) as u32
    }

    fn place(&self, offset: u32, length: usize) -> Result<u64, FlashFailed> {
        let at = offset as usize;
        match at + length <= BLOCKS * BLOCK {
            true => Ok((BLOCK + at) as u64),
            false => Err(FlashFailed(io::ErrorKind::InvalidInput.into())),
        }
    }

    fn put(&mut self, bytes: &[u8], at: u64) -> Result<(), FlashFailed> {
        self.file.write_all_at(bytes, at).map_err(FlashFailed)?;
        self.file.sync_data().map_err(FlashFailed)
    }
}

/// Makes an erased flash with a new address.
fn create(path: &Path) -> io::Result<()> {
    let mut address = [0; 6];
    File::open("/dev/urandom")?.read_exact(&mut address)?;
    // The two top bits mark a static random address.
    address[5] |= 0xC0;
    let mut bytes = vec![0xFF; (1 + BLOCKS) * BLOCK];
    bytes[..MAGIC.len()].copy_from_slice(MAGIC);
    bytes[MAGIC.len()..MAGIC.len() + 6].copy_from_slice(&address);
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    fs::create_dir_all(folder)?;
    let mut draft = PathBuf::from(path).into_os_string();
    draft.push(".new");
    // It will hold bonds, which are secret.
    let mut options = File::options();
    let mut file = options.write(true).create(true).truncate(true).mode(0o600).open(&draft)?;
    file.write_all(&bytes)?;
    file.sync_all()?;
    fs::rename(&draft, path)?;
    File::open(folder)?.sync_all()
}

impl ErrorType for FileFlash {
    type Error = FlashFailed;
}

impl ReadNorFlash for FileFlash {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashFailed> {
        let at = self.place(offset, bytes.len())?;
        self.file.read_exact_at(bytes, at).map_err(FlashFailed)
    }

    fn capacity(&self) -> usize {
        BLOCKS * BLOCK
    }
}

impl NorFlash for FileFlash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = BLOCK;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashFailed> {
        let length = (to as usize).saturating_sub(from as usize);
        let at = self.place(from, length)?;
        self.put(&vec![0xFF; length], at)
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashFailed> {
        let at = self.place(offset, bytes.len())?;
        let mut words = vec![0; bytes.len()];
        self.file.read_exact_at(&mut words, at).map_err(FlashFailed)?;
        // Programming only clears bits.
        words.iter_mut().zip(bytes).for_each(|(word, byte)| *word &= byte);
        self.put(&words, at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vergence_air::Executor;

    fn run<T>(future: impl Future<Output = T>) -> T {
        Executor::new().block_on(future).unwrap()
    }

    fn folder(name: &str) -> PathBuf {
        let dir = std::env::temp_dir().join(format!("{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&dir);
        dir
    }

    #[test]
    fn what_is_written_is_there_for_the_next_process() {
        let path = folder("flash").join("deep/tag.flash");
        let address = {
            let mut flash = FileFlash::open(&path).unwrap();
            run(flash.write(4096, &[0xF0, 1, 2, 3])).unwrap();
            run(flash.write(4096, &[0x3F, 0xFF, 0xFF, 0xFF])).unwrap();
            let busy = FileFlash::open(&path).unwrap_err();
            assert_eq!(busy.kind(), io::ErrorKind::ResourceBusy);
            flash.address()
        };
        assert_eq!(address[5] & 0xC0, 0xC0);
        let mut flash = FileFlash::open(&path).unwrap();
        assert_eq!(flash.address(), address);
        let mut bytes = [0; 5];
        run(flash.read(4096, &mut bytes)).unwrap();
        assert_eq!(bytes, [0x30, 1, 2, 3, 0xFF], "bits are cleared, never set");
        run(flash.erase(4096, 8192)).unwrap();
        run(flash.read(4096, &mut bytes)).unwrap();
        assert_eq!(bytes, [0xFF; 5]);
        assert!(run(flash.write(4 * 4096 - 2, &[0; 4])).is_err(), "behind the end");
    }

    #[test]
    fn other_files_are_left_alone() {
        let path = folder("other").with_extension("txt");
        fs::write(&path, "a letter").unwrap();
        assert!(FileFlash::open(&path).is_err());
        assert_eq!(fs::read_to_string(&path).unwrap(), "a letter");
        fs::remove_file(&path).unwrap();
    }
}
