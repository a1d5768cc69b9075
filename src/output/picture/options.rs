//! Options of pictures.

use std::str::FromStr;

use super::camera_file::CameraFile;
use crate::math::{DVec3, Vec3};

/// Meaning of the colors of the cloth; the names are those of the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Coloring {
    /// As a fabric where all cloth hangs together, else by piece.
    #[default]
    Shaded,
    /// Front and back in two tints.
    Fabric,
    /// A color for every piece.
    Piece,
    /// A color for every rank.
    Rank,
    /// Stretched red, pressed blue.
    Strain,
    /// How near the nearest contact is.
    Contact,
    /// Height over the whole sequence, from dark blue (low) to yellow (high).
    Height,
    /// A color for every segment of a shot that is split in time.
    Segment,
    /// Direction of the surface as the camera sees it.
    Normal,
}

impl Coloring {
    const ALL: [(&str, Coloring); 9] = [
        ("shaded", Coloring::Shaded),
        ("fabric", Coloring::Fabric),
        ("piece", Coloring::Piece),
        ("rank", Coloring::Rank),
        ("strain", Coloring::Strain),
        ("contact", Coloring::Contact),
        ("height", Coloring::Height),
        ("segment", Coloring::Segment),
        ("normal", Coloring::Normal),
    ];

    /// Whether the recorded scene of a run has to say how its vertices are colored.
    pub fn needs_scene(self) -> bool {
        matches!(self, Coloring::Rank | Coloring::Strain | Coloring::Contact)
    }
}

impl FromStr for Coloring {
    type Err = String;
    fn from_str(text: &str) -> Result<Coloring, String> {
        let found = Coloring::ALL.iter().find(|(name, _)| *name == text);
        found.map(|(_, coloring)| *coloring).ok_or_else(|| {
            let names: Vec<&str> = Coloring::ALL.iter().map(|(name, _)| *name).collect();
            format!("{text:?} is not a coloring; valid are {}", names.join(", "))
        })
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

/// The ground of pictures.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub enum Ground {
    /// Below everything that is drawn. A flat floor that reaches beyond the cloth on all sides becomes the ground.
    #[default]
    Auto,
    /// No ground.
    Off,
    /// At this height of the scene, meters.
    At(f64),
}

impl FromStr for Ground {
    type Err = String;
    fn from_str(text: &str) -> Result<Ground, String> {
        match (text, text.parse::<f64>()) {
            ("auto", _) => Ok(Ground::Auto),
            ("off", _) => Ok(Ground::Off),
            (_, Ok(height_m)) if height_m.is_finite() => Ok(Ground::At(height_m)),
            _ => Err(format!("{text:?} is no ground; valid are auto, off and a height in meters")),
        }
    }
}

/// What the camera looks at.
#[derive(Clone, Debug, PartialEq, Default)]
pub enum Target {
    /// The cloth, and obstacles that stand within it: a wearer is shown whole.
    #[default]
    Auto,
    /// All cloth that is drawn.
    Cloth,
    /// The cloth, and obstacles near it.
    All,
    /// A point of the scene, meters.
    Point(DVec3),
    /// Vertices of the cloth.
    Piece(std::ops::Range<usize>),
    /// Vertices of the obstacles.
    Obstacle(std::ops::Range<usize>),
}

/// Size, coloring, camera and light of pictures.
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
    /// What the camera looks at.
    pub target: Target,
    /// How many times larger things are than where everything fits.
    pub zoom: f32,
    /// Focal length of the lens for a sensor 24 mm high, millimeters.
    pub lens_mm: f32,
    /// Camera from a file; direction, target and lens of these options then have no meaning.
    pub camera: Option<CameraFile>,
    /// Where the scene's origin is in what is drawn: frames are read about it, meters.
    pub origin_m: DVec3,
    /// The ground.
    pub ground: Ground,
    /// Whether light that something blocks leaves a shadow.
    pub shadows: bool,
    /// How many times the cloth is subdivided for the picture.
    pub smooth: u32,
    /// Threads that draw frames at the same time.
    pub threads: usize,
}

/// Focal length of the default lens, millimeters: 30 degrees from top to bottom, so that shapes stay true.
pub const LENS_MM: f32 = 44.785;

impl Default for PictureOptions {
    fn default() -> PictureOptions {
        PictureOptions {
            width: 960,
            height: 720,
            coloring: Coloring::Shaded,
            up: UpAxis::Z,
            azimuth_deg: None,
            elevation_deg: None,
            target: Target::Auto,
            zoom: 1.0,
            lens_mm: LENS_MM,
            camera: None,
            origin_m: DVec3::ZERO,
            ground: Ground::Auto,
            shadows: true,
            smooth: 0,
            threads: 1,
        }
    }
}
