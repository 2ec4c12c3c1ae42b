//! Progress on a terminal: one line on standard error that says which step runs; nothing when
//! standard error is not a terminal.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};
use vergence::{Event, Observer};
use vergence_devices::LedCommand;

/// Shows the steps of a run.
pub struct Progress {
    bar: ProgressBar,
}

impl Progress {
    /// A line for an open number of steps.
    pub fn steps() -> Self {
        let bar = ProgressBar::new_spinner();
        bar.enable_steady_tick(Duration::from_millis(100));
        Progress { bar }
    }

    /// A bar for a known number of runs.
    pub fn runs(count: usize) -> Self {
        let bar = ProgressBar::new(count as u64);
        if let Ok(style) = ProgressStyle::with_template("{bar:30} {pos}/{len} {msg} ({eta} left)") {
            bar.set_style(style);
        }
        Progress { bar }
    }

    /// One of the runs is done.
    pub fn advance(&self, message: impl Into<String>) {
        self.bar.set_message(message.into());
        self.bar.inc(1);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

impl Observer for Progress {
    fn notice(&mut self, event: &Event<'_>) {
        let message = match event {
            Event::Begun(step) => (*step).to_string(),
            Event::Heard(tags) => format!("{} tags answer", tags.len()),
            Event::Led(LedCommand::Play(pattern)) => format!("the tag blinks {}", pattern.bits),
            Event::Watched(side, _, []) => {
                format!("search: not in this view of the {} head", side.name())
            }
            Event::Watched(side, _, _) => format!("search: seen by the {} head", side.name()),
            _ => return,
        };
        self.bar.set_message(message);
    }
}
