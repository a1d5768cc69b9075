//! What the Python package `loomtree` calls: a simulation in the workers of this process, runs that write a run
//! directory, their frames, linear systems and schedules. The package in `package/` documents it for its users.

mod options;
mod run;
mod schedule;
mod simulation;
mod solve;
mod wait;

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;

/// The compiled part of `loomtree`.
#[pymodule]
fn _loomtree(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<simulation::Simulation>()?;
    module.add_function(wrap_pyfunction!(options::scene_to_toml, module)?)?;
    module.add_function(wrap_pyfunction!(run::run, module)?)?;
    module.add_function(wrap_pyfunction!(run::resume, module)?)?;
    module.add_function(wrap_pyfunction!(run::frames, module)?)?;
    module.add_function(wrap_pyfunction!(run::read_frame, module)?)?;
    module.add_function(wrap_pyfunction!(run::kept_states, module)?)?;
    module.add_function(wrap_pyfunction!(run::read_state, module)?)?;
    module.add_function(wrap_pyfunction!(solve::solve, module)?)?;
    module.add_function(wrap_pyfunction!(schedule::schedule, module)?)
}

/// An error that the user can correct.
fn bad_input(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Something that failed.
fn failed(error: impl std::fmt::Display) -> PyErr {
    PyRuntimeError::new_err(error.to_string())
}
