//! Values of a piece of cloth that differ from vertex to vertex: factors from a vertex property of its file, or from
//! the brightness of an image by texture coordinates.

use std::sync::Arc;

use crate::math::DVec2;

use super::error::Place;

/// What a map changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Quantity {
    /// Mass per area.
    Density,
    /// Stiffness against stretching and bending.
    Stiffness,
    /// Friction with cloth and with obstacles.
    Friction,
    /// Distance of contacts.
    Thickness,
}

impl Quantity {
    /// All of them, in the order of [`Maps::of`].
    pub(super) const ALL: [Quantity; 4] =
        [Quantity::Density, Quantity::Stiffness, Quantity::Friction, Quantity::Thickness];

    /// Name in scene files.
    pub(super) fn name(self) -> &'static str {
        match self {
            Quantity::Density => "density",
            Quantity::Stiffness => "stiffness",
            Quantity::Friction => "friction",
            Quantity::Thickness => "thickness",
        }
    }

    /// Least and largest factor.
    pub(super) fn range(self) -> [f64; 2] {
        match self {
            Quantity::Density | Quantity::Stiffness => [0.001, 1000.0],
            Quantity::Friction => [0.0, 1000.0],
            // Queries look for contacts up to the thickness of the scene, and impact zones leave a tenth of it.
            Quantity::Thickness => [0.2, 1.0],
        }
    }
}

/// A map as a scene file gives it.
#[derive(Clone, Debug)]
pub(super) struct MapSource {
    pub quantity: Quantity,
    pub values: Values,
    /// Factors where the value is 0 and where it is 1; linear between and beyond.
    pub factors: [f64; 2],
    pub at: Place,
}

/// Where the values of a map come from.
#[derive(Clone, Debug)]
pub(super) enum Values {
    /// A vertex property of the piece's file, or of a garment.
    Property(String),
    /// The brightness of an image, 0 to 1.
    Image(Arc<Image>),
}

/// Brightness of an image.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Image {
    pub width: usize,
    pub height: usize,
    /// Row after row from the top, 0 to 1.
    pub values: Vec<f32>,
}

impl Image {
    /// Linear between the centers of pixels, and as at the border beyond them. u runs to the right and v upward, 0 to 1
    /// over the image.
    pub(super) fn at(&self, uv: DVec2) -> f64 {
        let along = |share: f64, count: usize| {
            let place = (share * count as f64 - 0.5).clamp(0.0, (count - 1) as f64);
            let first = (place.floor() as usize).min(count.saturating_sub(2));
            (first, (first + 1).min(count - 1), place - first as f64)
        };
        let (left, right, s) = along(uv.x, self.width);
        let (upper, lower, t) = along(1.0 - uv.y, self.height);
        let value = |row: usize, column: usize| f64::from(self.values[row * self.width + column]);
        let across = |row: usize| value(row, left) * (1.0 - s) + value(row, right) * s;
        across(upper) * (1.0 - t) + across(lower) * t
    }
}

/// Factors of the vertices of a scene. A list is empty where nothing differs from 1.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Maps {
    /// On the mass per area.
    pub density: Vec<f32>,
    /// On the stiffness against stretching and bending.
    pub stiffness: Vec<f32>,
    /// On friction coefficients: of the cloth, and of obstacles that touch it there.
    pub friction: Vec<f32>,
    /// On the thickness; at most 1.
    pub thickness: Vec<f32>,
}

impl Maps {
    /// True if nothing differs from vertex to vertex.
    pub fn is_empty(&self) -> bool {
        *self == Maps::default()
    }

    /// Factor of a vertex in one of the lists.
    pub fn factor(list: &[f32], vertex: u32) -> f64 {
        list.get(vertex as usize).map_or(1.0, |&factor| f64::from(factor))
    }

    /// Factor of a triangle: the mean of its corners.
    pub fn of_triangle(list: &[f32], corners: [u32; 3]) -> f64 {
        if list.is_empty() { 1.0 } else { corners.iter().map(|&v| Maps::factor(list, v)).sum::<f64>() / 3.0 }
    }

    /// The lists of another numbering of vertices, by a function of a list.
    pub fn mapped(&self, of: impl Fn(&[f32]) -> Vec<f32>) -> Maps {
        let of = |list: &Vec<f32>| if list.is_empty() { Vec::new() } else { of(list) };
        Maps {
            density: of(&self.density),
            stiffness: of(&self.stiffness),
            friction: of(&self.friction),
            thickness: of(&self.thickness),
        }
    }

    pub(super) fn of(&mut self, quantity: Quantity) -> &mut Vec<f32> {
        match quantity {
            Quantity::Density => &mut self.density,
            Quantity::Stiffness => &mut self.stiffness,
            Quantity::Friction => &mut self.friction,
            Quantity::Thickness => &mut self.thickness,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_is_linear_between_the_centers_of_its_pixels() {
        let image = Image { width: 2, height: 2, values: vec![0.0, 1.0, 0.5, 0.25] };
        let at = |u: f64, v: f64| image.at(DVec2::new(u, v));
        assert_eq!([at(0.0, 1.0), at(1.0, 1.0), at(0.0, 0.0), at(1.0, 0.0)], [0.0, 1.0, 0.5, 0.25]);
        assert_eq!([at(0.25, 0.75), at(0.5, 0.75), at(0.5, 0.5), at(-3.0, 9.0)], [0.0, 0.5, 0.4375, 0.0]);
        let one = Image { width: 1, height: 1, values: vec![0.7] };
        assert_eq!(one.at(DVec2::new(0.3, 0.9)), f64::from(0.7f32));
    }
}
