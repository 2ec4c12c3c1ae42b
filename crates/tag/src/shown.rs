//! Text from the air as it may be shown to people.
//!
//! In: a name that anybody may have sent. Out: the same with everything escaped that a terminal would
//! obey instead of showing it. [`Record::validate`](crate::Record::validate) refuses records with such
//! text, but what a tag advertises and tells of itself has no such check before it is shown.

use core::fmt::{self, Write};

/// Shows a text with control characters, and those that change the direction of writing, escaped.
#[derive(Debug, Clone, Copy)]
pub struct Shown<'a>(pub &'a str);

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for c in self.0.chars() {
            match is_obeyed(c) {
                true => write!(f, "{}", c.escape_default())?,
                false => f.write_char(c)?,
            }
        }
        Ok(())
    }
}

/// Control characters, and the marks that overturn the order of the letters around them (Unicode
/// Standard Annex 9, explicit directional formatting).
pub(crate) fn is_obeyed(c: char) -> bool {
    let turns = matches!(c, '\u{61C}' | '\u{200E}' | '\u{200F}' | '\u{202A}'..='\u{202E}' | '\u{2066}'..='\u{2069}');
    turns || matches!(c, '\u{2028}' | '\u{2029}') || c.is_control()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_terminal_has_nothing_to_obey() {
        let shown = |text: &str| Shown(text).to_string();
        assert_eq!(shown("Tasse, чашка, 茶碗 \\ \"1\""), "Tasse, чашка, 茶碗 \\ \"1\"");
        assert_eq!(shown("cup\x1b[2J\n\u{9b}"), "cup\\u{1b}[2J\\n\\u{9b}");
        assert_eq!(shown("cup\u{202e}"), "cup\\u{202e}");
    }
}
