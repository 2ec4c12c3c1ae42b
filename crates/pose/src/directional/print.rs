//! Print that both views see, on the object's surface and on what it rests on.
//!
//! **In:** a pose, the model, two prepared views. **Out:** [`Patch`]es: small squares of the first
//! picture, carried over to the second by the surface that the pose puts there ([`pair`]), and how far
//! from that place the second picture shows the same print. An outline says how far away an object is by
//! where it ends, which a rounded edge, a shadow or a lamp at one side move; print has no such faults, it
//! is as far away as the surface that it is on. Which print it is nobody needs to know.
//!
//! An object that rests has the plane that it rests on in contact with it. The grain of a table top, its
//! seams and the shadows on it show how high that plane is to a fraction of a millimetre, there is more
//! of it than of the object, and it is there for plain objects too. How high the object is says how far
//! away it is, as a camera looks down on it.
//!
//! Only the shift along the epipolar line is measured: it is what depth is in. The surface's curve
//! within a square is followed to second order, without which a can seems to be millimetres further
//! away than it is. A slope of brightness across the square belongs to lamp and shading, not to print,
//! and is taken out of both; so is their contrast ([`square`]).

mod pair;
mod square;
#[cfg(test)]
mod tests;

use std::f64::consts::PI;
use std::ops::Range;

use nalgebra::{Matrix6, Point2, RowVector2, RowVector6};

use super::equations::{Move, VIEWS};
use super::level::Level;
use super::refine::Refined;
use super::search::Search;
use super::sites::{ByShared, Site};
use super::verdict::Explained;
use pair::{Pair, pixel_of};
use square::{Needs, find, print_at};

/// What the object rests on, as one of its surfaces.
const GROUND: u16 = u16::MAX;

/// How squares are laid on a surface.
struct Sampling {
    /// They are of 15 pixels' side, not of 7.
    large: bool,
    /// Distance from square to square (px), times the working scale: large objects have enough of them.
    step: usize,
    /// Squares that there must be.
    least: usize,
    /// How many measurements a square is worth, as squares overlap.
    worth: f64,
    /// What a square needs to be found.
    needs: Needs,
}

/// On the object. Fewer squares are a highlight, or the shadow of a handle.
const ON_OBJECT: Sampling = Sampling {
    large: false,
    step: 2,
    least: 4,
    worth: 0.15,
    needs: Needs { contrast: 2.0, correlation: 0.8 },
};
/// On what the object rests on, one after the other until there are squares. It is large, so each may say
/// little; of what noise hides from small squares large ones see more.
const ON_GROUND: [Sampling; 2] = [
    Sampling {
        large: false,
        step: 4,
        least: 16,
        worth: 0.5,
        needs: Needs { contrast: 1.5, correlation: 0.65 },
    },
    Sampling {
        large: true,
        step: 6,
        least: 24,
        worth: 0.25,
        needs: Needs { contrast: 1.0, correlation: 0.5 },
    },
];

/// How well a surface is known before it is seen.
pub(super) struct Trust {
    /// Deviation of the whole surface from where the record has it (m), and its degrees of freedom.
    pub surface_sd: f64,
    /// See `surface_sd`.
    pub surface_tail: f64,
    /// Deviation of where one view sees its print from where the other does (px), with heavy tails.
    pub between_sd_px: f64,
}

/// The object's surfaces: sides bulge, labels stand off.
const OF_OBJECT: Trust =
    Trust { surface_sd: 0.0004, surface_tail: f64::INFINITY, between_sd_px: 0.06 };
/// What the object rests on: feet and bent bottoms lift it a little, a coaster or a hand by more.
const OF_GROUND: Trust = Trust { surface_sd: 0.0004, surface_tail: 1.0, between_sd_px: 0.03 };

/// Deviation of the ground's slopes against the object (rad); the object's own surfaces have none.
pub(super) const SLOPE_SD: f64 = 0.003;
/// Degrees of freedom of what the views differ by about a surface, and of a square's shift.
pub(super) const BETWEEN_TAIL: f64 = 3.0;
pub(super) const SQUARE_TAIL: f64 = 3.0;

/// Squares of the ground that are enough for a pose: what the views differ by matters more than noise then.
pub(super) const ENOUGH: usize = 100;
/// Squares of the ground that are further than this from the middle one's level (px, and in deviations of
/// their noise) are on other things.
const LEVEL_PX: f64 = 0.2;
const LEVEL_SD: f64 = 3.0;
/// Poses that are less behind than this (nats) are told apart by what they rest on.
const RIVALS: f64 = 12.0;
/// Chance that an object rests on something else than the plane about it that both views see, and the
/// power with which fewer squares speak against a plane: by chance, some are found in a wrong one.
const ELSEWHERE: f64 = 0.03;
const FEWER: f64 = 3.0;
/// Gaps between an object and that plane where it does not rest on it are spread over so much (m), and the
/// share of the variance that edges claim that is the core of what they are off by: the rest is for tails.
const GAPS: f64 = 0.01;
const CORE: f64 = 0.2;

/// A square of print seen by both views.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    /// Its middle in the first picture.
    pub pixel: Point2<f64>,
    /// Which surface of the object it is on.
    pub part: u16,
    /// How far along the epipolar line of the second view it is from where the pose puts it (px).
    pub residual: f64,
    /// Deviation of that by noise (px).
    pub noise_px: f64,
    /// How many measurements it is worth: squares overlap.
    pub worth: f64,
    /// Shift by the surface along its own normal (px per m).
    pub by_surface: f64,
    /// Shift by the shared unknowns (px per unit).
    pub by_shared: ByShared,
    /// Shift by slopes of what the object rests on against the object, in two directions (px per rad).
    pub by_slope: RowVector2<f64>,
    /// Shift by small turns of each camera about its own x and y axes (px per rad).
    pub by_turn: [RowVector2<f64>; VIEWS],
}

impl Patch {
    /// It is on what the object rests on.
    pub fn on_ground(&self) -> bool {
        self.part == GROUND
    }

    /// How well its surface is known.
    pub(super) fn trust(&self) -> &'static Trust {
        if self.on_ground() { &OF_GROUND } else { &OF_OBJECT }
    }

    /// What is left of the residual (px) when the unknowns have moved.
    pub(super) fn left(&self, moved: &Move) -> f64 {
        let turns = self.by_turn.iter().zip(&moved.own).map(|(by, turn)| (by * turn).x);
        self.residual - (self.by_shared * moved.shared).x - turns.sum::<f64>()
    }

    /// The square as seen from where the unknowns have moved to.
    pub(super) fn after(&self, moved: &Move) -> Self {
        Patch { residual: self.left(moved), ..self.clone() }
    }
}

impl Search<'_> {
    /// The squares of print that both views show of a refined object.
    pub(super) fn print(&self, refined: &Refined) -> Vec<Patch> {
        let within = extent(&refined.sites);
        let pair = Pair::new(self, refined);
        pair.map_or_else(Vec::new, |pair| squares(&pair, within, &ON_OBJECT, false, usize::MAX))
    }

    /// The squares of what each of some refined poses seems to rest on, all of them or so many as are
    /// enough: of the first sampling by which any pose has some, so that they can be compared.
    pub(super) fn grounds(&self, poses: &[&Refined], enough: usize) -> Vec<Vec<Patch>> {
        let by = |s| poses.iter().map(|p| self.ground(p, s, enough)).collect::<Vec<_>>();
        let found = ON_GROUND.iter().map(by).find(|seen| seen.iter().any(|g| !g.is_empty()));
        found.unwrap_or_else(|| vec![Vec::new(); poses.len()])
    }

    fn ground(&self, refined: &Refined, sampling: &Sampling, enough: usize) -> Vec<Patch> {
        let everywhere = [0.0..f64::INFINITY, 0.0..f64::INFINITY];
        let pair = Pair::new(self, refined).filter(Pair::rests);
        pair.map_or_else(Vec::new, |pair| squares(&pair, everywhere, sampling, true, enough))
    }

    /// Of poses that differ, best first, those that do not rest where the ground is lose evidence: a box on
    /// another side would have its landmark at another height. Best first again.
    pub(super) fn heed_ground(&self, different: &mut [(Refined, Explained)]) {
        let best = different.first().map_or(0.0, |d| d.1.evidence);
        let rivals = different.iter().filter(|d| best - d.1.evidence < RIVALS).count();
        // The landmark is always as high above the ground on an object that is known to stand.
        if rivals < 2 || self.query.standing == Some(true) {
            return;
        }
        // All squares: that a pose has more of them than another is what tells.
        let poses: Vec<&Refined> = different[..rivals].iter().map(|d| &d.0).collect();
        let told = supported(&self.grounds(&poses, usize::MAX));
        different.iter_mut().zip(told).for_each(|(d, told)| d.1.evidence += told);
        different.sort_by(|a, b| b.1.evidence.total_cmp(&a.1.evidence));
    }
}

/// Squares in some columns and rows of the first picture, of the ground or of everything else: of every other
/// column and row first, then of those between, until there are enough, or so few that there will not be the
/// least.
fn squares(
    pair: &Pair,
    within: [Range<f64>; 2],
    sampling: &Sampling,
    ground: bool,
    enough: usize,
) -> Vec<Patch> {
    let step = sampling.step * pair.sights[0].coarse.scale;
    let (half, at) = if sampling.large { (7, at::<16, 15> as At) } else { (3, at::<8, 7> as At) };
    let area = room(&pair.sights[0].fine, within, half + 1);
    let mut out: Vec<Patch> = Vec::new();
    for (k, from) in [(0, 0), (step, step), (step, 0), (0, step)].into_iter().enumerate() {
        if k > 0 && !(k * sampling.least / 4..enough).contains(&out.len()) {
            break;
        }
        let places = lattice(area.clone(), 2 * step, from);
        out.extend(places.filter_map(|(x, y)| at(pair, x, y, sampling, ground)));
    }
    if ground {
        keep_level(&mut out);
    }
    out.sort_by_key(|p| p.part);
    let surfaces = out.chunk_by(|a, b| a.part == b.part);
    surfaces.filter(|squares| squares.len() >= sampling.least).flatten().cloned().collect()
}

/// Columns and rows of an area that are a step apart, row by row.
fn lattice(
    [columns, rows]: [Range<usize>; 2],
    step: usize,
    (right, down): (usize, usize),
) -> impl Iterator<Item = (usize, usize)> {
    let row = move |y| columns.clone().skip(right).step_by(step).map(move |x| (x, y));
    rows.skip(down).step_by(step).flat_map(row)
}

/// [`at`] for squares of one size.
type At = fn(&Pair, usize, usize, &Sampling, bool) -> Option<Patch>;

/// The square about a pixel of the first level, on the ground or on the object.
fn at<const LANES: usize, const SIDE: usize>(
    pair: &Pair,
    x: usize,
    y: usize,
    sampling: &Sampling,
    ground: bool,
) -> Option<Patch> {
    let [first, second] = pair.sights.map(|s| &s.fine);
    let here = print_at::<LANES, SIDE>(first, x, y, &sampling.needs)?;
    let middle = pair.surface(pixel_of(first, x, y)).filter(|s| (s.part == GROUND) == ground)?;
    let (place, by_surface) = pair.carry_over(x, y, SIDE / 2, middle)?;
    let found = find(&here, first, second, &place, &sampling.needs)?;
    Some(Patch {
        pixel: pixel_of(first, x, y).into(),
        part: middle.part,
        residual: found.shift,
        noise_px: found.noise_px,
        worth: sampling.worth,
        by_surface,
        by_shared: pair.by_shared(&middle) * by_surface,
        by_slope: pair.by_slope(&middle) * by_surface,
        by_turn: place.by_turn.map(|by| found.along.transpose() * by),
    })
}

/// Keeps the squares that are on one level with most; none where there is no such level.
fn keep_level(squares: &mut Vec<Patch>) {
    let height = |p: &Patch| p.residual / p.by_surface;
    squares.sort_by(|a, b| height(a).total_cmp(&height(b)));
    let Some(middle) = squares.get(squares.len() / 2).map(height) else { return };
    let all = squares.len();
    let near = |p: &Patch| LEVEL_PX.hypot(LEVEL_SD * p.noise_px);
    squares.retain(|p| (p.residual - middle * p.by_surface).abs() < near(p));
    if 2 * squares.len() < all {
        squares.clear();
    }
}

/// What print on the object says for the pose that it was found with (nats), the more the more of it both
/// views see and the nearer it is to where it should be. A surface that has it elsewhere says nothing: it
/// may be gloss.
pub(super) fn evidence(patches: &[Patch]) -> f64 {
    let surfaces = patches.chunk_by(|a, b| a.part == b.part);
    surfaces.map(|s| (s.iter().map(|p| p.worth).sum::<f64>() - off(s)).max(0.0)).sum()
}

/// What speaks against each of some poses (nats, at most zero) as the ground that it was found with does not
/// seem to be where the object would rest. That there is a plane says nothing for the object.
pub(super) fn supported(grounds: &[Vec<Patch>]) -> Vec<f64> {
    let found = |ground: &Vec<Patch>| match ground.len() {
        0 => 0.0,
        n => n as f64 * (-off(ground) / FEWER).exp(),
    };
    let found: Vec<f64> = grounds.iter().map(found).collect();
    let most = found.iter().copied().fold(0.0, f64::max);
    if most == 0.0 {
        return vec![0.0; found.len()];
    }
    let against = |f: f64| (ELSEWHERE + (1.0 - ELSEWHERE) * (f / most).powf(FEWER)).ln();
    found.into_iter().map(against).collect()
}

/// Belief that the object rests on the ground that it was found with, where its edges alone leave it with
/// this covariance: a gap of millimetres is a coaster or a hand, one that the edges cannot tell from none
/// is none.
pub(super) fn contact(ground: &[Patch], covariance: &Matrix6<f64>) -> f64 {
    if ground.is_empty() {
        return 0.0;
    }
    let (shift, by_surface, _) = mean(ground);
    let gap = shift / by_surface;
    let by_pose = ground.iter().map(|p| p.by_shared.fixed_columns::<6>(0) / p.by_surface);
    let by_pose = by_pose.sum::<RowVector6<f64>>() / ground.len() as f64;
    let edges = (by_pose * covariance * by_pose.transpose()).x;
    let variance = CORE * edges + OF_GROUND.surface_sd.powi(2);
    let contact = (-0.5 * gap * gap / variance).exp() / (2.0 * PI * variance).sqrt();
    let odds = contact * (1.0 - ELSEWHERE) / (ELSEWHERE / GAPS);
    odds / (1.0 + odds)
}

/// Mean shift of a surface's squares (px), mean shift by the surface (px per m), and the first's information
/// (1/px^2).
fn mean(squares: &[Patch]) -> (f64, f64, f64) {
    let (mut weight, mut shift, mut by_surface) = (0.0, 0.0, 0.0);
    for patch in squares {
        let w = patch.worth / (patch.noise_px * patch.noise_px);
        weight += w;
        shift += w * patch.residual;
        by_surface += w * patch.by_surface;
    }
    (shift / weight, by_surface / weight, weight)
}

/// How much less likely it is (nats) that a surface is where its squares are than where it should be.
fn off(squares: &[Patch]) -> f64 {
    let trust = squares[0].trust();
    let (shift, by_surface, weight) = mean(squares);
    let variance = trust.between_sd_px * trust.between_sd_px
        + (trust.surface_sd * by_surface).powi(2)
        + weight.recip();
    let tail = trust.surface_tail.min(BETWEEN_TAIL);
    0.5 * (tail + 1.0) * (shift * shift / (tail * variance)).ln_1p()
}

/// Columns and rows of the first picture (px) that the contour is in.
fn extent(sites: &[Site]) -> [Range<f64>; 2] {
    let (mut low, mut high) = ((f64::INFINITY, f64::INFINITY), (0f64, 0f64));
    for site in sites.iter().filter(|s| s.view == 0) {
        low = (low.0.min(site.pixel.0), low.1.min(site.pixel.1));
        high = (high.0.max(site.pixel.0), high.1.max(site.pixel.1));
    }
    [low.0..high.0, low.1..high.1]
}

/// Columns and rows of a level that are within those of its picture (px) and have so many beside them on
/// either side, which a whole square and its slopes need.
fn room(level: &Level, within: [Range<f64>; 2], beside: usize) -> [Range<usize>; 2] {
    let range = |within: &Range<f64>, origin: usize, size: usize| {
        let least = (within.start - origin as f64).max(beside as f64) as usize;
        let most = (within.end - origin as f64).max(0.0) as usize;
        least..most.min(size.saturating_sub(beside))
    };
    [
        range(&within[0], level.origin.0, level.width()),
        range(&within[1], level.origin.1, level.height()),
    ]
}
