//! The pairing agent: what BlueZ asks when a tag is paired.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bluer::agent::{Agent, ReqError};
use vergence_devices::TagAddress;

/// The passkey of the tag that is being paired. Everybody else who wants one is refused.
#[derive(Clone, Default)]
pub(super) struct Passkeys(Arc<Mutex<Option<Entry>>>);

#[derive(Clone, Copy)]
struct Entry {
    tag: TagAddress,
    passkey: u32,
    asked: bool,
}

/// Takes the passkey back.
pub(super) struct Permit<'a>(&'a Passkeys);

impl Drop for Permit<'_> {
    fn drop(&mut self) {
        *self.0.lock() = None;
    }
}

impl Permit<'_> {
    /// BlueZ asked for the passkey. It tells nobody how a pairing was made, but its kernel asks in
    /// passkey entry only, and a pairing that began so succeeds by that passkey or not at all.
    pub fn was_used(&self) -> bool {
        self.0.lock().is_some_and(|entry| entry.asked)
    }
}

impl Passkeys {
    /// Has the agent answer for this tag as long as the permit lives.
    pub fn permit(&self, tag: TagAddress, passkey: Option<u32>) -> Permit<'_> {
        *self.lock() = passkey.map(|passkey| Entry { tag, passkey, asked: false });
        Permit(self)
    }

    fn lock(&self) -> MutexGuard<'_, Option<Entry>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn of(&self, tag: TagAddress) -> Result<u32, ReqError> {
        match self.lock().as_mut().filter(|entry| entry.tag == tag) {
            Some(entry) => {
                entry.asked = true;
                Ok(entry.passkey)
            }
            None => Err(ReqError::Rejected),
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
        assert_eq!(passkeys.of(other), Err(ReqError::Rejected));
        assert!(!permit.was_used(), "another's question proves nothing");
        assert_eq!(passkeys.of(tag), Ok(123_456));
        assert!(permit.was_used());
        drop(permit);
        assert_eq!(passkeys.of(tag), Err(ReqError::Rejected));
        let _just_works = passkeys.permit(tag, None);
        assert_eq!(passkeys.of(tag), Err(ReqError::Rejected));
    }
}
