//! The pixels of a `sensor_msgs/Image` as 8-bit grey.

use vergence_imaging::Image;

use crate::msg::sensor_msgs;

/// Longest side of a picture that is read (px).
const LONGEST_SIDE: u32 = 1 << 14;

/// Why pixels cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PixelError {
    /// No pixels, or more than any camera has.
    #[error("picture size {width}x{height} is not usable")]
    Size {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// A pixel format that has no grey value here.
    #[error(
        "encoding \"{0}\" is not read; known are mono8, mono16, rgb8, bgr8, rgba8, bgra8, \
         yuv422 and yuv422_yuy2"
    )]
    Encoding(String),
    /// Rows overlap, or the data ends before the last row.
    #[error("{bytes} bytes with {step} bytes a row are too few for rows of {row} bytes")]
    Short {
        /// How many bytes there are.
        bytes: usize,
        /// Bytes from row to row.
        step: u32,
        /// Bytes that a row needs.
        row: usize,
    },
}

/// How a pixel's bytes give its grey value.
#[derive(Clone, Copy)]
enum Format {
    /// The byte at an offset is the grey value.
    Luma { bytes: usize, offset: usize },
    /// Colour; where red, green and blue stand.
    Colour { bytes: usize, rgb: [usize; 3] },
}

impl Format {
    fn of(image: &sensor_msgs::Image) -> Option<Format> {
        let luma = |bytes, offset| Format::Luma { bytes, offset };
        let colour = |bytes, rgb| Format::Colour { bytes, rgb };
        Some(match image.encoding.as_str() {
            "mono8" | "8UC1" => luma(1, 0),
            // The high byte of sixteen bits.
            "mono16" | "16UC1" => luma(2, usize::from(image.is_bigendian == 0)),
            "rgb8" => colour(3, [0, 1, 2]),
            // OpenCV's nameless three channels are blue first.
            "bgr8" | "8UC3" => colour(3, [2, 1, 0]),
            "rgba8" => colour(4, [0, 1, 2]),
            "bgra8" | "8UC4" => colour(4, [2, 1, 0]),
            "yuv422" | "uyvy" => luma(2, 1),
            "yuv422_yuy2" | "yuyv" => luma(2, 0),
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Format::Luma { bytes, .. } | Format::Colour { bytes, .. } => bytes,
        }
    }
}

/// Grey pixels of a picture: the luma where there is one, the high byte of 16 bits, Rec. 709
/// weights for colour (as for JPEG and PNG in `vergence-imaging`).
pub(super) fn grey(image: sensor_msgs::Image) -> Result<Image<u8>, PixelError> {
    let (width, height) = (image.width, image.height);
    let size_error = PixelError::Size { width, height };
    if !(1..=LONGEST_SIDE).contains(&width) || !(1..=LONGEST_SIDE).contains(&height) {
        return Err(size_error);
    }
    let Some(format) = Format::of(&image) else {
        return Err(PixelError::Encoding(image.encoding));
    };
    let (columns, rows, step) = (width as usize, height as usize, image.step as usize);
    let row = columns * format.bytes();
    let bytes = image.data.len();
    // The last row need not be padded.
    if step < row || bytes < step * (rows - 1) + row {
        return Err(PixelError::Short { bytes, step: image.step, row });
    }
    if let (Format::Luma { bytes: 1, .. }, true) = (format, step == columns) {
        let mut data = image.data;
        data.truncate(columns * rows);
        return Image::from_vec(columns, rows, data).ok_or(size_error);
    }
    let mut data = Vec::with_capacity(columns * rows);
    for line in image.data.chunks(step).take(rows) {
        let pixels = line[..row].chunks_exact(format.bytes());
        match format {
            Format::Luma { offset, .. } => data.extend(pixels.map(|p| p[offset])),
            Format::Colour { rgb: [r, g, b], .. } => {
                data.extend(pixels.map(|p| rec709(p[r], p[g], p[b])));
            }
        }
    }
    Image::from_vec(columns, rows, data).ok_or(size_error)
}

fn rec709(r: u8, g: u8, b: u8) -> u8 {
    ((2126 * u32::from(r) + 7152 * u32::from(g) + 722 * u32::from(b)) / 10000) as u8
}
