//! Kernels and the parts of a step, on both executors, and the same bits on any number of ranks.

mod contact_system;
mod gpu_kernels;
mod gpu_step;
mod guide;
mod matrix_free;
mod same_bits;
mod set_state;
mod step_reads;
