//! The default method: a search over all rotations on directional distance fields, refinement of
//! all six unknowns, and a verdict.
//!
//! Reads top to bottom: gradients where the object can be ([`level`]), oriented edges ([`edges`]),
//! directional fields ([`field`]), rotations that explain them ([`search`]), refinement on sub-pixel
//! edges with several candidates a site ([`sites`], [`refine`]), and how much the best explains
//! that a different pose would not ([`verdict`]).

pub mod edges;
pub mod field;
pub mod level;
pub mod picture;
pub mod refine;
pub mod search;
pub mod sites;
pub mod verdict;

use nalgebra::Vector3;
use vergence_geometry::{GaussianPose, Transform};

use crate::model::Model;
use crate::types::{Alternative, ObjectPose, Query, Refusal, View, check};
use field::Field;
use level::{Level, Region};
use refine::{EDGE_SD_PX, Pass, Refined};
use search::{Search, Sight};
use sites::{Layout, Site};
use verdict::Explained;

/// Settings of the directional method.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// The working scale is halved until the object's reach around its landmark is at most this
    /// (px): the search needs no more, and its time grows with the square.
    pub reach_px: f64,
    /// Spacing of the grid of all rotations (rad).
    pub grid_spacing: f64,
    /// Step of a standing object's turn about the vertical (rad).
    pub turn_step: f64,
    /// Hypotheses improved on the fields.
    pub seeds: usize,
    /// Halvings of the step while improving, from half the grid's spacing.
    pub climb_halvings: usize,
    /// Hypotheses refined on the pictures.
    pub refined: usize,
    /// Cosine between the landmark's normal and the line of sight below which no camera sees it.
    pub grazing: f64,
    /// Poses that differ by more than this turn (rad) count as different.
    pub different: f64,
    /// Share of the contour that must lie on edges.
    pub least_coverage: f64,
    /// Belief in the best pose below which it is refused.
    pub least_confidence: f64,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            reach_px: 110.0,
            grid_spacing: 8f64.to_radians(),
            turn_step: 3f64.to_radians(),
            seeds: 48,
            climb_halvings: 3,
            refined: 10,
            grazing: 0.1,
            different: 6f64.to_radians(),
            least_coverage: 0.5,
            least_confidence: 0.6,
        }
    }
}

/// What a recognition saw on its way, for pictures.
pub struct Trace<'a> {
    /// The prepared views.
    pub sights: Vec<Sight<'a>>,
    /// The object's form.
    pub model: Model,
    /// Refined poses that differ, best first.
    pub poses: Vec<Transform>,
    /// The sites of the best pose.
    pub sites: Vec<Site>,
}

/// The object's pose from the edges of one or more pictures, its rotation unknown.
pub fn recognise(views: &[View], query: &Query, config: &Config) -> Result<ObjectPose, Refusal> {
    recognise_traced(views, query, config).map_or_else(Err, |(result, _)| result)
}

/// [`recognise`] with what it saw, unless it could not even begin.
pub fn recognise_traced<'a>(
    views: &[View<'a>],
    query: &Query,
    config: &Config,
) -> Result<(Result<ObjectPose, Refusal>, Trace<'a>), Refusal> {
    let (landmark, normal) = check(views, query)?;
    let model = Model::new(query.record);
    let sights = prepare(views, query, landmark, config);
    if sights.is_empty() {
        return Err(Refusal::OutOfView);
    }
    let search = Search { sights: &sights, model: &model, query, landmark, normal, config };
    let hypotheses = search.hypotheses();
    let mut refined: Vec<(Refined, Explained)> =
        hypotheses.iter().map(|h| search.refine_and_weigh(&h.pose)).collect();
    refined.sort_by(|a, b| b.1.evidence.total_cmp(&a.1.evidence));
    let different = search.different(refined);
    let result = search.verdict(&different);
    let poses = different.iter().map(|(r, _)| r.pose).collect();
    let sites = different.into_iter().next().map(|(r, _)| r.sites).unwrap_or_default();
    Ok((result, Trace { sights, model, poses, sites }))
}

/// Gradients, edges and fields of the views that can show the object.
fn prepare<'a>(
    views: &[View<'a>],
    query: &Query,
    landmark: Vector3<f64>,
    config: &Config,
) -> Vec<Sight<'a>> {
    let half = Vector3::from(query.record.bounding_box.sides()) / 2.0;
    // The corner furthest from the landmark bounds what the object can reach.
    let reach = (landmark.abs() + half).norm() + 0.01;
    views
        .iter()
        .filter_map(|view| {
            let optical_from_base = view.base_from_optical.inverse();
            let p = optical_from_base * query.landmark.position;
            let pixel = view.camera.project(&p)?;
            let depth = (p.z - reach).max(0.5 * p.z);
            let reach_px = reach * view.camera.fx.max(view.camera.fy) / depth + 8.0;
            let mut scale = 1;
            while reach_px / scale as f64 > config.reach_px {
                scale *= 2;
            }
            let (width, height) = (view.image.width(), view.image.height());
            let region = Region::around((pixel.x, pixel.y), reach_px, width, height)?;
            let coarse = Level::new(view.image, &region, scale);
            let fine = (scale > 1).then(|| Level::new(view.image, &region, 1));
            let field = Field::new(&edges::edgels(&coarse), coarse.width(), coarse.height());
            Some(Sight { view: *view, optical_from_base, coarse, fine, field })
        })
        .collect()
}

impl Search<'_> {
    fn refine_and_weigh(&self, start: &Transform) -> (Refined, Explained) {
        let scale = self.sights.iter().map(|s| s.coarse.scale).max().unwrap_or(1) as f64;
        let pass = |sd: f64, range: f64, spacing: f64, fine: bool| Pass {
            sd_px: sd,
            layout: Layout { spacing_px: spacing, range_px: range },
            fine,
        };
        let mut passes = vec![
            pass(2.5 * scale, 7.0 * scale, 3.0 * scale, false),
            pass(1.5 * scale, 5.0 * scale, 3.0 * scale, false),
            pass(1.0 * scale, 4.0 * scale, 2.0 * scale, false),
        ];
        let mut s = scale;
        while s > 1.0 {
            s /= 2.0;
            passes.push(pass(1.0 * s, 4.0 * s, 2.0 * s, true));
        }
        passes.push(pass(0.7, 4.0, 1.5, true));
        passes.push(pass(0.5, 4.0, 1.5, true));
        let last = pass(EDGE_SD_PX, 4.0, 1.5, true);
        passes.push(last);
        let mut refined = self.refine(start, &passes);
        self.lay_out(&mut refined, &last);
        let mut explained = verdict::weigh(&refined.sites, last.layout.range_px, 0.4);
        explained.evidence -= refined.strain;
        (refined, explained)
    }

    /// Of a list that is sorted best first, those that differ from every better one.
    fn different(&self, sorted: Vec<(Refined, Explained)>) -> Vec<(Refined, Explained)> {
        let symmetry = self.query.symmetry();
        let mut kept: Vec<(Refined, Explained)> = Vec::new();
        for candidate in sorted {
            let turn = &candidate.0.pose.rotation;
            let away = |k: &(Refined, Explained)| {
                symmetry.angle_between(&k.0.pose.rotation, turn) > self.config.different
            };
            if kept.iter().all(away) {
                kept.push(candidate);
            }
        }
        kept
    }

    /// The best pose with its belief against the different ones, or a refusal.
    fn verdict(&self, different: &[(Refined, Explained)]) -> Result<ObjectPose, Refusal> {
        let Some(((best, explained), others)) = different.split_first() else {
            return Err(Refusal::NoAttitude);
        };
        let odds = |e: &Explained| (e.evidence - explained.evidence).exp();
        let total = 1.0 + others.iter().map(|o| odds(&o.1)).sum::<f64>();
        let found = ObjectPose {
            pose: GaussianPose { pose: best.pose, covariance: best.covariance },
            confidence: 1.0 / total,
            coverage: explained.coverage,
            alternatives: others
                .iter()
                .map(|o| Alternative { pose: o.0.pose, confidence: odds(&o.1) / total })
                .take(4)
                .collect(),
            symmetry: self.query.symmetry(),
        };
        if found.coverage < self.config.least_coverage {
            return Err(Refusal::TooFewEdges { best: Box::new(found) });
        }
        if found.confidence < self.config.least_confidence {
            return Err(Refusal::Ambiguous { best: Box::new(found) });
        }
        Ok(found)
    }
}

/// DIAG
pub fn diagnose(views: &[View], query: &Query, config: &Config, truth: &Transform) {
    let (landmark, normal) = check(views, query).unwrap();
    let model = Model::new(query.record);
    let sights = prepare(views, query, landmark, config);
    let search = Search { sights: &sights, model: &model, query, landmark, normal, config };
    let show = |name: &str, start: &Transform| {
        let (r, e) = search.refine_and_weigh(start);
        let d = vergence_geometry::gaussian::difference(truth, &r.pose);
        println!(
            "{name}: rot {:.2} deg pos {:.2} mm  ({:.2},{:.2},{:.2}) evidence {:.1} cov {:.2} scatter {:.2} own {:?} size {:.4} strain {:.1} sd {:.2}mm",
            d.fixed_rows::<3>(0).norm().to_degrees(),
            1e3 * d.fixed_rows::<3>(3).norm(),
            1e3 * d[3],
            1e3 * d[4],
            1e3 * d[5],
            e.evidence,
            e.coverage,
            e.scatter_px,
            r.nuisances.iter().map(|n| (n.0.z * 100.0).round() / 100.0).collect::<Vec<_>>(),
            r.log_size,
            r.strain,
            1e3 * (r.covariance[(3, 3)] + r.covariance[(4, 4)] + r.covariance[(5, 5)]).sqrt()
        );
        r
    };
    for (i, s) in sights.iter().enumerate() {
        println!(
            "view {i} scale {} {}x{} noise {:.2}",
            s.coarse.scale,
            s.coarse.width(),
            s.coarse.height(),
            s.coarse.noise
        );
    }
    let r = show("from truth", truth);
    // residuals at truth
    let layout = Layout { spacing_px: 1.5, range_px: 4.0 };
    for (v, s) in sights.iter().enumerate() {
        let mut out = Vec::new();
        let level = s.fine.as_ref().unwrap_or(&s.coarse);
        sites::sites(
            &mut out,
            s,
            v,
            level,
            &model,
            &sites::State { pose: truth, log_size: 0.0, nuisance: Default::default() },
            query.up,
            &layout,
        );

        let mut by: std::collections::BTreeMap<usize, Vec<f64>> = Default::default();
        let mut all = Vec::new();
        for site in &out {
            let sign = 1.0;
            if let Some(n) = site
                .edges()
                .iter()
                .map(|c| c.offset * sign)
                .min_by(|a, b| a.abs().total_cmp(&b.abs()))
            {
                if n.abs() < 1.5 {
                    by.entry(site.segment).or_default().push(n);
                    if site.kind == crate::Kind::Silhouette && !site.contact {
                        all.push(n);
                    }
                }
            }
        }
        all.sort_by(f64::total_cmp);
        println!(
            "view {v}: sites {} silhouette median outward {:.3} iqr {:.3}",
            out.len(),
            all.get(all.len() / 2).unwrap_or(&f64::NAN),
            all.get(all.len() * 3 / 4).unwrap_or(&f64::NAN)
                - all.get(all.len() / 4).unwrap_or(&f64::NAN)
        );
        if by.len() < 12 {
            for (k, mut v) in by {
                v.sort_by(f64::total_cmp);
                let kind = out.iter().find(|s| s.segment == k).map(|s| s.kind);
                let c = out.iter().any(|s| s.segment == k && s.contact);
                print!("  seg {k} {kind:?} {c} n {} med {:.2};", v.len(), v[v.len() / 2]);
            }
            println!();
        }
    }
    let _ = r;
    let hypotheses = search.hypotheses();
    for h in &hypotheses {
        let d = vergence_geometry::gaussian::difference(truth, &h.pose);
        print!("[start {:.1} deg ev {:.0}] ", d.fixed_rows::<3>(0).norm().to_degrees(), h.evidence);
        show("  hyp", &h.pose);
    }
}
