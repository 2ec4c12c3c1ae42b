//! The landmark as a measurement of where the object is.
//!
//! **In:** the landmark with its covariance, and the views. **Out:** what it says about the object's
//! place, whitened, and how that depends on small turns of the cameras. Where the cameras' angles are
//! known only so well, the landmark was triangulated with these angles too: a part of its error *is*
//! theirs. Taken as independent that would be counted twice, once by itself and once by what the edges
//! say about the angles. A landmark that is as uncertain as these angles make it has all its error from
//! them; one that is better known is the mean of as many fixations as it is better, this one among
//! them. So the unknown turns move it along by their share, and its own error is the rest.

use nalgebra::{Matrix3, Matrix3x2};
use vergence_geometry::gaussian::skew;

use super::equations::VIEWS;
use super::search::Sight;
use crate::types::Query;

/// Deviation of the light's place on the object from the record's (m): tags are stuck on by hand.
const PLACE_SD: f64 = 0.001;

/// What the landmark says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Landmark {
    /// Makes a difference of places (m) one of unit deviations.
    pub whiten: Matrix3<f64>,
    /// How it was moved (m) by small turns of each camera about its own x and y axes (rad).
    pub by_turn: [Matrix3x2<f64>; VIEWS],
}

impl Landmark {
    /// The landmark of a query that [`crate::types::check`] has passed.
    pub fn new(sights: &[Sight], query: &Query) -> Self {
        let landmark = &query.landmark;
        let place = Matrix3::identity() * (PLACE_SD * PLACE_SD);
        let mut by_turn = [Matrix3x2::zeros(); VIEWS];
        let mut covariance = landmark.covariance;
        let turning = sights.len() > 1 && sights.iter().any(|s| s.view.turn_sd > 0.0);
        if let Some(moves) = turning.then(|| triangulation(sights, query)).flatten() {
            let variance = |sight: &Sight| sight.view.turn_sd.powi(2);
            let explained = moves.iter().zip(sights).map(|(m, s)| m * m.transpose() * variance(s));
            let explained: Matrix3<f64> = explained.sum();
            let share = (covariance.trace() / explained.trace()).min(1.0);
            covariance = positive(covariance - explained * (share * share));
            by_turn = moves.map(|m| m * share);
        }
        let whiten = (covariance + place).try_inverse().and_then(|w| w.cholesky());
        let whiten = whiten.map_or(Matrix3::zeros(), |w| w.l().transpose());
        Landmark { whiten, by_turn }
    }
}

/// How the point where the views' rays meet moves (m) with small turns of the cameras (rad); `None`
/// when the rays are parallel.
fn triangulation(sights: &[Sight], query: &Query) -> Option<[Matrix3x2<f64>; VIEWS]> {
    let (mut information, mut moments) = (Matrix3::zeros(), [Matrix3x2::zeros(); VIEWS]);
    for (moment, sight) in moments.iter_mut().zip(sights) {
        let p = sight.optical_from_base * query.landmark.position;
        let (_, by_point) = sight.view.camera.project_with_jacobian(&p)?;
        let by_base = by_point * sight.optical_from_base.rotation.to_rotation_matrix();
        // A turned camera sees the light elsewhere; who does not know moves the point instead.
        let by_turn = by_point * -skew(&p.coords);
        *moment = by_base.transpose() * by_turn.fixed_columns::<2>(0);
        information += by_base.transpose() * by_base;
    }
    let inverse = information.try_inverse()?;
    Some(moments.map(|moment| inverse * moment))
}

/// A symmetric matrix without what is negative in it.
fn positive(m: Matrix3<f64>) -> Matrix3<f64> {
    let eigen = m.symmetric_eigen();
    let kept = Matrix3::from_diagonal(&eigen.eigenvalues.map(|e| e.max(0.0)));
    eigen.eigenvectors * kept * eigen.eigenvectors.transpose()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;
    use crate::directional::{Config, prepare};
    use crate::types::View;
    use nalgebra::{Point3, UnitQuaternion};
    use vergence_geometry::{Camera, GaussianPoint, Transform};
    use vergence_imaging::Image;
    use vergence_tag::Record;

    const TURN_SD: f64 = 2e-3;

    fn record() -> Record {
        let text = r#"{"object_id": "box", "landmarks": [{"position": [0.05, 0, 0], "normal": [1, 0, 0]}],
            "bounding_box": {"width": 0.1, "length": 0.1, "height": 0.1}, "shape": {"kind": "box"}}"#;
        serde_json::from_str(text).unwrap()
    }

    /// What the landmark of these views says, and its triangulation with unknown turns of the cameras.
    fn with(covariance: Matrix3<f64>, turn_sd: f64, check: impl Fn(Landmark, &[Sight])) {
        let image = Image::filled(320, 240, 90u8);
        let views = [0.1, -0.1].map(|y| View {
            image: &image,
            camera: Camera::centred(320, 240, 300.0),
            base_from_optical: Transform::from_parts(
                nalgebra::Vector3::new(0.0, y, 0.4).into(),
                UnitQuaternion::from_euler_angles(-1.9, 0.0, -FRAC_PI_2 - 2.0 * y),
            ),
            turn_sd,
        });
        let record = record();
        let position = Point3::new(0.6, 0.02, 0.2);
        let landmark = GaussianPoint { position, covariance };
        let query =
            Query { record: &record, landmark, landmark_index: 0, up: None, standing: None };
        let on_box = nalgebra::Vector3::new(0.05, 0.0, 0.0);
        let sights = prepare(&views, &query, on_box, &Config::default(), false);
        assert_eq!(sights.len(), 2);
        check(Landmark::new(&sights, &query), &sights);
    }

    #[test]
    fn turns_move_the_landmark_as_its_triangulation_does() {
        with(Matrix3::identity() * 1e-3, TURN_SD, |landmark, sights| {
            let truth = Point3::new(0.6, 0.02, 0.2);
            let turns = [[1e-4, -2e-4], [3e-4, 1e-4]];
            // Where cameras turned like that see the light, and where those pixels meet untold of it.
            let seen: Vec<_> = sights
                .iter()
                .zip(turns)
                .map(|(sight, [x, y])| {
                    let turn = Transform::rotation(nalgebra::Vector3::new(x, y, 0.0));
                    sight.view.camera.project(&(turn * sight.optical_from_base * truth)).unwrap()
                })
                .collect();
            let mut met = truth;
            for _ in 0..5 {
                let (mut a, mut b) = (Matrix3::zeros(), nalgebra::Vector3::zeros());
                for (sight, seen) in sights.iter().zip(&seen) {
                    let p = sight.optical_from_base * met;
                    let (pixel, j) = sight.view.camera.project_with_jacobian(&p).unwrap();
                    let j = j * sight.optical_from_base.rotation.to_rotation_matrix();
                    a += j.transpose() * j;
                    b += j.transpose() * (seen - pixel);
                }
                met += a.try_inverse().unwrap() * b;
            }
            let moves = landmark.by_turn.iter().zip(turns);
            let expected: nalgebra::Vector3<f64> =
                moves.map(|(m, turn)| m * nalgebra::Vector2::from(turn)).sum();
            let off = (met - truth - expected).norm();
            assert!(off < 0.02 * expected.norm(), "{off} of {}", expected.norm());
        });
    }

    #[test]
    fn what_the_turns_explain_of_its_covariance_is_not_counted_again() {
        let whole = |landmark: &Landmark| {
            let own = (landmark.whiten.transpose() * landmark.whiten).try_inverse().unwrap();
            let turns = landmark.by_turn.iter().map(|m| m * m.transpose() * (TURN_SD * TURN_SD));
            (own, turns.sum::<Matrix3<f64>>())
        };
        let single = Matrix3::identity() * 1e-3;
        with(single, TURN_SD, |landmark, _| {
            // As uncertain as the angles make it, and more: the rest is its own.
            let (own, turns) = whole(&landmark);
            assert!((own + turns - single - Matrix3::identity() * 1e-6).norm() < 1e-9);
            // The mean of four fixations: with a quarter of each one's turns it is as uncertain.
            with(turns / 4.0, TURN_SD, |mean, _| {
                assert!((mean.by_turn[0] * 4.0 - landmark.by_turn[0]).norm() < 1e-9);
                let (own, of_this) = whole(&mean);
                let all = turns / 4.0 + Matrix3::identity() * 1e-6;
                assert!((own + of_this - all).norm() < 1e-9, "{own} {of_this}");
            });
        });
        // Cameras whose angles are known leave the covariance as it is.
        with(Matrix3::identity() * 4e-6, 0.0, |landmark, _| {
            assert_eq!(landmark.by_turn, [Matrix3x2::zeros(); VIEWS]);
            let (own, _) = whole(&landmark);
            assert!((own - Matrix3::identity() * 5e-6).norm() < 1e-12);
        });
    }
}
