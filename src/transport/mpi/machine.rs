//! The machines of a world: who shares one with whom, and its cores.

use std::sync::Arc;

use rustix::thread::{CpuSet, sched_getaffinity};

use super::library::Library;
use crate::transport::{Machine, MachineError, cores};

/// Bytes of a host's name, and of a set of cores, that a process tells the others.
const NAME: usize = 64;
const CORES: usize = 1024 / 8;

/// The processes of a world and their hosts.
pub(super) struct Hosts {
    /// By process: the lowest process of its host.
    pub hosts: Vec<usize>,
    /// By process: what it is called in sentences.
    pub names: Arc<Vec<String>>,
    /// By process: cores that the processes of its host may use together.
    cores: Vec<usize>,
}

impl Hosts {
    /// Asks every process; waits for all of them.
    pub(super) fn census(library: &Library) -> Result<Hosts, String> {
        let mut own = vec![0_u8; NAME + 4 + CORES];
        let host = rustix::system::uname().nodename().to_string_lossy().into_owned();
        let name = &host.as_bytes()[..host.len().min(NAME)];
        own[..name.len()].copy_from_slice(name);
        own[NAME..NAME + 4].copy_from_slice(&std::process::id().to_le_bytes());
        let allowed = sched_getaffinity(None).unwrap_or_else(|_| first_cores(cores()));
        for core in (0..CpuSet::MAX_CPU.min(CORES * 8)).filter(|&core| allowed.is_set(core)) {
            own[NAME + 4 + core / 8] |= 1 << (core % 8);
        }
        let census = library.census(&own)?;
        let names = census.words.iter().enumerate().map(|(process, words)| {
            let name = words[..NAME].split(|&byte| byte == 0).next().unwrap_or_default();
            let pid = u32::from_le_bytes(std::array::from_fn(|at| words[NAME + at]));
            format!("rank {process} on {}, process {pid}", String::from_utf8_lossy(name))
        });
        let union = |host: usize| {
            let of_host = census.hosts.iter().zip(&census.words).filter(|(there, _)| **there == host);
            let both =
                of_host.fold([0_u8; CORES], |all, (_, words)| std::array::from_fn(|at| all[at] | words[NAME + 4 + at]));
            both.iter().map(|byte| byte.count_ones() as usize).sum::<usize>().max(1)
        };
        let cores = census.hosts.iter().map(|&host| union(host)).collect();
        Ok(Hosts { names: Arc::new(names.collect()), cores, hosts: census.hosts })
    }

    fn on_host_of(&self, process: usize) -> usize {
        self.hosts.iter().filter(|&&host| host == self.hosts[process]).count()
    }
}

fn first_cores(count: usize) -> CpuSet {
    let mut set = CpuSet::new();
    (0..count.min(CpuSet::MAX_CPU)).for_each(|core| set.set(core));
    set
}

/// The machines of a world as one.
pub(super) struct ClusterMachine(pub Arc<Hosts>);

impl Machine for ClusterMachine {
    fn cores(&self) -> usize {
        let hosts = &self.0.hosts;
        hosts
            .iter()
            .enumerate()
            .filter(|(process, host)| process == *host)
            .map(|(process, _)| self.0.cores[process])
            .sum()
    }

    /// As many as the fullest host allows, so that no rank waits for a slower one.
    fn threads_per_worker(&self, _workers: usize) -> usize {
        let of_process = |process: usize| self.0.cores[process] / self.0.on_host_of(process);
        (0..self.0.hosts.len()).map(of_process).min().unwrap_or(1).max(1)
    }

    fn place(&self, index: usize, _workers: usize) -> (usize, usize) {
        let hosts = &self.0.hosts;
        let before = hosts[..index].iter().filter(|&&host| host == hosts[index]).count();
        (before, self.0.on_host_of(index))
    }

    fn prepare(&self, workers: usize) -> Result<(), MachineError> {
        let there = self.0.hosts.len();
        if workers == there {
            return Ok(());
        }
        Err(MachineError::TooSmall(format!(
            "{workers} workers, and {there} processes were started: every process is a worker, so leave out --workers \
             (and --sessions), or start {workers} processes"
        )))
    }

    fn check_transfers(&self, _ranks: usize, _max_len: usize) -> Result<(), MachineError> {
        Ok(())
    }
}
