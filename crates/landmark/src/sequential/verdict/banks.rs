//! The expected light of every request.

use super::super::template::{Bank, rates};
use super::Round;
use crate::Request;

/// Banks of the requests, built when first needed and kept from frame to frame.
#[derive(Debug, Clone)]
pub struct Banks {
    own: Vec<Option<Bank>>,
}

impl Banks {
    /// No bank yet, for so many requests.
    pub fn new(requests: usize) -> Self {
        Banks { own: vec![None; requests] }
    }

    /// The bank of a request at the clock rates it may have.
    pub(super) fn own(&mut self, round: &Round, request: usize) -> &Bank {
        let Request { pattern, clock_tolerance, .. } = &round.requests[request];
        let times = round.history.times();
        let rates = rates(pattern, *clock_tolerance, round.history.span());
        let slot = &mut self.own[request];
        if slot.as_ref().is_some_and(|bank| !bank.has_rates(rates.len())) {
            *slot = None;
        }
        let window = round.history.capacity();
        let bank = slot.get_or_insert_with(|| Bank::new(pattern, &rates, times, window));
        bank.fit(times, round.history.numbers(), round.nuisance);
        bank
    }
}
