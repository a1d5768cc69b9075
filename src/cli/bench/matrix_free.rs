//! `loomtree bench matrix-free`: the same integrator with and without a stored matrix, P-Cloth's Fig. 18 [Li et al. 2020]. One
//! rank on the cpu executor, block Jacobi both times, from the same state with its contacts. The product without a matrix is
//! computed from the element records of the step (`solver::comparison`), which is less work than the paper's, where
//! every product evaluates the elements anew.

use std::path::PathBuf;

use super::common::{Common, machine, median, positive};
use super::ranks::{ModelState, seconds_of};
use super::table::FigureTable;
use crate::cli::CliError;
use crate::interconnect::{Kernel, Topology};
use crate::model::GlobalModel;
use crate::scene::Overrides;
use crate::step::{Simulation, StepStats};
use crate::telemetry::{Event, EventName};
use crate::transport::{SoloTransport, Transport};

/// Arguments of `loomtree bench matrix-free`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct MatrixFreeBench {
    #[command(flatten)]
    common: Common,
    /// Scene
    #[arg(long, default_value = "scenes/sphere.toml")]
    scene: PathBuf,
    /// Triangles of the scene, one row of the tables each
    #[arg(long, value_delimiter = ',', default_value = "5000,10000,20000,40000", value_parser = crate::cli::count)]
    resolution: Vec<u64>,
    /// Measured from the first step on that has so many contacts per vertex
    #[arg(long, default_value_t = 0.05, value_parser = positive)]
    contacts: f64,
    /// Or after so many steps, whichever comes first
    #[arg(long, default_value_t = 600)]
    skip: u32,
    /// Whole steps to time, stored and matrix-free in turn
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Products to time
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..))]
    repeat: u32,
    /// Machine whose device the modeled table is for [default: Titan Xp]
    #[arg(long, value_name = "FILE")]
    topology: Option<PathBuf>,
}

pub(super) fn run(bench: &MatrixFreeBench) -> Result<(), CliError> {
    let machine = machine(bench.topology.as_deref(), 1)?;
    let out = bench.common.out.as_deref();
    let (measured, modeled) = tables(bench, &machine)?;
    measured.y_label("matrix-free over stored").finish_curves(
        out,
        Some(("triangles", &["product_ratio", "integration_ratio", "step_ratio", "memory_ratio"])),
    )?;
    modeled.finish(out, Some(("triangles", "product_ratio")))
}

fn tables(bench: &MatrixFreeBench, machine: &Topology) -> Result<(FigureTable, FigureTable), CliError> {
    let title = format!(
        "measured: a stored matrix against none, {}, one rank, {} thread(s), cpu executor, block Jacobi",
        bench.scene.display(),
        bench.common.threads
    );
    let columns = vec![
        "triangles",
        "contacts",
        "stored_product_ms",
        "free_product_ms",
        "product_ratio",
        "stored_bytes",
        "free_bytes",
        "memory_ratio",
        "stored_integration_ms",
        "free_integration_ms",
        "integration_ratio",
        "stored_step_ms",
        "free_step_ms",
        "step_ratio",
        "stored_iterations",
        "free_iterations",
    ];
    let mut measured = FigureTable::new("matrix_free", title, columns);
    let title = format!(
        "modelled, not measured: a product on one {} with and without a stored matrix, {}",
        machine.device().name,
        bench.scene.display()
    );
    let columns = vec!["triangles", "stored_product_ms", "free_product_ms", "product_ratio"];
    let mut modeled = FigureTable::modeled("matrix_free_modelled", title, columns);
    for &resolution in &bench.resolution {
        let overrides = Overrides { resolution: Some(resolution), frames: None };
        let scene = crate::scene::load(&bench.scene, &overrides).map_err(CliError::bad_input)?;
        let triangles = scene.mesh.triangles.len() as f64;
        let state = ModelState::in_contact(GlobalModel::new(&scene), &bench.common, bench.contacts, bench.skip)?;
        let mut pair = [Measured::new(&state, &bench.common, false)?, Measured::new(&state, &bench.common, true)?];
        for one in &mut pair {
            one.time_products(bench.repeat)?;
        }
        for step in state.step..state.step + bench.steps {
            for one in &mut pair {
                one.step(step)?;
            }
        }
        let [stored, free] = &mut pair;
        let [product, free_product] = [&mut *stored, &mut *free].map(|one| median(&mut one.product_s) * 1e3);
        let of = |one: &Measured, seconds: fn(&StepStats) -> f64| {
            median(&mut one.steps.iter().map(seconds).collect::<Vec<_>>()) * 1e3
        };
        let [integration, free_integration] = [of(stored, integration_s), of(free, integration_s)];
        let [step, free_step] = [of(stored, |stats| stats.seconds.total), of(free, |stats| stats.seconds.total)];
        let iterations = |one: &Measured| of(one, |stats| f64::from(stats.iterations)) * 1e-3;
        let [bytes, free_bytes] = [stored.bytes, free.bytes].map(|bytes| bytes as f64);
        measured.push(vec![
            triangles,
            state.contacts as f64,
            product,
            free_product,
            free_product / product,
            bytes,
            free_bytes,
            free_bytes / bytes,
            integration,
            free_integration,
            free_integration / integration,
            step,
            free_step,
            free_step / step,
            iterations(stored),
            iterations(free),
        ]);
        let [product, free_product] =
            [stored.kernel, free.kernel].map(|kernel| machine.device().kernel_s(kernel.bytes, kernel.flops) * 1e3);
        modeled.push(vec![triangles, product, free_product, free_product / product]);
    }
    Ok((measured, modeled))
}

/// Implicit time integration: everything but collisions.
fn integration_s(stats: &StepStats) -> f64 {
    let s = &stats.seconds;
    s.exchange + s.elements + s.index_fill + s.value_fill + s.solve + s.advance
}

/// One of the two ways, measured.
struct Measured {
    simulation: Simulation,
    transport: SoloTransport,
    product_s: Vec<f64>,
    steps: Vec<StepStats>,
    /// Bytes of all tables and vectors, with the contacts of the first step.
    bytes: u64,
    /// Bytes and flops of a product.
    kernel: Kernel,
}

impl Measured {
    fn new(state: &ModelState, common: &Common, matrix_free: bool) -> Result<Measured, CliError> {
        let mut simulation = state.one_rank(common)?;
        if matrix_free {
            simulation.drop_matrix().map_err(|error| CliError::bad_input(error.to_string()))?;
        }
        let mut transport = SoloTransport::new(Box::new(|| false));
        let failed = |error: &dyn std::fmt::Display| CliError::failed(error.to_string());
        simulation.assemble(&mut transport, state.step).map_err(|error| failed(&error))?;
        let events = simulation.record_product(&mut transport).map_err(|error| failed(&error))?;
        let kernel = events.iter().fold(Kernel::default(), |sum, event| sum.plus(kernel_of(event)));
        let bytes = simulation.memory_bytes();
        Ok(Measured { simulation, transport, product_s: Vec::new(), steps: Vec::new(), bytes, kernel })
    }

    fn time_products(&mut self, repeat: u32) -> Result<(), CliError> {
        let transport: &mut dyn Transport = &mut self.transport;
        let times = self.simulation.time_products(transport, repeat).map_err(|e| CliError::failed(e.to_string()))?;
        self.product_s = times.iter().map(seconds_of).collect();
        Ok(())
    }

    fn step(&mut self, step: u32) -> Result<(), CliError> {
        let stats = self.simulation.step(&mut self.transport, step, false);
        self.steps.push(stats.map_err(|error| CliError::failed(error.to_string()))?);
        Ok(())
    }
}

/// Bytes and flops of a kernel of a product.
fn kernel_of(event: &Event) -> Kernel {
    match EventName::from_number(event.name) {
        Some(EventName::SpmvLocal | EventName::SpmvRemote) => {
            Kernel { bytes: event.bytes as f64, flops: event.flops as f64, measured_s: 0.0 }
        }
        _ => Kernel::default(),
    }
}
