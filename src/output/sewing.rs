//! What `report.json` says of seams that are sewn.

use std::fmt;

use serde::{Deserialize, Serialize};

/// A stage that begins with another mesh: panels have been sewn.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageRecord {
    /// The last step of the stage before.
    pub step: u64,
    /// The first frame with the new mesh.
    pub first_frame: u32,
    /// Triangles of the mesh.
    pub triangles: usize,
    /// Vertices of the mesh.
    pub vertices: usize,
    /// What was straightened when the seams were welded; omitted if nothing was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub straightened: Option<Straightened>,
}

/// Vertices of tangled corners that were moved when seams were welded, beyond the places where paired vertices meet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Straightened {
    /// Vertices of the panels that were moved.
    pub vertices: usize,
    /// The farthest way of one of them, meters.
    pub farthest_m: f64,
}

/// How far the seams of a state are open.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeamGap {
    /// The largest distance that vertices have to go to each other, meters.
    pub widest_m: f64,
    /// Places where they have farther to go than half of `weld_m`.
    pub open: usize,
}

/// A seam that was open when a run ended.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OpenSeam {
    /// Name of the seam.
    pub seam: String,
    /// Places where its vertices have farther to go than half of `weld_m`.
    pub open: usize,
    /// All places of the seam.
    pub places: usize,
    /// The largest distance that vertices of one place have to go to each other, meters.
    pub widest_m: f64,
    /// Why it is open.
    pub why: OpenBecause,
    /// What lies between the vertices of its open places, if something does: names of obstacles, or `cloth`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub between: Vec<String>,
}

/// Why a seam is open.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OpenBecause {
    /// It still closes: its threads still shorten, or it would be closed soon at its speed of the last frame.
    #[default]
    Closing,
    /// It has come to rest, and contacts lie on the way of an open place.
    Blocked,
    /// It has come to rest with nothing in the way: the cloth beside it is too tight.
    Taut,
}

impl fmt::Display for OpenSeam {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let OpenSeam { seam, open, places, widest_m, why, between } = self;
        write!(f, "`{seam}` is open at {open} of {places} places by up to {:.2} mm, ", 1e3 * widest_m)?;
        match why {
            OpenBecause::Closing => write!(f, "still closing"),
            OpenBecause::Blocked => write!(f, "blocked by {}", between.join(", ")),
            OpenBecause::Taut => write!(f, "held by the tension of its cloth"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_open_seam_is_one_clause() {
        let seam = OpenSeam {
            seam: "side".into(),
            open: 2,
            places: 9,
            widest_m: 1.566e-3,
            why: OpenBecause::Blocked,
            between: vec!["person".into(), "cloth".into()],
        };
        let text = "`side` is open at 2 of 9 places by up to 1.57 mm, blocked by person, cloth";
        assert_eq!(seam.to_string(), text);
        let taut = OpenSeam { why: OpenBecause::Taut, between: Vec::new(), ..seam };
        assert!(taut.to_string().ends_with("1.57 mm, held by the tension of its cloth"));
        assert_eq!(serde_json::to_value(&taut).unwrap()["why"], "taut");
    }
}
