//! Errors as people read them: what happened, and what to do about it.

use std::fmt;

/// A command that could not do its work.
#[derive(Debug)]
pub struct Failure {
    /// What happened.
    pub message: String,
    /// What to do.
    pub hint: String,
    /// Exit status: 1 not achieved, 2 misuse.
    pub status: u8,
}

impl Failure {
    /// The user asked for something that cannot be: exit status 2.
    pub fn misuse(message: impl fmt::Display, hint: impl fmt::Display) -> Self {
        Failure { message: message.to_string(), hint: hint.to_string(), status: 2 }
    }

    /// The thing asked for was not achieved: exit status 1.
    pub fn failed(message: impl fmt::Display, hint: impl fmt::Display) -> Self {
        Failure { message: message.to_string(), hint: hint.to_string(), status: 1 }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "error: {}\n  what to do: {}", self.message, self.hint)
    }
}

impl std::error::Error for Failure {}
