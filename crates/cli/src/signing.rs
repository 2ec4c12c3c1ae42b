//! Keys of record signatures as files: the owner's private key, the public keys that a robot trusts.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use vergence_devices::Config;
use vergence_tag::signature::{OwnerKey, TrustedKeys};

use crate::failure::Failure;

/// The keys that the configuration trusts, each named after its file.
pub fn trusted(config: &Config, folder: &Path) -> Result<TrustedKeys, Failure> {
    let hint = "the key `trusted_keys` of [radio] lists public keys (PEM), relative to the configuration's folder";
    let mut keys = TrustedKeys::default();
    for file in &config.radio.trusted_keys {
        let path = folder.join(file);
        let wrong = |error: String| Failure::misuse(format!("{}: {error}", path.display()), hint);
        let pem = fs::read_to_string(&path).map_err(|error| wrong(error.to_string()))?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        keys.trust(&name, &pem).map_err(|error| wrong(error.to_string()))?;
    }
    Ok(keys)
}

/// The keys of which one must have signed an object's record; `None` when none need have.
pub fn required(config: &Config, folder: &Path) -> Result<Option<TrustedKeys>, Failure> {
    if !config.radio.require_signature {
        return Ok(None);
    }
    if config.radio.trusted_keys.is_empty() {
        return Err(Failure::misuse(
            "[radio] requires signatures, but trusts no key",
            "list public keys in `trusted_keys`; `vergence tag key FILE` makes a pair",
        ));
    }
    trusted(config, folder).map(Some)
}

/// Reads a private key.
pub fn owner_key(path: &Path) -> Result<OwnerKey, Failure> {
    let hint =
        "--sign takes a private key on the curve P-256 (PEM); `vergence tag key FILE` makes one";
    let wrong = |error: String| Failure::misuse(format!("{}: {error}", path.display()), hint);
    let pem = fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    OwnerKey::from_pem(&pem).map_err(|error| wrong(error.to_string()))
}

/// Makes a pair of keys: the private one in `path`, which nobody else may read, the public one beside
/// it with the ending `.pub`. Neither file may be there before.
pub fn make_key(path: &Path) -> Result<PathBuf, Failure> {
    let public_path = path.with_extension("pub");
    if public_path == path {
        return Err(Failure::misuse(
            format!("{} would be both the private key and the public one", path.display()),
            "name the private key FILE.pem; FILE.pub goes beside it",
        ));
    }
    let unusable = |path: &Path, error: std::io::Error| {
        let hint = "name files that are not there yet, in a folder that can be written";
        Failure::failed(format!("{}: {error}", path.display()), hint)
    };
    let source = Path::new("/dev/urandom");
    let mut random = [0; 32];
    let read = File::open(source).and_then(|mut file| file.read_exact(&mut random));
    read.map_err(|error| unusable(source, error))?;
    let weird = |error| Failure::failed(error, "try once more");
    let [private, public] =
        OwnerKey::from_random(&random).and_then(|key| key.to_pem()).map_err(weird)?;
    let create = |path: &Path, mode| {
        let file = File::options().write(true).create_new(true).mode(mode).open(path);
        file.map_err(|error| unusable(path, error))
    };
    let mut private_file = create(path, 0o600)?;
    // A private key without its public one is of no use.
    let mut public_file =
        create(&public_path, 0o644).inspect_err(|_| drop(fs::remove_file(path)))?;
    private_file.write_all(private.as_bytes()).map_err(|error| unusable(path, error))?;
    public_file.write_all(public.as_bytes()).map_err(|error| unusable(&public_path, error))?;
    Ok(public_path)
}
