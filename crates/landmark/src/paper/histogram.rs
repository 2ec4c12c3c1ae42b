//! Projection histograms of the difference image: the column, then the row, where it is largest.

use nalgebra::Point2;
use vergence_imaging::Image;

/// Half width of the band around a peak (px): what the blurred image of a small light covers.
const HALF_BAND: usize = 3;

/// Sums of the difference along columns and along rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// Sum over the rows for every column (grey levels).
    pub along_x: Vec<f64>,
    /// Sum for every row over the band of columns around the peak of `along_x` (grey levels).
    pub along_y: Vec<f64>,
}

impl Projection {
    /// Projects a difference image.
    pub fn of(difference: &Image<f32>) -> Self {
        let mut along_x = vec![0.0; difference.width()];
        for y in 0..difference.height() {
            for (sum, &d) in along_x.iter_mut().zip(difference.row(y)) {
                *sum += f64::from(d);
            }
        }
        let band = band(peak(&along_x), difference.width());
        let row = |y: usize| difference.row(y)[band.clone()].iter().map(|&d| f64::from(d)).sum();
        let along_y = (0..difference.height()).map(row).collect();
        Projection { along_x, along_y }
    }
}

/// The places with the largest persistent difference, one after the other: the peak of the histogram
/// along x, the peak along y within that band, then the same with that place blanked.
pub fn places(difference: &Image<f32>, count: usize) -> Vec<Point2<f64>> {
    let mut left = difference.clone();
    let mut places = Vec::new();
    while places.len() < count {
        let projection = Projection::of(&left);
        let (x, y) = (peak(&projection.along_x), peak(&projection.along_y));
        let (columns, rows) = (band(x, left.width()), band(y, left.height()));
        let (mut mass, mut cx, mut cy) = (0.0, 0.0, 0.0);
        for y in rows {
            for x in columns.clone() {
                let weight = f64::from(left.row(y)[x]);
                mass += weight;
                cx += weight * x as f64;
                cy += weight * y as f64;
                left.set(x, y, 0.0);
            }
        }
        if mass <= 0.0 {
            break;
        }
        places.push(Point2::new(cx / mass, cy / mass));
    }
    places
}

fn peak(values: &[f64]) -> usize {
    (0..values.len()).max_by(|&a, &b| values[a].total_cmp(&values[b])).unwrap_or(0)
}

fn band(centre: usize, length: usize) -> std::ops::Range<usize> {
    centre.saturating_sub(HALF_BAND)..(centre + HALF_BAND + 1).min(length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_lights_come_out_larger_first() {
        let mut difference = Image::filled(60, 40, 0.0f32);
        for (x, y, value) in [(20, 10, 5.0), (21, 10, 5.0), (44, 30, 3.0)] {
            difference.set(x, y, value);
        }
        let found = places(&difference, 5);
        assert_eq!(found, vec![Point2::new(20.5, 10.0), Point2::new(44.0, 30.0)]);
        assert_eq!(Projection::of(&difference).along_x[44], 3.0);
    }
}
