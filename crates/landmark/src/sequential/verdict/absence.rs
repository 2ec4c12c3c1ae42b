//! Whether a tag that is not seen is not there.

use super::super::template::transitions;
use super::{Round, TRANSITIONS};
use crate::Decision;

impl Round<'_> {
    /// Says "absent" of what would have been found by now; to be asked after a scan.
    pub(in super::super) fn rule_out(&self, decisions: &mut [Decision]) {
        for (request, decision) in decisions.iter_mut().enumerate() {
            if *decision == Decision::Undecided && self.would_have_seen(request) {
                *decision = Decision::Absent;
            }
        }
    }

    /// Whether a tag of the least contrast would have been found by now.
    fn would_have_seen(&self, request: usize) -> bool {
        let pattern = &self.requests[request].pattern;
        let duty = f64::from(pattern.bits.weight()) / pattern.bits.len() as f64;
        let light = self.history.len() as f64 * duty * (1.0 - duty);
        let evidence = self.config.least_contrast.powi(2) * light / (2.0 * self.noise.median());
        let changes = transitions(pattern, self.history.times());
        evidence > 2.0 * self.presence() + 10.0 && changes > 2.0 * TRANSITIONS
    }
}
