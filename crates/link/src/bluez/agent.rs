//! The pairing agent: what BlueZ asks when a tag is paired.

use std::sync::{Arc, Mutex, PoisonError};

use bluer::agent::{Agent, ReqError};
use vergence_devices::TagAddress;

/// The passkey of the tag that is being paired. Everybody else who wants one is refused.
#[derive(Clone, Default)]
pub(super) struct Passkeys(Arc<Mutex<Option<(TagAddress, u32)>>>);

/// Takes the passkey back.
pub(super) struct Permit<'a>(&'a Passkeys);

impl Drop for Permit<'_> {
    fn drop(&mut self) {
        self.0.set(None);
    }
}

impl Passkeys {
    /// Has the agent answer for this tag as long as the permit lives.
    pub fn permit(&self, tag: TagAddress, passkey: Option<u32>) -> Permit<'_> {
        self.set(passkey.map(|passkey| (tag, passkey)));
        Permit(self)
    }

    fn set(&self, passkey: Option<(TagAddress, u32)>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = passkey;
    }

    fn of(&self, tag: TagAddress) -> Result<u32, ReqError> {
        match *self.0.lock().unwrap_or_else(PoisonError::into_inner) {
            Some((wanted, passkey)) if wanted == tag => Ok(passkey),
            _ => Err(ReqError::Rejected),
        }
    }

    /// An agent with a keyboard only: tags with a passkey are paired by it, others by Just Works.
    pub fn agent(&self) -> Agent {
        let passkeys = self.clone();
        Agent {
            request_default: false,
            request_passkey: Some(Box::new(move |request| {
                let answer = passkeys.of(TagAddress(request.device.0));
                Box::pin(async move { answer })
            })),
            ..Agent::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_tag_that_is_being_paired_gets_its_passkey() {
        let (tag, other) = (TagAddress([1; 6]), TagAddress([2; 6]));
        let passkeys = Passkeys::default();
        assert_eq!(passkeys.of(tag), Err(ReqError::Rejected));
        let permit = passkeys.permit(tag, Some(123_456));
        assert_eq!((passkeys.of(tag), passkeys.of(other)), (Ok(123_456), Err(ReqError::Rejected)));
        drop(permit);
        assert_eq!(passkeys.of(tag), Err(ReqError::Rejected));
        let _just_works = passkeys.permit(tag, None);
        assert_eq!(passkeys.of(tag), Err(ReqError::Rejected));
    }
}
