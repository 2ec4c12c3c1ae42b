//! Self-calibration of the whole head from a blinking light.
//!
//! In: the head as its description says it is ([`PanTiltHead`] of both sides, off by a few degrees and
//! millimetres), and fixations of one light at several places, each place seen from several angles of
//! both heads, the light all over the picture. Out: both heads as they are, how sure that is, or a
//! refusal that names the motion that is missing.
//!
//! **Unknowns.** Per head the three fixed transforms of its chain (base to pan joint, pan to tilt joint,
//! tilt to optical frame; so zero offsets, axis skew, lever arms and the heads' relative pose are all in
//! there, and go back into a URDF as joint origins), focal length, principal point and first radial
//! distortion; and the place of every light.
//!
//! **Method.** Bundle adjustment: Levenberg-Marquardt on the pixels, each weighted by centroid and
//! encoder noise, with Cauchy weights against wrong sightings, and a Gaussian prior on every unknown of
//! a head ([`Priors`]). In the end the encoders' rounding counts as what it is, bounded by half a step,
//! which tells half as much again of coarse servos. The priors also hold what no light can show: moving the whole head with all
//! lights, and the directions in which the parameters of one chain repeat each other. Angles and pixels
//! alone know no size: one known length between two places of the light, or known places (an arm that
//! holds it), gives the scale.
//!
//! **Predicted error.** The inverse of the normal matrix, carried to what matters: the distance of a
//! point ([`Calibration::distance_sigma`]) and its position ([`Calibration::systematic`]).

mod diagnosis;
mod solver;

use nalgebra::{DMatrix, Matrix2, Matrix3, Matrix3xX, Matrix6, Point3, SVector, Vector3, Vector6};
use vergence_geometry::gaussian::perturb;

use crate::triangulation::nearest_to_rays;
use crate::{Fixation, Noise, PanTiltHead, triangulate_many};

/// Unknowns of one head: three transforms, focal length, principal point, radial distortion.
pub(crate) const HEAD_UNKNOWNS: usize = 22;
/// Unknowns of both heads.
pub(crate) const BOTH: usize = 2 * HEAD_UNKNOWNS;

pub(crate) type HeadVector = SVector<f64, HEAD_UNKNOWNS>;

/// The light at one place: what both heads saw of it, left and right.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LightPlace {
    /// Fixations of the left and of the right head.
    pub fixations: [Vec<Fixation>; 2],
    /// Where it is in base, when something else knows (an arm): position and sigma (m).
    pub known: Option<(Point3<f64>, f64)>,
}

/// The distance between two places of the light, measured with a ruler.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownLength {
    /// Indices of the two places.
    pub places: [usize; 2],
    /// Distance (m).
    pub length: f64,
    /// Its standard deviation (m).
    pub sigma: f64,
}

/// How far the description may be off: one standard deviation of each unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Priors {
    /// Every rotation of every fixed transform (rad).
    pub rotation: f64,
    /// Every translation (m).
    pub translation: f64,
    /// Focal length, relative.
    pub focal: f64,
    /// Principal point (px).
    pub principal_px: f64,
    /// First radial distortion coefficient.
    pub k1: f64,
}

impl Default for Priors {
    /// Even within 3 degrees, 10 mm and 10 %: the bound divided by the root of three.
    fn default() -> Self {
        let uniform = 3f64.sqrt();
        Priors {
            rotation: 3f64.to_radians() / uniform,
            translation: 0.010 / uniform,
            focal: 0.10 / uniform,
            principal_px: 5.0,
            k1: 0.05,
        }
    }
}

impl Priors {
    /// Standard deviations in the order of a head's unknowns.
    fn sigmas(&self) -> HeadVector {
        let mut sigmas = HeadVector::zeros();
        for block in 0..3 {
            sigmas.fixed_rows_mut::<3>(6 * block).fill(self.rotation);
            sigmas.fixed_rows_mut::<3>(6 * block + 3).fill(self.translation);
        }
        sigmas[18] = self.focal;
        sigmas[19] = self.principal_px;
        sigmas[20] = self.principal_px;
        sigmas[21] = self.k1;
        sigmas
    }
}

/// What calibration needs beside the sightings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibrationConfig {
    /// How far the description may be off.
    pub priors: Priors,
    /// Noise of the joints; only what differs from fixation to fixation counts, a shared error is
    /// part of the zero offsets.
    pub noise: Noise,
    /// Largest predicted error (one sigma, m) of the distance of a point 1 m ahead with which the
    /// result is still handed out.
    pub required_distance_sigma: f64,
}

impl Default for CalibrationConfig {
    /// A 12-bit servo; 5 mm at 1 m, what grasping can still use.
    fn default() -> Self {
        CalibrationConfig {
            priors: Priors::default(),
            noise: Noise::of_servo(std::f64::consts::TAU / 4096.0, 0.0),
            required_distance_sigma: 0.005,
        }
    }
}

/// A motion that the data lack.
#[derive(Debug, Clone, PartialEq)]
pub enum Missing {
    /// Nothing tells the size of things.
    Scale,
    /// One head saw too little.
    Fixations {
        /// "left" or "right".
        head: &'static str,
        /// How many there are, and how many are needed.
        have: usize,
        /// The least.
        need: usize,
    },
    /// A joint hardly turned.
    Turn {
        /// "left" or "right".
        head: &'static str,
        /// "pan" or "tilt".
        joint: &'static str,
        /// How far it turned over all fixations (rad).
        span: f64,
    },
    /// The light stayed in one part of the picture.
    Picture {
        /// "left" or "right".
        head: &'static str,
        /// Part of the picture's width over which the light was seen.
        part: f64,
    },
    /// All places of the light are equally far.
    Depth {
        /// Ratio of the largest to the smallest distance.
        ratio: f64,
    },
    /// None of the above stands out; there are just too few or too noisy sightings.
    More,
}

impl std::fmt::Display for Missing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Missing::Scale => write!(
                f,
                "nothing tells the scale: move the light along a known length, or let the arm hold it"
            ),
            Missing::Fixations { head, have, need } => {
                write!(f, "the {head} head saw the light {have} times, {need} are needed")
            }
            Missing::Turn { head, joint, span } => write!(
                f,
                "{joint} of the {head} head turned over {:.0} degrees only: put the light at more bearings and heights",
                span.to_degrees()
            ),
            Missing::Picture { head, part } => write!(
                f,
                "the light crossed {:.0} % of the {head} picture only: look past it as well as at it",
                100.0 * part
            ),
            Missing::Depth { ratio } => write!(
                f,
                "all places of the light are about equally far (ratio {ratio:.2}): bring it nearer and farther"
            ),
            Missing::More => write!(f, "more sightings, or less noisy ones"),
        }
    }
}

/// Why there is no calibration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// The data do not determine the head; what is missing, the most important first.
    #[error(
        "the sightings do not determine the head, a distance of 1 m would be uncertain by {:.0} mm: {}",
        1e3 * .distance_sigma,
        list(.missing)
    )]
    Unconstrained {
        /// Motions to add.
        missing: Vec<Missing>,
        /// Predicted error (m, one sigma) of the distance of a point 1 m ahead.
        distance_sigma: f64,
    },
    /// Numbers that are not finite, or an index of a place that does not exist.
    #[error("unusable input: {0}")]
    Input(&'static str),
    /// The sightings fit a head that is nowhere near the description: left and right exchanged, or the
    /// URDF of another head.
    #[error(
        "the {head} head would have to differ from its description by {sigmas:.0} times what is \
         allowed for: check which camera is which, and the URDF"
    )]
    FarOff {
        /// "left" or "right".
        head: &'static str,
        /// In standard deviations of the priors.
        sigmas: f64,
    },
    /// The adjustment does not converge: the description is too far off, or left and right exchanged.
    #[error(
        "no head near the description explains the sightings ({rms_px:.1} px rms): check joint \
         directions, and which camera is which"
    )]
    NoFit {
        /// Residual (px, rms).
        rms_px: f64,
    },
}

fn list(missing: &[Missing]) -> String {
    missing.iter().map(Missing::to_string).collect::<Vec<_>>().join("; ")
}

/// A change of an unknown by more sigmas of its prior means that the description is of another head.
const FARTHEST: f64 = 6.0;

/// A calibrated head.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// Both heads as they are.
    pub heads: [PanTiltHead; 2],
    /// The light's places in base.
    pub lights: Vec<Point3<f64>>,
    /// Residual of the pixels (px, rms over both coordinates of the sightings that count).
    pub rms_px: f64,
    /// Part of the sightings that were set aside as wrong.
    pub outliers: f64,
    /// Covariance of both heads' unknowns, left then right.
    covariance: DMatrix<f64>,
}

/// Calibrates both heads, see the module's text.
pub fn calibrate(
    nominal: &[PanTiltHead; 2],
    places: &[LightPlace],
    lengths: &[KnownLength],
    config: &CalibrationConfig,
) -> Result<Calibration, CalibrateError> {
    check(places, lengths)?;
    let missing = diagnosis::missing_at_sight(nominal, places);
    if !missing.is_empty() {
        return Err(CalibrateError::Unconstrained { missing, distance_sigma: f64::INFINITY });
    }
    let problem = solver::Problem { nominal, places, lengths, config };
    // Three degrees are as much as the heads' vergence at 1 m, so where the rays of the description
    // meet may mislead; the usual distances are tried first.
    let starts = FIRST_DISTANCES
        .into_iter()
        .map(|distance| places.iter().map(|place| first_guess(nominal, place, distance)).collect());
    let Some(solution) = problem.solve(starts) else {
        return Err(CalibrateError::NoFit { rms_px: f64::INFINITY });
    };
    // Sightings that miss by more than the noise explains are another head, not this one.
    if solution.chi2_mean > solver::EXPLAINED {
        return Err(CalibrateError::NoFit { rms_px: solution.rms_px });
    }
    let (sigmas, head) = solution.farthest;
    if sigmas > FARTHEST {
        return Err(CalibrateError::FarOff { head: ["left", "right"][head], sigmas });
    }
    let calibration = Calibration {
        heads: solution.heads,
        lights: solution.lights,
        rms_px: solution.rms_px,
        outliers: solution.outliers,
        covariance: solution.covariance,
    };
    let distance_sigma = diagnosis::worst_distance_sigma(&calibration);
    if distance_sigma.is_nan() || distance_sigma > config.required_distance_sigma {
        let missing = diagnosis::missing_after(&calibration, places, lengths);
        return Err(CalibrateError::Unconstrained { missing, distance_sigma });
    }
    Ok(calibration)
}

impl Calibration {
    /// Covariance (m^2, base) that the calibration's own error gives a triangulated point, to be
    /// added to that of [`crate::triangulate`]. Holds the uncertainty of the whole head in base, too.
    pub fn systematic(&self, point: &Point3<f64>) -> Option<Matrix3<f64>> {
        let slopes = self.point_slopes(point)?;
        Some(&slopes * &self.covariance * slopes.transpose())
    }

    /// Standard deviation (m) that the calibration's own error gives the distance of a point from the
    /// middle of the head.
    pub fn distance_sigma(&self, point: &Point3<f64>) -> Option<f64> {
        let slopes = self.point_slopes(point)?;
        let middle = middle(&self.heads);
        let along = (point - middle).normalize();
        let mut row = along.transpose() * slopes;
        // The middle itself moves with the heads' mounts.
        for k in 0..2 {
            for axis in 0..3 {
                row[k * HEAD_UNKNOWNS + 3 + axis] -= 0.5 * along[axis];
            }
        }
        let variance = (&row * &self.covariance * row.transpose())[(0, 0)];
        (variance >= 0.0).then(|| variance.sqrt())
    }

    /// Standard deviation (rad) of joint zeros that make the distance of a point as uncertain as the whole
    /// calibration leaves it: what to tell whoever uses its heads and knows only of angles. `None` where
    /// the heads cannot look at it.
    pub fn zero_sigma(&self, point: &Point3<f64>) -> Option<f64> {
        // Small enough to be linear, large against what triangulation takes for nothing.
        const UNIT: f64 = 1e-3;
        Some(UNIT * self.distance_sigma(point)? / distance_sigma(&self.heads, point, UNIT)?)
    }

    /// Covariance of one head's fixed transform (0 base to pan joint, 1 pan to tilt joint, 2 tilt to
    /// optical frame), in the tangent order rotation, translation.
    pub fn transform_covariance(&self, head: usize, block: usize) -> Matrix6<f64> {
        let start = head * HEAD_UNKNOWNS + 6 * block;
        self.covariance.fixed_view::<6, 6>(start, start).into_owned()
    }

    /// Derivative of the triangulated point by both heads' unknowns: what the point becomes when
    /// the same angles and pixels are read with a slightly different head.
    fn point_slopes(&self, point: &Point3<f64>) -> Option<Matrix3xX<f64>> {
        let rays = |heads: &[PanTiltHead; 2], angles: &[[f64; 2]; 2]| {
            let centre = |k: usize| {
                let camera = &self.heads[k].camera;
                nalgebra::Point2::new(camera.cx, camera.cy)
            };
            nearest_to_rays(&[0, 1].map(|k| heads[k].ray(angles[k], &centre(k))))
        };
        let angles = [self.heads[0].aim_at(point), self.heads[1].aim_at(point)];
        let mut slopes = Matrix3xX::zeros(BOTH);
        for unknown in 0..BOTH {
            let step = if unknown % HEAD_UNKNOWNS >= 19 { 1e-3 } else { 1e-6 };
            let moved = |h: f64| {
                let mut heads = self.heads.clone();
                let mut change = HeadVector::zeros();
                change[unknown % HEAD_UNKNOWNS] = h;
                let k = unknown / HEAD_UNKNOWNS;
                heads[k] = apply(&heads[k], &change);
                rays(&heads, &angles)
            };
            slopes.set_column(unknown, &((moved(step)? - moved(-step)?) / (2.0 * step)));
        }
        Some(slopes)
    }
}

/// The middle between the two pan axes, from where distances count.
pub fn middle(heads: &[PanTiltHead; 2]) -> Point3<f64> {
    let origin = |k: usize| heads[k].chain.joints[0].parent_from_joint.translation.vector;
    Point3::from((origin(0) + origin(1)) / 2.0)
}

/// Standard deviation (m) of the distance of a light from the middle of the heads when nothing is unknown
/// but what every joint's angles have in common, of this deviation (rad). `None` where the heads cannot
/// look at it.
pub(crate) fn distance_sigma(
    heads: &[PanTiltHead; 2],
    light: &Point3<f64>,
    common_sigma: f64,
) -> Option<f64> {
    let ideal = |k: usize| {
        let angles = heads[k].aim_at(light);
        let pixel = heads[k].project(angles, light)?;
        Some([Fixation { angles, pixel, pixel_covariance: Matrix2::zeros() }])
    };
    let noise = Noise { step_sigma: 0.0, common_sigma };
    let known = triangulate_many(heads, [&ideal(0)?, &ideal(1)?], &noise).ok()?;
    Some(known.distance_from(&middle(heads)).1)
}

/// A head with its unknowns changed: three tangents (rotation, translation) in parent axes, log focal
/// length, principal point, k1.
pub(crate) fn apply(head: &PanTiltHead, change: &HeadVector) -> PanTiltHead {
    let tangent = |block: usize| Vector6::from(change.fixed_rows::<6>(6 * block));
    let mut moved = head.clone();
    for (block, joint) in moved.chain.joints.iter_mut().enumerate() {
        joint.parent_from_joint = perturb(&joint.parent_from_joint, &tangent(block));
    }
    moved.chain.last_from_tip = perturb(&moved.chain.last_from_tip, &tangent(2));
    let camera = &mut moved.camera;
    camera.fx *= change[18].exp();
    camera.fy *= change[18].exp();
    camera.cx += change[19];
    camera.cy += change[20];
    camera.distortion.k1 += change[21];
    moved
}

fn check(places: &[LightPlace], lengths: &[KnownLength]) -> Result<(), CalibrateError> {
    let finite = |f: &Fixation| {
        f.angles
            .iter()
            .chain(f.pixel.iter())
            .chain(f.pixel_covariance.iter())
            .all(|v| v.is_finite())
    };
    if !places.iter().flat_map(|p| p.fixations.iter().flatten()).all(finite) {
        return Err(CalibrateError::Input("a fixation is not finite"));
    }
    let known = places.iter().filter_map(|p| p.known);
    if !known.into_iter().all(|(p, s)| p.iter().all(|v| v.is_finite()) && s > 0.0) {
        return Err(CalibrateError::Input(
            "a known place is not finite, or its sigma not positive",
        ));
    }
    for l in lengths {
        let [a, b] = l.places;
        if a == b || a.max(b) >= places.len() || !(l.length > 0.0 && l.sigma > 0.0) {
            return Err(CalibrateError::Input(
                "a known length is between unknown places, or not positive",
            ));
        }
    }
    Ok(())
}

/// Distances (m) at which the lights start; `None` for where their rays meet.
const FIRST_DISTANCES: [Option<f64>; 4] = [Some(1.0), None, Some(0.6), Some(1.8)];

/// A place for the light to start from: along the mean ray, at the given distance or where the rays
/// meet, in front and within arm's reach or so.
fn first_guess(heads: &[PanTiltHead; 2], place: &LightPlace, distance: Option<f64>) -> Point3<f64> {
    if let Some((position, _)) = place.known {
        return position;
    }
    let rays: Vec<_> = (0..2)
        .flat_map(|k| place.fixations[k].iter().map(move |f| (k, f)))
        .map(|(k, f)| heads[k].ray(f.angles, &f.pixel))
        .collect();
    let mean: Vector3<f64> = rays.iter().map(|r| r.direction.into_inner()).sum();
    let direction = mean.try_normalize(1e-9).unwrap_or_else(Vector3::x);
    let from = middle(heads);
    let met = || nearest_to_rays(&rays).map_or(1.0, |p| (p - from).dot(&direction));
    let distance = distance.unwrap_or_else(met);
    from + direction * distance.clamp(0.3, 3.0)
}
