//! What the daemon's errors mean: try again, or give up and say why.

use bluer::{Error, ErrorKind, InternalErrorKind};
use vergence_tag::gatt;

use crate::job::Fault;

fn refused(what: &str) -> Fault {
    Fault::Refused(what.into())
}

/// An error of a conversation or of the daemon.
pub(super) fn fault(error: Error) -> Fault {
    match error.kind {
        ErrorKind::NotAuthorized | ErrorKind::NotPermitted => {
            refused("refuses this to robots that are not paired with it")
        }
        ErrorKind::NotSupported => refused("does not know this request"),
        ErrorKind::InvalidLength => refused("does not understand what it was sent"),
        ErrorKind::Internal(InternalErrorKind::DBusConnectionLost) => {
            Fault::Dead("the connection to the Bluetooth daemon is lost".into())
        }
        // No such program on the bus, or no bus.
        ErrorKind::Internal(InternalErrorKind::DBus(name)) if name.contains("ServiceUnknown") => {
            Fault::Dead("the Bluetooth daemon does not run".into())
        }
        ErrorKind::Failed => match attribute_error(&error.message) {
            // 0x0E, "unlikely": what wants a key makes BlueZ pair by itself, which our agent refuses.
            Some(0x05 | 0x08 | 0x0C | 0x0E | 0x0F) => {
                refused("refuses this to robots that are not paired with it")
            }
            Some(gatt::ERROR_MALFORMED) => refused("does not understand what it was sent"),
            Some(gatt::ERROR_IMPOSSIBLE) => refused("was asked for what it cannot do or hold"),
            Some(gatt::ERROR_STORAGE) => refused("could not store the record"),
            Some(code) => Fault::Refused(format!("refuses: attribute error {code:#04x}")),
            None => Fault::Lost,
        },
        ErrorKind::NotFound
        | ErrorKind::DoesNotExist
        | ErrorKind::ServicesUnresolved
        | ErrorKind::InProgress
        | ErrorKind::NotReady
        | ErrorKind::NotAvailable
        | ErrorKind::ConnectionAttemptFailed => Fault::Lost,
        _ => Fault::Refused(format!("Bluetooth daemon: {error}")),
    }
}

/// An error of connecting: nearly all are the radio's.
pub(super) fn of_connecting(error: Error) -> Fault {
    match fault(error) {
        dead @ Fault::Dead(_) => dead,
        _ => Fault::Lost,
    }
}

/// An error of pairing. Not tried again: the tag counts failed pairings and answers ever later.
pub(super) fn of_pairing(error: Error) -> Fault {
    match error.kind {
        // The link was not there yet or broke before a key was asked for.
        ErrorKind::ConnectionAttemptFailed | ErrorKind::NotFound | ErrorKind::InProgress => {
            Fault::Lost
        }
        _ => Fault::Refused(format!("pairing failed: {error}")),
    }
}

/// The code in "Operation failed with ATT error: 0x80 (...)".
fn attribute_error(message: &str) -> Option<u8> {
    let (_, rest) = message.split_once("ATT error: 0x")?;
    let digits = rest.find(|c: char| !c.is_ascii_hexdigit()).map_or(rest, |end| &rest[..end]);
    u8::from_str_radix(digits, 16).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(kind: ErrorKind, message: &str) -> Error {
        Error { kind, message: message.into() }
    }

    #[test]
    fn links_that_fail_are_tried_again_and_refusals_are_not() {
        let busy = error(ErrorKind::Failed, "Device or resource busy");
        assert_eq!(fault(busy), Fault::Lost);
        let aborted = error(ErrorKind::Failed, "le-connection-abort-by-local");
        assert_eq!(of_connecting(aborted), Fault::Lost);
        for message in ["Operation failed with ATT error: 0x0e", "ATT error: 0x05 (x)"] {
            let Fault::Refused(what) = fault(error(ErrorKind::Failed, message)) else {
                panic!("{message}")
            };
            assert!(what.contains("not paired"), "{what}");
        }
        let malformed = error(ErrorKind::Failed, "Operation failed with ATT error: 0x80");
        assert_eq!(fault(malformed), refused("does not understand what it was sent"));
        let wrong = of_pairing(error(ErrorKind::AuthenticationFailed, "Authentication Failed"));
        assert!(matches!(wrong, Fault::Refused(what) if what.starts_with("pairing failed")));
    }
}
