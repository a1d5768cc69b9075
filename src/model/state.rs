//! The state of the cloth between two steps: all data that a step uses from earlier steps. All other data of a rank
//! follow from the scene, this state and the number of the step, so a run can continue from any state.
//!
//! Every function below names all fields of [`State`] and [`RankState`], so that a new field cannot be forgotten.

use bytemuck::{Pod, Zeroable};
use thiserror::Error;
use xxhash_rust::xxh3::Xxh3;

use crate::math::{DIM, Vec3};
use crate::mesh::{Hinge, hinges};
use crate::scene::{Fabric, Fold, Hold, Scene};

/// State of the whole cloth, in the mesh's vertex order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// Relative to the local origin of the scene ([`Scene::origin_m`]), meters.
    pub positions: Vec<Vec3>,
    /// m/s.
    pub velocities: Vec<Vec3>,
    /// Of every hinge in the order of [`crate::mesh::hinges`]; empty if no fabric of the scene is plastic.
    pub creases: Vec<Crease>,
    /// Of every triangle of the mesh; empty if no fabric of the scene stays stretched.
    pub stretches: Vec<RestStretch>,
    /// Ascending, each vertex and obstacle once. Empty unless obstacles that overlap have pinched the cloth.
    pub let_go: Vec<LetGo>,
    /// What pins have taken hold of while the cloth moved, ascending by vertex, each once.
    pub holds: Vec<Hold>,
}

/// A vertex and an obstacle that pass through each other, because the vertex had no room between that obstacle and one
/// that overlaps it. The obstacle takes no notice of the vertex and its triangles until the vertex is back on its side
/// and they are clear of the obstacle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Pod, Zeroable)]
#[repr(C)]
pub struct LetGo {
    /// Vertex of the mesh in a [`State`], place among the own rows in a [`RankState`].
    pub vertex: u32,
    /// Obstacle, in the order of the scene.
    pub obstacle: u32,
    /// The side that the vertex came from: 1 inside the obstacle, 0 outside.
    pub inside: u32,
}

/// Plastic bending of a hinge: its angle at rest (radians) and its plastic curvature so far (1/m).
pub type Crease = [f32; 2];

/// Plastic stretching of a triangle: its symmetric rest stretch uu, vv, uv in the plane of warp and weft, and its
/// plastic strain so far ([`crate::forces::plastic_stretch`]).
pub type RestStretch = [f32; 4];

/// The rest stretch of a triangle that has not yielded.
pub const UNSTRETCHED: RestStretch = [1.0, 1.0, 0.0, 0.0];

/// Elements of the mesh that touch the rows of a rank, in the order of the rank's elements: what a state says of them
/// ([`super::RankModel::plastic_elements`]). Empty lists where nothing is plastic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PlasticElements {
    /// Hinges, in the order of [`crate::mesh::hinges`].
    pub hinges: Vec<u32>,
    /// Triangles.
    pub triangles: Vec<u32>,
}

impl PlasticElements {
    /// Their numbers.
    pub fn counts(&self) -> PlasticCounts {
        PlasticCounts { creases: self.hinges.len(), stretches: self.triangles.len() }
    }
}

/// Numbers of creases and rest stretches of a state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlasticCounts {
    /// Of [`State::creases`].
    pub creases: usize,
    /// Of [`State::stretches`].
    pub stretches: usize,
}

/// A value that is not finite; no step can continue from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotFinite {
    /// Vertex of the mesh.
    pub vertex: u32,
    /// `position` or `velocity`.
    pub quantity: &'static str,
}

impl State {
    /// The start state of a scene.
    pub fn start_of(scene: &Scene) -> State {
        State {
            positions: scene.mesh.positions.clone(),
            velocities: scene.velocities.clone(),
            creases: creases_at_start(scene),
            stretches: vec![UNSTRETCHED; stretches_of(scene)],
            let_go: Vec::new(),
            holds: Vec::new(),
        }
    }

    /// State of zeros, to be filled by [`State::scatter`].
    pub fn zeros(vertices: usize, plastic: PlasticCounts) -> State {
        State {
            positions: vec![Vec3::ZERO; vertices],
            velocities: vec![Vec3::ZERO; vertices],
            creases: vec![Crease::default(); plastic.creases],
            stretches: vec![UNSTRETCHED; plastic.stretches],
            let_go: Vec::new(),
            holds: Vec::new(),
        }
    }

    /// Numbers of creases and rest stretches.
    pub fn plastic_counts(&self) -> PlasticCounts {
        PlasticCounts { creases: self.creases.len(), stretches: self.stretches.len() }
    }

    /// Number of vertices of the mesh; none if the fields have different lengths or name vertices that are not there.
    pub fn vertices(&self) -> Option<usize> {
        let State { positions, velocities, creases: _, stretches: _, let_go, holds } = self;
        let mut named = let_go.iter().map(|one| one.vertex).chain(holds.iter().map(|hold| hold.vertex));
        let known = named.all(|vertex| (vertex as usize) < positions.len());
        (positions.len() == velocities.len() && known).then_some(positions.len())
    }

    /// 16 hexadecimal digits over the bits of positions, velocities, creases, rest stretches, what is let go, then
    /// holds.
    /// `-0.0` and `0.0` differ, so equal hashes mean equal bits, except with probability 2^-64.
    pub fn hash(&self) -> String {
        let State { positions, velocities, creases, stretches, let_go, holds } = self;
        let mut hasher = Xxh3::new();
        hash_words(&mut hasher, positions);
        hash_words(&mut hasher, velocities);
        hash_words(&mut hasher, creases);
        hash_words(&mut hasher, stretches);
        hash_words(&mut hasher, let_go);
        hash_words(&mut hasher, holds);
        format!("{:016x}", hasher.digest())
    }

    /// The first value that is not finite. Positions are checked first.
    pub fn first_not_finite(&self) -> Option<NotFinite> {
        // Creases and rest stretches follow from positions, and plastic curvatures and strains are finite wherever the
        // rest is.
        let State { positions, velocities, creases: _, stretches: _, let_go: _, holds: _ } = self;
        [("position", positions), ("velocity", velocities)].into_iter().find_map(|(quantity, values)| {
            let vertex = values.iter().position(|value| !value.is_finite())? as u32;
            Some(NotFinite { vertex, quantity })
        })
    }

    /// The part of a rank. `order`: the vertex of each row, in the order of the rows; `plastic`: the elements that
    /// touch them.
    pub fn gather(&self, order: &[u32], plastic: &PlasticElements) -> RankState {
        let State { positions, velocities, creases, stretches, let_go, holds } = self;
        let mut own = Vec::new();
        if !let_go.is_empty() {
            for (row, &v) in (0..).zip(order) {
                let first = let_go.partition_point(|one| one.vertex < v);
                let of_vertex = let_go[first..].iter().take_while(|one| one.vertex == v);
                own.extend(of_vertex.map(|one| LetGo { vertex: row, ..*one }));
            }
        }
        let mut own_holds = Vec::new();
        if !holds.is_empty() {
            for (row, &v) in (0..).zip(order) {
                let of_vertex = holds.binary_search_by_key(&v, |hold| hold.vertex);
                own_holds.extend(of_vertex.ok().map(|place| Hold { vertex: row, ..holds[place] }));
            }
        }
        let rows = |values: &[Vec3]| order.iter().flat_map(|&v| values[v as usize].to_array()).collect();
        RankState {
            positions: rows(positions),
            velocities: rows(velocities),
            creases: plastic.hinges.iter().map(|&hinge| creases[hinge as usize]).collect(),
            stretches: plastic.triangles.iter().map(|&triangle| stretches[triangle as usize]).collect(),
            let_go: own,
            holds: own_holds,
        }
    }

    /// Copies the part of a rank into the state, which has nothing let go for its rows yet; the inverse of
    /// [`State::gather`]. A hinge or triangle that touches rows of several ranks has the same bits on each.
    pub fn scatter(&mut self, order: &[u32], plastic: &PlasticElements, part: &RankState) {
        let State { positions, velocities, creases, stretches, let_go, holds } = self;
        let in_mesh = |one: &LetGo| LetGo { vertex: order[one.vertex as usize], ..*one };
        let_go.extend(part.let_go.iter().map(in_mesh));
        let_go.sort_unstable();
        holds.extend(part.holds.iter().map(|hold| Hold { vertex: order[hold.vertex as usize], ..*hold }));
        holds.sort_unstable_by_key(|hold| hold.vertex);
        for (values, rows) in [(positions, &part.positions), (velocities, &part.velocities)] {
            assert_eq!(rows.len(), order.len() * DIM, "a rank's state has as many rows as its part of the order");
            for (&v, row) in order.iter().zip(rows.as_chunks::<DIM>().0) {
                values[v as usize] = Vec3::from_array(*row);
            }
        }
        assert_eq!(part.plastic_counts(), plastic.counts(), "a rank's state has those of the elements of its rows");
        for (&hinge, crease) in plastic.hinges.iter().zip(&part.creases) {
            creases[hinge as usize] = *crease;
        }
        for (&triangle, stretch) in plastic.triangles.iter().zip(&part.stretches) {
            stretches[triangle as usize] = *stretch;
        }
    }
}

/// Number of [`State::creases`] of a scene.
pub(super) fn creases_of(scene: &Scene) -> usize {
    if scene.fabrics.iter().any(Fabric::creases) { hinges(&scene.mesh).len() } else { 0 }
}

/// [`State::creases`] at the start: the folds of the scene, which have not yielded.
fn creases_at_start(scene: &Scene) -> Vec<Crease> {
    if creases_of(scene) == 0 {
        return Vec::new();
    }
    let crease = |hinge: &Hinge| [Fold::angle_of(&scene.folds, [hinge.vertices[0], hinge.vertices[1]]), 0.0];
    hinges(&scene.mesh).iter().map(crease).collect()
}

/// Number of [`State::stretches`] of a scene.
pub(super) fn stretches_of(scene: &Scene) -> usize {
    if scene.fabrics.iter().any(Fabric::stays_stretched) { scene.mesh.triangles.len() } else { 0 }
}

/// A rank's part of a [`State`]: its rows in the global order, three values each, and the elements that touch them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RankState {
    /// Meters.
    pub positions: Vec<f32>,
    /// m/s.
    pub velocities: Vec<f32>,
    /// In the order of the rank's hinges; empty if no fabric of the scene is plastic.
    pub creases: Vec<Crease>,
    /// In the order of the rank's triangles; empty if no fabric of the scene stays stretched.
    pub stretches: Vec<RestStretch>,
    /// Ascending.
    pub let_go: Vec<LetGo>,
    /// Ascending by row.
    pub holds: Vec<Hold>,
}

/// Error of bytes that are not the state of a rank.
#[derive(Debug, Error)]
#[error("state of a rank: {0}")]
pub struct RankStateError(String);

impl RankState {
    /// State of zeros.
    pub fn zeros(rows: usize, plastic: PlasticCounts) -> RankState {
        RankState {
            positions: vec![0.0; rows * DIM],
            velocities: vec![0.0; rows * DIM],
            creases: vec![Crease::default(); plastic.creases],
            stretches: vec![UNSTRETCHED; plastic.stretches],
            let_go: Vec::new(),
            holds: Vec::new(),
        }
    }

    fn plastic_counts(&self) -> PlasticCounts {
        PlasticCounts { creases: self.creases.len(), stretches: self.stretches.len() }
    }

    /// The arrays as bytes, in a fixed order; a message carries them unserialized.
    pub fn to_bytes(&self) -> [&[u8]; 6] {
        let RankState { positions, velocities, creases, stretches, let_go, holds } = self;
        [
            bytemuck::cast_slice(positions),
            bytemuck::cast_slice(velocities),
            bytemuck::cast_slice(creases),
            bytemuck::cast_slice(stretches),
            bytemuck::cast_slice(let_go),
            bytemuck::cast_slice(holds),
        ]
    }

    /// The arrays from bytes in the order of [`RankState::to_bytes`].
    ///
    /// # Errors
    /// The bytes are not the arrays of `rows` rows and as many elements as `plastic` says.
    pub fn from_bytes(arrays: &[&[u8]], rows: usize, plastic: PlasticCounts) -> Result<RankState, RankStateError> {
        let mut state = RankState::zeros(rows, plastic);
        let RankState { positions, velocities, creases, stretches, let_go, holds } = &mut state;
        let count = |array: usize, size: usize| arrays.get(array).map_or(0, |bytes| bytes.len() / size);
        let_go.resize(count(4, size_of::<LetGo>()), LetGo::zeroed());
        holds.resize(count(5, size_of::<Hold>()), Hold::zeroed());
        let fields: [&mut [u8]; 6] = [
            bytemuck::cast_slice_mut(positions),
            bytemuck::cast_slice_mut(velocities),
            bytemuck::cast_slice_mut(creases),
            bytemuck::cast_slice_mut(stretches),
            bytemuck::cast_slice_mut(let_go),
            bytemuck::cast_slice_mut(holds),
        ];
        if arrays.len() != fields.len() {
            return Err(RankStateError(format!("{} arrays instead of {}", arrays.len(), fields.len())));
        }
        for (field, bytes) in fields.into_iter().zip(arrays) {
            if field.len() != bytes.len() {
                return Err(RankStateError(format!(
                    "{} bytes instead of {} for {rows} rows",
                    bytes.len(),
                    field.len()
                )));
            }
            field.copy_from_slice(bytes);
        }
        let mut named = let_go.iter().map(|one| one.vertex).chain(holds.iter().map(|hold| hold.vertex));
        match named.find(|&row| row as usize >= rows) {
            Some(row) => Err(RankStateError(format!("row {row} of {rows} is let go or held"))),
            None => Ok(state),
        }
    }

    /// Bytes of the arrays.
    pub fn bytes(&self) -> u64 {
        self.to_bytes().iter().map(|array| array.len() as u64).sum()
    }
}

/// Holds of other numbers of vertices; of several of one vertex the first one.
pub(super) fn renumbered(holds: &[Hold], vertex_of: impl Fn(u32) -> u32) -> Vec<Hold> {
    let mut all: Vec<Hold> = holds.iter().map(|hold| Hold { vertex: vertex_of(hold.vertex), ..*hold }).collect();
    all.sort_by_key(|hold| hold.vertex);
    all.dedup_by_key(|hold| hold.vertex);
    all
}

/// Adds values made of 32-bit words to a hash, as little-endian bytes.
pub fn hash_words<T: Pod>(hasher: &mut Xxh3, values: &[T]) {
    if cfg!(target_endian = "little") {
        hasher.update(bytemuck::cast_slice(values));
    } else {
        bytemuck::cast_slice::<T, u32>(values).iter().for_each(|word| hasher.update(&word.to_le_bytes()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbered(vertices: usize) -> State {
        let at = |v: usize, offset: f32| Vec3::new(v as f32, offset, -(v as f32));
        State {
            positions: (0..vertices).map(|v| at(v, 0.5)).collect(),
            velocities: (0..vertices).map(|v| at(v, 7.0)).collect(),
            creases: vec![[0.25, 2.0], [-0.5, 8.0], [0.75, 16.0]],
            stretches: vec![[1.5, 1.0, 0.25, 0.5], [1.25, 0.75, 0.0, 0.5]],
            let_go: [(0, 1, 0), (2, 0, 1), (2, 3, 0), (4, 1, 0)]
                .map(|(vertex, obstacle, inside)| LetGo { vertex, obstacle, inside })
                .into_iter()
                .filter(|one| (one.vertex as usize) < vertices)
                .collect(),
            holds: [1, 3]
                .map(|vertex| Hold {
                    vertex,
                    corners: [7, 8, 9],
                    weights: [0.5, 0.25, 0.25],
                    offset_m: [0.0, 1.0, 2.0],
                })
                .into_iter()
                .filter(|hold| (hold.vertex as usize) < vertices)
                .collect(),
        }
    }

    #[test]
    fn the_parts_of_all_ranks_are_the_whole() {
        let (whole, order) = (numbered(5), [3u32, 0, 4, 1, 2]);
        let plastic = [
            PlasticElements { hinges: vec![0, 2], triangles: vec![1] },
            PlasticElements { hinges: vec![1, 2], triangles: vec![1, 0] },
        ];
        let parts = [0..2, 2..5].map(|rows| (rows.clone(), &plastic[rows.start / 2]));
        let parts = parts.map(|(rows, plastic)| (rows.clone(), plastic, whole.gather(&order[rows], plastic)));
        assert_eq!(parts[0].2.positions, [3.0, 0.5, -3.0, 0.0, 0.5, -0.0]);
        assert_eq!(parts[0].2.velocities[..3], [3.0, 7.0, -3.0]);
        assert_eq!(parts[0].2.creases, [[0.25, 2.0], [0.75, 16.0]]);
        assert_eq!(parts[1].2.stretches, [[1.25, 0.75, 0.0, 0.5], [1.5, 1.0, 0.25, 0.5]]);
        assert_eq!(parts[0].2.let_go, [LetGo { vertex: 1, obstacle: 1, inside: 0 }]);
        assert_eq!(parts[1].2.let_go.iter().map(|one| one.vertex).collect::<Vec<_>>(), [0, 2, 2]);
        let mut again = State::zeros(5, whole.plastic_counts());
        for (rows, plastic, part) in parts {
            let part = RankState::from_bytes(&part.to_bytes(), rows.len(), plastic.counts()).unwrap();
            again.scatter(&order[rows], plastic, &part);
        }
        assert_eq!(again, whole);
        assert_eq!(again.hash(), whole.hash());
        again.creases[1][0] = 0.5;
        assert_ne!(again.hash(), whole.hash());
        let other =
            State { holds: vec![Hold { offset_m: [0.5; 3], ..whole.holds[0] }, whole.holds[1]], ..whole.clone() };
        assert_ne!(other.hash(), whole.hash());
        again = whole.clone();
        again.stretches[1][3] = 0.25;
        assert_ne!(again.hash(), whole.hash());
        again = whole.clone();
        again.let_go[1].inside = 0;
        assert_ne!(again.hash(), whole.hash());
        assert_eq!(State { positions: Vec::new(), velocities: Vec::new(), ..whole }.vertices(), None);
    }

    #[test]
    fn bytes_of_another_shape_are_refused() {
        let part = numbered(2).gather(&[0, 1], &PlasticElements { hinges: vec![1], triangles: vec![0] });
        let bytes = part.to_bytes();
        // One of the two vertices is held.
        assert_eq!(part.bytes(), 84 + 40);
        let shorter = [bytes[0], &bytes[1][1..], bytes[2], bytes[3], bytes[4], bytes[5]];
        for (arrays, rows, creases, stretches) in [
            (&bytes[..1], 2, 1, 1),
            (&bytes[..], 1, 1, 1),
            (&bytes[..], 2, 0, 1),
            (&bytes[..], 2, 1, 0),
            (&shorter, 2, 1, 1),
        ] {
            let plastic = PlasticCounts { creases, stretches };
            let error = RankState::from_bytes(arrays, rows, plastic).unwrap_err().to_string();
            assert!(error.contains("instead of"), "{error}");
        }
        let beyond = RankState { let_go: vec![LetGo { vertex: 2, obstacle: 0, inside: 0 }], ..part.clone() };
        let plastic = PlasticCounts { creases: 1, stretches: 1 };
        let error = RankState::from_bytes(&beyond.to_bytes(), 2, plastic).unwrap_err().to_string();
        assert!(error.contains("row 2 of 2 is let go or held"), "{error}");
    }

    #[test]
    fn the_first_value_that_is_not_finite_is_named() {
        let mut state = numbered(4);
        assert_eq!(state.first_not_finite(), None);
        state.velocities[1].y = f32::INFINITY;
        assert_eq!(state.first_not_finite(), Some(NotFinite { vertex: 1, quantity: "velocity" }));
        state.positions[3].x = f32::NAN;
        assert_eq!(state.first_not_finite(), Some(NotFinite { vertex: 3, quantity: "position" }));
        state.positions.pop();
        assert_eq!(state.vertices(), None);
    }
}
