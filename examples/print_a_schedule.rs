//! Prints the work queue of every GPU of a topology: what it receives from whom in which stage.
//!
//! `cargo run --release --example print_a_schedule -- [TOPOLOGY.toml]`

use std::error::Error;
use std::path::Path;

use loomtree::{ScheduleKind, Topology, plan_schedule};

/// Bytes of a sub-vector: 150,000 rows of three f32.
const SUB_VECTOR_BYTES: f64 = 1.8e6;

fn main() -> Result<(), Box<dyn Error>> {
    let file = std::env::args().nth(1).unwrap_or_else(|| "topology/pcie_4.toml".into());
    let topology = Topology::read(Path::new(&file))?;
    let plan = plan_schedule(ScheduleKind::Auto, &topology, SUB_VECTOR_BYTES)?;
    println!("{file}: {} takes {:.3} ms (modelled)", plan.kind.name(), plan.cost.total_s * 1e3);
    for (gpu, queue) in plan.schedule.queues.iter().enumerate() {
        let stages: Vec<String> = queue.iter().map(|node| format!("v{} from {}", node.vector, node.source)).collect();
        println!("GPU {gpu}: {}", stages.join(", "));
    }
    Ok(())
}
