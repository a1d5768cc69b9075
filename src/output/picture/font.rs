//! Digits of 3x5 pixels for frame numbers, and letters of 5x7 pixels for names.

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

/// Glyphs of 5x7 dots, seven rows of five bits from the top, ascending by character.
#[rustfmt::skip]
const GLYPHS: [(char, u64); 77] = [
    (' ', 0x000000000), ('%', 0x672222273), ('(', 0x088842082), (')', 0x208210888), ('+', 0x0084f9080),
    (',', 0x000000088), ('-', 0x0000f8000), ('.', 0x00000018c), ('/', 0x042222210), ('0', 0x3a33ae62e),
    ('1', 0x11842108e), ('2', 0x3a213221f), ('3', 0x7c441062e), ('4', 0x08ca97c42), ('5', 0x7e1e0862e),
    ('6', 0x1910f462e), ('7', 0x7c2222108), ('8', 0x3a317462e), ('9', 0x3a317844c), (':', 0x018c03180),
    ('=', 0x001f07c00), ('?', 0x3a2111004), ('A', 0x3a31fc631), ('B', 0x7a31f463e), ('C', 0x3e108420f),
    ('D', 0x7a318c63e), ('E', 0x7e10f421f), ('F', 0x7e10f4210), ('G', 0x3e109c62f), ('H', 0x4631fc631),
    ('I', 0x38842108e), ('J', 0x1c4210a4c), ('K', 0x4654c5251), ('L', 0x42108421f), ('M', 0x4775ac631),
    ('N', 0x4735ace31), ('O', 0x3a318c62e), ('P', 0x7a31f4210), ('Q', 0x3a318d64d), ('R', 0x7a31f5251),
    ('S', 0x3e107043e), ('T', 0x7c8421084), ('U', 0x46318c62e), ('V', 0x46318c544), ('W', 0x4631ad771),
    ('X', 0x462a22a31), ('Y', 0x462a21084), ('Z', 0x7c222221f), ('[', 0x39084210e), (']', 0x38421084e),
    ('_', 0x00000001f), ('a', 0x000e0be2f), ('b', 0x421e8c63e), ('c', 0x000f8420f), ('d', 0x042f8c62f),
    ('e', 0x000e8fe0e), ('f', 0x191c42108), ('g', 0x01f18bc2e), ('h', 0x421e8c631), ('i', 0x100c2108e),
    ('j', 0x080610a4c), ('k', 0x4212a6292), ('l', 0x30842108e), ('m', 0x001aad6b5), ('n', 0x001e8c631),
    ('o', 0x000e8c62e), ('p', 0x001e8fa10), ('q', 0x000f8bc21), ('r', 0x0016c4210), ('s', 0x000f8383e),
    ('t', 0x211c42106), ('u', 0x00118c62f), ('v', 0x00118c544), ('w', 0x0011ad6aa), ('x', 0x001151151),
    ('y', 0x00118bc2e), ('z', 0x001f1111f),
];
/// Dots from a character to the next, and from a line to the next.
const ADVANCE: (usize, usize) = (6, 9);

/// Width of a text, pixels, where every dot is `scale` wide.
pub(super) fn width(text: &str, scale: usize) -> usize {
    (text.chars().count() * ADVANCE.0).saturating_sub(1) * scale
}

/// Height of a line, pixels.
pub(super) fn height(scale: usize) -> usize {
    ADVANCE.1 * scale
}

/// Writes `text` with its top left corner at (`left`, `top`). What is outside of the picture is cut off; characters
/// without a glyph are question marks.
pub(super) fn text(image: &mut Image, text: &str, (left, top): (usize, usize), scale: usize, ink: [u8; 3]) {
    for (i, character) in text.chars().enumerate() {
        let find = |character| GLYPHS.binary_search_by_key(&character, |(known, _)| *known).ok();
        let Some(glyph) = find(character).or_else(|| find('?')) else { continue };
        for dot in 0..35 {
            if GLYPHS[glyph].1 >> (34 - dot) & 1 == 0 {
                continue;
            }
            let (x, y) = (left + (i * ADVANCE.0 + dot % 5) * scale, top + (1 + dot / 5) * scale);
            for (x, y) in (0..scale * scale).map(|k| (x + k % scale, y + k / scale)) {
                if x < image.width() && y < image.height() {
                    image.set(x, y, ink);
                }
            }
        }
    }
}

/// The text, with its beginning left out where it is wider than `room` pixels.
pub(super) fn cut(text: &str, scale: usize, room: usize) -> String {
    let fits = (room + scale) / (ADVANCE.0 * scale);
    let count = text.chars().count();
    if count <= fits {
        return text.into();
    }
    let kept: String = text.chars().skip(count - fits.saturating_sub(2)).collect();
    format!("..{kept}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn glyphs_are_in_order_and_names_are_cut_at_their_beginnings() {
        assert!(GLYPHS.windows(2).all(|pair| pair[0].0 < pair[1].0));
        let mut image = Image::new(12, 9);
        text(&mut image, "L\u{e9}", (0, 0), 1, [255; 3]);
        let row = |y: usize| (0..11).map(|x| if image.get(x, y)[0] > 0 { '#' } else { '.' }).collect::<String>();
        assert_eq!([row(1), row(7)], ["#......###.", "#####...#.."]);
        assert_eq!((cut("out/flag", 2, 12 * 8), cut("out/flag", 2, 12 * 6)), ("out/flag".into(), "..flag".into()));
    }
}
