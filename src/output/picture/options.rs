//! Options of pictures.

use std::str::FromStr;

use crate::math::Vec3;

/// Meaning of the colors of the cloth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Coloring {
    /// Front and back of the cloth in two tints.
    #[default]
    Shaded,
    /// Height over the whole sequence, from dark blue (low) to yellow (high).
    Height,
    /// Direction of the surface as the camera sees it.
    Normal,
}

impl FromStr for Coloring {
    type Err = String;
    fn from_str(text: &str) -> Result<Coloring, String> {
        match text {
            "shaded" => Ok(Coloring::Shaded),
            "height" => Ok(Coloring::Height),
            "normal" => Ok(Coloring::Normal),
            _ => Err(format!("{text:?} is not a coloring; valid are shaded, height and normal")),
        }
    }
}

/// The axis that points up in the pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum UpAxis {
    /// Y points up.
    Y,
    /// Z points up.
    #[default]
    Z,
}

impl FromStr for UpAxis {
    type Err = String;
    fn from_str(text: &str) -> Result<UpAxis, String> {
        match text {
            "y" => Ok(UpAxis::Y),
            "z" => Ok(UpAxis::Z),
            _ => Err(format!("{text:?} is not an up axis; valid are y and z")),
        }
    }
}

impl UpAxis {
    /// The axis as a unit vector.
    pub fn vector(self) -> Vec3 {
        match self {
            UpAxis::Y => Vec3::Y,
            UpAxis::Z => Vec3::Z,
        }
    }
}

/// Size, coloring and camera of pictures.
#[derive(Clone, Debug, PartialEq)]
pub struct PictureOptions {
    /// Width of a picture, pixels.
    pub width: u32,
    /// Height of a picture, pixels.
    pub height: u32,
    /// Meaning of the colors.
    pub coloring: Coloring,
    /// The axis of the scene that points up in the picture.
    pub up: UpAxis,
    /// Direction of the camera around the up axis, degrees; none = the side that shows most of the cloth.
    pub azimuth_deg: Option<f32>,
    /// Height of the camera above the horizon, degrees; none = chosen with the azimuth.
    pub elevation_deg: Option<f32>,
    /// Threads that draw frames at the same time.
    pub threads: usize,
}

impl Default for PictureOptions {
    fn default() -> PictureOptions {
        PictureOptions {
            width: 960,
            height: 720,
            coloring: Coloring::Shaded,
            up: UpAxis::Z,
            azimuth_deg: None,
            elevation_deg: None,
            threads: 1,
        }
    }
}
