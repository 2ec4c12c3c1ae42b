//! What the recognisers are given and what they give back.

use nalgebra::{DMatrix, Matrix3, Point3, Unit, UnitQuaternion, Vector3};
use vergence_geometry::gaussian::difference;
use vergence_geometry::{Camera, CameraError, GaussianPoint, GaussianPose, Symmetry, Transform};
use vergence_imaging::Image;
use vergence_tag::{Record, Shape};

use crate::model::Model;

/// A picture, the camera that took it and where that camera was.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// Grey picture.
    pub image: &'a Image<u8>,
    /// Intrinsic parameters; its size must be the picture's.
    pub camera: Camera,
    /// Pose of the camera's optical frame in the base frame.
    pub base_from_optical: Transform,
    /// Standard deviation of a small turn of the camera about its own x and y axes (rad): how well
    /// the head's angles are known. Zero when exactly. When it is not zero, the landmark is taken
    /// to have been triangulated from these views (and others, when it is better known than they
    /// could tell), so that a part of its error is theirs; with one view it is its own.
    pub turn_sd: f64,
}

impl View<'_> {
    /// The camera's centre in the base frame.
    pub fn eye(&self) -> Point3<f64> {
        self.base_from_optical.translation.vector.into()
    }
}

/// What is looked for and what is known of it.
#[derive(Debug, Clone, Copy)]
pub struct Query<'a> {
    /// The tag's record.
    pub record: &'a Record,
    /// The blinking landmark in the base frame (m), with its covariance.
    pub landmark: GaussianPoint,
    /// Which of the record's landmarks it is.
    pub landmark_index: usize,
    /// Direction against gravity in the base frame, when known: standing poses are tried first. When it is
    /// not, the first view's picture is taken to be upright, roughly.
    pub up: Option<Unit<Vector3<f64>>>,
    /// Whether the object is known to stand upright (its z axis along `up`) or known not to;
    /// `None` when nobody knows: then upright is likelier than upside down.
    pub standing: Option<bool>,
}

/// Motions that move the landmark by less than this (m) cannot be told apart by anybody: it is
/// four standard deviations of a good triangulation.
const SYMMETRY_SLACK: f64 = 0.004;
/// A body of 48 corners comes home after so many turns of one kind.
const MOST_POWERS: usize = 48;
/// A body counts as symmetric when its corners come this near (m) to where others were.
const CORNER_TOLERANCE: f64 = 0.0004;

impl Query<'_> {
    /// The landmark's position in the object frame (m) and its outward normal.
    pub fn landmark_in_object(&self) -> Option<(Vector3<f64>, Vector3<f64>)> {
        let site = self.record.landmarks.get(self.landmark_index)?;
        Some((site.position.into(), Vector3::from(site.normal).try_normalize(1e-6)?))
    }

    /// The motions of the object that neither its form nor its landmark can tell apart.
    pub fn symmetry(&self) -> Symmetry {
        self.symmetry_of(&Model::new(self.record))
    }

    /// [`Query::symmetry`] with the record's model.
    pub(crate) fn symmetry_of(&self, model: &Model) -> Symmetry {
        let Some((landmark, _)) = self.landmark_in_object() else { return Symmetry::none() };
        let stays = |s: &Transform| {
            (s.transform_point(&landmark.into()).coords - landmark).norm() < SYMMETRY_SLACK
        };
        // With all its powers: what is kept is to be a group.
        let keep = |s: &Transform| {
            let powers = std::iter::successors(Some(*s), |p| Some(p * s));
            powers.take(MOST_POWERS).take_while(|p| p.rotation.angle() > 0.01).all(|p| stays(&p))
        };
        match &self.record.shape {
            Shape::Cylinder { .. } => {
                Symmetry::Revolution { flip: 2.0 * landmark.z.abs() < SYMMETRY_SLACK }
            }
            Shape::Cup { .. } => Symmetry::Revolution { flip: false },
            Shape::Sphere { .. } => Symmetry::Full,
            Shape::Box | Shape::Prism { .. } | Shape::Convex { .. } => {
                let motions = model.symmetries(CORNER_TOLERANCE);
                Symmetry::Finite(motions.into_iter().filter(keep).collect())
            }
        }
    }
}

/// Corners that come nearer than this share of the widest side to where others were look alike from
/// edges of real objects.
const NEAR_SHARE: f64 = 0.02;

impl Query<'_> {
    /// Motions that change the object's outline by no more than objects deviate from their records.
    pub(crate) fn near_symmetries(&self, model: &Model) -> Vec<Transform> {
        match &self.record.shape {
            Shape::Box | Shape::Prism { .. } | Shape::Convex { .. } => {
                let sides = self.record.bounding_box.sides();
                model.symmetries(NEAR_SHARE * sides.iter().fold(0.0, |a: f64, &b| a.max(b)))
            }
            Shape::Cylinder { .. } => {
                // Upside down about the landmark's own direction: it stays as near as it can.
                let (x, y) = self.landmark_in_object().map_or((1.0, 0.0), |(p, _)| (p.x, p.y));
                let axis = Unit::try_new(Vector3::new(x, y, 0.0), 1e-9);
                let axis = axis.unwrap_or(Vector3::x_axis());
                let over = UnitQuaternion::from_axis_angle(&axis, std::f64::consts::PI);
                vec![Transform::from_parts(Default::default(), over)]
            }
            Shape::Cup { .. } | Shape::Sphere { .. } => Vec::new(),
        }
    }
}

/// A pose that also explains the edges, less well.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alternative {
    /// `base_from_object`.
    pub pose: Transform,
    /// Share of belief, 0 to 1; with the best pose's confidence they add up to at most one.
    pub confidence: f64,
}

/// A recognised object.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectPose {
    /// `base_from_object` with its covariance.
    pub pose: GaussianPose,
    /// Belief that this pose is the right one, 0 to 1.
    pub confidence: f64,
    /// Share of the visible contour that edges explain, 0 to 1.
    pub coverage: f64,
    /// Other poses, best first.
    pub alternatives: Vec<Alternative>,
    /// Motions about which the result says nothing.
    pub symmetry: Symmetry,
}

impl ObjectPose {
    /// Normalised estimation error squared of `truth` (`base_from_object`) over what the result
    /// speaks about, with its degrees of freedom: six, without the turn about its axis five for a
    /// solid of revolution, three for a ball. `None` when the covariance is singular.
    pub fn nees(&self, truth: &Transform) -> Option<(f64, usize)> {
        let pose = &self.pose.pose;
        let error = difference(pose, &self.symmetry.nearest(truth, pose));
        let axis = pose.rotation * Vector3::z_axis();
        // Directions of the turns that count.
        let across = axis.cross(&pose.transform_vector(&Vector3::x()));
        let turns = match self.symmetry {
            Symmetry::Finite(_) => vec![Vector3::x(), Vector3::y(), Vector3::z()],
            Symmetry::Revolution { .. } => vec![across, axis.cross(&across)],
            Symmetry::Full => Vec::new(),
        };
        let freedoms = turns.len() + 3;
        let mut by = DMatrix::zeros(freedoms, 6);
        for (row, turn) in turns.iter().enumerate() {
            by.fixed_view_mut::<1, 3>(row, 0).copy_from(&turn.transpose());
        }
        by.fixed_view_mut::<3, 3>(freedoms - 3, 3).fill_diagonal(1.0);
        let error = &by * error;
        let factor = (&by * self.pose.covariance * by.transpose()).cholesky()?;
        Some((error.dot(&factor.solve(&error)), freedoms))
    }
}

/// Why there is no pose.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// No picture was given.
    #[error("no picture was given")]
    NoView,
    /// A picture is not of its camera's size.
    #[error("picture {view} is {picture:?} pixels large, its camera says {camera:?}")]
    Size {
        /// Which picture, from zero.
        view: usize,
        /// Its columns and rows.
        picture: (usize, usize),
        /// What the camera says.
        camera: (usize, usize),
    },
    /// A camera's numbers are not usable.
    #[error("the camera of picture {view} is not usable: {source}")]
    BadCamera {
        /// Which picture, from zero.
        view: usize,
        /// What is wrong with it.
        source: CameraError,
    },
    /// The record has no such landmark, or one without a direction.
    #[error("the record has no usable landmark {0}")]
    NoLandmark(usize),
    /// The record cannot be true.
    #[error("the record is impossible: {0}")]
    Record(#[from] vergence_tag::Invalid),
    /// The landmark's position or covariance is not usable.
    #[error("the landmark's position or covariance is not usable")]
    BadLandmark,
    /// A camera's place or the deviation of its angles is not a number.
    #[error("the place of picture {view}'s camera is not usable")]
    BadPlace {
        /// Which picture, from zero.
        view: usize,
    },
    /// The direction of gravity is not a number.
    #[error("the direction of gravity is not usable")]
    BadVertical,
    /// The landmark is in front of no camera.
    #[error("the landmark is outside every picture")]
    OutOfView,
    /// No attitude shows the landmark to every camera that saw it.
    #[error("no attitude of the object shows its landmark to the cameras")]
    NoAttitude,
    /// Too little of the best contour lies on edges.
    #[error("only {:.0} % of the best contour lies on edges", 100.0 * .best.coverage)]
    TooFewEdges {
        /// The best guess, not to be relied on.
        best: Box<ObjectPose>,
    },
    /// Edges fit the best pose hardly better than they would by chance, as in mere clutter.
    #[error("the edges fit the best pose little better than chance would ({nats:.1} nats)")]
    Chance {
        /// Logarithm of the likelihood ratio against chance.
        nats: f64,
        /// The best guess, not to be relied on.
        best: Box<ObjectPose>,
    },
    /// Tracking found something, but turned further than an object does between two pictures.
    #[error("lost: the best pose is turned by {turned_deg:.0} degrees since the last picture")]
    Lost {
        /// By how much (degrees).
        turned_deg: f64,
        /// What was found, not to be relied on.
        best: Box<ObjectPose>,
    },
    /// Another pose explains the edges about as well.
    #[error("two different poses explain the edges about as well (confidence {:.2})", .best.confidence)]
    Ambiguous {
        /// The best guess, not to be relied on.
        best: Box<ObjectPose>,
    },
}

impl Refusal {
    /// The best guess behind a refusal, when there was one.
    pub fn best_guess(&self) -> Option<&ObjectPose> {
        match self {
            Refusal::TooFewEdges { best }
            | Refusal::Chance { best, .. }
            | Refusal::Ambiguous { best }
            | Refusal::Lost { best, .. } => Some(best),
            _ => None,
        }
    }
}

/// Checks everything that came from outside; gives the landmark's place and normal in the object.
pub(crate) fn check(
    views: &[View],
    query: &Query,
) -> Result<(Vector3<f64>, Vector3<f64>), Refusal> {
    if views.is_empty() {
        return Err(Refusal::NoView);
    }
    for (view, v) in views.iter().enumerate() {
        let picture = (v.image.width(), v.image.height());
        let camera = (v.camera.width, v.camera.height);
        if picture != camera {
            return Err(Refusal::Size { view, picture, camera });
        }
        v.camera.validate().map_err(|source| Refusal::BadCamera { view, source })?;
    }
    query.record.validate()?;
    let site = query.landmark_in_object().ok_or(Refusal::NoLandmark(query.landmark_index))?;
    let covariance: &Matrix3<f64> = &query.landmark.covariance;
    let finite = query.landmark.position.coords.iter().chain(covariance).all(|v| v.is_finite());
    // Beyond a kilometre nothing is known, and squares of such numbers overflow.
    let sane = covariance.iter().all(|v| v.abs() < 1e6);
    if !finite || !sane || covariance.cholesky().is_none() {
        return Err(Refusal::BadLandmark);
    }
    let placed = |v: &View| {
        let place = &v.base_from_optical;
        let numbers = place.translation.vector.iter().chain(place.rotation.coords.iter());
        v.turn_sd.is_finite() && numbers.into_iter().all(|n| n.is_finite())
    };
    if let Some(view) = views.iter().position(|v| !placed(v)) {
        return Err(Refusal::BadPlace { view });
    }
    if query.up.is_some_and(|up| !up.iter().all(|n| n.is_finite())) {
        return Err(Refusal::BadVertical);
    }
    let seen = |v: &View| {
        let p = v.base_from_optical.inverse_transform_point(&query.landmark.position);
        v.camera.project(&p).is_some_and(|pixel| v.camera.contains(&pixel, 0.0))
    };
    if !views.iter().any(seen) {
        return Err(Refusal::OutOfView);
    }
    Ok(site)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix6, UnitQuaternion, Vector6};
    use vergence_geometry::gaussian::perturb;

    fn found(symmetry: Symmetry) -> ObjectPose {
        let pose = Transform::from_parts(
            Vector3::new(0.5, 0.1, 0.2).into(),
            UnitQuaternion::from_euler_angles(0.4, -0.3, 1.0),
        );
        let covariance = Matrix6::identity() * 1e-4;
        let pose = GaussianPose { pose, covariance };
        ObjectPose { pose, confidence: 1.0, coverage: 1.0, alternatives: Vec::new(), symmetry }
    }

    #[test]
    fn what_cannot_be_seen_does_not_count_as_an_error() {
        let shift = Vector6::new(0.0, 0.0, 0.0, 0.01, 0.0, 0.0);
        let over = UnitQuaternion::from_euler_angles(0.0, std::f64::consts::PI, 0.0);
        let upside_down = Transform::from_parts(Default::default(), over);
        for (symmetry, freedoms, turn) in [
            (
                Symmetry::Revolution { flip: false },
                5,
                UnitQuaternion::from_euler_angles(0.0, 0.0, 2.0),
            ),
            (Symmetry::Finite(vec![Transform::identity(), upside_down]), 6, over),
            (Symmetry::Full, 3, UnitQuaternion::from_euler_angles(1.0, 0.5, 2.0)),
        ] {
            let found = found(symmetry);
            let mut truth = perturb(&found.pose.pose, &shift);
            truth.rotation *= turn;
            let (squares, of) = found.nees(&truth).unwrap();
            assert_eq!(of, freedoms);
            assert!((squares - 1.0).abs() < 1e-6, "{squares}");
        }
    }

    #[test]
    fn a_tilt_counts() {
        let found = found(Symmetry::Revolution { flip: false });
        let across = found.pose.pose.rotation * Vector3::x() * 0.02;
        let tilt = Vector6::new(across.x, across.y, across.z, 0.0, 0.0, 0.0);
        let (squares, _) = found.nees(&perturb(&found.pose.pose, &tilt)).unwrap();
        assert!((squares - 4.0).abs() < 1e-2, "{squares}");
    }
}
