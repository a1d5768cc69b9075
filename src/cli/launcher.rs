//! Who starts the workers of a command: this program, or `mpirun` and `srun`, which start one process per rank.

use super::CliError;
use crate::coordinator::Launch;

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
    #[arg(long, value_enum, default_value_t, value_name = "WHO")]
    pub launcher: LauncherChoice,
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

/// Runs `command` with the workers that `choice` names. In a process that is only a worker, `command` is not run: the
/// process serves until the first one is done.
///
/// # Errors
/// Those of the command, and a launcher that does not fit this program (exit code 2).
pub fn under(choice: LauncherChoice, command: impl FnOnce(Launch) -> Result<(), CliError>) -> Result<(), CliError> {
    let there = announced(|name| std::env::var(name).ok());
    match (choice, there) {
        (LauncherChoice::Processes, _) | (LauncherChoice::Auto, None) => command(Launch::Spawn),
        (LauncherChoice::Auto | LauncherChoice::Mpi, there) => in_world(there, command),
    }
}

#[cfg(not(feature = "mpi"))]
fn in_world(there: Option<Announced>, _command: impl FnOnce(Launch) -> Result<(), CliError>) -> Result<(), CliError> {
    // One rank speaks for all.
    if there.is_some_and(|there| there.rank > 0) {
        return Err(CliError::bad_input(""));
    }
    let started = there.map_or(String::new(), |there| format!("; {} of its processes were started", there.size));
    Err(CliError::bad_input(format!(
        "this program is built without MPI{started}: build it with cargo build --release --features mpi (which needs \
         libopenmpi-dev or libmpich-dev, and libclang-dev), or say --launcher processes"
    )))
}

#[cfg(feature = "mpi")]
fn in_world(there: Option<Announced>, command: impl FnOnce(Launch) -> Result<(), CliError>) -> Result<(), CliError> {
    use crate::os::signals;
    use crate::transport::Membership;
    use crate::worker;

    let mut member = Membership::join(there.map(|there| there.size)).map_err(|message| {
        let first = there.is_none_or(|there| there.rank == 0);
        CliError::bad_input(if first { message } else { String::new() })
    })?;
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
    let result = command(Launch::World(member.world()));
    let exit_code = result.as_ref().map_or_else(|error| error.exit_code, |()| 0);
    if let Err(error) = &result
        && !error.message.is_empty()
    {
        super::exit_code(Err(error.clone()));
    }
    member.leave(exit_code);
    // Said above, before the other processes end.
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
