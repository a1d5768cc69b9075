//! What changes name of a scene that runs: pins, fabrics and edges, as vertices of its mesh of now.

use std::path::{Path, PathBuf};

use super::parsed::ParsedScene;
use super::pins::{EDGES, sheet_edge};
use super::{Change, Fabric, Overrides, SceneError};

/// Names of a scene and what they stand for now. A change of the mesh takes them along ([`Handles::renumber`]).
#[derive(Clone, Debug, Default)]
pub struct Handles {
    /// The scene file, beside which fabrics are looked for.
    pub path: PathBuf,
    /// Fabrics that the scene names.
    pub fabrics: Vec<Fabric>,
    /// Pins that still hold.
    pub pins: Vec<PinGroup>,
    /// The pieces of cloth, in the order of the scene.
    pub cloths: Vec<ClothHandles>,
}

/// A `[[pin]]`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PinGroup {
    /// Its name, or its number among the pins.
    pub name: String,
    /// The vertices that it holds, of the mesh of now.
    pub vertices: Vec<u32>,
}

/// What can be named of a piece of cloth.
#[derive(Clone, Debug, Default)]
pub struct ClothHandles {
    /// Name of the piece.
    pub name: String,
    /// Whether it is a sheet, whose vertices have no numbers of their own.
    pub is_sheet: bool,
    /// The vertex of now of every vertex of its file; `u32::MAX` where there is none.
    pub vertices: Vec<u32>,
    /// Its edges: name, and vertices of now from end to end.
    pub edges: Vec<(String, Vec<u32>)>,
}

impl ParsedScene {
    /// The handles of the scene that [`ParsedScene::at`] builds.
    ///
    /// # Errors
    /// Those of [`ParsedScene::at`] about pieces, seams and pins.
    pub fn handles(&self, overrides: &Overrides) -> Result<Handles, SceneError> {
        let (pieces, _) = self.pieces(overrides, 0)?;
        let (mut cloths, mut firsts, mut first) = (Vec::new(), Vec::new(), 0u32);
        for piece in &pieces {
            let mesh = &piece.cloth;
            let vertex = |number: u32| mesh.vertex(number).map(|v| v + first);
            let mut edges: Vec<(String, Vec<u32>)> = Vec::new();
            if let Some(sheet) = &piece.sheet {
                let sides = EDGES.iter().filter_map(|(name, _)| Some((name.to_string(), sheet_edge(sheet, name)?)));
                edges.extend(sides.map(|(name, side)| (name, side.into_iter().map(|v| v + first).collect())));
            }
            let named = mesh.edges.iter().map(|(name, side)| (name.clone(), side.iter().copied().filter_map(vertex)));
            edges.extend(named.map(|(name, side)| (name, side.collect())));
            let vertices = (0..mesh.file_vertices()).map(|number| vertex(number).unwrap_or(u32::MAX)).collect();
            let name = piece.source.name.clone();
            cloths.push(ClothHandles { name, is_sheet: piece.sheet.is_some(), vertices, edges });
            firsts.push(first);
            first += mesh.mesh.positions.len() as u32;
        }
        let mut pins = Vec::with_capacity(self.pins.len());
        for (number, pin) in self.pins.iter().enumerate() {
            let selected = pin.vertices(&pieces[pin.cloth], &self.obstacles)?;
            let vertices = selected.into_iter().map(|v| v + firsts[pin.cloth]).collect();
            pins.push(PinGroup { name: pin.name.clone().unwrap_or_else(|| number.to_string()), vertices });
        }
        Ok(Handles { path: self.path.clone(), fabrics: self.fabrics.clone(), pins, cloths })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Changes of the scene while it runs, in the order of their steps.
    pub fn changes(&self) -> &[Change] {
        &self.changes
    }
}

impl Handles {
    /// Takes the names along to another mesh: `vertex_of` gives the vertex of each vertex before, `halved` the ends of
    /// the edge of vertices that were added in the middle of edges, both by their new numbers.
    pub fn renumber(&mut self, vertex_of: impl Fn(u32) -> u32, halved: &[(u32, [u32; 2])]) {
        for pin in &mut self.pins {
            pin.vertices.iter_mut().for_each(|v| *v = vertex_of(*v));
            pin.vertices.sort_unstable();
            pin.vertices.dedup();
            for (middle, ends) in halved {
                if ends.iter().all(|end| pin.vertices.binary_search(end).is_ok()) {
                    let place = pin.vertices.partition_point(|v| v < middle);
                    pin.vertices.insert(place, *middle);
                }
            }
        }
        for cloth in &mut self.cloths {
            let sides = cloth.edges.iter_mut().map(|(_, side)| side);
            for vertex in sides.flatten().chain(&mut cloth.vertices).filter(|v| **v != u32::MAX) {
                *vertex = vertex_of(*vertex);
            }
        }
    }

    /// The piece of a name, or else of a number.
    ///
    /// # Errors
    /// A sentence with the names of the pieces.
    pub fn cloth(&self, name: &str) -> Result<usize, String> {
        let number = || name.parse().ok().filter(|&number: &usize| number < self.cloths.len());
        let found = self.cloths.iter().position(|cloth| cloth.name == name).or_else(number);
        let known = || self.cloths.iter().map(|cloth| &cloth.name[..]).collect::<Vec<_>>().join(", ");
        found.ok_or_else(|| format!("no cloth is named `{name}` ({})", known()))
    }
}
