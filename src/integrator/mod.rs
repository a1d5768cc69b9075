//! Backward Euler [Baraff and Witkin 1998; Li et al. 2020, Eqs. 1-3]: with dv from the solver, v(t1) = v(t0) + dv and
//! x(t1) = x(t0) + dt v(t1). Prescribed vertices are set exactly.

pub mod advance;
mod advance_cpu;
pub mod inertia;
mod inertia_cpu;
pub mod pins;
pub mod scatter;
mod scatter_cpu;
pub mod surfaces;
