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

/// Pictures side by side, up to four in a row, with their names below.
pub(super) fn beside(pictures: &[(&str, Image)]) -> Image {
    let width = pictures.iter().map(|(_, p)| p.width()).max().unwrap_or(1);
    let height = pictures.iter().map(|(_, p)| p.height()).max().unwrap_or(1);
    let columns = match pictures.len() {
        0..=4 => pictures.len().max(1),
        5..=6 => 3,
        _ => 4,
    };
    let rows = pictures.len().div_ceil(columns).max(1);
    let scale = if width >= 400 { 2 } else { 1 };
    let label = font::height(scale) + 2 * GAP;
    let mut sheet = Image::new(columns * (width + GAP) - GAP, rows * (height + label));
    sheet.fill(PAPER);
    for (i, (name, picture)) in pictures.iter().enumerate() {
        let (left, top) = (i % columns * (width + GAP), i / columns * (height + label));
        sheet.paste(picture, left, top);
        let name = font::cut(name, scale, width);
        let middle = left + (width - font::width(&name, scale).min(width)) / 2;
        font::text(&mut sheet, &name, (middle, top + height + GAP / 2), scale, INK);
    }
    sheet
}

/// Rows of small pictures with the numbers of their frames, each row with a name in front.
pub(super) fn rows(rows: &[(String, Vec<(u32, Image)>)]) -> Image {
    const SCALE: usize = 2;
    let all = || rows.iter().flat_map(|(_, pictures)| pictures);
    let width = all().map(|(_, p)| p.width()).max().unwrap_or(1);
    let height = all().map(|(_, p)| p.height()).max().unwrap_or(1);
    let columns = rows.iter().map(|(_, pictures)| pictures.len()).max().unwrap_or(0);
    let lines = |name: &str| name.split('\n').map(|line| font::width(line, SCALE)).max().unwrap_or(0);
    let first = rows.iter().map(|(name, _)| lines(name)).max().unwrap_or(0) + 2 * GAP;
    let mut sheet = Image::new(first + columns * (width + GAP) + GAP, rows.len() * (height + GAP) + GAP);
    sheet.fill(PAPER);
    for (i, (name, pictures)) in rows.iter().enumerate() {
        let top = GAP + i * (height + GAP);
        for (line, text) in name.split('\n').enumerate() {
            font::text(&mut sheet, text, (GAP, top + line * font::height(SCALE)), SCALE, INK);
        }
        for (j, (frame, picture)) in pictures.iter().enumerate() {
            let left = first + GAP + j * (width + GAP);
            sheet.paste(picture, left, top);
            font::number(&mut sheet, *frame, (left, top), 2, INK, PAPER);
        }
    }
    sheet
}
