//! What the heads see of the object once the arm is at work.

use nalgebra::{Matrix3, Point3, Vector3};
use vergence_devices::{LedCommand, Side, TagAddress};
use vergence_geometry::{GaussianPoint, JointAngles};
use vergence_head::{Fixation, Noise, triangulate};
use vergence_landmark::Sighting;
use vergence_tag::Pattern;

use crate::find::reaim::settle;
use crate::find::search::Seen;
use crate::find::{Found, Missing, Run, Stop, names};
use crate::system::HandLight;

/// How far from where it was found the landmark may be seen at the second look (m).
const SECOND_REACH: f64 = 0.06;
/// What two lights in one picture do not have in common (rad, one sigma): a tenth of a pixel of a wide lens.
const UNLIKE: f64 = 3e-4;
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

    /// The gripper's light beside the object's: both are seen from one stand of the heads, so that what the
    /// joint angles get wrong moves both alike.
    pub(super) fn hand_beside(
        &mut self,
        light: &HandLight,
        joints: &JointAngles,
        found: &Found,
    ) -> Result<HandSight, Stop> {
        let tag = self.heard.iter().find(|tag| tag.may_be(&light.object_id)).cloned();
        let tag = tag.ok_or_else(|| Stop::OutOfRange {
            object: light.object_id.clone(),
            heard: names(&self.heard),
        })?;
        let record = self.record(&tag, &light.object_id)?;
        let base_from_tag = light.chain.forward(joints);
        let object = found.landmark.position;
        // The light that shines most towards the heads.
        let eyes = self.system.heads.each_ref().map(|head| head.base_from_optical([0.0; 2]));
        let eyes = 0.5 * (eyes[0].translation.vector + eyes[1].translation.vector);
        let to_heads = (eyes - base_from_tag.translation.vector).normalize();
        let shines =
            |normal: [f64; 3]| (base_from_tag.rotation * Vector3::from(normal)).dot(&to_heads);
        let sites = (0u8..).zip(&record.landmarks);
        let best = sites.max_by(|a, b| shines(a.1.normal).total_cmp(&shines(b.1.normal)));
        let (index, site) = best.ok_or(Stop::Lost("hand"))?;
        let by_joints = base_from_tag * Point3::from(site.position);
        let between = nalgebra::center(&object, &by_joints);
        let stand = [0, 1].map(|k| self.system.heads[k].look_at(&between));
        self.system.turn(stand)?;
        let objects = self.lit(found.tag, 0, |run, pattern| run.watch_here(pattern, &object))?;
        let hands =
            self.lit(tag.address, index, |run, pattern| run.watch_here(pattern, &by_joints))?;
        let noise = self.noise_from_below();
        let most = 6.0 * noise.step_sigma.hypot(noise.common_sigma);
        let joints = self.system.joints()?;
        let both = |k: usize| {
            let missing = || Stop::NotSeen { views: 2, missing: Missing::One(Side::BOTH[k]) };
            let fixation = |angles, seen: &Sighting| Fixation {
                angles,
                pixel: seen.pixel,
                pixel_covariance: seen.covariance,
            };
            let own = objects[k].as_ref().ok_or_else(missing)?;
            let hand = hands[k].as_ref().ok_or_else(missing)?;
            let told = fixation(self.camera_angles(k, &joints[k]), own);
            let angles = settle(&self.system.heads[k], &told, &object, most);
            let angles = angles.ok_or(Stop::Lost(Side::BOTH[k].name()))?;
            Ok::<_, Stop>([fixation(angles, own), fixation(angles, hand)])
        };
        let (left, right) = (both(0)?, both(1)?);
        let alike = Noise { step_sigma: 0.0, common_sigma: UNLIKE };
        let place = |which: usize| {
            triangulate(&self.system.heads, &[left[which], right[which]], &alike).map(|l| l.point)
        };
        let (own, hand) = (place(0)?, place(1)?);
        let difference = own.covariance + hand.covariance;
        Ok(HandSight { by_joints, seen: hand.position, difference })
    }

    /// What either head sees of a light (base) from where it stands.
    fn watch_here(
        &mut self,
        pattern: &Pattern,
        near: &Point3<f64>,
    ) -> Result<[Option<Sighting>; 2], Stop> {
        let joints = self.system.joints()?;
        let [left, right] = self.watch(pattern, joints.map(Some))?;
        let seen = [(0, left), (1, right)].map(|(k, sightings)| {
            let seen = Seen { joints: joints[k], sightings };
            self.within(k, seen, near, SECOND_REACH).sightings.into_iter().next()
        });
        Ok(seen)
    }

    /// Looks for the landmark where it should be (base): its place, or at least that one head sees it
    /// in that direction.
    pub(super) fn sight(&mut self, tag: TagAddress, expected: &Point3<f64>) -> Result<Sight, Stop> {
        self.lit(tag, 0, |run, pattern| {
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
        self.lit(tag, 0, |run, pattern| {
            let seen = run.watch_near(pattern, near, SECOND_REACH)?;
            run.locate_seen(tag, pattern, seen)
        })
    }

    /// Does something while one of the tag's lights blinks. The report keeps where the landmark was found at first.
    fn lit<T>(
        &mut self,
        tag: TagAddress,
        landmark: u8,
        work: impl FnOnce(&mut Self, &Pattern) -> Result<T, Stop>,
    ) -> Result<T, Stop> {
        let first = self.landmark.clone();
        let pattern = self.start_blinking(tag, landmark)?;
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

/// The gripper's light as the heads see it beside the object.
pub(super) struct HandSight {
    /// Where the arm's joints put it (base).
    pub(super) by_joints: Point3<f64>,
    /// Where the heads see it (base).
    pub(super) seen: Point3<f64>,
    /// Covariance of that against the object's landmark (m^2).
    pub(super) difference: Matrix3<f64>,
}
