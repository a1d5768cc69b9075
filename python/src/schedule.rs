//! Transfer-stage schedules of topology files.

use std::path::PathBuf;

use loomtree::{ScheduleKind, Topology, plan_schedule};
use pyo3::prelude::*;

use crate::bad_input;

/// Plans the transfer stages of a topology for sub-vectors of `sub_vector_bytes` bytes. Returns the kind, by rank and
/// stage the pair of the source and the sub-vector, the modelled seconds of the stages, and their sum.
#[pyfunction]
#[allow(clippy::type_complexity, reason = "a tuple for Python, which makes a class of it")]
pub(crate) fn schedule(
    topology: PathBuf,
    kind: &str,
    sub_vector_bytes: f64,
) -> PyResult<(String, Vec<Vec<(usize, usize)>>, Vec<f64>, f64)> {
    let kind: ScheduleKind =
        serde_json::from_value(kind.into()).map_err(|error| bad_input(format!("kind: {error}")))?;
    let topology = Topology::read(&topology).map_err(bad_input)?;
    let plan = plan_schedule(kind, &topology, sub_vector_bytes).map_err(bad_input)?;
    let queue =
        |queue: &Vec<loomtree::interconnect::QueueNode>| queue.iter().map(|node| (node.source, node.vector)).collect();
    let queues = plan.schedule.queues.iter().map(queue).collect();
    Ok((plan.kind.name().to_string(), queues, plan.cost.stage_s, plan.cost.total_s))
}
