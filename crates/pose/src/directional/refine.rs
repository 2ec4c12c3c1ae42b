//! All six unknowns together, from the edges of all views, print that both see, the landmark and gravity.
//!
//! **In:** a pose that is right to a few pixels. **Out:** the pose that maximises the likelihood of
//! a mixture: every site's edge is one of its candidates with Gaussian error, or none. Solved by
//! Gauss-Newton on the expected assignments (EM), the edge deviation shrinking from pass to pass
//! (annealing). The landmark is a measurement of three numbers with its covariance.
//!
//! Nuisance unknowns with priors take up what would else bias the pose: the object's size is not
//! exactly the record's, silhouettes appear a fraction of a pixel off (rounded edges, blooming,
//! gamma), lips have some thickness, all in every view alike; and each camera's angles are known to
//! the servos' accuracy. The foot of a standing object, where the shadow begins, is measured only
//! coarsely.

use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, Vector2, Vector3, Vector6};
use vergence_geometry::gaussian::{difference, perturb, skew};
use vergence_geometry::{Symmetry, Transform};

use super::equations::{Edge, Equations, Move, Offsets, Solution, VIEWS, by_part, part_of};
use super::print::Patch;
use super::search::Search;
use super::sites::{FORM_AT, Form, LIP_AT, Layout, SHARED, Site, State, sites};
use crate::model::{Kind, Rest};

/// Standard deviation of an edge's place once the pose is right (px): aliasing, gamma, blooming and
/// bent edges, not only noise.
pub const EDGE_SD_PX: f64 = 0.2;
/// The covariance takes the deviations of what sites have in common this much larger than the
/// estimate does: the estimate is best with the core of their distribution, the covariance has to
/// hold its tails (their root mean square is up to two and a half times the core, docs/pose.md).
const DOUBT: f64 = 2.5;
/// Neighbouring sites err alike: contour length that counts as one independent measurement, in the
/// picture (px; blur and aliasing) and on the object (m; bent edges, shadows, lines of print).
const CORRELATION_PX: f64 = 5.0;
const CORRELATION: f64 = 0.012;
/// Density of edges that have nothing to do with the contour (per px of normal).
pub const STRAY_DENSITY: f64 = 0.08;
/// Deviation of a standing object's axis from gravity (rad): tables and heads are not quite level.
const STANDING_SD: f64 = 0.006;
/// Beyond this tilt (rad) an object is not taken to stand.
const STANDING_LIMIT: f64 = 0.05;

/// Probability that a visible contour shows no edge of its own: occluded, without contrast or, below a
/// wall that turns away, in shadow, whose edge is the one that shows.
pub fn absence(site: &Site) -> f64 {
    match site.kind {
        Kind::Limb if site.contact => 0.6,
        Kind::Silhouette | Kind::Limb | Kind::Rim => 0.2,
        Kind::Crease => 0.45,
    }
}

/// Thickness of the lip of an open rim (m), and its deviation.
const LIP: f64 = 0.003;
const LIP_SD: f64 = 0.0015;
/// Deviation of the swelling of silhouettes (px).
const SWELL_SD_PX: f64 = 0.4;
/// Deviation of the logarithm of the object's size: one percent.
const SIZE_SD: f64 = 0.01;

/// Deviation (px) of a site's edge when a pass works with `sd_px`.
pub fn deviation(site: &Site, sd_px: f64) -> f64 {
    sd_px.hypot(site.offset_sd() * site.px_per_metre)
}

/// What holds against an attitude in which nothing can rest, where gravity is known (nats): objects
/// in a room stand or lie unless a hand holds them.
const UNSUPPORTED: f64 = 20.0;

/// How many objects stand upright, their z axis up, to one that is upside down, where nobody says which.
/// Fewer than the confidence that an answer needs, so that it never decides alone.
const UPRIGHT: f64 = 8.0;
/// Cosine between an object's z axis and the vertical from which on it counts as upright, not as on its side.
const UPRIGHT_FROM: f64 = 0.3;

/// How many independent measurements a site is worth.
pub fn independent(site: &Site) -> f64 {
    (site.length / (CORRELATION_PX + CORRELATION * site.px_per_metre)).min(1.0)
}

/// Precision (1/rad^2) with which a step holds the turns. What nothing is known of, as of a ball's turn
/// about its landmark, would else be turned by radians for the slightest reason, and a turn as large takes
/// those along that are known.
const HOLD: f64 = 10.0;

/// One pass of the refinement.
#[derive(Debug, Clone, Copy)]
pub struct Pass {
    /// Deviation of edges (picture px).
    pub sd_px: f64,
    /// How sites are laid out.
    pub layout: Layout,
}

/// Steps on the same sites: the assignments settle while the geometry is linear.
pub const STEPS: usize = 3;

/// The last pass: full resolution, tight.
pub const FINAL: Pass = Pass::new(EDGE_SD_PX, 4.0, 2.5, true);

impl Pass {
    /// A pass from its numbers: deviation, range to either side, spacing of sites (picture px).
    pub const fn new(sd_px: f64, range_px: f64, spacing_px: f64, fine: bool) -> Self {
        Pass { sd_px, layout: Layout { spacing_px, range_px, fine } }
    }
}

/// A refined pose.
#[derive(Debug, Clone)]
pub struct Refined {
    /// `base_from_object`.
    pub pose: Transform,
    /// How the object differs from its record.
    pub form: Form,
    /// Small turns of each view's camera about its own x and y axes (rad).
    pub turns: [Vector2<f64>; VIEWS],
    /// Covariance of the pose's tangent, once [`Search::doubt`] has put it there.
    pub covariance: Matrix6<f64>,
    /// How far off the parts of the object seem to be from where the record has them.
    pub offsets: Vec<Offsets>,
    /// The hypothesis that it comes from rests on something level: it stays so while it is refined,
    /// or free attitudes would absorb it, which always explain a little more.
    pub rests: bool,
    /// The sites of the last pass, at the pose before its last step.
    pub sites: Vec<Site>,
    /// The print that both views see, once [`Search::patches`] has put it there: it counts from then on.
    pub patches: Vec<Patch>,
}

type SharedMatrix = SMatrix<f64, SHARED, SHARED>;
type SharedVector = SVector<f64, SHARED>;

impl Search<'_> {
    /// Refines a state through the given passes.
    pub fn refine(&self, refined: &mut Refined, passes: &[Pass]) {
        for pass in passes {
            self.lay_out(refined, &pass.layout);
            let sites = std::mem::take(&mut refined.sites);
            let parts = by_part(&sites);
            let mut moved = Move::default();
            for _ in 0..STEPS {
                self.advance(refined, &parts, pass.sd_px, &mut moved);
            }
            refined.sites = sites;
            refined.apply(&moved);
        }
    }

    /// One step on from where it has `moved`, on sites in the order of [`by_part`]. The parts' offsets
    /// are kept in `refined`, whose pose stays. Without information nothing moves.
    pub(super) fn advance(
        &self,
        refined: &mut Refined,
        sites: &[&Site],
        sd_px: f64,
        moved: &mut Move,
    ) {
        if let Some(found) = self.solve(refined, sites, sd_px, moved, (1.0, HOLD)) {
            moved.shared += found.step.shared;
            moved.own.iter_mut().zip(found.step.own).for_each(|(m, s)| *m += s);
            refined.offsets = found.offsets;
        }
    }

    /// The covariance of a refined pose, with all that sites have in common taken seriously.
    pub fn doubt(&self, refined: &mut Refined, pass: &Pass) {
        self.lay_out(refined, &pass.layout);
        let sites = std::mem::take(&mut refined.sites);
        let still = Move::default();
        let solution = self.solve(refined, &by_part(&sites), pass.sd_px, &still, (DOUBT, 0.0));
        if let Some(solution) = solution {
            refined.covariance = solution.covariance();
        }
        refined.sites = sites;
    }

    /// Looks for the edges around a refined pose anew.
    pub fn lay_out(&self, refined: &mut Refined, layout: &Layout) {
        let mut found = std::mem::take(&mut refined.sites);
        found.clear();
        for (view, sight) in self.sights.iter().enumerate() {
            let state =
                State { pose: &refined.pose, form: refined.form, turn: refined.turns[view] };
            let up = self.query.up;
            sites(&mut found, sight, view, self.model, &state, up, layout);
        }
        refined.sites = found;
    }

    /// One Gauss-Newton step from `moved` on sites in the order of [`by_part`]; turns are held with some
    /// precision (1/rad^2).
    fn solve(
        &self,
        refined: &Refined,
        sites: &[&Site],
        sd_px: f64,
        moved: &Move,
        (doubt, hold): (f64, f64),
    ) -> Option<Solution> {
        let mut equations = Equations::new(self.sights.len(), sd_px, doubt);
        let mut edges = Vec::new();
        for part in sites.chunk_by(|a, b| part_of(a) == part_of(b)) {
            edges.clear();
            for site in part {
                let turn = site.by_turn * moved.own[site.view];
                let shift = (site.by_shared * moved.shared).x + turn.x;
                let lip_shift = site.by_lip * moved.shared[LIP_AT];
                let found = assign(site, shift, lip_shift, sd_px);
                edges.extend(found.map(|(inner, weight, residual)| Edge {
                    site,
                    inner,
                    weight,
                    residual,
                }));
            }
            equations.part(&edges, &refined.offsets);
        }
        for part in refined.patches.chunk_by(|a, b| a.part == b.part) {
            equations.surface(part, &refined.offsets, moved);
        }
        let mut now = refined.without_sites();
        now.apply(moved);
        let (mut a, b) = self.prior(&now);
        (0..3).for_each(|k| a[(k, k)] += hold);
        equations.shared(&a, &b);
        let (residual, by_shared) = self.landmark_residual(&now);
        equations.landmark(&residual, &by_shared, &self.measured);
        for view in 0..self.sights.len() {
            equations.own(view, self.turn_precision(view), &-now.turns[view]);
        }
        equations.solve()
    }

    fn turn_precision(&self, view: usize) -> f64 {
        // An exactly known angle still gets a nanoradian, so that one formula serves.
        self.sights[view].view.turn_sd.max(1e-9).powi(-2)
    }

    /// Residual of the landmark (m), the cameras' turns considered, and the derivative of its place by
    /// the shared unknowns.
    fn landmark_residual(&self, state: &Refined) -> (Vector3<f64>, SMatrix<f64, 3, SHARED>) {
        let lever = state.pose.rotation * self.landmark * state.form.x.exp();
        let centre = state.pose.translation.vector;
        let mut j = SMatrix::<f64, 3, SHARED>::zeros();
        j.fixed_view_mut::<3, 3>(0, 0).copy_from(&-skew(&lever));
        j.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
        j.fixed_view_mut::<3, 1>(0, FORM_AT).copy_from(&lever);
        let turns = self.measured.by_turn.iter().zip(&state.turns);
        let moved: Vector3<f64> = turns.map(|(by_turn, turn)| by_turn * turn).sum();
        (self.query.landmark.position.coords - moved - centre - lever, j)
    }

    /// Information and right-hand side of the pose's tangent, edges aside.
    pub(super) fn known(&self, state: &Refined) -> (Matrix6<f64>, Vector6<f64>) {
        let (a, b) = self.prior(state);
        let (residual, by_shared) = self.landmark_residual(state);
        let whitened = self.measured.whiten * by_shared.fixed_columns::<6>(0);
        (
            a.fixed_view::<6, 6>(0, 0) + whitened.transpose() * whitened,
            b.fixed_rows::<6>(0) + whitened.transpose() * (self.measured.whiten * residual),
        )
    }

    /// Information and right-hand side of gravity and of the form.
    fn prior(&self, state: &Refined) -> (SharedMatrix, SharedVector) {
        let (mut a, mut b) = (SharedMatrix::zeros(), SharedVector::zeros());
        if let Some((turn, held)) = self.tilt(state) {
            let tilts = held / (STANDING_SD * STANDING_SD);
            let mut block = a.fixed_view_mut::<3, 3>(0, 0);
            block += tilts;
            let mut rhs = b.fixed_rows_mut::<3>(0);
            rhs += tilts * turn;
        }
        for (k, (sd, off)) in form_sd().iter().zip(&(state.form - usual())).enumerate() {
            a[(FORM_AT + k, FORM_AT + k)] += sd.powi(-2);
            b[FORM_AT + k] -= off * sd.powi(-2);
        }
        // A solid of revolution says nothing about one turn: it gets a value all the same.
        a += SharedMatrix::identity() * 1e-3;
        (a, b)
    }

    /// What the priors hold against a state (nats): half their squared normalised residuals, and what attitudes
    /// are rare.
    pub(super) fn strain(&self, state: &Refined) -> f64 {
        let landmark = (self.measured.whiten * self.landmark_residual(state).0).norm_squared();
        let form = (state.form - usual()).component_div(&form_sd()).norm_squared();
        let tilt = match self.tilt(state) {
            Some((turn, _)) => (turn.norm() / STANDING_SD).powi(2),
            None if self.query.up.is_some() && self.query.standing.is_none() => 2.0 * UNSUPPORTED,
            None => 0.0,
        };
        let turns: f64 = (0..self.sights.len())
            .map(|v| self.turn_precision(v) * state.turns[v].norm_squared())
            .sum();
        0.5 * (landmark + form + tilt + turns) - self.upright(state)
    }

    /// What speaks for a state because objects are rather upright than upside down (nats).
    fn upright(&self, state: &Refined) -> f64 {
        if self.query.standing.is_some() || self.symmetry == Symmetry::Full {
            return 0.0;
        }
        let axis = state.pose.rotation * Vector3::z();
        let way = match self.query.up {
            Some(up) if axis.dot(&up).abs() < UPRIGHT_FROM => 0.0,
            Some(up) => axis.dot(&up).signum(),
            // Cameras are not upside down either, but which way is level nobody knows.
            None => {
                let pictures_up = -(self.sights[0].view.base_from_optical.rotation * Vector3::y());
                (axis.dot(&pictures_up) / UPRIGHT_FROM).clamp(-1.0, 1.0)
            }
        };
        0.5 * UPRIGHT.ln() * way
    }

    /// The small turn (base frame) that would make the object rest exactly, when it seems to, and a
    /// projection onto the turns that resting keeps it from.
    fn tilt(&self, state: &Refined) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        let (rest, tilt) = self.rest(state)?;
        let turn = state.pose.rotation.to_rotation_matrix();
        Some((tilt, turn * rest.held * turn.inverse()))
    }

    /// How the object rests in a state, when it seems to, and the small turn (base frame) that would make it
    /// rest exactly.
    pub(super) fn rest(&self, state: &Refined) -> Option<(Rest, Vector3<f64>)> {
        let up = self.query.up?.into_inner();
        let turn = state.pose.rotation.to_rotation_matrix();
        let rest = match self.query.standing {
            Some(false) => return None,
            Some(true) => Rest::on(-Vector3::z()),
            None => self.model.rest(&(turn.inverse() * -up)),
        };
        let nearest = turn * -rest.down;
        let tilt = nearest.cross(&up);
        let rests = nearest.dot(&up) > 0.0
            && (tilt.norm() < STANDING_LIMIT || state.rests || self.query.standing == Some(true));
        rests.then_some((rest, tilt))
    }
}

impl Refined {
    /// A pose not yet refined.
    pub fn new(pose: &Transform, rests: bool) -> Self {
        Refined {
            pose: *pose,
            rests,
            form: usual(),
            turns: Default::default(),
            covariance: Matrix6::identity(),
            offsets: Vec::new(),
            sites: Vec::new(),
            patches: Vec::new(),
        }
    }

    pub(super) fn apply(&mut self, moved: &Move) {
        self.pose = perturb(&self.pose, &moved.shared.fixed_rows::<6>(0).into_owned());
        self.form += moved.shared.fixed_rows::<3>(FORM_AT);
        self.turns.iter_mut().zip(&moved.own).for_each(|(turn, step)| *turn += step);
        self.patches.iter_mut().for_each(|p| p.residual = p.left(moved));
    }

    /// How its unknowns have to change to become another's.
    pub(super) fn to(&self, other: &Refined) -> Move {
        let mut moved = Move::default();
        moved.shared.fixed_rows_mut::<6>(0).copy_from(&difference(&self.pose, &other.pose));
        moved.shared.fixed_rows_mut::<3>(FORM_AT).copy_from(&(other.form - self.form));
        let turns = other.turns.iter().zip(&self.turns);
        moved.own.iter_mut().zip(turns).for_each(|(own, (to, from))| *own = to - from);
        moved
    }

    /// The unknowns alone.
    pub(super) fn without_sites(&self) -> Self {
        Refined { sites: Vec::new(), offsets: Vec::new(), patches: Vec::new(), ..*self }
    }
}

/// What the form is expected to be, and by how much it deviates.
fn usual() -> Form {
    Form::new(0.0, 0.0, LIP)
}

fn form_sd() -> Form {
    Form::new(SIZE_SD, SWELL_SD_PX, LIP_SD)
}

/// Edges further off than this many deviations have no say.
const FAR: f64 = 8.0;

/// Measurements of a site whose contour has moved by `shift`, the inner edge of its lip by another
/// `lip_shift`: for either edge whether it is the inner one, weight (1/px^2) and mean residual (px).
fn assign(
    site: &Site,
    shift: f64,
    lip_shift: f64,
    sd: f64,
) -> impl Iterator<Item = (bool, f64, f64)> {
    let common = site.offset_sd() * site.px_per_metre;
    let missing = absence(site);
    let edges = if site.inner.is_some() { 2.0 } else { 1.0 };
    let density = (1.0 - missing) / (edges * (2.0 * std::f64::consts::PI).sqrt());
    // Likelihood, its weighted residual and its weight, for either edge.
    let mut sums = [[0.0; 3]; 2];
    for (place, inner) in site.places() {
        let sum = &mut sums[usize::from(inner)];
        let place = if inner { place + lip_shift } else { place };
        for c in site.edges() {
            let r = c.offset - place - shift;
            let local = sd * sd + c.noise_px * c.noise_px;
            let total = local + common * common;
            if r * r > FAR * FAR * total {
                continue;
            }
            let likelihood = density * c.weight * (-0.5 * r * r / total).exp() / total.sqrt();
            let weight = likelihood * sd * sd / local;
            sum[0] += likelihood;
            sum[1] += weight * r;
            sum[2] += weight;
        }
    }
    let total = sums[0][0] + sums[1][0] + missing * STRAY_DENSITY;
    let scale = (site.length / CORRELATION_PX).min(1.0) / total;
    [false, true]
        .into_iter()
        .zip(sums)
        .filter(|(_, sum)| sum[0] > 0.0)
        .map(move |(inner, [_, moment, weight])| (inner, scale * weight, moment / weight))
}
