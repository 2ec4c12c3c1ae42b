//! From what a camera delivers to grey: buffer bytes in, [`Image`] out.
//!
//! Luma is taken as it comes. In `yuyv` and `nv12` it mostly spans 16 to 235 instead of 0 to 255; a
//! stretch would only add rounding, and nothing here needs absolute brightness.

use vergence_imaging::{Image, codec};

use super::huffman;
use crate::v4l2::PixelFormat;

impl PixelFormat {
    /// All, best first: grey loses nothing, JPEG loses most.
    pub(super) const ALL: [PixelFormat; 4] =
        [PixelFormat::Grey, PixelFormat::Yuyv, PixelFormat::Nv12, PixelFormat::Mjpeg];

    /// The kernel's four character code.
    pub(super) fn code(self) -> u32 {
        u32::from_le_bytes(match self {
            PixelFormat::Grey => *b"GREY",
            PixelFormat::Yuyv => *b"YUYV",
            PixelFormat::Nv12 => *b"NV12",
            PixelFormat::Mjpeg => *b"MJPG",
        })
    }

    /// Bytes from one luma value to the next, and of a row without padding; `None` for JPEG.
    fn pixel_bytes(self) -> Option<usize> {
        match self {
            PixelFormat::Grey | PixelFormat::Nv12 => Some(1),
            PixelFormat::Yuyv => Some(2),
            PixelFormat::Mjpeg => None,
        }
    }
}

/// How pictures lie in a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    pub format: PixelFormat,
    pub width: usize,
    pub height: usize,
    /// Bytes from one row to the next; zero where the format has no rows.
    pub stride: usize,
}

impl Layout {
    /// A layout whose rows fit their stride; drivers that do not tell a stride have none.
    pub fn new(format: PixelFormat, width: usize, height: usize, stride: usize) -> Option<Self> {
        let row = width * format.pixel_bytes().unwrap_or(0);
        let stride = if stride == 0 { row } else { stride };
        let fits = stride >= row && width > 0 && height > 0;
        fits.then_some(Layout { format, width, height, stride })
    }

    /// The picture in a buffer, or what is wrong with it.
    pub fn grey(&self, bytes: &[u8]) -> Result<Image<u8>, String> {
        let Some(step) = self.format.pixel_bytes() else { return self.jpeg(bytes) };
        // The last row may come without its padding.
        let needed = self.stride * (self.height - 1) + self.width * step;
        if bytes.len() < needed {
            return Err(format!("a picture of {} bytes instead of {needed}", bytes.len()));
        }
        let mut image = Image::filled(self.width, self.height, 0);
        for (y, row) in bytes.chunks(self.stride).take(self.height).enumerate() {
            match step {
                1 => image.row_mut(y).copy_from_slice(&row[..self.width]),
                _ => {
                    for (grey, pair) in image.row_mut(y).iter_mut().zip(row.chunks_exact(2)) {
                        *grey = pair[0];
                    }
                }
            }
        }
        Ok(image)
    }

    fn jpeg(&self, bytes: &[u8]) -> Result<Image<u8>, String> {
        let image = codec::decode(&huffman::complete(bytes)).map_err(|e| e.to_string())?;
        if (image.width(), image.height()) != (self.width, self.height) {
            let (width, height) = (image.width(), image.height());
            return Err(format!(
                "a picture of {width}x{height} instead of {}x{}",
                self.width, self.height
            ));
        }
        Ok(image)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(x: usize, y: usize) -> u8 {
        (10 + 7 * x + 31 * y) as u8
    }

    /// A buffer with `step` bytes a pixel, rows `stride` apart, 0xEE wherever no luma is.
    fn buffer(width: usize, height: usize, step: usize, stride: usize) -> Vec<u8> {
        let mut bytes = vec![0xEE; stride * (height - 1) + width * step];
        for y in 0..height {
            for x in 0..width {
                bytes[y * stride + x * step] = value(x, y);
            }
        }
        bytes
    }

    #[test]
    fn luma_is_found_under_any_stride() {
        let truth = Image::from_fn(6, 3, value);
        for (format, step) in
            [(PixelFormat::Grey, 1), (PixelFormat::Yuyv, 2), (PixelFormat::Nv12, 1)]
        {
            for padding in [0, 1, 20] {
                let stride = 6 * step + padding;
                let layout = Layout::new(format, 6, 3, stride).unwrap();
                let mut bytes = buffer(6, 3, step, stride);
                assert_eq!(layout.grey(&bytes).unwrap(), truth, "{layout:?}");
                // Colour planes and what else follows are no matter.
                bytes.extend([0xEE; 64]);
                assert_eq!(layout.grey(&bytes).unwrap(), truth, "{layout:?}");
            }
        }
    }

    #[test]
    fn short_pictures_and_short_strides_are_refused() {
        let layout = Layout::new(PixelFormat::Yuyv, 6, 3, 16).unwrap();
        let bytes = buffer(6, 3, 2, 16);
        assert!(layout.grey(&bytes[..bytes.len() - 1]).unwrap_err().contains("43 bytes"));
        assert_eq!(Layout::new(PixelFormat::Yuyv, 6, 3, 11), None);
        assert_eq!(Layout::new(PixelFormat::Grey, 6, 3, 0).unwrap().stride, 6);
        assert_eq!(Layout::new(PixelFormat::Grey, 6, 0, 6), None);
    }

    #[test]
    fn jpeg_pictures_come_with_or_without_their_tables() {
        let truth = Image::from_fn(32, 16, |x, y| (60 + 3 * x + 2 * y) as u8);
        let file = codec::encode_jpeg(&truth, 95).unwrap();
        let layout = Layout::new(PixelFormat::Mjpeg, 32, 16, 0).unwrap();
        let near = |image: Image<u8>| {
            image.data().iter().zip(truth.data()).all(|(a, b)| a.abs_diff(*b) < 6)
        };
        assert!(near(layout.grey(&file).unwrap()));
        // USB cameras leave the standard Huffman tables out.
        let bare = without_huffman_tables(&file);
        assert!(bare.len() + 100 < file.len());
        assert!(near(layout.grey(&bare).unwrap()));
        // Some pad the picture with zeros.
        assert!(near(layout.grey(&[&file[..], &[0; 512]].concat()).unwrap()));
        assert!(layout.grey(&file[..20]).is_err());
        let other = Layout::new(PixelFormat::Mjpeg, 16, 16, 0).unwrap();
        assert!(other.grey(&file).unwrap_err().contains("32x16 instead of 16x16"));
    }

    /// Drops the segments DHT (0xFFC4) before the picture's data.
    fn without_huffman_tables(file: &[u8]) -> Vec<u8> {
        let mut out = file[..2].to_vec();
        let mut rest = &file[2..];
        while rest[1] != 0xDA {
            let length = 2 + usize::from(u16::from_be_bytes([rest[2], rest[3]]));
            if rest[1] != 0xC4 {
                out.extend(&rest[..length]);
            }
            rest = &rest[length..];
        }
        out.extend(rest);
        out
    }
}
