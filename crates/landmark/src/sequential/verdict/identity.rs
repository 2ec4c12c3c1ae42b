//! Whether another requested pattern explains what is seen.
//!
//! The request must lead every other by `ln(others / alpha)`; both are weighed with the same noise, and
//! at their best phase between those of the bank as well.

use super::super::evidence::{Series, refined_gain, weigh};
use super::banks::Banks;
use super::{Round, Seen};

/// Log likelihood ratio by which each of so many other explanations must be beaten.
pub fn margin(others: usize, wrong_identity: f64) -> f64 {
    (others.max(1) as f64 / wrong_identity).ln()
}

impl Round<'_> {
    /// Whether a request leads every other at a place.
    pub(super) fn leads_requests(&self, request: usize, seen: &Seen, banks: &mut Banks) -> bool {
        let series = &seen.series.settled(seen.evidence.correlation.powi(2));
        let Some(own) = self.level(request, series, banks) else { return false };
        let others = self.requests.len() - 1;
        let limit = own - margin(others, self.config.wrong_identity);
        let mut rivals = (0..self.requests.len()).filter(|other| *other != request);
        rivals.all(|other| self.level(other, series, banks).is_none_or(|rival| rival <= limit))
    }

    /// Log likelihood ratio of a request. A strong light tells phases apart that the bank does not have:
    /// the best is sought between them.
    fn level(&self, request: usize, series: &Series, banks: &mut Banks) -> Option<f64> {
        let bank = banks.own(self, request);
        let found = weigh(series, bank, 0.0, &mut Vec::new())?;
        let (pattern, times) = (&self.requests[request].pattern, self.history.times());
        let gain = refined_gain(series, pattern, times, self.nuisance, found, bank.step);
        Some(found.log_ratio + gain)
    }
}
