//! A picture in memory, and PNG files.

use std::io;
use std::path::Path;
use std::sync::OnceLock;

use crate::math::Vec3;
use crate::output::{WriteError, write_atomically};

/// An sRGB picture, 8 bits per channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
}

impl Image {
    /// A black picture of `width` x `height` pixels.
    pub fn new(width: usize, height: usize) -> Image {
        Image { width, height, rgb: vec![0; width * height * 3] }
    }

    /// The picture with these pixels, 4 bytes each, row by row; the fourth byte is left out. Panics if they are too
    /// few.
    pub fn from_rgba(width: usize, height: usize, rgba: &[u8]) -> Image {
        let rgb = rgba[..width * height * 4].chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
        Image { width, height, rgb }
    }

    /// Red, green and blue of all pixels, row by row.
    pub(super) fn bytes(&self) -> &[u8] {
        &self.rgb
    }

    /// Width, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Color of a pixel; row 0 is the top.
    pub fn get(&self, x: usize, y: usize) -> [u8; 3] {
        let at = (y * self.width + x) * 3;
        [self.rgb[at], self.rgb[at + 1], self.rgb[at + 2]]
    }

    /// Sets a pixel, sRGB; row 0 is the top.
    pub fn set(&mut self, x: usize, y: usize, color: [u8; 3]) {
        let at = (y * self.width + x) * 3;
        self.rgb[at..at + 3].copy_from_slice(&color);
    }

    /// Draws an edge around the picture, a hundredth of its width wide.
    pub fn frame(&mut self, color: [u8; 3]) {
        let wide = (self.width / 100).max(2);
        for y in 0..self.height {
            for x in 0..self.width {
                if x < wide || y < wide || x + wide >= self.width || y + wide >= self.height {
                    self.set(x, y, color);
                }
            }
        }
    }

    /// Makes all pixels one color.
    pub fn fill(&mut self, color: [u8; 3]) {
        self.rgb.chunks_exact_mut(3).for_each(|pixel| pixel.copy_from_slice(&color));
    }

    /// Copies `other` to a place; what does not fit is cut off.
    pub fn paste(&mut self, other: &Image, left: usize, top: usize) {
        let columns = other.width.min(self.width.saturating_sub(left));
        for y in 0..other.height.min(self.height.saturating_sub(top)) {
            let to = ((top + y) * self.width + left) * 3;
            let from = y * other.width * 3;
            self.rgb[to..to + columns * 3].copy_from_slice(&other.rgb[from..from + columns * 3]);
        }
    }

    /// A smaller picture: every pixel is the mean of those it covers.
    pub fn shrunk(&self, width: usize, height: usize) -> Image {
        let (width, height) = (width.clamp(1, self.width), height.clamp(1, self.height));
        let mut small = Image::new(width, height);
        for y in 0..height {
            let rows = y * self.height / height..((y + 1) * self.height / height).max(y * self.height / height + 1);
            for x in 0..width {
                let columns = x * self.width / width..((x + 1) * self.width / width).max(x * self.width / width + 1);
                let mut sum = [0usize; 3];
                for row in rows.clone() {
                    for column in columns.clone() {
                        let color = self.get(column, row);
                        (0..3).for_each(|c| sum[c] += usize::from(color[c]));
                    }
                }
                let count = rows.len() * columns.len();
                small.set(x, y, sum.map(|s| ((s + count / 2) / count) as u8));
            }
        }
        small
    }

    /// Writes a PNG file.
    pub fn save(&self, path: &Path) -> Result<(), WriteError> {
        write_atomically(path, |out| self.encode(out))
    }

    /// The bytes of a PNG file.
    ///
    /// # Errors
    /// The picture is too large for the format.
    pub fn png(&self) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.encode(&mut bytes)?;
        Ok(bytes)
    }

    fn encode(&self, out: impl io::Write) -> io::Result<()> {
        let mut encoder = png::Encoder::new(out, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_compression(png::Compression::Balanced);
        let mut writer = encoder.write_header().map_err(io_from_png)?;
        writer.write_image_data(&self.rgb).map_err(io_from_png)?;
        writer.finish().map_err(io_from_png)
    }
}

pub(super) fn io_from_png(error: png::EncodingError) -> io::Error {
    match error {
        png::EncodingError::IoError(e) => e,
        other => io::Error::other(other),
    }
}

/// 8-bit sRGB of a linear color.
pub(super) fn srgb_from_linear(color: Vec3) -> [u8; 3] {
    const STEPS: usize = 4096;
    static TABLE: OnceLock<Vec<u8>> = OnceLock::new();
    let table = TABLE.get_or_init(|| {
        let encode = |i: usize| {
            let x = i as f32 / STEPS as f32;
            let y = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 };
            (y * 255.0 + 0.5) as u8
        };
        (0..=STEPS).map(encode).collect()
    });
    color.to_array().map(|x| table[(x.clamp(0.0, 1.0) * STEPS as f32 + 0.5) as usize])
}
