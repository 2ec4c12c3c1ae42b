//! Normal equations of the refinement, with errors that sites have in common.
//!
//! **In:** weighted residuals of contour sites and of print with their derivatives, and priors. **Out:** the
//! step of all unknowns and the pose's covariance.
//!
//! Sites along one edge do not err independently. A rounded or bent edge, a shadow, a lamp on one
//! side move the whole edge, and both cameras see nearly the same of it. So every part of the body
//! has unknown offset and tilt on the object that all views share, every short piece of it another
//! offset, and every view sees the part with an offset of its own. All have priors and are
//! eliminated (Schur complement) before the rest is solved. What is left of a long edge is about one
//! number for where it lies, however many pixels it has; and what the cameras agree about (how far
//! away the edge is) is known better than where on the object the edge is.
//!
//! Two variances are estimated on the way: the scatter of a part's edges in a view (print, clutter
//! and noise make some edges far worse than others), and the offsets of a part (heavy tails, as of a
//! Student's t: a part that is seen to be far off may well be, on the object or in one view only,
//! where a shadow or another object ends beside it).

use multiversion::multiversion;
use nalgebra::{Cholesky, Const, Matrix6, RowVector2, SMatrix, SVector, Vector2, Vector3};

use super::landmark::Landmark;
use super::print::{BETWEEN_TAIL, Patch, SLOPE_SD, SQUARE_TAIL};
use super::sites::{ByShared, LIP_AT, SHARED, Site};

/// Unknowns of each view: small turns of its camera.
const OWN: usize = 2;
/// Views at most: what has a fixed size is fast.
pub(super) const VIEWS: usize = 2;
/// All unknowns, and those of one part: its offset and tilt (m), its offset in each view (px).
const ALL: usize = SHARED + OWN * VIEWS;
const PART: usize = 2 + VIEWS;
const WITH_PART: usize = ALL + PART;
/// The same in whole vectors of so many lanes.
const LANES: usize = 4;
const PADDED: usize = WITH_PART.next_multiple_of(LANES);

/// Length of a piece (m), and the deviation of its offset from its part's (m): dents, print.
const PIECE: f64 = 0.015;
const PIECE_SD: f64 = 0.0003;
/// Deviation of a part's ends from its direction on the object (m).
const TILT_SD: f64 = 0.0005;
/// Deviation of what one view sees of a part from what all see (px): at least this, and this share
/// of the scatter of its edges.
const VIEW_SD_PX: f64 = 0.05;
const SCATTER_SHARE: f64 = 0.3;
/// Independent sites that the expected scatter of a part's edges counts for.
const SCATTER_PRIOR: f64 = 1.5;
/// Degrees of freedom of the parts' offsets.
pub(super) const OFFSET_TAIL: f64 = 2.0;
/// The same of what one view sees beside that.
const VIEW_TAIL: f64 = 3.0;

/// Surfaces are told from other parts by this.
const SURFACES: u32 = 1 << 20;

/// Changes of the unknowns.
#[derive(Clone, Default)]
pub(super) struct Move {
    /// Of those all views share.
    pub shared: SVector<f64, SHARED>,
    /// Of each view's own.
    pub own: [Vector2<f64>; VIEWS],
}

/// One measurement of a site.
pub(super) struct Edge<'a> {
    /// The site.
    pub site: &'a Site,
    /// It is the inner edge of the lip.
    pub inner: bool,
    /// Against a site with one edge of good contrast: how many measurements it counts for.
    pub weight: f64,
    /// How far off it is (px).
    pub residual: f64,
}

/// Sites in the order in which they share errors: by [`part_of`], piece and view.
pub(super) fn by_part(sites: &[Site]) -> Vec<&Site> {
    let mut sorted: Vec<(u64, &Site)> = sites.iter().map(|s| (order(s), s)).collect();
    // Stable: sites come along the contour of one view after the other.
    sorted.sort_by_key(|s| s.0);
    sorted.into_iter().map(|s| s.1).collect()
}

fn order(site: &Site) -> u64 {
    u64::from(part_of(site)) << 40 | u64::from(piece_of(site)) << 8 | site.view as u64
}

/// Which piece of its part a site is in.
fn piece_of(site: &Site) -> u32 {
    (site.along / PIECE) as u32
}

/// Part, kind and whether it is in contact: what errs together.
pub(super) fn part_of(site: &Site) -> u32 {
    8 * u32::from(site.part) + 2 * site.kind as u32 + u32::from(site.contact)
}

/// Normal equations while they are summed: of all unknowns, then of one part's own.
struct Sums {
    /// From the diagonal's vector of lanes on: the rest is the same.
    a: [[f64; PADDED]; PADDED],
    b: [f64; PADDED],
}

/// A part's own unknowns, each by the unknowns before it: offset (m), tilt (m at its ends), offset in
/// each view (px).
struct Eliminated {
    part: u32,
    rows: [[f64; PADDED]; PART],
    rhs: [f64; PART],
}

/// The equations while they are built.
pub(super) struct Equations {
    sd_px: f64,
    doubt: f64,
    sums: Sums,
    parts: Vec<Eliminated>,
}

impl Equations {
    /// No measurement yet. `sd_px` is how well edges fit at this stage; `doubt` multiplies the
    /// deviations of all that sites have in common.
    pub fn new(views: usize, sd_px: f64, doubt: f64) -> Self {
        let mut sums = Sums::new();
        // Views that are not there keep their place; their unknowns stay zero.
        for k in SHARED + OWN * views..ALL {
            sums.a[k][k] = 1.0;
        }
        Equations { sd_px, doubt, sums, parts: Vec::with_capacity(16) }
    }

    /// Adds the measurements of one part, by piece and view, without what only the part's own offsets
    /// explain. `offsets` are the parts' offsets as last seen.
    pub fn part(&mut self, edges: &[Edge], offsets: &[Offsets]) {
        let Some(first) = edges.first() else { return };
        let part = part_of(first.site);
        let seen = seen(offsets, part);
        let scatter = scatter(edges, self.sd_px);
        let shared = tailed(first.site.offset_sd().powi(2), seen.shared, OFFSET_TAIL);
        let own = |v: usize| {
            let view = VIEW_SD_PX * VIEW_SD_PX + SCATTER_SHARE * SCATTER_SHARE * scatter[v];
            tailed(view, seen.own_px[v], VIEW_TAIL)
        };
        let doubt = self.doubt * self.doubt;
        let priors = std::array::from_fn(|k| match k {
            0 => (doubt * shared).recip(),
            1 => (doubt * TILT_SD * TILT_SD).recip(),
            v => (doubt * own(v - 2)).recip(),
        });
        let pieces = (self.doubt * PIECE_SD).powi(-2);
        let (rows, rhs) = add_part(&mut self.sums, edges, &scatter, pieces, &priors);
        self.parts.push(Eliminated { part, rows, rhs });
    }

    /// Adds the print of one surface, without what only the surface's own place explains. `moved` is how
    /// far the unknowns are from where its residuals were measured.
    pub fn surface(&mut self, patches: &[Patch], offsets: &[Offsets], moved: &Move) {
        let Some(first) = patches.first() else { return };
        let part = SURFACES | u32::from(first.part);
        let seen = seen(offsets, part);
        let doubt = self.doubt * self.doubt;
        let trust = first.trust();
        let shared = tailed(trust.surface_sd.powi(2), seen.shared, trust.surface_tail);
        let slope = SLOPE_SD * SLOPE_SD;
        let between = tailed(trust.between_sd_px.powi(2), seen.own_px[0], BETWEEN_TAIL);
        let mut sums = Sums::new();
        // In place of a part's tilt and of its offset in a view a surface has slopes and what the views
        // differ by.
        let priors = [shared, slope, between, slope];
        (ALL..).zip(priors).for_each(|(k, variance)| sums.a[k][k] = (doubt * variance).recip());
        for patch in patches {
            let mut by = by_all(&patch.by_shared, &patch.by_turn);
            let own = [patch.by_surface, patch.by_slope.x, 1.0, patch.by_slope.y];
            by[ALL..WITH_PART].copy_from_slice(&own);
            let residual = patch.left(moved);
            let left = residual - patch.by_surface * seen.shared - seen.own_px[0];
            // Heavy tails: gloss, and what stands before the object in one view.
            let variance = tailed(patch.noise_px * patch.noise_px, left, SQUARE_TAIL);
            sums.add(patch.worth / variance, residual, &by);
        }
        let (rows, rhs) = absorb(&mut self.sums, sums);
        self.parts.push(Eliminated { part, rows, rhs });
    }

    /// Adds information about the shared unknowns.
    pub fn shared(&mut self, a: &SMatrix<f64, SHARED, SHARED>, b: &SVector<f64, SHARED>) {
        for i in 0..SHARED {
            (i..SHARED).for_each(|j| self.sums.a[i][j] += a[(i, j)]);
            self.sums.b[i] += b[i];
        }
    }

    /// Adds a prior on a view's turns: their precision and what is missing to zero.
    pub fn own(&mut self, view: usize, precision: f64, missing: &Vector2<f64>) {
        let at = SHARED + OWN * view;
        for k in 0..OWN {
            self.sums.a[at + k][at + k] += precision;
            self.sums.b[at + k] += precision * missing[k];
        }
    }

    /// Adds the landmark: how far it is from its place (m), and how its place depends on the shared
    /// unknowns.
    pub fn landmark(
        &mut self,
        residual: &Vector3<f64>,
        by_shared: &SMatrix<f64, 3, SHARED>,
        measured: &Landmark,
    ) {
        let (residual, by_shared) = (measured.whiten * residual, measured.whiten * by_shared);
        let by_turn = measured.by_turn.map(|by_turn| measured.whiten * by_turn);
        for k in 0..3 {
            let by_turn = by_turn.map(|by_turn| by_turn.row(k).into_owned());
            let by = by_all(&by_shared.row(k).into_owned(), &by_turn);
            self.sums.add(1.0, residual[k], &by);
        }
    }

    /// The solution; `None` when it is not determined.
    pub fn solve(self) -> Option<Solution> {
        let above = |i: usize, j: usize| self.sums.a[i.min(j)][i.max(j)];
        let factor = SMatrix::<f64, ALL, ALL>::from_fn(above).cholesky()?;
        let x = factor.solve(&SVector::<f64, ALL>::from_column_slice(&self.sums.b[..ALL]));
        let own = |v| x.fixed_rows::<OWN>(SHARED + OWN * v).into_owned();
        let shared = x.fixed_rows::<SHARED>(0).into_owned();
        let step = Move { shared, own: std::array::from_fn(own) };
        let mut known = [0.0; WITH_PART];
        known[..ALL].copy_from_slice(x.as_slice());
        let offsets = self.parts.iter().map(|part| part.offsets(&mut known)).collect();
        Some(Solution { step, offsets, factor })
    }
}

impl Sums {
    fn new() -> Self {
        Sums { a: [[0.0; PADDED]; PADDED], b: [0.0; PADDED] }
    }

    /// Adds a measurement with its derivatives.
    #[inline(always)]
    fn add(&mut self, weight: f64, residual: f64, by: &[f64; PADDED]) {
        add_outer(&mut self.a, weight, by);
        add(&mut self.b, weight * residual, by);
    }

    /// Eliminates an unknown that no later one is left of: its row and right-hand side.
    #[inline(always)]
    fn eliminate(&mut self, k: usize) -> ([f64; PADDED], f64) {
        let row = std::array::from_fn(|i| if i <= k { self.a[i][k] } else { 0.0 });
        let rhs = self.b[k];
        self.add(-row[k].recip(), rhs, &row);
        (row, rhs)
    }
}

impl Eliminated {
    /// The part's own unknowns, put behind those that are known.
    fn offsets(&self, known: &mut [f64; WITH_PART]) -> Offsets {
        for (k, (row, rhs)) in (ALL..).zip(self.rows.iter().zip(self.rhs)) {
            let explained: f64 = row[..k].iter().zip(&known[..k]).map(|(a, x)| a * x).sum();
            known[k] = (rhs - explained) / row[k];
        }
        let own_px = std::array::from_fn(|v| known[ALL + 2 + v]);
        Offsets { part: self.part, shared: known[ALL], own_px }
    }
}

/// Derivatives by all unknowns, of a measurement in which both views have a part.
fn by_all(by_shared: &ByShared, by_turn: &[RowVector2<f64>; VIEWS]) -> [f64; PADDED] {
    let mut by = [0.0; PADDED];
    by.iter_mut().zip(by_shared).for_each(|(b, j)| *b = *j);
    for (own, by_turn) in by[SHARED..].chunks_mut(OWN).zip(by_turn) {
        own.iter_mut().zip(by_turn).for_each(|(b, j)| *b = *j);
    }
    by
}

/// A part's offsets as last seen.
fn seen(offsets: &[Offsets], part: u32) -> Offsets {
    offsets.iter().find(|o| o.part == part).copied().unwrap_or_default()
}

/// Variance of what has heavy tails, a Student's t of so many degrees of freedom, once it was seen to be
/// off by so much: by much is less surprising then. With infinitely many it is Gaussian.
fn tailed(variance: f64, seen: f64, tail: f64) -> f64 {
    variance + (seen * seen - variance) / (tail + 1.0)
}

/// Variance of a part's edges in each view about their mean (px^2).
fn scatter(edges: &[Edge], sd_px: f64) -> [f64; VIEWS] {
    // Weight, weighted residual and square.
    let mut sums = [[0.0; 3]; VIEWS];
    for e in edges {
        let sum = &mut sums[e.site.view];
        sum[0] += e.weight;
        sum[1] += e.weight * e.residual;
        sum[2] += e.weight * e.residual * e.residual;
    }
    let usual = sd_px * sd_px;
    sums.map(|[weight, moment, square]| {
        let about_mean = (square - moment * moment / weight.max(f64::MIN_POSITIVE)).max(0.0);
        (SCATTER_PRIOR * usual + about_mean) / (SCATTER_PRIOR + weight)
    })
}

/// Adds a part's edges to the equations of all unknowns: the pieces' offsets (of that precision,
/// 1/m^2) are eliminated, then the part's own unknowns with their priors, of which rows and right-hand
/// sides are returned.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn add_part(
    total: &mut Sums,
    edges: &[Edge],
    scatter: &[f64; VIEWS],
    precision: f64,
    priors: &[f64; PART],
) -> ([[f64; PADDED]; PART], [f64; PART]) {
    let mut sums = Sums::new();
    for (k, prior) in (ALL..).zip(priors) {
        sums.a[k][k] = *prior;
    }
    let at = |e: &Edge| piece_of(e.site);
    let (first, last) = (at(&edges[0]), at(&edges[edges.len() - 1]));
    for piece in edges.chunk_by(|a, b| at(a) == at(b)) {
        // From -1 to 1 along the part.
        let place = f64::from(2 * (at(&piece[0]) - first)) / f64::from((last - first).max(1));
        let place = if last > first { place - 1.0 } else { 0.0 };
        let mut of_piece = [0.0; PADDED];
        let (mut information, mut moment) = (0.0, 0.0);
        for view in piece.chunk_by(|a, b| a.site.view == b.site.view) {
            // The mean edge of the piece in this view.
            let v = view[0].site.view;
            let mut of_site = [0.0; PADDED];
            let (mut weight, mut residual, mut turn) = (0.0, 0.0, [0.0; OWN]);
            for e in view {
                let by_shared = e.site.by_shared.iter();
                of_site.iter_mut().zip(by_shared).for_each(|(o, j)| *o += e.weight * j);
                if e.inner {
                    of_site[LIP_AT] += e.weight * e.site.by_lip;
                }
                turn.iter_mut().zip(e.site.by_turn.iter()).for_each(|(o, j)| *o += e.weight * j);
                weight += e.weight;
                residual += e.weight * e.residual;
            }
            let each = weight.recip();
            residual *= each;
            of_site[SHARED + OWN * v..][..OWN].copy_from_slice(&turn);
            of_site.iter_mut().for_each(|o| *o *= each);
            let scale = view[0].site.px_per_metre;
            of_site[ALL] = scale;
            of_site[ALL + 1] = scale * place;
            of_site[ALL + 2 + v] = 1.0;
            let weight = weight / scatter[v];
            sums.add(weight, residual, &of_site);
            add(&mut of_piece, weight * scale, &of_site);
            information += weight * scale * scale;
            moment += weight * scale * residual;
        }
        sums.add(-1.0 / (information + precision), moment, &of_piece);
    }
    absorb(total, sums)
}

/// Adds a part's sums to those of all unknowns, its own unknowns eliminated: their rows and right-hand
/// sides.
#[inline(always)]
fn absorb(total: &mut Sums, mut sums: Sums) -> ([[f64; PADDED]; PART], [f64; PART]) {
    let (mut rows, mut rhs) = ([[0.0; PADDED]; PART], [0.0; PART]);
    for k in (0..PART).rev() {
        (rows[k], rhs[k]) = sums.eliminate(ALL + k);
    }
    for (total, row) in total.a.iter_mut().zip(&sums.a) {
        add(total, 1.0, row);
    }
    add(&mut total.b, 1.0, &sums.b);
    (rows, rhs)
}

/// Adds `scale v`.
#[inline(always)]
fn add(to: &mut [f64; PADDED], scale: f64, v: &[f64; PADDED]) {
    to.iter_mut().zip(v).for_each(|(t, v)| *t += scale * v);
}

/// Adds `weight v v'`, from the diagonal's lanes on: the rest is the same.
#[inline(always)]
fn add_outer(a: &mut [[f64; PADDED]; PADDED], weight: f64, v: &[f64; PADDED]) {
    const { assert!(PADDED == 5 * LANES, "one line for the rows of each vector") };
    add_rows::<0>(a, weight, v);
    add_rows::<1>(a, weight, v);
    add_rows::<2>(a, weight, v);
    add_rows::<3>(a, weight, v);
    add_rows::<4>(a, weight, v);
}

/// [`add_outer`] of the rows of one vector: loops of fixed length become a few vector operations.
#[inline(always)]
fn add_rows<const AT: usize>(a: &mut [[f64; PADDED]; PADDED], weight: f64, v: &[f64; PADDED]) {
    let from = AT * LANES;
    for i in from..from + LANES {
        let w = weight * v[i];
        for j in from..PADDED {
            a[i][j] += w * v[j];
        }
    }
}

/// How far off the edges of a part are.
#[derive(Debug, Clone, Copy, Default)]
pub struct Offsets {
    /// Part and kind.
    part: u32,
    /// In all views, on the object (m).
    shared: f64,
    /// In each view beside that (px).
    own_px: [f64; VIEWS],
}

/// What the equations give.
pub(super) struct Solution {
    /// Changes of the unknowns.
    pub step: Move,
    /// How far off the parts are.
    pub offsets: Vec<Offsets>,
    factor: Cholesky<f64, Const<ALL>>,
}

impl Solution {
    /// Covariance of the pose's tangent.
    pub fn covariance(&self) -> Matrix6<f64> {
        let unit = SMatrix::<f64, ALL, 6>::identity();
        self.factor.solve(&unit).fixed_view::<6, 6>(0, 0).into_owned()
    }
}
