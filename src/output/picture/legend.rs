//! The scale of colors in the corner of a picture.

use super::font;
use super::image::{Image, srgb_from_linear};
use super::palette::{Scale, on_scale};

/// A scale with what its ends mean.
#[derive(Clone, Debug)]
pub(super) struct Legend {
    /// Colors from low to high.
    pub scale: &'static Scale,
    /// Name of the value.
    pub name: &'static str,
    /// Texts of the low and the high end.
    pub ends: [String; 2],
}

/// Narrowest picture that has room for a legend, pixels.
const NARROWEST: usize = 320;
const INK: [u8; 3] = [40, 40, 40];

impl Legend {
    /// Draws the scale into the lower left corner; a small picture stays without one.
    pub(super) fn draw(&self, image: &mut Image) {
        if image.width() < NARROWEST || image.height() < NARROWEST / 2 {
            return;
        }
        let scale = (image.width() / 480).max(1);
        let (margin, wide, high) = (8 * scale, image.width() / 4, 6 * scale);
        let top = image.height() - margin - high - font::height(scale);
        for x in 0..wide {
            let color = srgb_from_linear(on_scale(self.scale, x as f32 / (wide - 1) as f32)[0]);
            (top..top + high).for_each(|y| image.set(margin + x, y, color));
        }
        let [low, high_end] = &self.ends;
        let below = top + high;
        font::text(image, low, (margin, below), scale, INK);
        let right = margin + wide.saturating_sub(font::width(high_end, scale));
        font::text(image, high_end, (right, below), scale, INK);
        font::text(image, self.name, (margin, top.saturating_sub(font::height(scale))), scale, INK);
    }
}
