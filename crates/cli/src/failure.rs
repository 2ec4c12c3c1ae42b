//! Errors as people read them: what happened, and what to do about it.

use std::fmt;

use vergence_tag::Shown;

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
        Failure { message: shown(message), hint: hint.to_string(), status: 2 }
    }

    /// The thing asked for was not achieved: exit status 1.
    pub fn failed(message: impl fmt::Display, hint: impl fmt::Display) -> Self {
        Failure { message: shown(message), hint: hint.to_string(), status: 1 }
    }
}

/// What happened, with nothing in it that a terminal would obey but the ends of lines: parsers quote files
/// that anybody may have written.
fn shown(message: impl fmt::Display) -> String {
    let message = message.to_string();
    let lines: Vec<String> = message.lines().map(|line| Shown(line).to_string()).collect();
    lines.join("\n")
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "error: {}\n  what to do: {}", self.message, self.hint)
    }
}

impl std::error::Error for Failure {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_file_holds_does_not_steer_the_terminal() {
        let text = "kind = \"\u{1b}[2Jbox\"\n       ^ unknown";
        let told = "kind = \"\\u{1b}[2Jbox\"\n       ^ unknown";
        for failure in [Failure::misuse(text, "hint"), Failure::failed(text, "hint")] {
            assert_eq!(failure.message, told);
        }
    }
}
