//! Whether another requested pattern explains what is seen.
//!
//! The request must lead every other by `ln(others / alpha)`; both are weighed with the same noise, and
//! the other at its best phase between those of the bank as well.

use super::super::evidence::{refined_gain, weigh};
use super::banks::Banks;
use super::{Round, Seen};

/// Log likelihood ratio by which each of so many other explanations must be beaten.
pub fn margin(others: usize, wrong_identity: f64) -> f64 {
    (others.max(1) as f64 / wrong_identity).ln()
}

impl Round<'_> {
    /// Whether a request leads every other at a place.
    pub(super) fn leads_requests(&self, request: usize, seen: &Seen, banks: &mut Banks) -> bool {
        let own = seen.evidence;
        let series = &seen.series.settled(own.correlation.powi(2));
        let mut scratch = Vec::new();
        let others = self.requests.len() - 1;
        for other in (0..self.requests.len()).filter(|o| *o != request) {
            let limit = own.log_ratio - margin(others, self.config.wrong_identity);
            let bank = banks.own(self, other);
            let Some(rival) = weigh(series, bank, 0.0, &mut scratch) else { continue };
            // A strong light tells phases apart that the bank does not have.
            let pattern = &self.requests[other].pattern;
            let times = self.history.times();
            let gain = refined_gain(series, pattern, times, self.nuisance, rival, bank.step);
            if rival.log_ratio + gain > limit {
                return false;
            }
        }
        true
    }
}
