//! The real programs: runs, solves, benchmarks, faults, and the transport between processes.

mod bad_input;
mod bench_commands;
mod bodies;
mod cli_json;
mod cli_render;
mod cli_sweep;
mod command_line;
mod control_conformance;
mod convert;
mod cores;
mod descriptors;
mod far;
mod faults;
mod groups;
mod launch;
mod live;
mod machine_limits;
#[cfg(feature = "mpi")]
mod mpi;
mod one_process;
mod resume;
mod same_bits;
mod session;
mod sewing;
mod solve_command;
mod start_from;
mod streams;
mod suspended;
mod time_split;
mod transport_conformance;
mod transport_control;
mod transport_patterns;
mod transport_processes;
