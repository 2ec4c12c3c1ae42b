//! A signed record's envelope: COSE_Sign1 (RFC 9052, section 4.2) around the record's CBOR.
//!
//! ```text
//! 18([ h'A10126', {4: key id}, record, signature ])      ES256: P-256 and SHA-256 (RFC 9053)
//! ```
//! A tag stores and serves the envelope as it is; it looks inside but checks no signature, for the
//! robot decides whom it trusts (feature `signature`). `no_std` and without a heap, which the COSE
//! crates are not; therefore by hand, against vectors of the COSE working group.

use minicbor::data::{Tag, Type};
use minicbor::decode::Error as DecodeError;
use minicbor::encode::Write;
use minicbor::{Decoder, Encoder};

use crate::cbor::entries;

/// CBOR tag of COSE_Sign1.
const SIGN1: u64 = 18;
/// Header labels.
const ALGORITHM: u64 = 1;
const CRITICAL: u64 = 2;
const KEY_ID: u64 = 4;
/// ECDSA with P-256 and SHA-256.
pub const ES256: i64 = -7;

/// The parts of an envelope, as they are on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sign1<'b> {
    /// The protected headers' own encoding, which is signed.
    pub protected: &'b [u8],
    /// Algorithm, of the protected headers.
    pub algorithm: Option<i64>,
    /// Hint at the key.
    pub key_id: Option<&'b [u8]>,
    /// What is signed: a record's CBOR.
    pub payload: &'b [u8],
    /// The signature.
    pub signature: &'b [u8],
}

/// Bytes are an envelope, and not a plain record.
pub fn is_signed(bytes: &[u8]) -> bool {
    Decoder::new(bytes).tag().is_ok_and(|tag| tag == Tag::new(SIGN1))
}

/// Takes an envelope apart.
pub fn open(bytes: &[u8]) -> Result<Sign1<'_>, DecodeError> {
    let mut d = Decoder::new(bytes);
    if d.tag()? != Tag::new(SIGN1) || d.array()? != Some(4) {
        return Err(DecodeError::message("not a COSE_Sign1"));
    }
    let protected = d.bytes()?;
    let (mut algorithm, mut key_id) = (None, None);
    if !protected.is_empty() {
        headers(&mut Decoder::new(protected), &mut algorithm, &mut key_id)?;
    }
    // An algorithm that is not signed proves nothing.
    headers(&mut d, &mut None, &mut key_id)?;
    let payload = match d.datatype()? {
        Type::Bytes => d.bytes()?,
        _ => return Err(DecodeError::message("the envelope holds no record")),
    };
    let signature = d.bytes()?;
    if d.position() != bytes.len() {
        return Err(DecodeError::message("bytes follow the envelope"));
    }
    Ok(Sign1 { protected, algorithm, key_id, payload, signature })
}

fn headers<'b>(
    d: &mut Decoder<'b>,
    algorithm: &mut Option<i64>,
    key_id: &mut Option<&'b [u8]>,
) -> Result<(), DecodeError> {
    entries(d, |d, label| {
        match label {
            // Algorithms may have names, too; none of those is known here.
            ALGORITHM if d.datatype()? != Type::String => *algorithm = Some(d.i64()?),
            KEY_ID => *key_id = Some(d.bytes()?),
            CRITICAL => return Err(DecodeError::message("a critical header is not understood")),
            _ => d.skip()?,
        }
        Ok(())
    })
}

/// Writes the bytes that a signature is made over (RFC 9052, section 4.4), without external data.
pub fn to_be_signed<W: Write>(
    protected: &[u8],
    payload: &[u8],
    out: W,
) -> Result<(), minicbor::encode::Error<W::Error>> {
    let mut e = Encoder::new(out);
    e.array(4)?.str("Signature1")?.bytes(protected)?.bytes(&[])?.bytes(payload)?;
    Ok(())
}

/// Protected headers of everything that is signed here: the algorithm ES256.
pub const PROTECTED: &[u8] = &[0xA1, 0x01, 0x26];

/// Writes an envelope with [`PROTECTED`] headers.
pub fn seal<W: Write>(
    key_id: &[u8],
    payload: &[u8],
    signature: &[u8],
    out: W,
) -> Result<(), minicbor::encode::Error<W::Error>> {
    let mut e = Encoder::new(out);
    e.tag(Tag::new(SIGN1))?.array(4)?.bytes(PROTECTED)?;
    e.map(1)?.u64(KEY_ID)?.bytes(key_id)?;
    e.bytes(payload)?.bytes(signature)?;
    Ok(())
}
