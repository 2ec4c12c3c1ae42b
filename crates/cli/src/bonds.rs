//! The file that keeps the keys of paired tags over runs (`bonds` of `[radio]`).
//!
//! It holds bonds one after the other ([`Bond::to_bytes`]), one of every tag. A new one is written as
//! a whole new file beside the old one, which then takes its name: whenever the power fails, the old
//! file is there or the new one. Nobody but the user can read it.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use vergence_link::{BOND_BYTES, Bond};

/// What a file of bonds holds.
#[derive(Debug, PartialEq)]
pub struct Kept {
    /// One bond of every tag, the latest.
    pub bonds: Vec<Bond>,
    /// A bond was cut short at the end and is lost.
    pub torn: bool,
}

/// Reads a file of bonds; one that does not exist holds none.
pub fn read(path: &Path) -> io::Result<Kept> {
    let bytes = match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Vec::new(),
        read => read?,
    };
    let (whole, rest) = bytes.as_chunks::<BOND_BYTES>();
    let mut bonds = Vec::new();
    whole.iter().for_each(|bytes| put(&mut bonds, Bond::from_bytes(*bytes)));
    Ok(Kept { bonds, torn: !rest.is_empty() })
}

/// Keeps a bond, in the place of an earlier one with the same tag.
pub fn keep(path: &Path, bond: &Bond) -> io::Result<()> {
    // The file itself is replaced, not a link to it.
    let path = &fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let mut bonds = read(path)?.bonds;
    put(&mut bonds, bond.clone());
    let bytes: Vec<u8> = bonds.iter().flat_map(Bond::to_bytes).collect();

    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{}.new", std::process::id()));
    let new = Path::new(&name);
    let written = replace(path, new, &bytes);
    if written.is_err() {
        // What is there is what went wrong; it need not stay there as well.
        let _ = fs::remove_file(new);
    }
    written
}

fn put(bonds: &mut Vec<Bond>, bond: Bond) {
    bonds.retain(|earlier| !earlier.is_of_same_tag(&bond));
    bonds.push(bond);
}

fn replace(path: &Path, new: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::options().write(true).create_new(true).mode(0o600).open(new)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    fs::rename(new, path)?;
    // The name is kept in the folder.
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    /// A bond with the tag of this number.
    fn bond(tag: u8, key: u8) -> Bond {
        let mut bytes = [0; BOND_BYTES];
        bytes[..16].fill(key);
        bytes[16..23].copy_from_slice(&[1, tag, 1, 2, 3, 4, 0xC0]);
        bytes[39] = 2;
        Bond::from_bytes(bytes)
    }

    #[test]
    fn bonds_are_replaced_whole_and_for_one_reader() {
        let folder = std::env::temp_dir().join(format!("vergence-bonds-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir(&folder).unwrap();
        let path = &folder.join("tags.bonds");
        assert_eq!(read(path).unwrap(), Kept { bonds: vec![], torn: false });
        // As a careless copy left it: readable by all, with a tag twice and half a bond at the end.
        let old = [bond(1, 1), bond(2, 2), bond(1, 3)].map(|bond| bond.to_bytes()).concat();
        fs::write(path, [&old[..], &[7; 11]].concat()).unwrap();
        fs::set_permissions(path, PermissionsExt::from_mode(0o644)).unwrap();
        assert_eq!(read(path).unwrap(), Kept { bonds: vec![bond(2, 2), bond(1, 3)], torn: true });

        keep(path, &bond(2, 4)).unwrap();
        assert_eq!(read(path).unwrap(), Kept { bonds: vec![bond(1, 3), bond(2, 4)], torn: false });
        assert_eq!(fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "nothing is left beside it");
        fs::remove_dir_all(&folder).unwrap();
    }
}
