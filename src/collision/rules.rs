//! Which pairs of features are contacts, and what contact element a pair becomes. Checks the parameters that decide it;
//! does not look for pairs.

use thiserror::Error;

use super::Candidate;
use super::broad::CollisionMesh;
use super::contact::Pair;
use crate::forces::{ContactElement, NO_VERTEX};

/// Factor on the thickness where pairs are only preselected, so that rounding does not lose a contact.
pub(super) const WIDER: f32 = 1.001;

/// Parameters that decide which pairs of features are contacts, and the forces of these contacts.
#[derive(Clone, Debug, PartialEq)]
pub struct ContactParams {
    /// Distance below which features repel each other, meters. Features of one piece of cloth repel each other below
    /// half the smallest altitude around their vertices, if that is less: a fine mesh at rest does not repel itself.
    pub thickness_m: f32,
    /// Distance that counts as an impact, meters; 0 asks for touching.
    pub separation_m: f32,
    /// Stiffness of a contact over effective mass / step^2; no unit.
    pub stiffness_ratio: f32,
    /// Length of a step, seconds.
    pub step_s: f32,
    /// Per vertex: Coulomb coefficient. A contact with an obstacle has that of the obstacle's vertices, a contact of
    /// cloth with cloth the mean of both features (each the first of its vertices).
    pub friction: Vec<f32>,
    /// Per vertex: 1/mass, 1/kg; 0 for vertices whose motion is imposed (pins, obstacles).
    pub inverse_masses_per_kg: Vec<f32>,
    /// Per vertex: smallest altitude at rest of the triangles around it, meters: see `smallest_altitudes`. Not looked
    /// at for obstacles.
    pub smallest_altitudes_m: Vec<f32>,
    /// Per vertex of cloth: factor on the coefficient of an obstacle that touches it; empty: 1 everywhere.
    pub friction_factors: Vec<f32>,
    /// Per vertex of cloth: factor on the thickness, at most 1; empty: 1 everywhere. A contact of cloth with cloth has
    /// the mean of both features.
    pub thickness_factors: Vec<f32>,
}

/// Why parameters cannot be used with a mesh.
#[derive(Debug, Error, PartialEq)]
pub enum DetectorError {
    /// A list does not have one value per vertex.
    #[error("{what} has {values} values, but the mesh has {vertices} vertices")]
    Count {
        /// The list, as the subject of a sentence.
        what: &'static str,
        /// Its length.
        values: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// A quantity is negative or NaN.
    #[error("{what} is or holds {value}; it must be a number, 0 or more")]
    Value {
        /// The quantity, as the subject of a sentence.
        what: &'static str,
        /// Its value.
        value: f32,
    },
    /// The step is not longer than 0.
    #[error("the step is {step_s} s long; it must be longer than 0")]
    Step {
        /// Length of the step, seconds.
        step_s: f32,
    },
}

/// Decides which pairs of features are contacts; holds what that takes per vertex.
pub(super) struct Rules {
    pub params: ContactParams,
    cloth_vertices: usize,
    pieces: Vec<u32>,
    /// Per vertex: the thickness within its piece.
    within_piece_m: Vec<f32>,
    /// Per vertex: the same, [`WIDER`].
    pub reach_within_piece_m: Vec<f32>,
    /// The largest thickness of pairs within a piece.
    pub widest_within_piece_m: f32,
    /// The largest thickness of all pairs: less than that of the parameters where there is one piece only.
    pub widest_m: f32,
}

impl Rules {
    /// # Errors
    /// The parameters do not have one value per vertex, or a value is negative or NaN.
    pub(super) fn new(mesh: &CollisionMesh, params: ContactParams) -> Result<Rules, DetectorError> {
        check(mesh, &params)?;
        let limit = |&altitude_m: &f32| params.thickness_m.min(0.5 * altitude_m.max(0.0));
        let within_piece_m: Vec<f32> = params.smallest_altitudes_m.iter().map(limit).collect();
        let widest_within_piece_m = within_piece_m[..mesh.cloth_vertices].iter().fold(0.0, |a: f32, &b| a.max(b));
        let reach_within_piece_m = within_piece_m.iter().map(|thickness_m| thickness_m * WIDER).collect();
        let mut pieces = mesh.triangles.iter().map(|face| mesh.pieces[face[0] as usize]);
        let first = pieces.next();
        let one_piece = pieces.all(|piece| Some(piece) == first);
        let widest_m = if one_piece { widest_within_piece_m } else { params.thickness_m };
        let (pieces, cloth_vertices) = (mesh.pieces.clone(), mesh.cloth_vertices);
        Ok(Rules {
            params,
            cloth_vertices,
            pieces,
            within_piece_m,
            reach_within_piece_m,
            widest_within_piece_m,
            widest_m,
        })
    }

    /// Bytes of the lists, one value of each per vertex.
    pub(super) fn bytes(&self) -> u64 {
        4 * (self.params.friction.len() + self.params.inverse_masses_per_kg.len() + self.pieces.len()) as u64
            + 12 * self.within_piece_m.len() as u64
    }

    /// A distance that no contact of a candidate exceeds, [`WIDER`] so that rounded tests miss none.
    #[inline(always)]
    pub(super) fn reach_m(&self, candidate: &Candidate) -> f32 {
        let [a, b, c, d] = candidate.vertices.map(|v| v as usize);
        let limit = |v: usize| self.within_piece_m[v];
        let reach_m = match candidate.is_vertex_face() {
            true if self.pieces[a] == self.pieces[b] => limit(a),
            false if self.pieces[a] == self.pieces[c] => limit(a).min(limit(b)).min(limit(c)).min(limit(d)),
            _ => self.params.thickness_m,
        };
        reach_m * WIDER
    }

    /// The thickness of a pair.
    fn thickness_m(&self, pair: &Pair) -> f32 {
        let vertices = || pair.vertices.into_iter().filter(|&v| v != NO_VERTEX).map(|v| v as usize);
        let mut pieces = vertices().map(|v| self.pieces[v]);
        let first = pieces.next();
        let most_m = (self.params.thickness_m * self.thickness_factor(pair)).min(pair.most_m);
        if pieces.any(|piece| Some(piece) != first) {
            return most_m;
        }
        vertices().fold(most_m, |least, v| least.min(self.within_piece_m[v]))
    }

    /// Mean of the factors of the features that are cloth, each at its closest point.
    fn thickness_factor(&self, pair: &Pair) -> f32 {
        let factors = &self.params.thickness_factors;
        if factors.is_empty() {
            return 1.0;
        }
        let (mut sum, mut weights) = (0.0, 0.0);
        for (&vertex, weight) in pair.vertices.iter().zip(pair.weights) {
            if let Some(factor) = factors.get(vertex as usize) {
                sum += weight.abs() * factor;
                weights += weight.abs();
            }
        }
        if weights > 0.0 { (sum / weights).min(1.0) } else { 1.0 }
    }

    /// True if a pair is closer than its thickness, or will be once it has come closer by `approach_m`.
    pub(super) fn is_near(&self, pair: &Pair, approach_m: f32) -> bool {
        pair.distance_m - approach_m.max(0.0) < self.thickness_m(pair)
    }

    /// The element of a contact; none if nothing in it can move.
    pub(super) fn element(&self, pair: &Pair) -> Option<ContactElement> {
        let mut mobility = 0.0;
        for (&vertex, weight) in pair.vertices.iter().zip(pair.weights) {
            if vertex != NO_VERTEX {
                mobility += weight * weight * self.params.inverse_masses_per_kg[vertex as usize];
            }
        }
        // The negation makes NaN no contact.
        if !(mobility > 0.0) {
            return None;
        }
        let step_s = self.params.step_s;
        Some(ContactElement {
            vertices: pair.vertices,
            weights: pair.weights,
            normal: pair.normal.to_array(),
            distance_m: pair.distance_m,
            thickness_m: self.thickness_m(pair),
            stiffness_n_m: self.params.stiffness_ratio * pair.share / (mobility * step_s * step_s),
            friction: self.friction(pair),
            kind: pair.kind,
        })
    }

    fn friction(&self, pair: &Pair) -> f32 {
        // Sides of a seam must find each other.
        if pair.most_m < f32::INFINITY {
            return 0.0;
        }
        let [a, b, c, _] = pair.vertices;
        let other = if pair.kind == 0 { b } else { c };
        let friction = |v: u32| self.params.friction[v as usize];
        let obstacle = [a, other].into_iter().find(|&v| v as usize >= self.cloth_vertices);
        let factor = |obstacle: u32| {
            let cloth = if obstacle == a { other } else { a };
            self.params.friction_factors.get(cloth as usize).copied().unwrap_or(1.0)
        };
        obstacle.map_or_else(|| 0.5 * (friction(a) + friction(other)), |v| friction(v) * factor(v))
    }
}

/// Checks lengths and signs.
fn check(mesh: &CollisionMesh, params: &ContactParams) -> Result<(), DetectorError> {
    let lists = [
        ("the list of friction coefficients", &params.friction),
        ("the list of inverse masses", &params.inverse_masses_per_kg),
        ("the list of altitudes", &params.smallest_altitudes_m),
    ];
    for (what, list) in lists {
        if list.len() != mesh.vertices {
            return Err(DetectorError::Count { what, values: list.len(), vertices: mesh.vertices });
        }
        if let Some(&value) = list.iter().find(|&&value| !(value >= 0.0)) {
            return Err(DetectorError::Value { what, value });
        }
    }
    for (what, list) in [
        ("the list of friction factors", &params.friction_factors),
        ("the list of thickness factors", &params.thickness_factors),
    ] {
        if !list.is_empty() && list.len() != mesh.cloth_vertices {
            return Err(DetectorError::Count { what, values: list.len(), vertices: mesh.cloth_vertices });
        }
        if let Some(&value) = list.iter().find(|&&value| !(value >= 0.0)) {
            return Err(DetectorError::Value { what, value });
        }
    }
    let numbers = [
        ("the thickness", params.thickness_m),
        ("the separation", params.separation_m),
        ("the stiffness ratio", params.stiffness_ratio),
    ];
    for (what, value) in numbers {
        if !(value >= 0.0 && value.is_finite()) {
            return Err(DetectorError::Value { what, value });
        }
    }
    if !(params.step_s > 0.0) {
        return Err(DetectorError::Step { step_s: params.step_s });
    }
    Ok(())
}
