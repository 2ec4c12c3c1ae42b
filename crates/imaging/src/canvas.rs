//! A colour canvas for the pictures that explain a run: images side by side, lines, marks, plots.

use crate::Image;

/// A colour, red green blue.
pub type Rgb = [u8; 3];

/// Colours of the pictures; readable on grey and told apart by most colour-blind people.
pub mod colour {
    use super::Rgb;
    /// Orange.
    pub const ORANGE: Rgb = [255, 140, 0];
    /// Sky blue.
    pub const BLUE: Rgb = [86, 180, 233];
    /// Bluish green.
    pub const GREEN: Rgb = [0, 200, 130];
    /// Reddish purple.
    pub const PURPLE: Rgb = [214, 110, 190];
    /// Yellow.
    pub const YELLOW: Rgb = [240, 228, 66];
    /// White.
    pub const WHITE: Rgb = [255, 255, 255];
    /// Black.
    pub const BLACK: Rgb = [0, 0, 0];
}

/// A drawing surface; everything outside is clipped.
#[derive(Debug, Clone, PartialEq)]
pub struct Canvas {
    pixels: Image<Rgb>,
}

impl Canvas {
    /// A canvas of one colour.
    pub fn new(width: usize, height: usize, background: Rgb) -> Self {
        Canvas { pixels: Image::filled(width, height, background) }
    }

    /// A grey image enlarged by a whole factor, every pixel a square.
    pub fn from_gray(image: &Image<u8>, scale: usize) -> Self {
        let mut canvas = Canvas::new(image.width() * scale, image.height() * scale, colour::BLACK);
        canvas.blit_gray(image, 0, 0, scale);
        canvas
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.pixels.width()
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.pixels.height()
    }

    /// The drawn pixels.
    pub fn pixels(&self) -> &Image<Rgb> {
        &self.pixels
    }

    /// Draws a grey image with its top-left corner at (`left`, `top`), enlarged by a whole factor.
    pub fn blit_gray(&mut self, image: &Image<u8>, left: usize, top: usize, scale: usize) {
        for y in 0..image.height() * scale {
            for x in 0..image.width() * scale {
                let gray = image.row(y / scale)[x / scale];
                self.pixels.set(left + x, top + y, [gray; 3]);
            }
        }
    }

    /// Draws another canvas with its top-left corner at (`left`, `top`).
    pub fn blit(&mut self, other: &Canvas, left: usize, top: usize) {
        for y in 0..other.height() {
            for (x, &pixel) in other.pixels.row(y).iter().enumerate() {
                self.pixels.set(left + x, top + y, pixel);
            }
        }
    }

    /// Blends a pixel towards a colour; `alpha` in [0, 1].
    fn blend(&mut self, x: i64, y: i64, colour: Rgb, alpha: f64) {
        if x < 0 || y < 0 {
            return;
        }
        let (x, y) = (x as usize, y as usize);
        if let Some(below) = self.pixels.get(x, y) {
            let mix = |b: u8, c: u8| (f64::from(b) + (f64::from(c) - f64::from(b)) * alpha) as u8;
            self.pixels.set(x, y, std::array::from_fn(|k| mix(below[k], colour[k])));
        }
    }

    /// An anti-aliased line about one and a half pixels wide, in canvas coordinates.
    pub fn line(&mut self, from: (f64, f64), to: (f64, f64), colour: Rgb) {
        let far = 4.0 * (self.width() + self.height()) as f64;
        let usable = |p: (f64, f64)| p.0.abs() < far && p.1.abs() < far;
        if !usable(from) || !usable(to) {
            return;
        }
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        let length2 = (dx * dx + dy * dy).max(1e-12);
        let range = |a: f64, b: f64| (a.min(b).floor() as i64 - 1, a.max(b).ceil() as i64 + 1);
        let ((x0, x1), (y0, y1)) = (range(from.0, to.0), range(from.1, to.1));
        for y in y0.max(0)..=y1.min(self.height() as i64 - 1) {
            for x in x0.max(0)..=x1.min(self.width() as i64 - 1) {
                let (px, py) = (x as f64 - from.0, y as f64 - from.1);
                let along = ((px * dx + py * dy) / length2).clamp(0.0, 1.0);
                let distance = (px - along * dx).hypot(py - along * dy);
                let alpha = (1.25 - distance).clamp(0.0, 1.0);
                if alpha > 0.0 {
                    self.blend(x, y, colour, alpha);
                }
            }
        }
    }

    /// A cross whose arms leave the centre free, as gun sights do.
    pub fn cross(&mut self, centre: (f64, f64), arm: f64, colour: Rgb) {
        for (ux, uy) in [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
            let at = |r: f64| (centre.0 + ux * r, centre.1 + uy * r);
            self.line(at(arm * 0.35), at(arm), colour);
        }
    }

    /// A circle drawn as a polygon.
    pub fn circle(&mut self, centre: (f64, f64), radius: f64, colour: Rgb) {
        let at = |k: usize| {
            let angle = k as f64 * std::f64::consts::TAU / 32.0;
            (centre.0 + radius * angle.cos(), centre.1 + radius * angle.sin())
        };
        for k in 0..32 {
            self.line(at(k), at(k + 1), colour);
        }
    }

    /// A filled rectangle.
    pub fn fill(&mut self, left: usize, top: usize, width: usize, height: usize, colour: Rgb) {
        for y in top..top + height {
            for x in left..left + width {
                self.pixels.set(x, y, colour);
            }
        }
    }

    /// A plot of values over the rectangle, from `low` at the bottom to `high` at the top.
    pub fn plot(&mut self, rect: [usize; 4], values: &[f64], low: f64, high: f64, colour: Rgb) {
        let [left, top, width, height] = rect;
        let span = (high - low).max(1e-12);
        let point = |k: usize| {
            let x = left as f64 + (k as f64 + 0.5) * width as f64 / values.len() as f64;
            let y = ((values[k].clamp(low, high) - low) / span) * (height as f64 - 1.0);
            (x, top as f64 + height as f64 - 1.0 - y)
        };
        for k in 1..values.len() {
            self.line(point(k - 1), point(k), colour);
        }
    }

    /// Text in a built-in 5x7 face, `scale` times enlarged; characters it lacks are left blank.
    pub fn text(&mut self, left: usize, top: usize, scale: usize, text: &str, colour: Rgb) {
        for (index, character) in text.chars().enumerate() {
            let Some(rows) = crate::canvas::glyph(character) else { continue };
            for (y, bits) in rows.iter().enumerate() {
                for x in 0..5 {
                    if bits >> (4 - x) & 1 == 1 {
                        let (px, py) = (left + (index * 6 + x) * scale, top + y * scale);
                        self.fill(px, py, scale, scale, colour);
                    }
                }
            }
        }
    }
}

/// The rows of a character, most significant of five bits at the left; letters are capitals.
fn glyph(character: char) -> Option<[u8; 7]> {
    Some(match character.to_ascii_uppercase() {
        'A' => [14, 17, 17, 31, 17, 17, 17],
        'B' => [30, 17, 17, 30, 17, 17, 30],
        'C' => [14, 17, 16, 16, 16, 17, 14],
        'D' => [30, 17, 17, 17, 17, 17, 30],
        'E' => [31, 16, 16, 30, 16, 16, 31],
        'F' => [31, 16, 16, 30, 16, 16, 16],
        'G' => [14, 17, 16, 23, 17, 17, 15],
        'H' => [17, 17, 17, 31, 17, 17, 17],
        'I' => [14, 4, 4, 4, 4, 4, 14],
        'J' => [7, 2, 2, 2, 2, 18, 12],
        'K' => [17, 18, 20, 24, 20, 18, 17],
        'L' => [16, 16, 16, 16, 16, 16, 31],
        'M' => [17, 27, 21, 21, 17, 17, 17],
        'N' => [17, 25, 21, 19, 17, 17, 17],
        'O' => [14, 17, 17, 17, 17, 17, 14],
        'P' => [30, 17, 17, 30, 16, 16, 16],
        'Q' => [14, 17, 17, 17, 21, 18, 13],
        'R' => [30, 17, 17, 30, 20, 18, 17],
        'S' => [15, 16, 16, 14, 1, 1, 30],
        'T' => [31, 4, 4, 4, 4, 4, 4],
        'U' => [17, 17, 17, 17, 17, 17, 14],
        'V' => [17, 17, 17, 17, 17, 10, 4],
        'W' => [17, 17, 17, 21, 21, 27, 17],
        'X' => [17, 17, 10, 4, 10, 17, 17],
        'Y' => [17, 17, 10, 4, 4, 4, 4],
        'Z' => [31, 1, 2, 4, 8, 16, 31],
        '0' => [14, 17, 19, 21, 25, 17, 14],
        '1' => [4, 12, 4, 4, 4, 4, 14],
        '2' => [14, 17, 1, 6, 8, 16, 31],
        '3' => [31, 2, 4, 2, 1, 17, 14],
        '4' => [2, 6, 10, 18, 31, 2, 2],
        '5' => [31, 16, 30, 1, 1, 17, 14],
        '6' => [6, 8, 16, 30, 17, 17, 14],
        '7' => [31, 1, 2, 4, 8, 8, 8],
        '8' => [14, 17, 17, 14, 17, 17, 14],
        '9' => [14, 17, 17, 15, 1, 2, 12],
        '.' => [0, 0, 0, 0, 0, 12, 12],
        ',' => [0, 0, 0, 0, 12, 4, 8],
        ':' => [0, 12, 12, 0, 12, 12, 0],
        '-' => [0, 0, 0, 31, 0, 0, 0],
        '+' => [0, 4, 4, 31, 4, 4, 0],
        '=' => [0, 0, 31, 0, 31, 0, 0],
        '/' => [1, 1, 2, 4, 8, 16, 16],
        '(' => [2, 4, 8, 8, 8, 4, 2],
        ')' => [8, 4, 2, 2, 2, 4, 8],
        '%' => [24, 25, 2, 4, 8, 19, 3],
        '<' => [2, 4, 8, 16, 8, 4, 2],
        '>' => [8, 4, 2, 1, 2, 4, 8],
        '_' => [0, 0, 0, 0, 0, 0, 31],
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drawing_outside_is_clipped() {
        let mut canvas = Canvas::new(20, 10, colour::BLACK);
        canvas.line((-30.0, 5.0), (60.0, 5.0), colour::WHITE);
        canvas.line((f64::NAN, 5.0), (60.0, 1e12), colour::WHITE);
        canvas.text(15, 5, 2, "EDGE", colour::WHITE);
        canvas.blit_gray(&Image::filled(30, 30, 9), 12, 7, 2);
        assert_eq!(canvas.pixels().get(3, 5), Some(colour::WHITE));
        assert_eq!(canvas.pixels().get(3, 1), Some(colour::BLACK));
    }
}
