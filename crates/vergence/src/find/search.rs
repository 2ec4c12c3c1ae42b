//! Step 2 of the paper: both heads sweep until both have seen the light.

use vergence_devices::{JointReading, Side};
use vergence_head::{Field, Search, SearchConfig};
use vergence_landmark::Sighting;
use vergence_tag::Pattern;

use super::{Missing, Run, Stop};

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
        let mut views = 0;
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
                if let Some(brightest) = sightings.first() {
                    search.sighted(k, [joints[k].pan, joints[k].tilt], &brightest.pixel);
                    seen[k] = Some(Seen { joints: joints[k], sightings });
                }
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
}
