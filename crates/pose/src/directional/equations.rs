//! Normal equations of the refinement, with errors that sites have in common.
//!
//! **In:** weighted residuals of contour sites with their derivatives, and priors. **Out:** the
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
use nalgebra::{Matrix4, Matrix6, SMatrix, SVector, Vector2, Vector4};

use super::sites::{LIP_AT, SHARED, Site};

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

/// Changes of the unknowns.
#[derive(Clone)]
pub(super) struct Move {
    /// Of those all views share.
    pub shared: SVector<f64, SHARED>,
    /// Of each view's own.
    pub own: Vec<Vector2<f64>>,
}

impl Move {
    /// None at all.
    pub fn none(views: usize) -> Self {
        Move { shared: SVector::zeros(), own: vec![Vector2::zeros(); views] }
    }
}

/// One measurement of a site.
pub(super) struct Edge<'a> {
    /// The site.
    pub site: &'a Site,
    /// It is the inner edge of the lip.
    pub inner: bool,
    /// Against a site with one edge of good contrast.
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

/// Part and kind: what errs together.
pub(super) fn part_of(site: &Site) -> u32 {
    3 * u32::from(site.part) + site.kind as u32
}

/// A part's own unknowns once those of the others are: offset (m), tilt (m at its ends), offset in
/// each view (px).
struct Eliminated {
    part: u32,
    inverse: Matrix4<f64>,
    mixed: SMatrix<f64, ALL, PART>,
    rhs: Vector4<f64>,
}

/// The equations while they are built.
pub(super) struct Equations {
    views: usize,
    sd_px: f64,
    doubt: f64,
    a: SMatrix<f64, ALL, ALL>,
    b: SVector<f64, ALL>,
    parts: Vec<Eliminated>,
}

impl Equations {
    /// No measurement yet. `sd_px` is how well edges fit at this stage; `doubt` multiplies the
    /// deviations of all that sites have in common.
    pub fn new(views: usize, sd_px: f64, doubt: f64) -> Self {
        let mut a = SMatrix::zeros();
        // Views that are not there keep their place; their unknowns stay zero.
        for k in SHARED + OWN * views..ALL {
            a[(k, k)] = 1.0;
        }
        let b = SVector::zeros();
        Equations { views, sd_px, doubt, a, b, parts: Vec::new() }
    }

    /// Adds the measurements of one part, by piece and view, without what only the part's own offsets
    /// explain. `offsets` are the parts' offsets as last seen.
    pub fn part(&mut self, edges: &[Edge], offsets: &[Offsets]) {
        let Some(part) = edges.first().map(|e| part_of(e.site)) else { return };
        let seen = offsets.iter().find(|o| o.part == part).copied().unwrap_or_default();
        let scatter = scatter(edges, self.sd_px);
        let (a, b) = normal_equations(edges, &scatter, (self.doubt * PIECE_SD).powi(-2));
        // Heavy tails: a part that was seen to be off by much may well be off by much.
        let tailed =
            |variance: f64, seen: f64, tail: f64| (tail * variance + seen * seen) / (tail + 1.0);
        let variance = tailed(edges[0].site.offset_sd().powi(2), seen.shared, OFFSET_TAIL);
        let doubt = self.doubt * self.doubt;
        let mut inner = a.fixed_view::<PART, PART>(ALL, ALL).into_owned();
        inner[(0, 0)] += (doubt * variance).recip();
        inner[(1, 1)] += (doubt * TILT_SD * TILT_SD).recip();
        for (v, scatter) in scatter.iter().enumerate() {
            let view = VIEW_SD_PX * VIEW_SD_PX + SCATTER_SHARE * SCATTER_SHARE * scatter;
            let view = tailed(view, seen.own_px[v], VIEW_TAIL);
            inner[(2 + v, 2 + v)] += (doubt * view).recip();
        }
        let Some(inverse) = inner.try_inverse() else { return };
        let mixed = a.fixed_view::<ALL, PART>(0, ALL).into_owned();
        let rhs = b.fixed_rows::<PART>(ALL).into_owned();
        let lost = mixed * inverse;
        self.a += a.fixed_view::<ALL, ALL>(0, 0) - lost * mixed.transpose();
        self.b += b.fixed_rows::<ALL>(0) - lost * rhs;
        self.parts.push(Eliminated { part, inverse, mixed, rhs });
    }

    fn add(
        &mut self,
        view: usize,
        js: &SVector<f64, SHARED>,
        jo: &Vector2<f64>,
        weight: f64,
        residual: f64,
    ) {
        let at = SHARED + OWN * view;
        let mut by = SVector::<f64, ALL>::zeros();
        by.fixed_rows_mut::<SHARED>(0).copy_from(js);
        by.fixed_rows_mut::<OWN>(at).copy_from(jo);
        self.a.ger(weight, &by, &by, 1.0);
        self.b.axpy(weight * residual, &by, 1.0);
    }

    /// Adds information about the shared unknowns.
    pub fn shared(&mut self, a: &SMatrix<f64, SHARED, SHARED>, b: &SVector<f64, SHARED>) {
        let mut block = self.a.fixed_view_mut::<SHARED, SHARED>(0, 0);
        block += a;
        let mut rhs = self.b.fixed_rows_mut::<SHARED>(0);
        rhs += b;
    }

    /// Adds a prior on a view's turns: their precision and what is missing to zero.
    pub fn own(&mut self, view: usize, precision: f64, missing: &Vector2<f64>) {
        let at = SHARED + OWN * view;
        for k in 0..OWN {
            self.a[(at + k, at + k)] += precision;
            self.b[at + k] += precision * missing[k];
        }
    }

    /// Adds a measured pixel.
    pub fn pixel(
        &mut self,
        view: usize,
        by_shared: &SMatrix<f64, 2, SHARED>,
        by_own: &SMatrix<f64, 2, OWN>,
        weight: f64,
        residual: &Vector2<f64>,
    ) {
        for k in 0..2 {
            let (js, jo) = (by_shared.row(k).transpose(), by_own.row(k).transpose());
            self.add(view, &js, &jo, weight, residual[k]);
        }
    }

    /// The solution; `None` when it is not determined.
    pub fn solve(self) -> Option<Solution> {
        let factor = self.a.cholesky()?;
        let x = factor.solve(&self.b);
        let unit = SMatrix::<f64, ALL, 6>::identity();
        let covariance = factor.solve(&unit).fixed_view::<6, 6>(0, 0).into_owned();
        let own = (0..self.views).map(|v| x.fixed_rows::<OWN>(SHARED + OWN * v).into_owned());
        let step = Move { shared: x.fixed_rows::<SHARED>(0).into_owned(), own: own.collect() };
        let offsets = self.parts.iter().map(|p| {
            let own = p.inverse * (p.rhs - p.mixed.tr_mul(&x));
            Offsets { part: p.part, shared: own[0], own_px: std::array::from_fn(|v| own[2 + v]) }
        });
        let offsets = offsets.collect();
        Some(Solution { step, covariance, offsets })
    }
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

/// Normal equations of a part's edges for all unknowns and the part's own, the pieces' offsets
/// (of that precision, 1/m^2) eliminated.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn normal_equations(
    edges: &[Edge],
    scatter: &[f64; VIEWS],
    precision: f64,
) -> (SMatrix<f64, WITH_PART, WITH_PART>, SVector<f64, WITH_PART>) {
    let mut a = [[0.0; PADDED]; PADDED];
    let mut b = [0.0; PADDED];
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
            add_outer(&mut a, weight, &of_site);
            add(&mut b, weight * residual, &of_site);
            add(&mut of_piece, weight * scale, &of_site);
            information += weight * scale * scale;
            moment += weight * scale * residual;
        }
        let share = 1.0 / (information + precision);
        add_outer(&mut a, -share, &of_piece);
        add(&mut b, -share * moment, &of_piece);
    }
    let mut whole = SMatrix::<f64, WITH_PART, WITH_PART>::zeros();
    for (i, column) in whole.as_mut_slice().chunks_exact_mut(WITH_PART).enumerate() {
        column.copy_from_slice(&a[i][..WITH_PART]);
        let above = &a[..i / LANES * LANES];
        column.iter_mut().zip(above).for_each(|(c, row)| *c = row[i]);
    }
    (whole, SVector::from_column_slice(&b[..WITH_PART]))
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
    /// Covariance of the pose's tangent.
    pub covariance: Matrix6<f64>,
    /// How far off the parts are.
    pub offsets: Vec<Offsets>,
}
