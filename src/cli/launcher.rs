//! Who starts the workers of a command: this program, or `mpirun` and `srun`, which start one process per rank.

use super::CliError;
use crate::coordinator::Launch;
#[cfg(feature = "mpi")]
use crate::os::signals;
use crate::transport::MeasuredWorld;
#[cfg(feature = "mpi")]
use crate::transport::{Inside, Membership};
#[cfg(feature = "mpi")]
use crate::worker;

/// Origin of the workers of a command.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum LauncherChoice {
    /// The ranks of mpirun or srun where one of them has started this program, else processes
    #[default]
    Auto,
    /// Child processes of this one
    Processes,
    /// The ranks that mpirun or srun has started, each a worker
    Mpi,
}

/// Arguments about the origin of workers.
#[derive(Clone, Debug, clap::Args)]
pub struct LauncherArgs {
    /// Who starts the workers; mpi = mpirun or srun have, one process per worker on one or several machines
    #[arg(long, value_enum, default_value_t, value_name = "WHO", global = true)]
    pub launcher: LauncherChoice,
    /// Under mpirun or srun: how ranks of one host send to each other; auto = shared memory
    #[arg(long, value_enum, default_value_t, value_name = "WAY", global = true)]
    pub transport: TransportChoice,
}

impl LauncherArgs {
    /// Those of a command line without them.
    pub const NONE: LauncherArgs = LauncherArgs { launcher: LauncherChoice::Auto, transport: TransportChoice::Auto };
}

/// Way of the messages inside a host, in a world of several processes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum TransportChoice {
    /// Shared memory of this program
    #[default]
    Auto,
    /// MPI, as between hosts
    Mpi,
}

/// Processes of a world, as the environment of its launcher names them: number of processes and own rank.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Announced {
    size: usize,
    rank: usize,
}

/// Variables of launchers: number of processes, and own rank. Those of Slurm are of a step (`srun`), because a batch
/// script is one process of a job of many tasks.
const VARIABLES: [[&str; 2]; 4] = [
    ["OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"],
    ["PMI_SIZE", "PMI_RANK"],
    ["PMIX_SIZE", "PMIX_RANK"],
    ["SLURM_STEP_NUM_TASKS", "SLURM_PROCID"],
];

fn announced(variable: impl Fn(&str) -> Option<String>) -> Option<Announced> {
    let number = |name: &str| variable(name)?.parse().ok();
    VARIABLES.iter().find_map(|[size, rank]| Some(Announced { size: number(size)?, rank: number(rank)? }))
}

/// Runs `command` with the workers that `args` name. In a process that is only a worker, `command` is not run: the
/// process serves until the first one is done.
///
/// # Errors
/// Those of the command, and a launcher that does not fit this program (exit code 2).
pub fn under(args: &LauncherArgs, command: impl FnOnce(Launch) -> Result<(), CliError>) -> Result<(), CliError> {
    let there = announced(|name| std::env::var(name).ok());
    match (args.launcher, there) {
        (LauncherChoice::Processes, _) | (LauncherChoice::Auto, None) if args.transport == TransportChoice::Auto => {
            command(Launch::Spawn)
        }
        (LauncherChoice::Processes, _) => {
            Err(CliError::bad_input("--transport mpi needs the ranks of mpirun or srun, and so --launcher mpi"))
        }
        (LauncherChoice::Auto | LauncherChoice::Mpi, there) => in_world(there, args.transport, command),
    }
}

/// Runs `command` once, with the measured world of all ranks if `mpirun` or `srun` has started this program. In a
/// process that is not the first one, `command` is not run.
///
/// # Errors
/// Those of the command, and a launcher that does not fit this program (exit code 2).
pub fn with_all(
    args: &LauncherArgs,
    command: impl FnOnce(Option<&MeasuredWorld>) -> Result<(), CliError>,
) -> Result<(), CliError> {
    let there = announced(|name| std::env::var(name).ok());
    match (args.launcher, there) {
        (LauncherChoice::Processes, _) | (LauncherChoice::Auto, None) => command(None),
        (LauncherChoice::Auto | LauncherChoice::Mpi, there) => measured(there, args.transport, command),
    }
}

#[cfg(not(feature = "mpi"))]
fn in_world(
    there: Option<Announced>,
    _transport: TransportChoice,
    _command: impl FnOnce(Launch) -> Result<(), CliError>,
) -> Result<(), CliError> {
    Err(not_built(there))
}

#[cfg(not(feature = "mpi"))]
fn measured(
    there: Option<Announced>,
    _transport: TransportChoice,
    _command: impl FnOnce(Option<&MeasuredWorld>) -> Result<(), CliError>,
) -> Result<(), CliError> {
    Err(not_built(there))
}

/// A program that cannot be a rank of `mpirun` or `srun`.
#[cfg(not(feature = "mpi"))]
fn not_built(there: Option<Announced>) -> CliError {
    // One rank speaks for all.
    if there.is_some_and(|there| there.rank > 0) {
        return CliError::bad_input("");
    }
    let started = there.map_or(String::new(), |there| format!("; {} of its processes were started", there.size));
    CliError::bad_input(format!(
        "this program is built without MPI{started}: build it with cargo build --release --features mpi (which needs \
         libopenmpi-dev or libmpich-dev, and libclang-dev), or say --launcher processes"
    ))
}

#[cfg(feature = "mpi")]
fn join(there: Option<Announced>, transport: TransportChoice) -> Result<Membership, CliError> {
    let inside = match transport {
        TransportChoice::Auto => Inside::SharedMemory,
        TransportChoice::Mpi => Inside::Mpi,
    };
    Membership::join(there.map(|there| there.size), inside).map_err(|message| {
        let first = there.is_none_or(|there| there.rank == 0);
        CliError::bad_input(if first { message } else { String::new() })
    })
}

#[cfg(feature = "mpi")]
fn in_world(
    there: Option<Announced>,
    transport: TransportChoice,
    command: impl FnOnce(Launch) -> Result<(), CliError>,
) -> Result<(), CliError> {
    let mut member = join(there, transport)?;
    if !member.is_first() {
        // The first process stops all others in order, also where the launcher has passed a signal on to all.
        signals::leave_stops_to_others();
    }
    // The channel reports a failure to the coordinator.
    let served = member.serve(|rank, control, data| drop(worker::serve(rank, control, data)));
    served.map_err(CliError::failed)?;
    if !member.is_first() {
        member.leave(0);
        return Ok(());
    }
    let world = member.world();
    leave_with(member, command(Launch::World(world)))
}

#[cfg(feature = "mpi")]
fn measured(
    there: Option<Announced>,
    transport: TransportChoice,
    command: impl FnOnce(Option<&MeasuredWorld>) -> Result<(), CliError>,
) -> Result<(), CliError> {
    let member = join(there, transport)?;
    let result = member.measure().map_err(CliError::failed).and_then(|world| match member.is_first() {
        true => command(Some(&world)),
        false => Ok(()),
    });
    leave_with(member, result)
}

/// Leaves the world with the exit code of a command. Its error is said before the other processes end.
#[cfg(feature = "mpi")]
fn leave_with(member: Membership, result: Result<(), CliError>) -> Result<(), CliError> {
    let exit_code = result.as_ref().map_or_else(|error| error.exit_code, |()| 0);
    if result.is_err() {
        super::exit_code(result.clone());
    }
    member.leave(exit_code);
    result.map_err(|error| CliError { message: String::new(), ..error })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn launchers_announce_their_processes() {
        let of = |pairs: &[(&str, &str)]| {
            announced(|name| pairs.iter().find(|(key, _)| *key == name).map(|(_, value)| value.to_string()))
        };
        assert_eq!(of(&[]), None);
        let open_mpi = [("OMPI_COMM_WORLD_SIZE", "8"), ("OMPI_COMM_WORLD_RANK", "3")];
        assert_eq!(of(&open_mpi), Some(Announced { size: 8, rank: 3 }));
        assert_eq!(of(&[("PMI_RANK", "0"), ("PMI_SIZE", "2")]), Some(Announced { size: 2, rank: 0 }));
        let step = [("SLURM_STEP_NUM_TASKS", "4"), ("SLURM_PROCID", "1"), ("SLURM_NTASKS", "4")];
        assert_eq!(of(&step), Some(Announced { size: 4, rank: 1 }));
        // A batch script.
        assert_eq!(of(&[("SLURM_NTASKS", "4"), ("SLURM_PROCID", "0")]), None);
    }
}
