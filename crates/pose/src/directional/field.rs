//! Directional distance fields with integral tables along each direction.
//!
//! **In:** edge points with direction. **Out:** for every direction of a line a table from which
//! the mean capped distance of a whole straight segment to edges *of that direction* is read with
//! two look-ups. The idea is that of fast directional chamfer matching (Liu et al., CVPR 2010):
//! distance in place plus a price for the angle, summed by integral images along the direction.
//! Here the distance is measured across the line only (that is what an edge point says), in a layout
//! where lines run down the rows: an edge point changes its own row only.
//!
//! Values are sixteenths of a level pixel in u16; sums wrap around, differences stay exact as long
//! as one segment's sum stays below 65536, that is for segments up to 600 pixels.

use std::cell::RefCell;
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
const SPREAD: f32 = 4.5;
/// Half of the directions are steeper than 45 degrees, half are flatter: each half is one table.
const SLOTS: usize = DIRECTIONS / 2;
/// The first direction of either half; the flat ones go on beyond 180 degrees.
const FIRST: [usize; 2] = [DIRECTIONS.div_ceil(4), (3 * DIRECTIONS).div_ceil(4)];
/// Columns that an edge point reaches to either side: about as far as the cap.
const BESIDE: usize = 7;
/// Columns that are worked on at once.
const LANES: usize = 16;
/// Parts of a unit in the prices of turns.
const TURN: i32 = 64;
/// A price that is never the least.
const NOTHING: u16 = u16::MAX / 2;

/// The tables of one view.
#[derive(Debug, Clone, Default)]
pub struct Field {
    /// Of steep lines, whose rows are the level's, and of flat ones, whose rows are its columns.
    tables: Option<[Table; 2]>,
}

/// Half of the directions.
#[derive(Debug, Clone)]
struct Table {
    rows: usize,
    cols: usize,
    /// Sums of one direction in one row: of whole vectors of columns and a zero on either side.
    stride: usize,
    slots: Vec<Slot>,
    /// Row by row, one direction after the other: at every column the sum of the values down the line
    /// that passes there, this row included. A row of zeros comes first.
    sums: Vec<u16>,
}

/// One direction.
#[derive(Debug, Clone)]
struct Slot {
    /// Column shift of a line through row 0, at every row.
    shift: Vec<i32>,
    /// Price of a distance of so many columns, from [`BESIDE`] on one side to the same on the other.
    cone: [u16; LANES],
    /// Mean value: what a segment laid down at random would read.
    mean: f32,
}

/// An edge point as a table reads it.
#[derive(Clone, Copy, Default)]
struct Point {
    col: u16,
    /// The slots that it counts for.
    slots: (u8, u8),
    /// Its direction from the table's first ([`TURN`]).
    turn: i32,
}

impl Field {
    /// Builds the tables for a level of this size.
    pub fn new(edgels: &[Edgel], width: usize, height: usize) -> Self {
        let steep = Table::new(FIRST[0], height, width, edgels.iter().map(|e| (e.y, e.x, e)));
        let flat = Table::new(FIRST[1], width, height, edgels.iter().map(|e| (e.x, e.y, e)));
        Field { tables: Some([steep, flat]) }
    }

    /// Sum over a segment (level pixels) of the mean distance that chance would give minus the
    /// distance read, in pixels times pixels of length; positive speaks for the segment. Parts
    /// outside the level do not count.
    pub fn evidence(&self, from: (f32, f32), to: (f32, f32)) -> f32 {
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        if !(dx.is_finite() && dy.is_finite()) {
            return 0.0;
        }
        let Some(tables) = &self.tables else { return 0.0 };
        let length = (dx * dx + dy * dy).sqrt();
        let (half, slot) = home(nearest_direction(dx, dy));
        let swap = |p: (f32, f32)| if half == 0 { (p.1, p.0) } else { p };
        tables[half].evidence(slot, swap(from), swap(to), length)
    }

    /// The value (px) of one direction's field at a pixel, for pictures.
    pub fn value(&self, direction: usize, x: usize, y: usize) -> f32 {
        let Some(tables) = &self.tables else { return CAP_PX };
        let (half, slot) = home(direction);
        let (row, col) = if half == 0 { (y, x) } else { (x, y) };
        let here = (row, col as i32);
        f32::from(tables[half].between(slot, here, here)) / f32::from(UNIT)
    }
}

/// Index of the direction nearest to that of a vector.
fn nearest_direction(dx: f32, dy: f32) -> usize {
    (line_direction(dx, dy) / STEP + 0.5) as usize % DIRECTIONS
}

/// The half that a direction is in, and which it is there.
fn home(direction: usize) -> (usize, usize) {
    let steps = (direction + DIRECTIONS - FIRST[0]) % DIRECTIONS;
    (steps / SLOTS, steps % SLOTS)
}

/// Nearest whole number; of values beyond all pictures, one beyond them.
fn nearest(value: f32) -> i32 {
    const FAR: f32 = 4096.0;
    (value.clamp(-FAR, FAR) + (FAR + 0.5)) as i32 - FAR as i32
}

impl Table {
    /// The table of the directions from `first` on, of edge points with their rows and columns.
    fn new<'a>(
        first: usize,
        rows: usize,
        cols: usize,
        edgels: impl Iterator<Item = (u16, u16, &'a Edgel)> + Clone,
    ) -> Self {
        // Edge points by row: how many there are in the rows above tells where a row's begin.
        let mut ends = vec![0; rows + 1];
        edgels.clone().for_each(|(row, ..)| ends[usize::from(row) + 1] += 1);
        (0..rows).for_each(|r| ends[r + 1] += ends[r]);
        let mut points = vec![Point::default(); ends[rows]];
        for (row, col, e) in edgels {
            let next = &mut ends[usize::from(row)];
            points[*next] = Point::new(col, e.direction / STEP - first as f32);
            *next += 1;
        }
        ends.pop();
        let mut slots: Vec<Slot> = (first..first + SLOTS).map(|k| Slot::new(k, rows)).collect();
        let stride = cols.next_multiple_of(LANES) + 2;
        let sums = sweep(&points, &ends, cols, stride, &mut slots);
        Table { rows, cols, stride, slots, sums }
    }

    /// The sum down the line that passes a place; `row` counts the row of zeros.
    fn sum(&self, slot: usize, row: usize, col: i32) -> u16 {
        let at = (row * SLOTS + slot) * self.stride + 1;
        self.sums[at.wrapping_add_signed(col as isize)]
    }

    /// The sum of the values from one row of a line to another, columns as the line has them there.
    fn between(&self, slot: usize, from: (usize, i32), to: (usize, i32)) -> u16 {
        // What came before was summed from the column that the line has in the row above, be it in
        // the margin: so it is read there.
        let above = from.1 - self.slots[slot].sideways(from.0);
        self.sum(slot, to.0 + 1, to.1).wrapping_sub(self.sum(slot, from.0, above))
    }

    /// [`Field::evidence`] of ends as row and column.
    fn evidence(&self, slot: usize, from: (f32, f32), to: (f32, f32), length: f32) -> f32 {
        let ((mut r0, c0), (mut r1, c1)) = (from, to);
        if r0 > r1 {
            (r0, r1) = (r1, r0);
        }
        let Slot { shift, mean, .. } = &self.slots[slot];
        let last_row = self.rows as i32 - 1;
        let middle_row = nearest(0.5 * (r0 + r1)).clamp(0, last_row) as usize;
        let line = nearest(0.5 * (c0 + c1)) - shift[middle_row];
        // Whole rows that the segment covers, at least one.
        let (first, end) = (nearest(r0).max(0), nearest(r1));
        let last = (end - 1).max(first).min(last_row);
        if end < 0 || last < first {
            return 0.0;
        }
        let (mut first, mut last) = (first as usize, last as usize);
        let inside = |row: usize| (0..self.cols as i32).contains(&(line + shift[row]));
        // What leaves the level at the side counts as far as it is within.
        while first < last && !inside(first) {
            first += 1;
        }
        while first < last && !inside(last) {
            last -= 1;
        }
        if !inside(first) {
            return 0.0;
        }
        let [from, to] = [first, last].map(|row| (row, line + shift[row]));
        let sum = self.between(slot, from, to);
        let rows = (last - first + 1) as f32;
        let counted = length * (rows / (r1 - r0).max(rows)).min(1.0);
        (mean - f32::from(sum) / rows) * counted / f32::from(UNIT)
    }
}

thread_local! {
    /// Storage of tables that are no more, for the next ones: new memory comes page by page
    /// from the system, which takes longer than to fill it.
    static SPARE: RefCell<Vec<Vec<u16>>> = const { RefCell::new(Vec::new()) };
}
/// Tables whose storage is kept: those of two views.
const SPARES: usize = 4;

/// Storage of at least this size, with what it last held.
fn spare(size: usize) -> Vec<u16> {
    let kept = SPARE.with_borrow_mut(|spare| {
        let fits = spare.iter().position(|s| s.len() >= size);
        fits.map(|k| spare.remove(k))
    });
    kept.unwrap_or_else(|| vec![0; size])
}

impl Drop for Table {
    fn drop(&mut self) {
        let sums = std::mem::take(&mut self.sums);
        SPARE.with_borrow_mut(|spare| {
            spare.push(sums);
            spare.sort_by_key(Vec::len);
            if spare.len() > SPARES {
                spare.remove(0);
            }
        });
    }
}

impl Slot {
    fn new(direction: usize, rows: usize) -> Self {
        let (sin, cos) = (direction as f32 * STEP).sin_cos();
        let lean = if sin.abs() < cos.abs() { sin / cos } else { cos / sin };
        // Distance across the line to the next column.
        let step = f32::from(UNIT) / (1.0 + lean * lean).sqrt();
        let mut cone = [NOTHING; LANES];
        for (k, price) in cone[..=2 * BESIDE].iter_mut().enumerate() {
            *price = (step * k.abs_diff(BESIDE) as f32) as u16;
        }
        let shift = (0..rows).map(|r| nearest(r as f32 * lean)).collect();
        Slot { shift, cone, mean: 0.0 }
    }

    /// Columns that a line moves from the row above to this one.
    fn sideways(&self, row: usize) -> i32 {
        if row == 0 { 0 } else { self.shift[row] - self.shift[row - 1] }
    }
}

impl Point {
    /// `steps` is its direction from the table's first, modulo half a circle.
    fn new(col: u16, steps: f32) -> Self {
        let steps = if steps < 0.0 { steps + DIRECTIONS as f32 } else { steps };
        // The half circle is closed: what is well behind the table's last is before its first.
        let behind = steps > SLOTS as f32 + SPREAD;
        let steps = if behind { steps - DIRECTIONS as f32 } else { steps };
        let slot = |steps: f32| (steps.max(0.0) as usize).min(SLOTS) as u8;
        let slots = (slot(steps - SPREAD + 1.0), slot(steps + SPREAD + 1.0));
        Point { col, slots, turn: turn_of(steps) }
    }
}

/// The price of so many steps, finely.
fn turn_of(steps: f32) -> i32 {
    (steps * STEP_PRICE * TURN as f32) as i32
}

/// The sums of a [`Table`] from its edge points, which come row by row up to the given ends; notes the
/// mean values. A row's values of all directions fit into the nearest cache, and an edge point
/// changes a single vector of each.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn sweep(
    points: &[Point],
    ends: &[usize],
    cols: usize,
    stride: usize,
    slots: &mut [Slot],
) -> Vec<u16> {
    const CAP: u16 = (CAP_PX * UNIT as f32) as u16;
    let mut sums = spare((ends.len() + 1) * SLOTS * stride);
    sums[..SLOTS * stride].fill(0);
    let padded = stride - 2;
    let wide = padded + LANES;
    let mut values = vec![CAP; SLOTS * wide];
    let turns: [i32; SLOTS] = std::array::from_fn(|k| turn_of(k as f32));
    let mut totals = [0u64; SLOTS];
    let mut begin = 0;
    for (row, &end) in ends.iter().enumerate() {
        for point in &points[begin..end] {
            let (from, to) = (usize::from(point.slots.0), usize::from(point.slots.1));
            for k in from..to {
                let turn = ((point.turn - turns[k]).abs() / TURN) as u16;
                let around = &mut values[k * wide + usize::from(point.col)..][..LANES];
                for (value, price) in around.iter_mut().zip(&slots[k].cone) {
                    *value = (*value).min(price + turn);
                }
            }
        }
        begin = end;
        let (done, here) = sums.split_at_mut((row + 1) * SLOTS * stride);
        for (k, slot) in slots.iter().enumerate() {
            let values = &values[k * wide + BESIDE..][..padded];
            totals[k] += u64::from(values[..cols].iter().map(|&v| u32::from(v)).sum::<u32>());
            let above = (row * SLOTS + k) * stride + 1;
            let above = &done[above.wrapping_add_signed(-slot.sideways(row) as isize)..][..padded];
            let here = &mut here[k * stride..][..stride];
            (here[0], here[stride - 1]) = (0, 0);
            let here = here[1..].as_chunks_mut::<LANES>().0;
            let down = values.as_chunks::<LANES>().0.iter().zip(above.as_chunks::<LANES>().0);
            for (here, (values, above)) in here.iter_mut().zip(down) {
                *here = std::array::from_fn(|i| values[i].wrapping_add(above[i]));
            }
        }
        values.fill(CAP);
    }
    for (slot, total) in slots.iter_mut().zip(totals) {
        slot.mean = total as f32 / (ends.len() * cols).max(1) as f32;
    }
    sums
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
                        let turned = turn.abs() <= SPREAD * STEP;
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
                    // Either price is cut to a sixteenth.
                    let error = expected - found;
                    assert!((-0.001..0.126).contains(&error), "{direction} ({x}, {y}): {error}");
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
            let evidence = field.evidence(at(from), at(to));
            let (half, slot) = home(direction);
            let mean = field.tables.as_ref().unwrap()[half].slots[slot].mean / f32::from(UNIT);
            let expected = mean * length - sum;
            assert!((evidence - expected).abs() < 1e-2, "{evidence} for {expected}");
        }
    }

    #[test]
    fn a_segment_that_leaves_the_level_counts_as_far_as_it_is_within() {
        let (width, height) = (45, 33);
        let field = Field::new(&strewn(40, width, height), width, height);
        // Along either diagonal, out to either side.
        for (inside, outside) in [((20.0, 12.0), 40.0), ((24.0, 20.0), -40.0)] {
            for lean in [1.0f32, -1.0] {
                let end = |by: f32| (inside.0 + by, inside.1 + lean * by);
                let whole = field.evidence(inside, end(outside));
                // As far as the nearest border.
                let sides = [
                    if outside > 0.0 { 44.0 - inside.0 } else { inside.0 },
                    if (outside > 0.0) == (lean > 0.0) { 32.0 - inside.1 } else { inside.1 },
                ];
                let within = outside.signum() * sides[0].min(sides[1]);
                let part = field.evidence(inside, end(within));
                // A pixel more or less at the border may read up to the cap.
                assert!((whole - part).abs() < 2.0 * CAP_PX, "{whole} for {part}");
                assert!(whole != 0.0);
            }
        }
    }
}
