//! The row-major image.

/// A row-major image without padding.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Image<T> {
    width: usize,
    height: usize,
    data: Vec<T>,
}

impl<T: Copy> Image<T> {
    /// An image filled with one value.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Image { width, height, data: vec![value; width * height] }
    }

    /// An image from row-major data; `None` when the length does not fit the size.
    pub fn from_vec(width: usize, height: usize, data: Vec<T>) -> Option<Self> {
        (data.len() == width.checked_mul(height)?).then_some(Image { width, height, data })
    }

    /// An image computed pixel by pixel from column and row.
    pub fn from_fn(width: usize, height: usize, mut f: impl FnMut(usize, usize) -> T) -> Self {
        let data = (0..width * height).map(|i| f(i % width, i / width)).collect();
        Image { width, height, data }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row by row.
    pub fn data(&self) -> &[T] {
        &self.data
    }

    /// All pixels, row by row, to write.
    pub fn data_mut(&mut self) -> &mut [T] {
        &mut self.data
    }

    /// The pixels of one row.
    ///
    /// # Panics
    /// When `y` is outside the image, as slices do.
    pub fn row(&self, y: usize) -> &[T] {
        &self.data[y * self.width..(y + 1) * self.width]
    }

    /// The pixels of one row, to write.
    pub fn row_mut(&mut self, y: usize) -> &mut [T] {
        &mut self.data[y * self.width..(y + 1) * self.width]
    }

    /// The pixel at column `x`, row `y`; `None` outside.
    pub fn get(&self, x: usize, y: usize) -> Option<T> {
        (x < self.width && y < self.height).then(|| self.data[y * self.width + x])
    }

    /// Sets the pixel at column `x`, row `y`; nothing outside.
    pub fn set(&mut self, x: usize, y: usize, value: T) {
        if x < self.width && y < self.height {
            self.data[y * self.width + x] = value;
        }
    }

    /// Applies `f` to every pixel.
    pub fn map<U: Copy>(&self, f: impl FnMut(T) -> U) -> Image<U> {
        let data = self.data.iter().copied().map(f).collect();
        Image { width: self.width, height: self.height, data }
    }
}

impl<T: Copy + Into<f32>> Image<T> {
    /// Bilinear interpolation at a position between pixel centres; clamped to the border.
    pub fn sample(&self, x: f32, y: f32) -> f32 {
        let x = x.clamp(0.0, (self.width - 1) as f32);
        let y = y.clamp(0.0, (self.height - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(self.width - 1), (y0 + 1).min(self.height - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let at = |x: usize, y: usize| -> f32 { self.data[y * self.width + x].into() };
        let top = at(x0, y0) + fx * (at(x1, y0) - at(x0, y0));
        let bottom = at(x0, y1) + fx * (at(x1, y1) - at(x0, y1));
        top + fy * (bottom - top)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_is_interpolated_exactly() {
        let plane = Image::from_fn(8, 6, |x, y| 3.0 * x as f32 - 2.0 * y as f32);
        assert!((plane.sample(2.25, 3.5) - (6.75 - 7.0)).abs() < 1e-5);
        assert_eq!(plane.sample(-4.0, 0.0), 0.0);
    }

    #[test]
    fn a_wrong_length_is_refused() {
        assert!(Image::from_vec(3, 2, vec![0u8; 5]).is_none());
        assert!(Image::from_vec(usize::MAX, 2, vec![0u8; 5]).is_none());
    }
}
