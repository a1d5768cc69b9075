//! Contact element: two features of cloth or obstacles closer than the thickness, as proximity detection hands them over.

use crate::gpu::gpu_struct;

/// In place of a vertex that a contact does not have.
pub const NO_VERTEX: u32 = u32::MAX;

gpu_struct! {
    /// A pair of closest features. Vertices are global rows (local ones on the device); numbers from the count of cloth rows on
    /// are obstacle vertices, which have no row in the system. Four kinds, told apart by the vertices present and `kind`:
    /// vertex-face `[v, a, b, c]`, vertex-edge `[v, a, b, NO_VERTEX]`, vertex-vertex `[v, w, NO_VERTEX, NO_VERTEX]`,
    /// edge-edge `[a0, a1, b0, b1]`.
    pub struct ContactElement {
        /// Vertices, [`NO_VERTEX`] where there is none.
        pub vertices: [u32; 4],
        /// Signed weights of the closest points: sum(weights * x) = distance * normal; they sum to zero. 0 for no vertex.
        pub weights: [f32; 4],
        /// Unit vector from the second feature to the first.
        pub normal: [f32; 3],
        /// Distance at the start of the step, metres.
        pub distance_m: f32,
        /// Distance below which the features repel each other, metres.
        pub thickness_m: f32,
        /// Stiffness of the repulsion, N/m.
        pub stiffness_n_m: f32,
        /// Coulomb friction coefficient.
        pub friction: f32,
        /// 0 = first feature is a vertex, 1 = two edges.
        pub kind: u32,
    }
}

impl ContactElement {
    /// Sort key: one order of all contacts of a step, whoever found them.
    pub fn key(&self) -> ([u32; 4], u32) {
        (self.vertices, self.kind)
    }
}
