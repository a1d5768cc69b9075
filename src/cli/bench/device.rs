//! `loomtree bench device`: the bandwidth that every memory-bound kernel is held against.

use super::common::Common;
use super::table::FigureTable;
use crate::cli::CliError;
use crate::gpu::bandwidth_gb_s;

/// Arguments of `loomtree bench device`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct DeviceBench {
    #[command(flatten)]
    common: Common,
    /// Bytes of the arrays, MiB; well above the caches
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u64).range(1..=65536))]
    megabytes: u64,
}

pub(super) fn run(bench: &DeviceBench) -> Result<(), CliError> {
    let executor = bench.common.executor()?;
    let measured = bandwidth_gb_s(&executor, (bench.megabytes as usize) << 20)
        .map_err(|error| CliError::failed(error.to_string()))?;
    let title = format!(
        "memory bandwidth of {} ({} thread(s)), {} MiB arrays",
        executor.device_name(),
        bench.common.threads,
        bench.megabytes
    );
    let mut table = FigureTable::new("device", title, vec!["copy_gb_s", "read_gb_s"]);
    table.push(vec![measured.copy_gb_s, measured.read_gb_s]);
    table.finish(bench.common.out.as_deref(), None)
}
