//! What the owner of a tag chooses.

use embassy_time::Duration;

/// Who may use a characteristic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Everybody.
    Open,
    /// Robots that paired, without proof of who they are ("Just Works").
    Encrypted,
    /// Robots that paired with the passkey.
    Authenticated,
}

/// A tag's settings.
#[derive(Debug, Clone, PartialEq)]
pub struct Config<'a> {
    /// Static random address, least significant byte first; the two top bits of the last are set.
    pub address: [u8; 6],
    /// Model number string of the Device Information service.
    pub model: &'a str,
    /// Passkey (six digits) that is printed on the tag; `None`: pairing proves nothing.
    pub passkey: Option<u32>,
    /// Who may read the record. Open: a robot finds what it never met.
    pub record_access: Access,
    /// Who may write it.
    pub write_access: Access,
    /// Who may command the LED.
    pub command_access: Access,
    /// Longest play of the LED: bounds the light of a robot that forgot the tag, and the charge
    /// that anybody can draw.
    pub longest_play: Duration,
    /// Advertising interval after start and after a link.
    pub fast_interval: Duration,
    /// How long it stays fast: a robot that lost its link comes back at once.
    pub fast_time: Duration,
    /// Advertising interval when nothing happens: decides the battery's life.
    pub slow_interval: Duration,
    /// A link on which nothing is asked for this long, and nothing plays, is ended, so that nobody
    /// blocks the tag by holding it.
    pub idle_link: Duration,
}

impl Default for Config<'_> {
    fn default() -> Self {
        Config {
            address: [0, 0, 0, 0, 0, 0xC0],
            model: "tag",
            passkey: None,
            record_access: Access::Open,
            write_access: Access::Authenticated,
            command_access: Access::Open,
            longest_play: Duration::from_secs(120),
            fast_interval: Duration::from_millis(100),
            fast_time: Duration::from_secs(30),
            slow_interval: Duration::from_millis(1000),
            idle_link: Duration::from_secs(30),
        }
    }
}
