//! A sheet of small pictures with their frame numbers, to see a whole run at a glance.

use super::font;
use super::image::Image;

/// Most pictures on a sheet.
const MOST: usize = 20;
/// Most pictures side by side.
const COLUMNS: usize = 5;
/// Width of a small picture, pixels.
const WIDTH: usize = 384;
/// Space between pictures, pixels.
const GAP: usize = 6;
const PAPER: [u8; 3] = [250, 250, 250];
const INK: [u8; 3] = [40, 40, 40];

/// Frames for the sheet: evenly spaced, the first and the last always among them.
pub(super) fn choose(numbers: &[u32]) -> Vec<u32> {
    let count = numbers.len().min(MOST);
    let spaces = count.saturating_sub(1).max(1);
    (0..count).map(|i| numbers[(i * (numbers.len() - 1) + spaces / 2) / spaces]).collect()
}

/// The picture at the size of the sheet's cells.
pub(super) fn thumbnail(image: &Image) -> Image {
    let width = WIDTH.min(image.width());
    image.shrunk(width, (image.height() * width).div_ceil(image.width().max(1)))
}

/// Lays small pictures out row by row and numbers them.
pub(super) fn compose(pictures: impl IntoIterator<Item = (u32, Image)>) -> Image {
    let pictures: Vec<(u32, Image)> = pictures.into_iter().collect();
    let width = pictures.iter().map(|(_, p)| p.width()).max().unwrap_or(1);
    let height = pictures.iter().map(|(_, p)| p.height()).max().unwrap_or(1);
    let square = (1..=COLUMNS).find(|columns| columns * columns >= pictures.len());
    let columns = square.unwrap_or(COLUMNS);
    let rows = pictures.len().div_ceil(columns).max(1);
    let mut sheet = Image::new(columns * (width + GAP) + GAP, rows * (height + GAP) + GAP);
    sheet.fill(PAPER);
    for (i, (frame, picture)) in pictures.iter().enumerate() {
        let (left, top) = (GAP + i % columns * (width + GAP), GAP + i / columns * (height + GAP));
        sheet.paste(picture, left, top);
        font::number(&mut sheet, *frame, (left, top), 3, INK, PAPER);
    }
    sheet
}
