//! The whole chain of calibration and measurement in small, and calibration's refusals.

use nalgebra::Point2;

use super::*;
use crate::calibration::{CalibrateError, Missing};
use crate::evaluation::world::Session;

/// A quarter of the usual sightings: the tests' time is dear.
fn small() -> EvaluationConfig {
    EvaluationConfig { places: 20, views: 24, ..EvaluationConfig::default() }
}

fn drawn(seed: u64, light: LightSource) -> (World, Session, CalibrationConfig) {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let kind = &SERVO_KINDS[1];
    let config = EvaluationConfig { light, ..small() };
    let world = World::draw(kind, &config, &mut random);
    let session = world.session(&config, &mut random);
    let settings = CalibrationConfig {
        noise: Noise::of_servo(kind.step, 0.0),
        ..CalibrationConfig::default()
    };
    (world, session, settings)
}

#[test]
fn calibration_turns_decimetres_into_millimetres_and_knows_its_error() {
    let config = EvaluationConfig { placements: 16, heads: 4, trials: 12, ..small() };
    let figures = evaluate_kind(&SERVO_KINDS[1], &config);
    assert!(figures.depth_rms_before > 0.05, "{figures:?}");
    assert!(figures.depth_rms_after < 0.005, "{figures:?}");
    assert!(figures.depth_rms_after < figures.depth_rms_single, "{figures:?}");
    assert!(figures.held_out_rms_px < 0.25 && figures.model_rms_px < 0.08, "{figures:?}");
    assert!(figures.coverage >= 0.7, "{figures:?}");
    assert_eq!(figures.refused_calibrations, 0);
    assert_eq!(figures, evaluate_kind(&SERVO_KINDS[1], &config), "repeats bit for bit");
}

#[test]
fn wrong_sightings_are_set_aside() {
    let (world, mut session, settings) = drawn(4, LightSource::Arm);
    for (i, place) in session.places.iter_mut().enumerate() {
        // A reflection on the table, now and then.
        place.fixations[i % 2][3].pixel += nalgebra::Vector2::new(9.0, 40.0);
    }
    let calibration =
        calibrate(&world.nominal, &session.places, &session.lengths, &settings).unwrap();
    let share = session.places.len() as f64
        / session.places.iter().flat_map(|p| &p.fixations).flatten().count() as f64;
    assert!((calibration.outliers - share).abs() < 0.3 * share, "{}", calibration.outliers);
    assert!(calibration.rms_px < 0.3, "{}", calibration.rms_px);
    let ahead = crate::calibration::middle(&calibration.heads) + nalgebra::Vector3::x();
    assert!(calibration.distance_sigma(&ahead).unwrap() < 0.003);
    assert!(calibration.systematic(&ahead).unwrap().trace() > 0.0);
}

#[test]
fn what_is_missing_is_named() {
    let refused = |world: &World, session: &Session, settings: &CalibrationConfig| match calibrate(
        &world.nominal,
        &session.places,
        &session.lengths,
        settings,
    ) {
        Err(CalibrateError::Unconstrained { missing, .. }) => missing,
        other => panic!("must be refused: {:?}", other.map(|c| c.rms_px)),
    };
    let (world, mut session, settings) = drawn(2, LightSource::Ruler);
    session.lengths.clear();
    assert_eq!(refused(&world, &session, &settings)[0], Missing::Scale);

    let (world, mut session, settings) = drawn(3, LightSource::Arm);
    for place in &mut session.places {
        place.fixations[1].truncate(0);
    }
    let missing = refused(&world, &session, &settings);
    assert_eq!(missing, [Missing::Fixations { head: "right", have: 0, need: 24 }]);

    // The light at four places only, always in the middle of the picture.
    let (world, mut session, settings) = drawn(5, LightSource::Ruler);
    session.places.truncate(4);
    session.lengths.truncate(2);
    let near_centre = |p: &Point2<f64>| (p - Point2::new(159.5, 119.5)).norm() < 60.0;
    for place in &mut session.places {
        place.fixations.iter_mut().for_each(|f| f.retain(|f| near_centre(&f.pixel)));
    }
    let missing = refused(&world, &session, &settings);
    let said = missing.iter().map(Missing::to_string).collect::<Vec<_>>().join("; ");
    if let [Missing::Fixations { .. }, ..] = missing[..] {
        panic!("the test needs more sightings: {said}");
    }
    assert!(said.contains("of the left picture only"), "{said}");
}

#[test]
fn exchanged_heads_do_not_fit() {
    let (mut world, session, settings) = drawn(7, LightSource::Arm);
    world.nominal.swap(0, 1);
    let result = calibrate(&world.nominal, &session.places, &session.lengths, &settings);
    assert!(
        matches!(result, Err(CalibrateError::FarOff { .. } | CalibrateError::NoFit { .. })),
        "{:?}",
        result.map(|c| c.rms_px)
    );
}

#[test]
fn fixation_takes_little_more_than_slew_and_code() {
    let timing = time_to_fixation(20, 0.2, 1);
    assert_eq!(timing.not_found, 0);
    assert!(timing.ratio_in_sight < 1.3, "{timing:?}");
    assert!(timing.ratio_last_seen < 1.4, "{timing:?}");
}
