//! What the heads see of the object once the arm is at work.

use nalgebra::Point3;
use vergence_devices::{LedCommand, Side, TagAddress};
use vergence_geometry::GaussianPoint;
use vergence_tag::Pattern;

use crate::find::{Found, Run, Stop};

/// How far from where it was found the landmark may be seen at the second look (m).
const SECOND_REACH: f64 = 0.06;
/// How far from where the hand must have carried it the landmark is looked for (m): where it was before
/// the lift, too.
const LIFT_REACH: f64 = 0.15;
/// How far from there one head alone may see it (m): what may slip in the fingers.
const LIFT_PLACE: f64 = 0.02;

/// The LED is told to stop whatever came of the look.
impl Run<'_> {
    /// Measures the landmark and recognises the object once more, starting from where it was.
    pub(super) fn again(&mut self, found: &Found) -> Result<Found, Stop> {
        let (landmark, angles) = self.relocate(found.tag, &found.landmark.position)?;
        let frames = self.look()?;
        let object = self.recognise(&found.record, landmark, &frames, angles)?;
        Ok(Found { object, landmark, ..found.clone() })
    }

    /// Looks for the landmark where it should be (base): its place, or at least that one head sees it
    /// in that direction.
    pub(super) fn sight(&mut self, tag: TagAddress, expected: &Point3<f64>) -> Result<Sight, Stop> {
        self.lit(tag, |run, pattern| {
            let seen = run.watch_near(pattern, expected, LIFT_REACH)?;
            let there = [0, 1].map(|k| {
                !run.within(k, seen[k].clone(), expected, LIFT_PLACE).sightings.is_empty()
            });
            match (run.locate_seen(tag, pattern, seen), there) {
                (Ok((after, _)), _) => Ok(Sight::Place(after)),
                (Err(Stop::Device(error)), _) => Err(error.into()),
                (Err(_), [true, _]) => Ok(Sight::Direction(Side::Left)),
                (Err(_), [_, true]) => Ok(Sight::Direction(Side::Right)),
                (Err(stop), _) => Err(stop),
            }
        })
    }

    fn relocate(
        &mut self,
        tag: TagAddress,
        near: &Point3<f64>,
    ) -> Result<(GaussianPoint, [[f64; 2]; 2]), Stop> {
        self.lit(tag, |run, pattern| {
            let seen = run.watch_near(pattern, near, SECOND_REACH)?;
            run.locate_seen(tag, pattern, seen)
        })
    }

    /// Does something while the tag blinks. The report keeps where the landmark was found at first.
    fn lit<T>(
        &mut self,
        tag: TagAddress,
        work: impl FnOnce(&mut Self, &Pattern) -> Result<T, Stop>,
    ) -> Result<T, Stop> {
        let first = self.landmark.clone();
        let pattern = self.start_blinking(tag)?;
        let outcome = work(self, &pattern);
        let stopped = self.command(tag, LedCommand::Stop);
        self.landmark = first;
        let outcome = outcome?;
        stopped?;
        Ok(outcome)
    }
}

/// What a look for the lifted landmark gives.
pub(super) enum Sight {
    /// Where it is: both heads saw it.
    Place(GaussianPoint),
    /// This head alone saw it where it should be.
    Direction(Side),
}
