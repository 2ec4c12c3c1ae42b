//! Squares of one picture found in the other.
//!
//! **In:** a pixel of the first picture, and the [`Place`] where the second should show the square about
//! it, warped. **Out:** how far along the epipolar line it is from there. Means and slopes of brightness
//! are taken out of both squares and their contrast is an unknown, so that only print counts.

use multiversion::multiversion;
use nalgebra::{Matrix2, SMatrix, Vector2};

use crate::directional::equations::VIEWS;
use crate::directional::level::Level;

/// Rounds of the shift's refinement, and how far it may go (px): repeated print is further apart.
const ROUNDS: usize = 4;
const REACH_PX: f64 = 2.0;
/// A round that moves by less than this (px) is the last.
const STILL_PX: f64 = 0.01;
/// Correlation of the two squares that is needed on the way, and contrast of the second against the
/// first.
const LEAST_CORRELATION: f32 = 0.3;
const LEAST_GAIN: f32 = 0.5;
/// Squares whose shift is known worse than this (px) are left out; none is known better than that.
const MOST_NOISE_PX: f64 = 0.3;
const LEAST_NOISE_PX: f64 = 0.07;
/// Deviation across the epipolar line of where the second picture shows a square (px): lenses.
const ACROSS_SD_PX: f64 = 0.05;

/// What a square needs to be found.
pub struct Needs {
    /// Contrast in the first picture (root mean square), in deviations of the noise.
    pub contrast: f32,
    /// Correlation with what the second picture has there.
    pub correlation: f32,
}

/// A square on the surface, and where the second view should see it.
pub struct Place {
    /// Middle in the first picture's level.
    pub middle: (usize, usize),
    /// Middle in the second picture's level, and how it moves there with columns and rows of the first,
    /// to second order.
    pub there: Vector2<f64>,
    pub affine: Matrix2<f64>,
    pub bend: [Vector2<f64>; 2],
    /// Unit vector along the epipolar line in the second picture.
    pub epipolar: Vector2<f64>,
    /// How it moves in the second picture with small turns of each camera about its own x and y axes (px
    /// per rad).
    pub by_turn: [Matrix2<f64>; VIEWS],
}

/// Where a square was found.
pub struct Found {
    /// How far along the epipolar line from its place (px), and the deviation of that.
    pub shift: f64,
    /// See `shift`.
    pub noise_px: f64,
    /// How much longer or shorter the shift seems by a displacement in the second picture: as much as it
    /// is along the line, and by what is across it, the more the more level the print's edges are to the
    /// line.
    pub along: Vector2<f64>,
}

/// Grey levels of a square: a row of the picture in every column, padded with zeros to a whole vector.
pub type Square<const LANES: usize, const SIDE: usize> = SMatrix<f32, LANES, SIDE>;

/// The square about a pixel that is far enough from the border, without its mean and its slopes; `None`
/// where there is little to see.
pub fn print_at<const LANES: usize, const SIDE: usize>(
    level: &Level,
    x: usize,
    y: usize,
    needs: &Needs,
) -> Option<Square<LANES, SIDE>> {
    let flat = flattened(&square::<LANES, SIDE>(level, x, y));
    let least = needs.contrast * level.step_noise * SIDE as f32;
    (flat.norm() >= least).then_some(flat)
}

/// The grey levels around a pixel that is far enough from the border.
#[inline(always)]
fn square<const LANES: usize, const SIDE: usize>(
    level: &Level,
    x: usize,
    y: usize,
) -> Square<LANES, SIDE> {
    let half = SIDE / 2;
    let mut out = Square::<LANES, SIDE>::zeros();
    for (row, mut to) in (y - half..).zip(out.column_iter_mut()) {
        let from = &level.smooth.row(row)[x - half..][..SIDE];
        to.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
    }
    out
}

/// Where a square's pixel is from its middle, by lane.
const fn places<const LANES: usize, const SIDE: usize>() -> [f32; LANES] {
    let mut at = [0.0; LANES];
    let mut k = 0;
    while k < SIDE {
        at[k] = k as f32 - (SIDE / 2) as f32;
        k += 1;
    }
    at
}

/// Without its mean and its slopes.
#[inline(always)]
fn flattened<const LANES: usize, const SIDE: usize>(
    square: &Square<LANES, SIDE>,
) -> Square<LANES, SIDE> {
    let at = const { places::<LANES, SIDE>() };
    // Sum of k^2 over all pixels.
    let squares = (SIDE * (SIDE / 2) * (SIDE / 2 + 1) * SIDE / 3) as f32;
    let (mut columns, mut by_y) = ([0.0; LANES], [0.0; LANES]);
    for (row, y) in square.column_iter().zip(at) {
        for k in 0..LANES {
            columns[k] += row[k];
            by_y[k] += y * row[k];
        }
    }
    let mean = columns.iter().sum::<f32>() / (SIDE * SIDE) as f32;
    let by_x = columns.iter().zip(at).map(|(v, x)| v * x).sum::<f32>() / squares;
    let by_y = by_y.iter().sum::<f32>() / squares;
    let mut out = *square;
    for (mut row, y) in out.column_iter_mut().zip(at) {
        for k in 0..SIDE {
            row[k] -= mean + by_x * at[k] + by_y * y;
        }
    }
    out
}

/// Where the second picture shows a square: Gauss-Newton on shift and contrast, the slopes being the first
/// picture's.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub fn find<const LANES: usize, const SIDE: usize>(
    here: &Square<LANES, SIDE>,
    first: &Level,
    second: &Level,
    place: &Place,
    needs: &Needs,
) -> Option<Found> {
    let hh = here.norm_squared();
    let look = |shift: f64| {
        let there = flattened(&warped::<LANES, SIDE>(second, place, shift)?);
        let (ht, tt) = (here.dot(&there), there.norm_squared());
        let correlation = ht / (hh * tt).sqrt();
        (correlation >= LEAST_CORRELATION).then_some((there, ht, tt, correlation))
    };
    // Most that fail do so here: the second view sees something else there.
    let (mut there, mut ht, mut tt, mut correlation) = look(0.0)?;
    // A step in the second picture is this step in the first.
    let back = place.affine.try_inverse()?;
    let (x, y) = place.middle;
    let between = |dx: usize, dy: usize| {
        let at = square::<LANES, SIDE>;
        let [before, after] = [at(first, x - dx, y - dy), at(first, x + dx, y + dy)];
        (after - before) * 0.5
    };
    let slopes = [between(1, 0), between(0, 1)];
    let along =
        |step: Vector2<f64>| flattened(&(slopes[0] * step.x as f32 + slopes[1] * step.y as f32));
    let across = Vector2::new(-place.epipolar.y, place.epipolar.x);
    let (slopes, level) = (along(back * place.epipolar), along(back * across));
    let (hs, ss) = (here.dot(&slopes), slopes.norm_squared());
    let determinant = hh * ss - hs * hs;
    if determinant <= 1e-6 * hh * ss {
        return None;
    }
    let (mut shift, mut noise_px) = (0.0, f64::INFINITY);
    for round in 0..ROUNDS {
        if round > 0 {
            (there, ht, tt, correlation) = look(shift)?;
        }
        let st = slopes.dot(&there);
        // there = gain here - moved slopes.
        let gain = (ht * ss - st * hs) / determinant;
        let moved = (ht * hs - st * hh) / determinant;
        if gain < LEAST_GAIN || gain > LEAST_GAIN.recip() {
            return None;
        }
        let change = f64::from(moved / gain);
        shift += change.clamp(-1.0, 1.0);
        if shift.abs() > REACH_PX {
            return None;
        }
        let rest = (tt - gain * ht + moved * st).max(0.0) / (SIDE * SIDE - 5) as f32;
        noise_px = f64::from((rest * hh / determinant).sqrt() / gain);
        if change.abs() < STILL_PX {
            break;
        }
    }
    let slant = f64::from(level.dot(&slopes) / ss);
    let noise_px = noise_px.hypot(slant * ACROSS_SD_PX).max(LEAST_NOISE_PX);
    let along = place.epipolar + across * slant;
    let found = Found { shift, noise_px, along };
    (correlation > needs.correlation && noise_px < MOST_NOISE_PX).then_some(found)
}

/// The second picture where the square's pixels are in it, shifted along the epipolar line; `None` when
/// some are outside.
#[inline(always)]
fn warped<const LANES: usize, const SIDE: usize>(
    level: &Level,
    place: &Place,
    shift: f64,
) -> Option<Square<LANES, SIDE>> {
    let at = const { places::<LANES, SIDE>() };
    let (width, height) = (level.width(), level.height());
    let data = level.smooth.data();
    let middle = (place.there + place.epipolar * shift).cast::<f32>();
    let (affine, bend) = (place.affine.cast::<f32>(), place.bend.map(|b| b.cast::<f32>()));
    let (most_x, most_y) = (width as f32 - 1.0, height as f32 - 1.0);
    let along = |axis: usize| at.map(|x| affine[(axis, 0)] * x + bend[0][axis] * (x * x));
    let along = [along(0), along(1)];
    let mut out = Square::<LANES, SIDE>::zeros();
    for (mut row, y) in out.column_iter_mut().zip(at) {
        let start = affine.column(1) * y + bend[1] * (y * y) + middle;
        let (xs, ys) = (along[0].map(|x| start.x + x), along[1].map(|y| start.y + y));
        let within = xs.iter().fold(true, |all, &x| all & (x >= 0.0) & (x < most_x))
            & ys.iter().fold(true, |all, &y| all & (y >= 0.0) & (y < most_y));
        if !within {
            return None;
        }
        // The four pixels around every place.
        let mut around = [[0.0; LANES]; 4];
        for k in 0..SIDE {
            let i = ys[k] as usize * width + xs[k] as usize;
            let (above, below) = (&data[i..i + 2], &data[i + width..i + width + 2]);
            [around[0][k], around[1][k], around[2][k], around[3][k]] =
                [above[0], above[1], below[0], below[1]];
        }
        for k in 0..LANES {
            let (right, down) = (xs[k] - xs[k].floor(), ys[k] - ys[k].floor());
            let above = around[0][k] + right * (around[1][k] - around[0][k]);
            let below = around[2][k] + right * (around[3][k] - around[2][k]);
            row[k] = above + down * (below - above);
        }
    }
    Some(out)
}
