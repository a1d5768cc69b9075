//! Digits of 3x5 pixels, for frame numbers.

use super::image::Image;

/// Rows from the top, three bits each.
const DIGITS: [[u8; 5]; 10] = [
    [0b111, 0b101, 0b101, 0b101, 0b111],
    [0b010, 0b110, 0b010, 0b010, 0b111],
    [0b111, 0b001, 0b111, 0b100, 0b111],
    [0b111, 0b001, 0b111, 0b001, 0b111],
    [0b101, 0b101, 0b111, 0b001, 0b001],
    [0b111, 0b100, 0b111, 0b001, 0b111],
    [0b111, 0b100, 0b111, 0b101, 0b111],
    [0b111, 0b001, 0b010, 0b010, 0b010],
    [0b111, 0b101, 0b111, 0b101, 0b111],
    [0b111, 0b101, 0b111, 0b001, 0b111],
];

/// Writes `number` with its top left corner at (`left`, `top`), every dot `scale` pixels wide, on a box of `paper`.
/// Dots outside the picture are cut off.
pub(super) fn number(
    image: &mut Image,
    number: u32,
    (left, top): (usize, usize),
    scale: usize,
    ink: [u8; 3],
    paper: [u8; 3],
) {
    let digits = number.to_string();
    let (columns, rows) = (digits.len() * 4 + 1, 7);
    for y in 0..rows * scale {
        for x in 0..columns * scale {
            // One dot of paper around every digit.
            let (column, row) = (x / scale, y / scale);
            let digit = usize::from(digits.as_bytes()[(column.saturating_sub(1) / 4).min(digits.len() - 1)] - b'0');
            let (dot, line) = (column.wrapping_sub(1) % 4, row.wrapping_sub(1));
            let inked = column > 0 && dot < 3 && line < 5 && DIGITS[digit][line] >> (2 - dot) & 1 == 1;
            if left + x < image.width() && top + y < image.height() {
                image.set(left + x, top + y, if inked { ink } else { paper });
            }
        }
    }
}
