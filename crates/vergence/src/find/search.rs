//! Step 2 of the paper: both heads sweep until both have seen the light.

use vergence_devices::{JointReading, Side};
use vergence_head::{Field, Search, SearchConfig};
use vergence_landmark::Sighting;
use vergence_tag::Pattern;

use super::{Missing, Run, Stop};

/// A light is so many times brighter than what a table shows of it; a mirror shows nearly all.
const MUCH_BRIGHTER: f64 = 3.0;

/// Where one head saw the light, at which angles.
#[derive(Debug, Clone)]
pub(crate) struct Seen {
    /// The head's angles.
    pub(crate) joints: JointReading,
    /// All places, brightest first; a mirror shows the light a second time.
    pub(crate) sightings: Vec<Sighting>,
}

impl Run<'_> {
    /// Turns the heads from view to view until both have the light in their picture.
    pub(super) fn search(&mut self, pattern: &Pattern) -> Result<[Seen; 2], Stop> {
        let heads = self.system.heads.clone();
        let field = Field::reachable(&heads);
        let mut search = Search::new(&heads, &field, None, &SearchConfig::default());
        let mut seen: [Option<Seen>; 2] = [None, None];
        let mut watched: [Option<[f64; 2]>; 2] = [None, None];
        let (mut views, mut again) = (0, false);
        loop {
            let current = self.system.joints()?.map(|j| [j.pan, j.tilt]);
            let Some(targets) = search.next(current) else { break };
            let joints = self.system.turn(targets.map(Some))?;
            // A head that has the light, or nothing new in view, waits for the other.
            let due: [bool; 2] =
                std::array::from_fn(|k| seen[k].is_none() && watched[k] != Some(targets[k]));
            let readings = std::array::from_fn(|k| due[k].then_some(joints[k]));
            let sightings = self.watch(pattern, readings)?;
            for (k, sightings) in sightings.into_iter().enumerate().filter(|(k, _)| due[*k]) {
                watched[k] = Some(targets[k]);
                views += 1;
                let Some(brightest) = sightings.first().map(|s| s.pixel) else { continue };
                let new = Seen { joints: joints[k], sightings };
                match seen[1 - k].as_ref().and_then(|other| self.reflection(k, &new, other)) {
                    // The view shows the reflection only.
                    Some(side) if side == k => continue,
                    // Once: of two lights alike, neither can convict the other for ever.
                    Some(_) if !again => {
                        again = true;
                        seen[1 - k] = None;
                        search = Search::new(&heads, &field, None, &SearchConfig::default());
                    }
                    _ => {}
                }
                search.sighted(k, [joints[k].pan, joints[k].tilt], &brightest);
                seen[k] = Some(new);
            }
            if let [Some(left), Some(right)] = &seen {
                return Ok([left.clone(), right.clone()]);
            }
        }
        let missing = match seen {
            [None, None] => Missing::Either,
            [None, _] => Missing::One(Side::Left),
            _ => Missing::One(Side::Right),
        };
        Err(Stop::NotSeen { views, missing })
    }

    /// Which head saw nothing but a reflection: what the heads saw of one and the same place, by head `k`
    /// and by the other, is far from the brightest that one of them saw.
    fn reflection(&self, k: usize, new: &Seen, other: &Seen) -> Option<usize> {
        let seen = if k == 0 { [new, other] } else { [other, new] };
        let common = self.same_light(seen);
        let brighter = |side: &usize| {
            let brightest = seen[*side].sightings.first();
            brightest.map_or(0.0, |s| s.amplitude) > MUCH_BRIGHTER * common[*side].1.amplitude
        };
        (0..2).find(brighter).map(|side| 1 - side)
    }
}
