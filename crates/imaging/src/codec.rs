//! PNG and JPEG, in and out.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, GrayImage, ImageDecoder, ImageFormat};

use crate::{Canvas, Image};

/// Largest picture that is read, in pixels: a bound on memory for files from outside.
const MAX_PIXELS: u64 = 1 << 26;

/// Why a picture could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum CodecError {
    /// The file could not be opened or written.
    #[error("{path}: {source}")]
    File {
        /// Which file.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The content is no picture that we can read.
    #[error("not a readable picture: {0}")]
    Content(#[from] image::ImageError),
    /// The header announces more pixels than any camera of ours has.
    #[error("a picture of {width}x{height} pixels is too large")]
    TooLarge {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
}

/// Decodes PNG or JPEG bytes to grey (Rec. 709 weights for colour).
pub fn decode(bytes: &[u8]) -> Result<Image<u8>, CodecError> {
    let decoder = open(bytes)?;
    let (width, height) = decoder.dimensions();
    // Before any memory is taken: a few bytes may announce gigabytes.
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(CodecError::TooLarge { width, height });
    }
    limits().reserve(decoder.total_bytes())?;
    let gray = DynamicImage::from_decoder(decoder)?.into_luma8();
    let (width, height) = (gray.width() as usize, gray.height() as usize);
    Ok(Image::from_fn(width, height, |x, y| gray.as_raw()[y * width + x]))
}

/// Columns and rows that the header of PNG or JPEG bytes announces; nothing is decoded.
pub fn size(bytes: &[u8]) -> Result<(usize, usize), CodecError> {
    let (width, height) = open(bytes)?.dimensions();
    Ok((width as usize, height as usize))
}

/// Reads the header.
fn open(bytes: &[u8]) -> Result<impl ImageDecoder, CodecError> {
    let mut reader = image::ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(image::ImageError::IoError)?;
    reader.limits(limits());
    Ok(reader.into_decoder()?)
}

/// Memory for the largest picture as colour with transparency.
fn limits() -> image::Limits {
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(MAX_PIXELS * 4);
    limits
}

/// Reads a PNG or JPEG file as grey.
pub fn read(path: &Path) -> Result<Image<u8>, CodecError> {
    let bytes = std::fs::read(path)
        .map_err(|source| CodecError::File { path: path.display().to_string(), source })?;
    decode(&bytes)
}

/// Encodes as JPEG of the given quality (1 to 100).
pub fn encode_jpeg(image: &Image<u8>, quality: u8) -> Result<Vec<u8>, CodecError> {
    let mut out = Vec::new();
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, quality);
    encoder.encode(
        image.data(),
        image.width() as u32,
        image.height() as u32,
        image::ExtendedColorType::L8,
    )?;
    Ok(out)
}

/// Encodes as PNG.
pub fn encode_png(image: &Image<u8>) -> Result<Vec<u8>, CodecError> {
    let gray =
        GrayImage::from_raw(image.width() as u32, image.height() as u32, image.data().into())
            .unwrap_or_default();
    png(DynamicImage::ImageLuma8(gray))
}

fn png(picture: DynamicImage) -> Result<Vec<u8>, CodecError> {
    let mut out = Cursor::new(Vec::new());
    picture.write_to(&mut out, ImageFormat::Png)?;
    Ok(out.into_inner())
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), CodecError> {
    std::fs::write(path, bytes)
        .map_err(|source| CodecError::File { path: path.display().to_string(), source })
}

/// Writes a grey PNG file.
pub fn write_png(path: &Path, image: &Image<u8>) -> Result<(), CodecError> {
    write(path, &encode_png(image)?)
}

/// Writes a drawing as a colour PNG file.
pub fn write_canvas(path: &Path, canvas: &Canvas) -> Result<(), CodecError> {
    let (width, height) = (canvas.width() as u32, canvas.height() as u32);
    let bytes: Vec<u8> = canvas.pixels().data().iter().flatten().copied().collect();
    let rgb = image::RgbImage::from_raw(width, height, bytes).unwrap_or_default();
    write(path, &png(DynamicImage::ImageRgb8(rgb))?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> Image<u8> {
        Image::from_fn(64, 48, |x, y| (2 * x + y) as u8)
    }

    #[test]
    fn png_is_lossless_and_jpeg_is_near() {
        assert_eq!(decode(&encode_png(&ramp()).unwrap()).unwrap(), ramp());
        let jpeg = decode(&encode_jpeg(&ramp(), 90).unwrap()).unwrap();
        let worst = jpeg.data().iter().zip(ramp().data()).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst.unwrap() < 8, "worst difference {worst:?}");
    }

    #[test]
    fn rubbish_is_an_error() {
        assert!(decode(b"not a picture").is_err());
        let png = encode_png(&ramp()).unwrap();
        assert!(decode(&png[..png.len() / 2]).is_err());
    }

    #[test]
    fn a_header_that_announces_too_many_pixels_is_refused_before_decoding() {
        let mut jpeg = encode_jpeg(&ramp(), 90).unwrap();
        // Start of frame: marker, length, bits, rows, columns.
        let frame = jpeg.windows(2).position(|w| w == [0xFF, 0xC0]).unwrap();
        assert_eq!(size(&jpeg).unwrap(), (64, 48));
        let side = 1u16 << 14;
        jpeg[frame + 5..frame + 7].copy_from_slice(&side.to_be_bytes());
        jpeg[frame + 7..frame + 9].copy_from_slice(&side.to_be_bytes());
        assert_eq!(size(&jpeg).unwrap(), (1 << 14, 1 << 14));
        let error = decode(&jpeg).unwrap_err();
        assert!(matches!(error, CodecError::TooLarge { width: 16384, height: 16384 }), "{error}");
    }
}
