//! The clock of the laboratory: a discrete-event simulation of transfers over shared links and of kernels on devices, in
//! virtual time. Same program, same times: nothing here measures, and nothing depends on threads or hash maps.
//!
//! A transfer waits for what it depends on, occupies every link of its path until its bytes are through ("released"; links
//! are shared max-min fairly, `network.rs`), and has arrived one latency of the path later ("done"). A latency therefore
//! delays the tasks that wait for the bytes, but does not keep a link busy: the next transfer of a queue follows at
//! once. The caller states how long a kernel lasts. Dependencies alone state which kernels and transfers exclude one
//! another.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::network::{Channels, Network};
use super::topology::Topology;

/// The work of a task.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Work {
    /// Bytes from one GPU's memory to another's.
    Transfer {
        /// GPU that sends.
        from: usize,
        /// GPU that receives.
        to: usize,
        /// Size of the transfer, bytes.
        bytes: f64,
    },
    /// Time that passes on a device or on the wire: a kernel, an all-reduce, or nothing at all (0).
    Seconds(f64),
}

/// The point in the run of a task that another task waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Milestone {
    /// The task's links are free again.
    Released,
    /// The task's result has arrived.
    Done,
}

/// Times of a task, seconds of virtual time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TaskTimes {
    /// Start of the work.
    pub start_s: f64,
    /// When its links were free again.
    pub released_s: f64,
    /// When its result had arrived.
    pub done_s: f64,
}

impl TaskTimes {
    /// Times of a task that did not run.
    pub const NEVER: TaskTimes = TaskTimes { start_s: f64::INFINITY, released_s: f64::INFINITY, done_s: f64::INFINITY };
}

/// Tasks in the order in which they were added, and who waits for whom.
#[derive(Clone, Debug, Default)]
pub struct Program {
    work: Vec<Work>,
    /// (task that is waited for, what of it, task that waits).
    edges: Vec<(u32, Milestone, u32)>,
}

/// Tasks that wait for each other in a circle never run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{stuck} of {tasks} tasks wait for each other in a circle")]
pub struct Circle {
    /// Tasks that never ran.
    pub stuck: usize,
    /// Tasks of the program.
    pub tasks: usize,
}

impl Program {
    /// Adds a task that starts at time 0, unless it is made to wait; returns its number.
    pub fn add(&mut self, work: Work) -> usize {
        self.work.push(work);
        self.work.len() - 1
    }

    /// Makes `task` wait for `moment` of `other`; both exist already.
    pub fn after(&mut self, task: usize, other: usize, moment: Milestone) {
        self.edges.push((other as u32, moment, task as u32));
    }

    /// Adds a task that waits until all of `others` are done.
    pub fn add_after(&mut self, work: Work, others: &[usize]) -> usize {
        let task = self.add(work);
        others.iter().for_each(|&other| self.after(task, other, Milestone::Done));
        task
    }

    /// Number of tasks in the program.
    pub fn len(&self) -> usize {
        self.work.len()
    }

    /// True if the program has no tasks.
    pub fn is_empty(&self) -> bool {
        self.work.is_empty()
    }

    /// The work of task number `task`.
    pub fn work(&self, task: usize) -> Work {
        self.work[task]
    }

    /// Runs all tasks on the links of `topology`; one span per task.
    ///
    /// # Panics
    /// If a transfer names a GPU that the topology does not have.
    pub fn run(&self, topology: &Topology) -> Result<Vec<TaskTimes>, Circle> {
        self.run_on(&Channels::of(topology))
    }

    pub(super) fn run_on(&self, channels: &Channels) -> Result<Vec<TaskTimes>, Circle> {
        Run::new(self, channels).finish()
    }
}

/// A moment in virtual time, ordered; ties go to the task that was added first.
#[derive(Clone, Copy, PartialEq)]
struct Completion(f64, u32);

impl Eq for Completion {}

impl PartialOrd for Completion {
    fn partial_cmp(&self, other: &Completion) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Completion {
    fn cmp(&self, other: &Completion) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0).then(self.1.cmp(&other.1))
    }
}

struct Run<'a> {
    work: &'a [Work],
    channels: &'a Channels,
    network: Network<'a>,
    /// Those that wait for task i: `waiting[starts[i]..starts[i + 1]]`.
    starts: Vec<u32>,
    waiting: Vec<(Milestone, u32)>,
    /// Moments that a task still waits for.
    missing: Vec<u32>,
    spans: Vec<TaskTimes>,
    done: BinaryHeap<Reverse<Completion>>,
    finished: usize,
    ready: Vec<u32>,
}

impl<'a> Run<'a> {
    fn new(program: &'a Program, channels: &'a Channels) -> Run<'a> {
        let tasks = program.work.len();
        let (mut starts, mut missing) = (vec![0u32; tasks + 1], vec![0u32; tasks]);
        for (other, _, task) in &program.edges {
            starts[*other as usize + 1] += 1;
            missing[*task as usize] += 1;
        }
        for i in 0..tasks {
            starts[i + 1] += starts[i];
        }
        let mut next = starts.clone();
        let mut waiting = vec![(Milestone::Done, 0); program.edges.len()];
        for (other, moment, task) in &program.edges {
            let slot = &mut next[*other as usize];
            waiting[*slot as usize] = (*moment, *task);
            *slot += 1;
        }
        Run {
            work: &program.work,
            channels,
            network: Network::new(channels),
            starts,
            waiting,
            missing,
            spans: vec![TaskTimes::NEVER; tasks],
            done: BinaryHeap::new(),
            finished: 0,
            ready: Vec::new(),
        }
    }

    fn finish(mut self) -> Result<Vec<TaskTimes>, Circle> {
        let tasks = self.work.len();
        self.ready = (0..tasks as u32).filter(|task| self.missing[*task as usize] == 0).collect();
        let (mut now_s, mut ended) = (0.0, Vec::new());
        loop {
            self.start_ready(now_s);
            let next_done_s = self.done.peek().map_or(f64::INFINITY, |event| event.0.0);
            let next_s = self.network.next_end_s(now_s).min(next_done_s);
            if next_s == f64::INFINITY {
                break;
            }
            now_s = next_s.max(now_s);
            self.network.ended(now_s, &mut ended);
            for &task in &ended {
                self.release(task, now_s);
            }
            while let Some(&Reverse(Completion(done_s, task))) = self.done.peek() {
                if done_s > now_s {
                    break;
                }
                self.done.pop();
                self.complete(task as usize);
            }
        }
        if self.finished < tasks {
            return Err(Circle { stuck: tasks - self.finished, tasks });
        }
        Ok(self.spans)
    }

    /// Starts what waits for nothing any more, in the order of the program.
    fn start_ready(&mut self, now_s: f64) {
        self.ready.sort_unstable();
        for task in std::mem::take(&mut self.ready) {
            let index = task as usize;
            self.spans[index].start_s = now_s;
            match self.work[index] {
                Work::Transfer { from, to, bytes } => self.network.start(index, from, to, bytes, now_s),
                Work::Seconds(seconds) => {
                    self.spans[index].released_s = now_s + seconds;
                    self.spans[index].done_s = now_s + seconds;
                    self.done.push(Reverse(Completion(now_s + seconds, task)));
                }
            }
        }
    }

    fn release(&mut self, task: usize, now_s: f64) {
        let Work::Transfer { from, to, .. } = self.work[task] else { return };
        let done_s = now_s + self.channels.latency_s(from, to);
        (self.spans[task].released_s, self.spans[task].done_s) = (now_s, done_s);
        self.done.push(Reverse(Completion(done_s, task as u32)));
        self.tell(task, Milestone::Released);
    }

    fn complete(&mut self, task: usize) {
        self.finished += 1;
        if matches!(self.work[task], Work::Seconds(_)) {
            self.tell(task, Milestone::Released);
        }
        self.tell(task, Milestone::Done);
    }

    fn tell(&mut self, task: usize, moment: Milestone) {
        for i in self.starts[task] as usize..self.starts[task + 1] as usize {
            let (wanted, waiter) = self.waiting[i];
            if wanted == moment {
                let missing = &mut self.missing[waiter as usize];
                *missing -= 1;
                if *missing == 0 {
                    self.ready.push(waiter);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::interconnect::Duplex;

    #[test]
    fn a_latency_delays_the_arrival_and_not_the_next_transfer() {
        let pair = Topology::balanced_tree(2, 1.0, 1e6, Duplex::Full).unwrap();
        let mut program = Program::default();
        let first = program.add(Work::Transfer { from: 0, to: 1, bytes: 3e9 });
        let second = program.add(Work::Transfer { from: 0, to: 1, bytes: 1e9 });
        program.after(second, first, Milestone::Released);
        let kernel = program.add_after(Work::Seconds(0.5), &[second]);
        let spans = program.run(&pair).unwrap();
        // Two links of one second each.
        assert_eq!(spans[first], TaskTimes { start_s: 0.0, released_s: 3.0, done_s: 5.0 });
        assert_eq!(spans[second], TaskTimes { start_s: 3.0, released_s: 4.0, done_s: 6.0 });
        assert_eq!(spans[kernel], TaskTimes { start_s: 6.0, released_s: 6.5, done_s: 6.5 });
    }

    #[test]
    fn a_circle_is_reported() {
        let mut program = Program::default();
        let (a, b) = (program.add(Work::Seconds(1.0)), program.add(Work::Seconds(1.0)));
        program.add(Work::Seconds(1.0));
        program.after(a, b, Milestone::Done);
        program.after(b, a, Milestone::Done);
        let alone = Topology::default_for(1).unwrap();
        assert_eq!(program.run(&alone), Err(Circle { stuck: 2, tasks: 3 }));
    }
}
