//! Colors of cloth and obstacles: those of the page of `loomtree view` (`view/page/colors.js`), in linear light.

use crate::math::Vec3;

/// Front and back of cloth as a fabric, sRGB.
const FABRIC: [[f32; 3]; 2] = [[0.86, 0.45, 0.31], [0.35, 0.50, 0.66]];
/// Obstacles, sRGB.
const OBSTACLE: [f32; 3] = [0.62, 0.64, 0.67];
/// Categories (pieces, ranks, segments), sRGB; more of them get hues.
const NAMED: [[f32; 3]; 8] = [
    [0.90, 0.49, 0.31],
    [0.27, 0.62, 0.79],
    [0.44, 0.73, 0.42],
    [0.93, 0.74, 0.33],
    [0.69, 0.48, 0.80],
    [0.86, 0.42, 0.56],
    [0.35, 0.74, 0.68],
    [0.60, 0.55, 0.42],
];
/// Share of a front's brightness that the back of cloth colored by meaning has.
const BEHIND: f32 = 0.74;

/// Five evenly spaced colors of a scale, sRGB.
pub(super) type Scale = [[f32; 3]; 5];
/// From dark blue over green to yellow, with evenly rising lightness.
pub(super) const HEIGHT: Scale =
    [[0.18, 0.20, 0.45], [0.16, 0.42, 0.56], [0.20, 0.62, 0.52], [0.55, 0.77, 0.36], [0.98, 0.88, 0.35]];
/// Pressed blue, at rest gray, stretched red.
pub(super) const STRAIN: Scale =
    [[0.13, 0.33, 0.72], [0.50, 0.68, 0.88], [0.86, 0.86, 0.85], [0.94, 0.60, 0.42], [0.75, 0.13, 0.16]];
/// Gray where nothing is near, then yellow to red.
pub(super) const CONTACT: Scale =
    [[0.70, 0.72, 0.75], [0.98, 0.85, 0.45], [0.97, 0.58, 0.25], [0.87, 0.27, 0.20], [0.55, 0.05, 0.15]];

/// Linear color of an sRGB one.
fn linear(srgb: [f32; 3]) -> Vec3 {
    Vec3::from_array(srgb.map(|x| if x <= 0.040_45 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) }))
}

/// Front and back of cloth as a fabric.
pub(super) fn fabric() -> [Vec3; 2] {
    FABRIC.map(linear)
}

/// Both sides of obstacles.
pub(super) fn obstacle() -> Vec3 {
    linear(OBSTACLE)
}

/// Front and back of a category.
pub(super) fn category(i: usize) -> [Vec3; 2] {
    let front = match NAMED.get(i) {
        Some(color) => linear(*color),
        None => hue((i as f32 * 0.618_034).fract(), if i % 2 == 1 { 0.62 } else { 0.5 }),
    };
    [front, front * BEHIND]
}

/// Front and back of a place on a scale, from 0 to 1.
pub(super) fn on_scale(scale: &Scale, share: f32) -> [Vec3; 2] {
    let x = if share.is_nan() { 0.0 } else { share.clamp(0.0, 1.0) * 4.0 };
    let stop = (x as usize).min(3);
    let (low, high) = (Vec3::from_array(scale[stop]), Vec3::from_array(scale[stop + 1]));
    let front = linear(low.lerp(high, x - stop as f32).to_array());
    [front, front * BEHIND]
}

/// A color by hue (0 to 1) and lightness, at a saturation of 0.55.
fn hue(hue: f32, light: f32) -> Vec3 {
    let channel = |n: f32| {
        let k = (n + hue * 12.0) % 12.0;
        light - 0.55 * light.min(1.0 - light) * (k - 3.0).min(9.0 - k).clamp(-1.0, 1.0)
    };
    linear([channel(0.0), channel(8.0), channel(4.0)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_colors_are_those_of_the_page() {
        let page = include_str!("../../view/page/colors.js");
        let text = |color: &[f32; 3]| format!("[{:.2}, {:.2}, {:.2}]", color[0], color[1], color[2]);
        for color in [FABRIC.as_slice(), &[OBSTACLE], &NAMED, &HEIGHT, &STRAIN, &CONTACT].concat() {
            assert!(page.contains(&text(&color)), "{color:?}");
        }
    }

    #[test]
    fn neighbors_differ_and_scales_reach_their_ends() {
        for i in 0..40 {
            assert!((category(i)[0] - category(i + 1)[0]).length() > 0.05, "{i}");
        }
        assert_eq!(on_scale(&HEIGHT, -1.0)[0], linear(HEIGHT[0]));
        assert_eq!(on_scale(&HEIGHT, 2.0)[0], linear(HEIGHT[4]));
        assert_eq!(on_scale(&STRAIN, f32::NAN)[0], linear(STRAIN[0]));
    }
}
