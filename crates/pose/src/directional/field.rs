//! Directional distance fields with integral tables along each direction.
//!
//! **In:** edge points with direction. **Out:** for every direction of a line a table from which
//! the mean capped distance of a whole straight segment to edges *of that direction* is read with
//! two look-ups. The idea is that of fast directional chamfer matching (Liu et al., CVPR 2010):
//! distance in place plus a price for the angle, summed by integral images along the direction.
//! Here the distance is measured across the line only (that is what an edge point says), in a layout
//! where lines run down the rows, so every pass is a loop over row slices.
//!
//! Values are sixteenths of a level pixel in u16; sums wrap around, differences stay exact as long
//! as one segment's sum stays below 65536, that is for segments up to 600 pixels.

use std::f32::consts::PI;

use multiversion::multiversion;

use super::edges::{Edgel, line_direction};

/// Directions over 180 degrees: six degrees apart, so a 40 px segment bends 1 px at its ends.
pub const DIRECTIONS: usize = 30;
/// Units to a pixel.
pub const UNIT: u16 = 16;
/// Distances beyond this count as this (px).
pub const CAP_PX: f32 = 6.0;
/// Price of a difference in direction (px per radian): one pixel for six degrees.
const ANGLE_PRICE: f32 = 9.5;
/// Angle between neighbouring directions (rad).
const STEP: f32 = PI / DIRECTIONS as f32;
/// The price of a step (units).
const STEP_PRICE: f32 = ANGLE_PRICE * STEP * UNIT as f32;
/// Edge points of directions up to this many steps away count for a line.
const SPREAD: usize = 4;

/// The tables of one view.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Field {
    planes: Vec<Plane>,
    /// The planes' tables, one after the other: a single piece of memory, which the allocator keeps
    /// from one recognition to the next instead of giving it back to the system and clearing it anew.
    tables: Vec<u16>,
}

/// One direction.
#[derive(Debug, Clone, PartialEq)]
struct Plane {
    /// Rows run along x and columns along y (for lines flatter than 45 degrees).
    transposed: bool,
    rows: usize,
    cols: usize,
    /// Column shift of a line through row 0, at every row.
    shift: Vec<i32>,
    /// Where its table begins: `rows + 1` rows, the sum of the values above, along the line.
    start: usize,
    /// Mean value: what a segment laid down at random would read.
    mean: f32,
}

/// An edge point as the planes read it.
#[derive(Clone, Copy)]
struct Point {
    /// Its place in an upright plane and in a transposed one.
    at: [u32; 2],
    /// Price of its turn against the direction in whose bin it is, signed (units).
    lean: i32,
}

impl Field {
    /// Builds the tables for a level of this size.
    pub fn new(edgels: &[Edgel], width: usize, height: usize) -> Self {
        // Edge points by direction, so that each plane reads only those that can matter to it.
        let mut bins: [Vec<Point>; DIRECTIONS] = std::array::from_fn(|_| Vec::new());
        for e in edgels {
            let steps = e.direction / STEP;
            let nearest = (steps + 0.5) as usize;
            let (x, y) = (usize::from(e.x), usize::from(e.y));
            bins[nearest % DIRECTIONS].push(Point {
                at: [y * width + x, x * height + y].map(|i| i as u32),
                lean: ((steps - nearest as f32) * STEP_PRICE) as i32,
            });
        }
        let mut values = Vec::new();
        let mut tables = Vec::with_capacity(DIRECTIONS * (width + 1) * (height + 1));
        let planes = (0..DIRECTIONS)
            .map(|k| Plane::new(&bins, k, width, height, &mut values, &mut tables))
            .collect();
        Field { planes, tables }
    }

    /// Sum over a segment (level pixels) of the mean distance that chance would give minus the
    /// distance read, in pixels times pixels of length; positive speaks for the segment. Parts
    /// outside the level do not count. Also the length that did count.
    pub fn evidence(&self, from: (f32, f32), to: (f32, f32)) -> (f32, f32) {
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        if !(dx.is_finite() && dy.is_finite()) {
            return (0.0, 0.0);
        }
        let plane = self.planes.get(nearest_direction(dx, dy));
        let length = (dx * dx + dy * dy).sqrt();
        plane.map_or((0.0, 0.0), |p| p.evidence(&self.tables[p.start..], from, to, length))
    }

    /// The value (px) of one direction's field at a pixel, for pictures.
    pub fn value(&self, direction: usize, x: usize, y: usize) -> f32 {
        let plane = &self.planes[direction];
        let (row, col) = if plane.transposed { (x, y) } else { (y, x) };
        let i = row * plane.cols + col;
        let table = &self.tables[plane.start..];
        let before = plane.step_back(row, col as i32).map_or(0, |c| table[i - col + c]);
        f32::from(table[i + plane.cols].wrapping_sub(before)) / f32::from(UNIT)
    }
}

/// Index of the direction nearest to that of a vector.
fn nearest_direction(dx: f32, dy: f32) -> usize {
    (line_direction(dx, dy) / STEP + 0.5) as usize % DIRECTIONS
}

/// Nearest whole number of a value above -4096.
fn nearest(value: f32) -> i32 {
    (value + 4096.5) as i32 - 4096
}

impl Plane {
    fn new(
        bins: &[Vec<Point>; DIRECTIONS],
        direction: usize,
        width: usize,
        height: usize,
        values: &mut Vec<u16>,
        tables: &mut Vec<u16>,
    ) -> Self {
        let (sin, cos) = (direction as f32 * STEP).sin_cos();
        let transposed = sin.abs() < cos.abs();
        let (rows, cols) = if transposed { (width, height) } else { (height, width) };
        let lean = if transposed { sin / cos } else { cos / sin };
        values.clear();
        values.resize(rows * cols, (CAP_PX * f32::from(UNIT)) as u16);
        for step in 0..=2 * SPREAD {
            let turned = (step as f32 - SPREAD as f32) * STEP_PRICE;
            for point in &bins[(direction + DIRECTIONS + step - SPREAD) % DIRECTIONS] {
                let price = (turned as i32 + point.lean).unsigned_abs() as u16;
                let value = &mut values[point.at[usize::from(transposed)] as usize];
                *value = price.min(*value);
            }
        }
        // Distance across the line to a column k away.
        let step = f32::from(UNIT) / (1.0 + lean * lean).sqrt();
        let prices = HOPS.map(|k| (step * k as f32) as u16);
        let shift: Vec<i32> = (0..rows).map(|r| (r as f32 * lean).round() as i32).collect();
        let start = tables.len();
        let total = integrate(values, cols, &prices, &shift, tables);
        let mean = total as f32 / values.len().max(1) as f32;
        Plane { transposed, rows, cols, shift, start, mean }
    }

    /// The column of the same line one row further up; `None` beyond the border.
    fn step_back(&self, row: usize, col: i32) -> Option<usize> {
        let delta = if row == 0 { 0 } else { self.shift[row] - self.shift[row - 1] };
        usize::try_from(col - delta).ok().filter(|&c| c < self.cols && row > 0)
    }

    fn evidence(&self, table: &[u16], from: (f32, f32), to: (f32, f32), length: f32) -> (f32, f32) {
        let swap = |p: (f32, f32)| if self.transposed { (p.0, p.1) } else { (p.1, p.0) };
        let ((mut r0, c0), (mut r1, c1)) = (swap(from), swap(to));
        if r0 > r1 {
            (r0, r1) = (r1, r0);
        }
        let last_row = self.rows as i32 - 1;
        let middle_row = nearest(0.5 * (r0 + r1)).clamp(0, last_row) as usize;
        let line = nearest(0.5 * (c0 + c1)) - self.shift[middle_row];
        // Whole rows that the segment covers, at least one.
        let (first, end) = (nearest(r0).max(0), nearest(r1));
        let last = (end - 1).max(first).min(last_row);
        if end < 0 || last < first {
            return (0.0, 0.0);
        }
        let (first, last) = (first as usize, last as usize);
        let inside =
            |r: usize| usize::try_from(line + self.shift[r]).ok().filter(|&c| c < self.cols);
        let (Some(a), Some(b)) = (inside(first), inside(last)) else { return (0.0, 0.0) };
        let before = self.step_back(first, a as i32);
        let before = before.map_or(0, |c| table[first * self.cols + c]);
        let sum = table[(last + 1) * self.cols + b].wrapping_sub(before);
        let rows = (last - first + 1) as f32;
        let counted = length * (rows / (r1 - r0).max(rows)).min(1.0);
        ((self.mean - f32::from(sum) / rows) * counted / f32::from(UNIT), counted)
    }
}

/// Columns that one pass of [`integrate`] reaches across, longer ones later: about as far as the cap.
const HOPS: [usize; 3] = [1, 2, 4];
/// Columns that are worked on at once.
const LANES: usize = 16;
/// What no price makes overflow or best.
const NOTHING: u16 = u16::MAX / 2;

/// Spreads the values of every row to the columns beside them, `row[x] = min(row[x], row[x - k] +
/// price, row[x + k] + price)` for each hop k in turn, and appends the plane's table: its row `r + 1`
/// holds, at column c, the sum along the line that passes (r, c), down to and including row r.
/// Returns the sum of all values.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn integrate(
    values: &[u16],
    cols: usize,
    prices: &[u16; 3],
    shift: &[i32],
    tables: &mut Vec<u16>,
) -> u64 {
    const MARGIN: usize = HOPS[2];
    let padded = cols.next_multiple_of(LANES);
    let mut here = vec![NOTHING; padded + 2 * MARGIN];
    let mut there = here.clone();
    let mut total = 0;
    let start = tables.len();
    tables.resize(start + cols, 0);
    for (r, row) in values.chunks_exact(cols).enumerate() {
        here[MARGIN..MARGIN + cols].copy_from_slice(row);
        here[MARGIN + cols..].fill(NOTHING);
        for (&k, &price) in HOPS.iter().zip(prices) {
            let from = |first: usize| &here[first..][..padded];
            let beside = from(MARGIN - k).iter().zip(from(MARGIN + k));
            let out = there[MARGIN..][..padded].iter_mut();
            for ((out, own), (left, right)) in out.zip(from(MARGIN)).zip(beside) {
                *out = (*own).min((*left).min(*right) + price);
            }
            std::mem::swap(&mut here, &mut there);
        }
        let row = &here[MARGIN..MARGIN + cols];
        total += u64::from(row.iter().map(|&v| u32::from(v)).sum::<u32>());
        tables.extend_from_slice(row);
        if r > 0 {
            let (done, target) = tables[start..].split_at_mut((r + 1) * cols);
            let above = &done[r * cols..];
            match shift[r] - shift[r - 1] {
                1 => add(&mut target[1..], &above[..cols - 1]),
                -1 => add(&mut target[..cols - 1], &above[1..]),
                _ => add(target, above),
            }
        }
    }
    total
}

#[inline(always)]
fn add(target: &mut [u16], source: &[u16]) {
    for (t, s) in target.iter_mut().zip(source) {
        *t = t.wrapping_add(*s);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Edge points strewn over a level, by a small generator of its own so that they repeat.
    fn strewn(count: u32, width: usize, height: usize) -> Vec<Edgel> {
        let part = |k: u32, n: u32| k.wrapping_mul(2_654_435_761).rotate_left(13 * n) >> 8;
        let share = |k, n| part(k, n) as f32 / (1 << 24) as f32;
        let edgel = |k| Edgel {
            x: (share(k, 1) * width as f32) as u16,
            y: (share(k, 2) * height as f32) as u16,
            direction: share(k, 3) * PI,
        };
        (1..=count).map(edgel).collect()
    }

    #[test]
    fn values_are_the_least_distance_across_plus_the_price_of_the_turn() {
        // Rows of all lengths against the vectors' sixteen, and both layouts.
        for (width, height) in [(37, 21), (32, 48), (19, 16)] {
            let edgels = strewn(12, width, height);
            let field = Field::new(&edgels, width, height);
            for direction in 0..DIRECTIONS {
                let angle = direction as f32 * STEP;
                let (sin, cos) = angle.sin_cos();
                for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
                    let prices = edgels.iter().filter_map(|e| {
                        let turn = (e.direction - angle + 1.5 * PI) % PI - 0.5 * PI;
                        let turned = turn.abs() <= (SPREAD as f32 + 0.5) * STEP;
                        let dx = f32::from(e.x) - x as f32;
                        let dy = f32::from(e.y) - y as f32;
                        let flat = sin.abs() < cos.abs();
                        let (along, across) = if flat { (dx, dy * cos) } else { (dy, dx * sin) };
                        let steps = if flat { dy } else { dx };
                        let beside = along == 0.0 && steps.abs() <= 7.0 && turned;
                        beside.then(|| across.abs() + turn.abs() * ANGLE_PRICE)
                    });
                    let expected = prices.fold(CAP_PX, f32::min);
                    let found = field.value(direction, x, y);
                    // Every price is cut to a sixteenth, three hops and the turn at most.
                    let error = expected - found;
                    assert!((-0.07..0.4).contains(&error), "{direction} ({x}, {y}): {error}");
                }
            }
        }
    }

    #[test]
    fn a_segment_reads_what_its_pixels_hold() {
        let (width, height) = (45, 33);
        let field = Field::new(&strewn(40, width, height), width, height);
        // Upright and flat: pixels that need no rounding.
        for (from, to, direction) in [((9, 4), (9, 30), DIRECTIONS / 2), ((40, 12), (3, 12), 0)] {
            let (columns, rows) =
                (from.0.min(to.0)..from.0.max(to.0), from.1.min(to.1)..from.1.max(to.1));
            let pixels: Vec<(usize, usize)> = if direction == 0 {
                columns.map(|x| (x, from.1)).collect()
            } else {
                rows.map(|y| (from.0, y)).collect()
            };
            let sum: f32 = pixels.iter().map(|p| field.value(direction, p.0, p.1)).sum();
            let length = pixels.len() as f32;
            let at = |p: (usize, usize)| (p.0 as f32, p.1 as f32);
            let (evidence, counted) = field.evidence(at(from), at(to));
            assert!((counted - length).abs() < 1e-3, "{counted} of {length}");
            let expected = field.planes[direction].mean / f32::from(UNIT) * length - sum;
            assert!((evidence - expected).abs() < 1e-2, "{evidence} for {expected}");
        }
    }
}
