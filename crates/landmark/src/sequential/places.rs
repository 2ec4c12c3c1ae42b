//! The short list: places that may hold a light, and when each is worth another look.
//!
//! The picture is scanned now and then; the places on the list are what the decisions look at in
//! between, those near a decision at every frame. Evidence grows by so much a frame and no more: a
//! place far below its threshold is left alone until it could have come near.

use super::scan::Candidate;

/// Two pixels at most this far apart (px, along either axis) are one place.
const SAME: usize = 2;

/// What is known of one request at one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Watch {
    /// The request.
    pub request: usize,
    /// Its log likelihood ratio when it was last weighed, or an upper bound.
    pub level: f64,
    /// Frame count at which to weigh it again.
    pub due: usize,
    /// Frame count at which it first passed every test.
    pub stood: Option<usize>,
}

/// A place of the list.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// Column and row in the first frame.
    pub pixel: (usize, usize),
    /// The requests that may be there.
    pub watches: Vec<Watch>,
}

impl Place {
    fn is_near(&self, pixel: (usize, usize)) -> bool {
        self.pixel.0.abs_diff(pixel.0).max(self.pixel.1.abs_diff(pixel.1)) <= SAME
    }

    /// Adds watches of requests that have none yet.
    fn merge(&mut self, watches: impl IntoIterator<Item = Watch>) {
        for watch in watches {
            if !self.watches.iter().any(|w| w.request == watch.request) {
                self.watches.push(watch);
            }
        }
    }
}

/// A list of places, no two of them near each other.
#[derive(Debug, Clone, Default)]
pub struct Places {
    list: Vec<Place>,
}

impl Places {
    /// Whether any place is due at this frame count.
    pub fn any_due(&self, frames: usize) -> bool {
        self.list.iter().flat_map(|p| &p.watches).any(|w| w.due <= frames)
    }

    /// The places, to note what was found there.
    pub fn as_mut_slice(&mut self) -> &mut [Place] {
        &mut self.list
    }

    /// Adds requests at a pixel, to be weighed at once unless they are watched there already.
    pub fn add(&mut self, pixel: (usize, usize), requests: impl Iterator<Item = usize>) {
        self.merge(
            pixel,
            requests.map(|request| Watch { request, level: 0.0, due: 0, stood: None }),
        );
    }

    fn merge(&mut self, pixel: (usize, usize), watches: impl IntoIterator<Item = Watch>) {
        if let Some(place) = self.list.iter_mut().find(|p| p.is_near(pixel)) {
            place.merge(watches);
            return;
        }
        let mut place = Place { pixel, watches: Vec::new() };
        place.merge(watches);
        if !place.watches.is_empty() {
            self.list.push(place);
        }
    }

    /// Replaces the list by the candidates of a scan. What is known of a place near one is kept, and
    /// so is every place where some request reaches `keep`.
    pub fn renew(&mut self, candidates: Vec<Candidate>, keep: f64) {
        let old = std::mem::take(self);
        for Candidate { pixel, requests } in candidates {
            let known = old.list.iter().filter(|p| p.is_near(pixel)).flat_map(|p| &p.watches);
            self.merge(pixel, known.filter(|w| requests.contains(&w.request)).copied());
            self.add(pixel, requests.into_iter());
        }
        for place in old.list {
            let near = place.watches.into_iter().filter(|w| w.level >= keep);
            self.merge(place.pixel, near);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scan_keeps_what_is_known_and_what_is_near_a_decision() {
        let mut places = Places::default();
        places.add((10, 10), 0..2);
        places.add((11, 9), 2..3);
        places.add((30, 30), 0..1);
        places.add((50, 50), 0..1);
        assert_eq!(places.list.len(), 3, "a neighbour is the same place");
        places.as_mut_slice()[0].watches[1].level = 7.0;
        places.as_mut_slice()[1].watches[0].level = 12.0;
        places.renew(vec![Candidate { pixel: (10, 11), requests: vec![0, 1] }], 10.0);
        let pixels: Vec<_> = places.list.iter().map(|p| p.pixel).collect();
        assert_eq!(pixels, [(10, 11), (30, 30)], "weak places that are not seen again are dropped");
        let level = |r| places.list[0].watches.iter().find(|w| w.request == r).map(|w| w.level);
        assert_eq!((level(0), level(1), level(2)), (Some(0.0), Some(7.0), None));
    }
}
