//! Who wrote a record: signatures by ES256 and the keys that a robot trusts (feature `signature`).
//!
//! In: keys as PEM files of OpenSSL and others, a record as it was read. Out: a signed record, or a
//! [`Verdict`]. Keys are on the curve P-256; a key's id is the beginning of its COSE thumbprint (RFC
//! 9679). Signing is deterministic (RFC 6979).

use std::fmt;

use p256::SecretKey;
use p256::ecdsa::signature::{Signer, Verifier};
use p256::ecdsa::{Signature, SigningKey, VerifyingKey};
use p256::pkcs8::{
    DecodePrivateKey, DecodePublicKey, EncodePrivateKey, EncodePublicKey, LineEnding,
};
use sha2::{Digest, Sha256};

use crate::cbor::MAX_BYTES;
use crate::cose::{self, ES256};

/// Bytes of a key id: enough to tell an owner's keys apart. A collision costs one more check.
const KEY_ID_BYTES: usize = 8;

/// Why a key or a record was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SignatureError {
    /// No PEM of a P-256 key.
    #[error("no {0} key on the curve P-256 in PEM")]
    Key(&'static str),
    /// The record and its signature do not fit a tag.
    #[error("the signed record has {0} bytes, and a tag holds 1024")]
    Size(usize),
    /// Random numbers that are no key; take others.
    #[error("these random numbers are no key")]
    Seed,
}

/// What signs records.
pub struct OwnerKey(SigningKey);

impl OwnerKey {
    /// Makes a key of 32 random bytes, which must be as good as the key shall be.
    pub fn from_random(bytes: &[u8; 32]) -> Result<Self, SignatureError> {
        SigningKey::from_slice(bytes).map(OwnerKey).map_err(|_| SignatureError::Seed)
    }

    /// Reads a PEM file: "PRIVATE KEY" (PKCS #8) or "EC PRIVATE KEY" (SEC 1).
    pub fn from_pem(pem: &str) -> Result<Self, SignatureError> {
        let key = SecretKey::from_pkcs8_pem(pem).or_else(|_| SecretKey::from_sec1_pem(pem));
        key.map(|key| OwnerKey(key.into())).map_err(|_| SignatureError::Key("private"))
    }

    /// The private key as PEM, to be kept secret, and the public one.
    pub fn to_pem(&self) -> Result<[String; 2], SignatureError> {
        let private = self.0.to_pkcs8_pem(LineEnding::LF);
        let private = private.map_err(|_| SignatureError::Key("private"))?;
        let public = self.0.verifying_key().to_public_key_pem(LineEnding::LF);
        Ok([private.to_string(), public.map_err(|_| SignatureError::Key("public"))?])
    }

    /// Wraps a record's CBOR into an envelope with its signature.
    pub fn sign(&self, record: &[u8]) -> Result<Vec<u8>, SignatureError> {
        let mut signed = Vec::new();
        let mut message = Vec::new();
        // A vector takes all that is written to it.
        let _ = cose::to_be_signed(cose::PROTECTED, record, &mut message);
        let signature: Signature = self.0.sign(&message);
        let _ =
            cose::seal(&key_id(self.0.verifying_key()), record, &signature.to_bytes(), &mut signed);
        match signed.len() <= MAX_BYTES {
            true => Ok(signed),
            false => Err(SignatureError::Size(signed.len())),
        }
    }
}

/// The beginning of the SHA-256 of the key as a COSE_Key with only its required parameters.
fn key_id(key: &VerifyingKey) -> [u8; KEY_ID_BYTES] {
    let point = key.to_encoded_point(false);
    let mut canonical = vec![0xA4, 0x01, 0x02, 0x20, 0x01];
    for (label, coordinate) in [(0x21, point.x()), (0x22, point.y())] {
        canonical.extend([label, 0x58, 0x20]);
        canonical.extend(coordinate.into_iter().flatten());
    }
    let mut id = [0; KEY_ID_BYTES];
    id.copy_from_slice(&Sha256::digest(&canonical)[..KEY_ID_BYTES]);
    id
}

/// What a signature says of a record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// There is none.
    Unsigned,
    /// It is by this trusted key.
    Trusted(String),
    /// It is by a key that is not trusted.
    Unknown,
    /// It claims a trusted key and is not by it, or is no signature that is understood: the record
    /// was changed, or never was its owner's.
    Bad,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Verdict::Unsigned => f.write_str("not signed"),
            Verdict::Trusted(name) => write!(f, "signed by {name}"),
            Verdict::Unknown => f.write_str("signed by a key that is not trusted"),
            Verdict::Bad => f.write_str("the signature is wrong"),
        }
    }
}

/// The keys that a robot trusts, by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TrustedKeys(Vec<(String, VerifyingKey)>);

impl TrustedKeys {
    /// Trusts a public key ("PUBLIC KEY" in PEM).
    pub fn trust(&mut self, name: &str, pem: &str) -> Result<(), SignatureError> {
        let key = VerifyingKey::from_public_key_pem(pem);
        self.0.push((name.to_owned(), key.map_err(|_| SignatureError::Key("public"))?));
        Ok(())
    }

    /// Judges a record as it was read from a tag.
    pub fn judge(&self, record: &[u8]) -> Verdict {
        if !cose::is_signed(record) {
            return Verdict::Unsigned;
        }
        let Ok(envelope) = cose::open(record) else { return Verdict::Bad };
        let Ok(signature) = Signature::from_slice(envelope.signature) else { return Verdict::Bad };
        if envelope.algorithm != Some(ES256) {
            return Verdict::Bad;
        }
        let mut message = Vec::new();
        let _ = cose::to_be_signed(envelope.protected, envelope.payload, &mut message);
        // The id is a hint only: any trusted key will do.
        let by = self.0.iter().find(|(_, key)| key.verify(&message, &signature).is_ok());
        let claims = |key: &VerifyingKey| envelope.key_id == Some(&key_id(key));
        match by {
            Some((name, _)) => Verdict::Trusted(name.clone()),
            None if self.0.iter().any(|(_, key)| claims(key)) => Verdict::Bad,
            None => Verdict::Unknown,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cbor;
    use crate::record::Record;
    use proptest::prelude::*;

    fn record() -> Vec<u8> {
        let record: Record = serde_json::from_str(
            r#"{"object_id": "cup", "landmarks": [{"position": [0.04, 0.0, 0.0], "normal": [1, 0, 0]}],
                "bounding_box": {"width": 0.08, "length": 0.08, "height": 0.09}, "shape": {"kind": "box"}}"#,
        )
        .unwrap();
        let mut bytes = Vec::new();
        cbor::encode(&record, &mut bytes).unwrap();
        bytes
    }

    fn keys() -> (OwnerKey, TrustedKeys) {
        let key = OwnerKey::from_random(&[7; 32]).unwrap();
        let mut trusted = TrustedKeys::default();
        let other = OwnerKey::from_random(&[8; 32]).unwrap();
        trusted.trust("other", &other.to_pem().unwrap()[1]).unwrap();
        trusted.trust("owner", &key.to_pem().unwrap()[1]).unwrap();
        (key, trusted)
    }

    #[test]
    fn a_signed_record_is_a_record_and_is_known() {
        let (key, trusted) = keys();
        let signed = key.sign(&record()).unwrap();
        assert_eq!(cbor::decode(&signed).unwrap(), cbor::decode(&record()).unwrap());
        assert_eq!(trusted.judge(&signed), Verdict::Trusted("owner".into()));
        assert_eq!(trusted.judge(&record()), Verdict::Unsigned);
        assert_eq!(TrustedKeys::default().judge(&signed), Verdict::Unknown);
        let again = OwnerKey::from_pem(&key.to_pem().unwrap()[0]).unwrap();
        assert_eq!(again.sign(&record()).unwrap(), signed, "keys survive, signing repeats");
        println!("a signature costs {} bytes", signed.len() - record().len());
    }

    #[test]
    fn a_record_that_leaves_no_room_is_refused() {
        let (key, _) = keys();
        assert!(key.sign(&[0; 930]).is_ok());
        assert!(matches!(key.sign(&[0; 950]), Err(SignatureError::Size(_))));
        assert!(OwnerKey::from_pem("-----BEGIN RUBBISH-----").is_err());
        assert!(TrustedKeys::default().trust("x", &key.to_pem().unwrap()[0]).is_err());
    }

    proptest! {
        #[test]
        fn no_change_goes_unnoticed(at in 0usize..1000, bit in 0u8..8) {
            let (key, trusted) = keys();
            let mut signed = key.sign(&record()).unwrap();
            let whole = signed.clone();
            let open = cose::open(&whole).unwrap();
            // The header with the key id, a hint, is not signed: tag, array, protected, then this.
            let begin = 2 + 1 + cose::PROTECTED.len();
            let end = open.key_id.unwrap().as_ptr_range().end as usize - whole.as_ptr() as usize;
            let at = at % signed.len();
            signed[at] ^= 1 << bit;
            match trusted.judge(&signed) {
                Verdict::Trusted(_) => {
                    prop_assert!((begin..end).contains(&at), "at {}", at);
                    prop_assert_eq!(cose::open(&signed).unwrap().payload, open.payload);
                }
                verdict => prop_assert!(!(end - KEY_ID_BYTES..end).contains(&at), "{:?} at {}", verdict, at),
            }
        }

        #[test]
        fn no_envelope_panics(mut bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let (_, trusted) = keys();
            trusted.judge(&bytes);
            bytes.splice(0..0, [0xD2, 0x84, 0x43, 0xA1, 0x01, 0x26]);
            prop_assert!(!matches!(trusted.judge(&bytes), Verdict::Trusted(_)));
            let _ = cbor::decode(&bytes);
        }
    }

    /// Appendix C.2.1 of RFC 9052, with the public key of its appendix C.7.1.
    #[test]
    fn the_rfcs_own_example_verifies() {
        let hex = |text: &str| -> Vec<u8> {
            (0..text.len() / 2)
                .map(|k| u8::from_str_radix(&text[2 * k..2 * k + 2], 16).unwrap())
                .collect()
        };
        let envelope = hex(concat!(
            "d28443a10126a10442313154546869732069732074686520636f6e74656e742e",
            "58408eb33e4ca31d1c465ab05aac34cc6b23d58fef5c083106c4d25a91aef0b0117e2af9a291",
            "aa32e14ab834dc56ed2a223444547e01f11d3b0916e5a4c345cacb36",
        ));
        let point = hex(concat!(
            "04bac5b11cad8f99f9c72b05cf4b9e26d244dc189f745228255a219a86d6a09eff",
            "20138bf82dc1b6d562be0fa54ab7804a3a64b6d72ccfed6b6fb6ed28bbfc117e",
        ));
        let key = VerifyingKey::from_sec1_bytes(&point).unwrap();
        let trusted = TrustedKeys(vec![("11".into(), key)]);
        assert_eq!(trusted.judge(&envelope), Verdict::Trusted("11".into()));
        assert_eq!(cose::open(&envelope).unwrap().payload, b"This is the content.");
        let mut changed = envelope;
        changed[20] ^= 1;
        assert_eq!(trusted.judge(&changed), Verdict::Unknown, "its key id is not a thumbprint");
    }
}
