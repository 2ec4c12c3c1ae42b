//! Signs a record, or judges a signed one, from files: for checks against other COSE implementations.
//!
//! ```text
//! sign_record sign  private.pem record.json signed.cose
//! sign_record judge public.pem signed.cose
//! ```

use std::error::Error;
use std::fs;

use vergence_tag::signature::{OwnerKey, TrustedKeys};
use vergence_tag::{Record, cbor};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["sign", key, record, out] => {
            let record: Record = serde_json::from_str(&fs::read_to_string(record)?)?;
            record.validate()?;
            let mut bytes = Vec::new();
            cbor::encode(&record, &mut bytes)?;
            fs::write(out, OwnerKey::from_pem(&fs::read_to_string(key)?)?.sign(&bytes)?)?;
        }
        ["judge", key, signed] => {
            let mut keys = TrustedKeys::default();
            keys.trust("this key", &fs::read_to_string(key)?)?;
            let bytes = fs::read(signed)?;
            let id = cbor::decode(&bytes).map(|record| record.object_id.to_string());
            println!("{}: {}", id.unwrap_or("no record".into()), keys.judge(&bytes));
        }
        _ => return Err("usage: sign_record sign KEY RECORD OUT | judge KEY SIGNED".into()),
    }
    Ok(())
}
