//! [`Launcher`] whose workers are processes of this machine: children of this one, or processes that other programs
//! start. It owns the run's name and with it the run's files on the machine.

use std::cell::RefCell;
use std::io;
use std::process::{Child, Command};

use rustix::process::{Pid, Signal, kill_process};

use super::process::{cpu_ticks, is_busy};
use super::{Launcher, Life, Member, RunError, RunMember, RunName};
use crate::os::signals;

/// Makes the command that starts a worker of a run.
pub type WorkerCommand = Box<dyn FnMut(&RunName, usize) -> io::Result<Command>>;

/// Starts workers as child processes, or finds those that other programs start in the run's list of processes.
pub struct ProcessLauncher {
    command: Option<WorkerCommand>,
    children: Vec<Option<Child>>,
    /// By rank: workers that other programs started, as last seen.
    seen: RefCell<Vec<Option<Member>>>,
    /// By rank: how often the worker was busy when it was looked at.
    busy: RefCell<Vec<u64>>,
    run: RunName,
    // Dropped last: as long as it lives, the run counts as alive.
    _member: RunMember,
}

impl ProcessLauncher {
    /// A new run of `ranks` workers, started with `command`; without one other programs start them. The calling process
    /// is its coordinator.
    pub fn new(ranks: usize, command: Option<WorkerCommand>) -> Result<ProcessLauncher, RunError> {
        let (run, member) = RunName::create("coordinator")?;
        let children = (0..ranks).map(|_| None).collect();
        let (seen, busy) = (RefCell::new(vec![None; ranks]), RefCell::new(vec![0; ranks]));
        Ok(ProcessLauncher { command, children, seen, busy, run, _member: member })
    }

    /// The run.
    pub fn run(&self) -> &RunName {
        &self.run
    }

    fn pid(&self, rank: usize) -> Option<u32> {
        let child = self.children.get(rank).and_then(Option::as_ref).map(Child::id);
        child.or_else(|| self.member(rank).map(|member| member.pid))
    }

    /// The process of a worker that another program started; none if it has not registered (yet).
    fn member(&self, rank: usize) -> Option<Member> {
        let mut seen = self.seen.borrow_mut();
        let seen = seen.get_mut(rank)?;
        if seen.is_none() {
            let role = worker_role(rank);
            *seen = self.run.members().into_iter().find(|member| member.role == role);
        }
        seen.clone()
    }
}

/// Role of a registered worker process ([`RunName::join`]).
pub fn worker_role(rank: usize) -> String {
    format!("worker {rank}")
}

impl Launcher for ProcessLauncher {
    fn run_name(&self) -> Option<&RunName> {
        Some(&self.run)
    }

    fn start(&mut self, rank: usize) -> io::Result<()> {
        if let Some(command) = &mut self.command {
            self.children[rank] = Some(command(&self.run, rank)?.spawn()?);
        }
        Ok(())
    }

    fn life(&mut self, rank: usize) -> Life {
        match self.children.get_mut(rank).and_then(Option::as_mut).map(Child::try_wait) {
            None => Life::NotStarted,
            Some(Ok(Some(_))) => Life::Ended,
            Some(Ok(None) | Err(_)) => Life::Running,
        }
    }

    fn end_of(&mut self, rank: usize) -> Option<String> {
        let status = self.children.get_mut(rank)?.as_mut()?.try_wait().ok()??;
        Some(signals::describe_end(status))
    }

    fn work_of(&self, rank: usize) -> Option<u64> {
        let pid = self.pid(rank)?;
        let mut busy = self.busy.borrow_mut();
        let times = busy.get_mut(rank)?;
        // A worker that waits for a core is not hung, though it uses no time.
        *times += u64::from(is_busy(pid));
        Some(cpu_ticks(pid)? + *times)
    }

    fn describe(&self, rank: usize) -> String {
        match self.pid(rank) {
            Some(pid) => format!("process {pid}"),
            None => "unknown process".to_string(),
        }
    }

    fn kill(&mut self, rank: usize) {
        match self.children.get_mut(rank) {
            // A child that has been reaped must not be signaled, because another process may have its number.
            Some(Some(child)) => drop(child.kill()),
            _ => {
                let Some(member) = self.member(rank).filter(Member::is_alive) else { return };
                if let Some(pid) = i32::try_from(member.pid).ok().and_then(Pid::from_raw) {
                    let _ = kill_process(pid, Signal::KILL);
                }
            }
        }
    }

    fn wait(&mut self, rank: usize) {
        if let Some(Some(child)) = self.children.get_mut(rank) {
            let _ = child.wait();
        }
    }

    fn clean_up(&mut self) {
        // The ports of killed workers are released only when the run's files are removed.
        if let Err(error) = self.run.purge() {
            tracing::warn!("cannot remove the run's files: {error}");
        }
    }
}
