//! The library without processes: a flag on 1 and on 4 ranks (threads here), and the proof that both have the same bits.
//!
//! `cargo run --release --example same_bits -- [SCENE] [STEPS]`

use std::error::Error;
use std::path::PathBuf;
use std::thread;

use loomtree::gpu::Executor;
use loomtree::interconnect::fat_tree;
use loomtree::model::{GlobalModel, RankModel, State};
use loomtree::partition::RowPartition;
use loomtree::scene::{Overrides, Scene, load};
use loomtree::solver::ExchangeMode;
use loomtree::step::{ExchangePlan, Simulation};
use loomtree::transport::InProcessTransport;

type Failure = Box<dyn Error + Send + Sync>;

fn main() -> Result<(), Failure> {
    let mut arguments = std::env::args().skip(1);
    let path = PathBuf::from(arguments.next().unwrap_or_else(|| "scenes/flag.toml".into()));
    let steps = arguments.next().map_or(Ok(25), |text| text.parse())?;
    let scene = load(&path, &Overrides { resolution: Some(2000), frames: None })?;

    let one = simulate(&scene, 1, steps)?;
    let four = simulate(&scene, 4, steps)?;
    println!("{} after {steps} steps: {one} on 1 rank, {four} on 4 ranks", scene.name);
    if one != four {
        return Err("the states differ".into());
    }
    Ok(())
}

/// Hash of the state after `steps` steps on `ranks` ranks (a power of two), each a thread with its own executor.
fn simulate(scene: &Scene, ranks: usize, steps: u32) -> Result<String, Failure> {
    let model = GlobalModel::new(scene);
    let partition = RowPartition::new(model.rows(), ranks);
    let schedule = fat_tree(ranks)?;
    let mut parts = Vec::new();
    RankModel::split(&model, &partition, |_, part| {
        parts.push(part);
        Ok::<(), Failure>(())
    })?;

    let ranks = parts.into_iter().zip(InProcessTransport::group(ranks)).zip(schedule.queues);
    let threads: Vec<_> = ranks
        .map(|((part, mut transport), queue)| {
            thread::spawn(move || -> Result<_, Failure> {
                let plan = ExchangePlan { mode: ExchangeMode::Halo, queue };
                let mut simulation = Simulation::new(Executor::cpu(1), part, &plan)?;
                for step in 1..=steps {
                    simulation.step(&mut transport, step, false)?;
                }
                Ok(simulation.state())
            })
        })
        .collect();

    // Row blocks are contiguous ranges of the global order; the hash is over the mesh's own order.
    let mut state = State::zeros(model.rows());
    for (rank, thread) in threads.into_iter().enumerate() {
        let part = thread.join().map_err(|_| "a rank panicked")??;
        state.scatter(&model.original_from_global[partition.rows_of(rank)], &part);
    }
    Ok(state.hash())
}
