//! Plays patterns on the lights: chip by chip at absolute times, so that delays never add up.

use core::cell::Cell;

use embassy_futures::select::{Either, select};
use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::signal::Signal;
use embassy_time::{Duration, Instant, Timer};
use vergence_tag::{Command, Pattern};

use crate::board::{Lights, Play};

/// The way to the player: commands in, state out.
#[derive(Default)]
pub struct Remote {
    command: Signal<NoopRawMutex, Command>,
    playing: Cell<bool>,
    changed: Signal<NoopRawMutex, ()>,
}

impl Remote {
    /// Takes effect at once, in place of what was before.
    pub fn send(&self, command: Command) {
        self.playing.set(matches!(command, Command::Play { .. }));
        self.command.signal(command);
    }

    /// A play is under way.
    pub fn playing(&self) -> bool {
        self.playing.get()
    }

    /// Forgets a play that was cut off together with its player.
    pub fn reset(&self) {
        self.playing.set(false);
        self.command.reset();
        self.changed.reset();
    }

    /// Waits until a play has ended by itself.
    pub async fn ended(&self) {
        self.changed.wait().await;
    }
}

/// Obeys the remote for ever. `longest` bounds plays that name no limit and those that name more.
pub async fn play<L: Lights>(lights: &mut L, remote: &Remote, longest: Duration) -> ! {
    let mut next = remote.command.wait().await;
    loop {
        let Command::Play { pattern, limit } = next else {
            next = remote.command.wait().await;
            continue;
        };
        let begin = Instant::now();
        let limit = limit.map_or(longest, |l| Duration::from_secs(l.as_secs()).min(longest));
        let end = begin + whole(&pattern).map_or(limit, |whole| whole.min(limit));
        let play = Play { pattern, begin, end };
        lights.playing(Some(&play));
        let outcome = select(remote.command.wait(), show(lights, &play)).await;
        lights.set(pattern.landmark, 0);
        lights.playing(None);
        next = match outcome {
            Either::First(command) => command,
            Either::Second(()) => {
                remote.playing.set(false);
                remote.changed.signal(());
                remote.command.wait().await
            }
        };
    }
}

/// Time of all repeats.
fn whole(pattern: &Pattern) -> Option<Duration> {
    let period = pattern.period().as_micros() as u64;
    pattern.repeats.map(|repeats| Duration::from_micros(period.saturating_mul(repeats.into())))
}

/// Switches at every change between neighbouring chips, until the play's end.
async fn show<L: Lights>(lights: &mut L, play: &Play) {
    let pattern = &play.pattern;
    let chip = Duration::from_micros(pattern.chip.as_micros() as u64);
    let mut index = 0i64;
    let mut at = play.begin;
    while at < play.end {
        let on = pattern.bits.chip(index);
        lights.set(pattern.landmark, if on { pattern.brightness } else { 0 });
        // A pattern holds both, so that a change comes within one pass.
        while pattern.bits.chip(index) == on {
            index += 1;
            at += chip;
        }
        Timer::at(at.min(play.end)).await;
    }
}
