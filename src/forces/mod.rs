//! Forces of the cloth as compact element records: the kernels here turn positions and velocities into records from
//! which
//! `assembly` fills forces and matrix blocks. Nothing is summed over elements here.
//!
//! Signs: a record describes a positive semidefinite stiffness K (the negative force Jacobian, projected), so that the
//! system matrix is M + (dt^2 + dt*damping) K + dt D with D from the air drag [Li et al. 2020, Eq. 3].

pub mod bend;
mod bend_cpu;
pub mod contact;
mod contact_cpu;
mod contact_element;
pub mod crease;
mod crease_cpu;
mod element;
pub mod fiber;
mod fiber_cpu;
mod overstretch;
pub mod plastic_stretch;
mod plastic_stretch_cpu;
pub mod stitch;
mod stitch_cpu;
pub mod stretch;
mod stretch_cpu;

#[cfg(test)]
mod tests;

pub use bend_cpu::{bend_energy, dihedral_angle};
pub use contact_cpu::{LEAST_GAP, LinearBarrier, STICK_SPEED_M_S, contact_energy, linearized};
pub use contact_element::{ContactElement, NO_VERTEX};
pub use element::{
    CONTACT_RECORD_FLOATS, CORNERS_HINGE, CORNERS_TRIANGLE, FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams,
    TRIANGLE_RECORD_FLOATS, TriangleElement, hinge_element, triangle_element,
};
pub use overstretch::{Overstretch, largest_overstretch, overstretch};
pub use stretch_cpu::{stretch_energy, stretch_stiffness};
