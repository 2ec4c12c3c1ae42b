//! The results: BOP's CSV for scorers, a few lines for people.

use std::fmt::Write as _;
use std::path::Path;

use super::Outcome;
use crate::failure::Failure;

/// Writes the BOP results CSV: one row a scene that was answered, `t` in millimetres.
pub fn write(path: &Path, outcomes: &[Outcome]) -> Result<(), Failure> {
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
            "{},0,{},{:.6},{},{},{:.6}",
            outcome.id,
            outcome.object,
            found.confidence,
            row_major.join(" "),
            t.join(" "),
            outcome.seconds,
        );
    }
    std::fs::write(path, text).map_err(|e| {
        Failure::misuse(format!("{}: {e}", path.display()), "name a file in a folder that exists")
    })
}

/// Tells people on standard error what came out.
pub fn summary(outcomes: &[Outcome], path: &Path) {
    for outcome in outcomes {
        if let Err(refusal) = &outcome.result {
            eprintln!("scene {}: no pose: {refusal}", outcome.id);
        }
    }
    let answered = outcomes.iter().filter(|o| o.result.is_ok()).count();
    let mut seconds: Vec<f64> = outcomes.iter().map(|o| o.seconds).collect();
    seconds.sort_by(f64::total_cmp);
    let median = seconds.get(seconds.len() / 2).copied().unwrap_or(f64::NAN);
    eprintln!(
        "{answered} of {} scenes answered, median {:.1} ms a scene; results in {}",
        outcomes.len(),
        1000.0 * median,
        path.display()
    );
}
