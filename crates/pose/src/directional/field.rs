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

use super::edges::Edgel;

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

impl Field {
    /// Builds the tables for a level of this size.
    pub fn new(edgels: &[Edgel], width: usize, height: usize) -> Self {
        // Edge points by direction, so that each plane reads only those that can matter to it.
        let mut bins: [Vec<Edgel>; DIRECTIONS] = std::array::from_fn(|_| Vec::new());
        for e in edgels {
            bins[(e.direction / STEP + 0.5) as usize % DIRECTIONS].push(*e);
        }
        let mut values = Vec::new();
        let mut tables = Vec::with_capacity(DIRECTIONS * (width + 1) * (height + 1));
        let planes = (0..DIRECTIONS)
            .map(|k| {
                let near = (k + DIRECTIONS - SPREAD)..=(k + DIRECTIONS + SPREAD);
                let edgels = near.flat_map(|b| &bins[b % DIRECTIONS]);
                Plane::new(edgels, k as f32 * STEP, width, height, &mut values, &mut tables)
            })
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
    // atan on [-1, 1] to 0.004 rad, an eighth of the error of rounding to a direction.
    let atan = |t: f32| t * (PI / 4.0 + 0.273 * (1.0 - t.abs()));
    let angle = match dx.abs() >= dy.abs() {
        true if dx == 0.0 => 0.0,
        true => atan(dy / dx),
        false => PI / 2.0 - atan(dx / dy),
    };
    (angle / STEP + DIRECTIONS as f32 + 0.5) as usize % DIRECTIONS
}

/// Nearest whole number of a value above -4096.
fn nearest(value: f32) -> i32 {
    (value + 4096.5) as i32 - 4096
}

impl Plane {
    fn new<'a>(
        edgels: impl Iterator<Item = &'a Edgel>,
        angle: f32,
        width: usize,
        height: usize,
        values: &mut Vec<u16>,
        tables: &mut Vec<u16>,
    ) -> Self {
        let (sin, cos) = angle.sin_cos();
        let transposed = sin.abs() < cos.abs();
        let (rows, cols) = if transposed { (width, height) } else { (height, width) };
        let lean = if transposed { sin / cos } else { cos / sin };
        let cap = (CAP_PX * f32::from(UNIT)) as u16;
        values.clear();
        values.resize(rows * cols, cap);
        for e in edgels {
            let mut turn = e.direction - angle;
            if turn.abs() > PI / 2.0 {
                turn -= PI.copysign(turn);
            }
            let price = turn.abs() * ANGLE_PRICE;
            if price < CAP_PX {
                let (row, col) = if transposed { (e.x, e.y) } else { (e.y, e.x) };
                let value = &mut values[usize::from(row) * cols + usize::from(col)];
                *value = ((price * f32::from(UNIT)) as u16).min(*value);
            }
        }
        // Distance across the line to a column k away.
        let step = f32::from(UNIT) / (1.0 + lean * lean).sqrt();
        let prices = [1, 2, FURTHEST, 2].map(|k| (k, (step * k as f32) as u16));
        spread(values, cols, &prices);
        let shift: Vec<i32> = (0..rows).map(|r| (r as f32 * lean).round() as i32).collect();
        let total: u64 = values.iter().map(|&v| u64::from(v)).sum();
        let mean = total as f32 / values.len().max(1) as f32;
        let plane = Plane { transposed, rows, cols, shift, start: tables.len(), mean };
        plane.integrate(values, tables);
        plane
    }

    /// The column of the same line one row further up; `None` beyond the border.
    fn step_back(&self, row: usize, col: i32) -> Option<usize> {
        let delta = if row == 0 { 0 } else { self.shift[row] - self.shift[row - 1] };
        usize::try_from(col - delta).ok().filter(|&c| c < self.cols && row > 0)
    }

    /// Appends the plane's table. Its row `r + 1` holds, at column c, the sum along the line that passes (r, c),
    /// down to and including row r.
    fn integrate(&self, values: &[u16], tables: &mut Vec<u16>) {
        let cols = self.cols;
        tables.resize(self.start + cols, 0);
        for (r, row) in values.chunks_exact(cols).enumerate() {
            tables.extend_from_slice(row);
            if r == 0 {
                continue;
            }
            let (done, target) = tables[self.start..].split_at_mut((r + 1) * cols);
            let above = &done[r * cols..];
            match self.shift[r] - self.shift[r - 1] {
                1 => add(&mut target[1..], &above[..cols - 1]),
                -1 => add(&mut target[..cols - 1], &above[1..]),
                _ => add(target, above),
            }
        }
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

/// Furthest step of [`spread`].
const FURTHEST: usize = 4;

/// `row[x] = min(row[x], row[x - k] + price, row[x + k] + price)` for every row, for each k in turn.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn spread(values: &mut [u16], cols: usize, prices: &[(usize, u16)]) {
    // Beyond the border lies nothing: values that no price makes overflow or best.
    let mut spare = vec![u16::MAX / 2; cols + 2 * FURTHEST];
    for row in values.chunks_exact_mut(cols) {
        for &(k, price) in prices {
            spare[FURTHEST..FURTHEST + cols].copy_from_slice(row);
            let left = &spare[FURTHEST - k..][..cols];
            let right = &spare[FURTHEST + k..][..cols];
            for ((value, &l), &r) in row.iter_mut().zip(left).zip(right) {
                *value = (*value).min(l.min(r) + price);
            }
        }
    }
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn add(target: &mut [u16], source: &[u16]) {
    let source = &source[..target.len()];
    for (t, s) in target.iter_mut().zip(source) {
        *t = t.wrapping_add(*s);
    }
}
