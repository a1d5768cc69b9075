//! Processes of this machine: whether another process still runs, and the core of this one. The first also works for
//! processes that are not children, and counts zombies as ended. Linux only; it does not cover processes of other pid
//! namespaces.

use std::os::fd::OwnedFd;
use std::path::Path;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, PidfdFlags, pidfd_open};
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Watches one process by a descriptor, so that a reused process number is never mistaken for it.
#[derive(Debug)]
pub struct ProcessWatch {
    pid: u32,
    /// None if the system does not provide it (old kernels, some sandboxes); the start time then replaces it.
    descriptor: Option<OwnedFd>,
    start_ticks: Option<u64>,
}

impl ProcessWatch {
    /// Starts to watch process `pid`. A process that does not exist (any more) counts as ended.
    pub fn new(pid: u32) -> ProcessWatch {
        let number = i32::try_from(pid).ok().and_then(Pid::from_raw);
        let descriptor = number.and_then(|number| pidfd_open(number, PidfdFlags::empty()).ok());
        // Read after the descriptor was opened: if the process ended before, there is no start time.
        ProcessWatch { pid, descriptor, start_ticks: start_ticks(pid) }
    }

    /// Number of the watched process.
    pub fn pid(&self) -> u32 {
        self.pid
    }

    /// True while the process is stopped (SIGSTOP, Ctrl-Z).
    pub fn is_stopped(&self) -> bool {
        let line = std::fs::read_to_string(format!("/proc/{}/stat", self.pid)).unwrap_or_default();
        matches!(state_of(&line), Some(b'T' | b't'))
    }

    /// True once the process has ended, reaped or not. Never waits.
    pub fn has_ended(&self) -> bool {
        let Some(descriptor) = &self.descriptor else {
            return self.start_ticks.is_none() || start_ticks(self.pid) != self.start_ticks;
        };
        let mut polled = [PollFd::new(descriptor, PollFlags::IN)];
        // A failed poll says nothing about the process; the next call asks again.
        matches!(poll(&mut polled, Some(&Timespec { tv_sec: 0, tv_nsec: 0 })), Ok(ready) if ready > 0)
    }
}

/// Pins this thread to one core if `ranks` ranks of one thread each share fewer cores evenly. Otherwise ranks that wait
/// for each other in every iteration gather on a few cores. Ignores a refusal of the system.
pub fn share_cores(rank: usize, ranks: usize) {
    let Ok(allowed) = sched_getaffinity(None) else { return };
    let cores: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|&core| allowed.is_set(core)).collect();
    if let Some(core) = core_of(rank, ranks, &cores) {
        let mut one = CpuSet::new();
        one.set(core);
        let _ = sched_setaffinity(None, &one);
    }
}

/// The core of a rank, if ranks share cores evenly. Uneven shares are not pinned: with 3 ranks on 2 cores, several runs
/// at the same time would all crowd the same core.
fn core_of(rank: usize, ranks: usize, cores: &[usize]) -> Option<usize> {
    let shared = ranks > cores.len() && !cores.is_empty() && ranks.is_multiple_of(cores.len());
    shared.then(|| cores[rank % cores.len()])
}

/// Start of a process, in clock ticks since boot; together with the number it identifies a process permanently. `None`
/// if the process does not exist or is a zombie.
pub fn start_ticks(pid: u32) -> Option<u64> {
    parse_stat(&std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?)
}

/// Processor time that a process and its threads have used, in clock ticks. `None` as for [`start_ticks`].
pub(super) fn cpu_ticks(pid: u32) -> Option<u64> {
    ticks_of(Path::new(&format!("/proc/{pid}/stat")))
}

/// Whether a thread of a process computes, or waits for a core or for memory (states R and D). On a crowded machine such
/// a wait may be long, and it uses no processor time.
pub(super) fn is_busy(pid: u32) -> bool {
    let threads = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    threads.into_iter().any(|thread| thread_is_busy(&thread.path().join("stat")))
}

/// As [`cpu_ticks`], of the process or thread whose `stat` is at `path`.
pub(super) fn ticks_of(path: &Path) -> Option<u64> {
    parse_cpu(&std::fs::read_to_string(path).ok()?)
}

/// As [`is_busy`], of the thread whose `stat` is at `path`.
pub(super) fn thread_is_busy(path: &Path) -> bool {
    std::fs::read_to_string(path).is_ok_and(|line| matches!(state_of(&line), Some(b'R' | b'D')))
}

/// The state in a line of `/proc/PID/stat`.
fn state_of(line: &str) -> Option<u8> {
    line.rsplit_once(')')?.1.trim_start().bytes().next()
}

/// The sum of the times in user and kernel mode in a line of `/proc/PID/stat` (fields 14 and 15).
fn parse_cpu(line: &str) -> Option<u64> {
    let (_, fields) = line.rsplit_once(')')?;
    let mut times = fields.split_whitespace().skip(11);
    let user: u64 = times.next()?.parse().ok()?;
    Some(user + times.next()?.parse::<u64>().ok()?)
}

/// The start time in a line of `/proc/PID/stat`, unless the state is dead or zombie. The name (field 2) may hold spaces
/// and parentheses, so fields are counted from its last closing parenthesis.
fn parse_stat(line: &str) -> Option<u64> {
    let (_, fields) = line.rsplit_once(')')?;
    let mut fields = fields.split_whitespace();
    let state = fields.next()?;
    let start = fields.nth(18)?.parse().ok()?;
    (!matches!(state, "Z" | "X" | "x")).then_some(start)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_share_cores_only_in_equal_parts() {
        let cores = [2, 5];
        let of = |ranks: usize| (0..ranks).map(|rank| core_of(rank, ranks, &cores)).collect::<Vec<_>>();
        assert_eq!(of(4), [Some(2), Some(5), Some(2), Some(5)]);
        assert_eq!(of(3), [None; 3]);
        assert_eq!(of(2), [None; 2]);
        assert_eq!(core_of(0, 4, &[]), None);
    }

    #[test]
    fn stat_lines() {
        let rest = "1 2 3 0 -1 4194560 1 2 3 4 5 6 7 8 20 0 1 0 987654 100 200";
        assert_eq!(parse_stat(&format!("42 (a name) S {rest}")), Some(987654));
        assert_eq!(parse_stat(&format!("42 (odd) name)) R {rest}")), Some(987654));
        assert_eq!(parse_stat(&format!("42 (gone) Z {rest}")), None);
        assert_eq!(parse_cpu(&format!("42 (odd) name)) R {rest}")), Some(5 + 6));
        assert_eq!(parse_cpu("42 (cut) R 1 2"), None);
        assert_eq!(parse_stat("42 (cut"), None);
        assert_eq!(parse_stat(""), None);
    }

    #[test]
    fn own_process_runs_and_a_child_ends() {
        let without_descriptor = |pid: u32| ProcessWatch { descriptor: None, ..ProcessWatch::new(pid) };
        let own = std::process::id();
        assert!(!ProcessWatch::new(own).has_ended() && !without_descriptor(own).has_ended());
        assert!(start_ticks(own).is_some() && is_busy(own));
        assert!(ProcessWatch::new(0).has_ended() && ProcessWatch::new(u32::MAX).has_ended());

        let mut child = std::process::Command::new("sleep").arg("600").spawn().unwrap();
        let watches = [ProcessWatch::new(child.id()), without_descriptor(child.id())];
        assert!(watches.iter().all(|watch| !watch.has_ended() && !watch.is_stopped()));
        let number = Pid::from_child(&child);
        rustix::process::kill_process(number, rustix::process::Signal::STOP).unwrap();
        while !watches[0].is_stopped() {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        assert!(!watches[0].has_ended() && !is_busy(child.id()));
        child.kill().unwrap();
        // Not reaped yet: a zombie has ended too.
        while watches.iter().any(|watch| !watch.has_ended()) {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        assert_eq!(start_ticks(child.id()), None);
        child.wait().unwrap();
        assert!(watches.iter().all(ProcessWatch::has_ended) && ProcessWatch::new(child.id()).has_ended());
    }
}
