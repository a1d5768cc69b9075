//! 3-vectors and 3x3 blocks. Device code works in f32; f64 appears only where a sum or a geometric construction needs
//! it.

mod local_origin;

pub use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3, Mat3, Quat, UVec2, UVec3, Vec2, Vec3, Vec4};
pub use local_origin::{FAR_M, bounds, local_origin};

/// Components of a vertex quantity and the side of a matrix block.
pub const DIM: usize = 3;
