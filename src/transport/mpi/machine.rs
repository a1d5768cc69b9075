//! The machines of a world: who shares one with whom, and its cores.

use std::sync::Arc;

use rustix::thread::{CpuSet, sched_getaffinity};

use super::connect::Inside;
use super::library::Library;
use crate::transport::{Machine, MachineError, check_shared_memory, cores, shared_memory_space};

/// Bytes of a host's name, and of a set of cores, that a process tells the others.
const NAME: usize = 64;
const CORES: usize = 1024 / 8;

/// The processes of a world and their hosts.
pub(super) struct Hosts {
    /// By process: the lowest process of its host.
    pub hosts: Vec<usize>,
    /// By process: what it is called in sentences.
    pub names: Arc<Vec<String>>,
    /// By process: name of its host.
    pub host_names: Vec<String>,
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
        let host_name = |words: &Vec<u8>| {
            let name = words[..NAME].split(|&byte| byte == 0).next().unwrap_or_default();
            String::from_utf8_lossy(name).into_owned()
        };
        let host_names: Vec<String> = census.words.iter().map(host_name).collect();
        let names = census.words.iter().zip(&host_names).enumerate().map(|(process, (words, host))| {
            let pid = u32::from_le_bytes(std::array::from_fn(|at| words[NAME + at]));
            format!("rank {process} on {host}, process {pid}")
        });
        let union = |host: usize| {
            let of_host = census.hosts.iter().zip(&census.words).filter(|(there, _)| **there == host);
            let both =
                of_host.fold([0_u8; CORES], |all, (_, words)| std::array::from_fn(|at| all[at] | words[NAME + 4 + at]));
            both.iter().map(|byte| byte.count_ones() as usize).sum::<usize>().max(1)
        };
        let cores = census.hosts.iter().map(|&host| union(host)).collect();
        let names = Arc::new(names.collect());
        Ok(Hosts { names, host_names, cores, hosts: census.hosts })
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
pub(super) struct ClusterMachine {
    pub hosts: Arc<Hosts>,
    pub inside: Inside,
}

impl Machine for ClusterMachine {
    fn cores(&self) -> usize {
        let hosts = &self.hosts.hosts;
        hosts
            .iter()
            .enumerate()
            .filter(|(process, host)| process == *host)
            .map(|(process, _)| self.hosts.cores[process])
            .sum()
    }

    /// As many as the fullest host allows, so that no rank waits for a slower one.
    fn threads_per_worker(&self, _workers: usize) -> usize {
        let of_process = |process: usize| self.hosts.cores[process] / self.hosts.on_host_of(process);
        (0..self.hosts.hosts.len()).map(of_process).min().unwrap_or(1).max(1)
    }

    fn place(&self, index: usize, _workers: usize) -> (usize, usize) {
        let hosts = &self.hosts.hosts;
        let before = hosts[..index].iter().filter(|&&host| host == hosts[index]).count();
        (before, self.hosts.on_host_of(index))
    }

    fn prepare(&self, workers: usize) -> Result<(), MachineError> {
        let there = self.hosts.hosts.len();
        if workers == there {
            return Ok(());
        }
        Err(MachineError::TooSmall(format!(
            "{workers} workers, and {there} processes were started: every process is a worker, so leave out --workers \
             (and --sessions), or start {workers} processes"
        )))
    }

    /// Checks the host of process 0 for as many ranks as the fullest one has; the others say so when they connect.
    fn check_transfers(&self, ranks: usize, max_len: usize) -> Result<(), MachineError> {
        let hosts = &self.hosts.hosts;
        let most = (0..hosts.len()).map(|process| self.hosts.on_host_of(process)).max().unwrap_or(1).min(ranks);
        if self.inside == Inside::Mpi || most == 1 {
            return Ok(());
        }
        let (_, free) = shared_memory_space().map_err(|error| MachineError::Unreadable(error.to_string()))?;
        check_shared_memory(most, max_len, free).map_err(|error| MachineError::TooSmall(error.to_string()))
    }
}
