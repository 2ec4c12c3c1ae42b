//! The results: BOP's CSV for scorers, a few lines for people.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use super::Outcome;
use crate::failure::Failure;
use crate::out::refused;

/// Writes the BOP results CSV: one row an object that was answered, `t` in millimetres. All rows of an image
/// have its whole time, as BOP wants it.
pub fn write(path: &Path, outcomes: &[Outcome]) -> Result<(), Failure> {
    let seconds = seconds(outcomes);
    let mut text = String::from("scene_id,im_id,obj_id,score,R,t,time\n");
    for outcome in outcomes {
        let Ok(found) = &outcome.result else { continue };
        let left_from_object = outcome.base_from_left.inv_mul(&found.pose.pose);
        let r = left_from_object.rotation.to_rotation_matrix();
        let row_major: Vec<String> =
            r.matrix().transpose().iter().map(|v| format!("{v:.9}")).collect();
        let t: Vec<String> = left_from_object
            .translation
            .vector
            .iter()
            .map(|v| format!("{:.6}", v * 1000.0))
            .collect();
        let _ = writeln!(
            text,
            "{},{},{},{:.6},{},{},{:.6}",
            outcome.scene,
            outcome.image,
            outcome.object,
            found.confidence,
            row_major.join(" "),
            t.join(" "),
            seconds[&(outcome.scene, outcome.image)],
        );
    }
    std::fs::write(path, text).map_err(|e| refused(path, e))
}

/// Tells people on standard error what came out.
pub fn summary(outcomes: &[Outcome], path: &Path) {
    for outcome in outcomes {
        if let Err(refusal) = &outcome.result {
            let Outcome { scene, image, object, .. } = outcome;
            eprintln!("scene {scene}, image {image}, object {object}: no pose: {refusal}");
        }
    }
    let answered = outcomes.iter().filter(|o| o.result.is_ok()).count();
    let mut seconds: Vec<f64> = seconds(outcomes).into_values().collect();
    seconds.sort_by(f64::total_cmp);
    let median = seconds.get(seconds.len() / 2).copied().unwrap_or(f64::NAN);
    eprintln!(
        "{answered} of {} objects answered, median {:.1} ms an image; results in {}",
        outcomes.len(),
        1000.0 * median,
        path.display()
    );
}

/// Seconds for all objects of an image, by scene and image.
fn seconds(outcomes: &[Outcome]) -> BTreeMap<(u32, u32), f64> {
    let mut seconds = BTreeMap::new();
    for outcome in outcomes {
        *seconds.entry((outcome.scene, outcome.image)).or_default() += outcome.seconds;
    }
    seconds
}
