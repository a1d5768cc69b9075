//! Ranks on several machines: the processes that `mpirun` or `srun` has started. Process 0 holds the coordinator and
//! worker 0, every other process one worker. Only this module knows MPI.
//!
//! Processes wait for a crew, are its worker until they are dismissed, and wait for the next one until they leave.
//! MPI never waits: all waits are polls, so that heartbeats, deadlines and stops work as they do on one machine.

mod connect;
mod control;
mod data;
mod hosted;
mod library;
mod links;
mod machine;
mod pause;
mod stream;
mod tags;
mod vitals;

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

pub use connect::Inside;
use connect::MpiConnect;
use control::{Crew, MpiCoordinator, MpiLauncher, MpiWorker, Seat};
use library::{Library, Universe};
use machine::{ClusterMachine, Hosts};
use pause::Pause;
use stream::{Incoming, Kind, Outgoing};
use vitals::{Pulse, Vitals};

use super::{
    Connect, ControlCoordinator, ControlError, ControlWorker, Launcher, Machine, World, WorldCrew, remove_dead_runs,
};
use crate::os::clock::AwakeClock;

/// What a process does as worker `rank` of a crew until it is dismissed.
pub type Serve = fn(usize, Box<dyn ControlWorker>, Box<dyn Connect>);

/// The world of this process.
pub struct MpiWorld {
    library: Library,
    vitals: Arc<Vitals>,
    hosts: Arc<Hosts>,
    /// Number of the next crew.
    crews: AtomicU32,
    must_abort: Arc<AtomicBool>,
    inside: Inside,
}

impl fmt::Debug for MpiWorld {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "process {} of {}", self.library.rank(), self.library.ranks())
    }
}

/// This process among those of a world, between the initialization of MPI and its end.
pub struct Membership {
    world: Arc<MpiWorld>,
    /// Dropped before MPI ends.
    pulse: Option<Pulse>,
    own_worker: Option<JoinHandle<()>>,
    /// Process 0 has told this one to leave.
    is_dismissed: bool,
    /// Dropped last.
    _universe: Universe,
}

impl Membership {
    /// Joins the world of this process; messages inside a host go the way `inside`. Every process of the world calls
    /// it once, from its main thread; it waits for all of them. A panic in any thread of a process ends all processes
    /// from now on.
    ///
    /// # Errors
    /// A sentence about MPI, or about a world that has another number of processes than `expected`.
    pub fn join(expected: Option<usize>, inside: Inside) -> Result<Membership, String> {
        let (library, universe) = Library::start()?;
        if let Some(expected) = expected.filter(|&expected| expected != library.ranks()) {
            return Err(singletons(library.ranks(), expected));
        }
        let hosts = Arc::new(Hosts::census(&library)?);
        if hosts.hosts[library.rank()] == library.rank() {
            remove_dead_runs();
        }
        let vitals = Vitals::new(library.ranks());
        let pulse = Pulse::start(&library, &vitals, hosts.names[0].clone()).map_err(|error| error.to_string())?;
        abort_on_panic(&library);
        let (crews, must_abort) = (AtomicU32::new(1), Arc::default());
        let world = Arc::new(MpiWorld { library, vitals, hosts, crews, must_abort, inside });
        Ok(Membership { world, pulse: Some(pulse), own_worker: None, is_dismissed: false, _universe: universe })
    }

    /// Whether this is process 0, which holds the coordinator.
    pub fn is_first(&self) -> bool {
        self.world.library.rank() == 0
    }

    /// Makes this process a worker of every crew that asks for it, until process 0 leaves. In process 0 it returns at
    /// once, and a thread does so.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn serve(&mut self, serve: Serve) -> Result<(), String> {
        if !self.is_first() {
            self.is_dismissed = self.world.obey(Some(serve));
            return Ok(());
        }
        let world = self.world.clone();
        let thread = std::thread::Builder::new().name("worker 0".into()).spawn(move || _ = world.obey(Some(serve)));
        self.own_worker = Some(thread.map_err(|error| error.to_string())?);
        Ok(())
    }

    /// Connects the first processes of the world as the ranks of a group without a coordinator, as if they were on
    /// `hosts` (by process: the lowest process of its host). `crew`: a number that the group has for itself, the same
    /// on all its processes.
    pub fn group(&self, crew: u32, hosts: &[usize]) -> Box<dyn Connect> {
        Box::new(MpiConnect::new(&self.world.library, crew, 0, hosts, self.world.inside))
    }

    /// Own number and number of processes.
    pub fn rank(&self) -> (usize, usize) {
        (self.world.library.rank(), self.world.library.ranks())
    }

    /// The world, for the coordinator.
    pub fn world(&self) -> Arc<dyn World> {
        self.world.clone()
    }

    /// Ends the world: process 0 dismisses the others, and MPI ends everywhere once all have answered. Ends all
    /// processes at once with `exit_code` if one of them cannot be reached or does not listen.
    ///
    /// The end of MPI itself does not wait: started by `srun`, a process is gone while others still send to it, and
    /// those then try to connect to it for ever.
    pub fn leave(mut self, exit_code: u8) {
        if self.is_first() {
            self.dismiss(exit_code);
        } else if self.is_dismissed || self.world.obey(None) {
            self.pulse = None;
            complete(&mut [word(&self.world.library, 0, tags::GONE)]);
        }
        self.pulse = None;
    }

    /// Tells all processes to leave, and waits until they have.
    fn dismiss(&mut self, exit_code: u8) {
        let world = self.world.clone();
        let MpiWorld { library, vitals, must_abort, .. } = &*world;
        let abort = || library.abort(i32::from(exit_code).max(1));
        let others = 1..library.ranks();
        if others.clone().any(|process| vitals.is_lost(process)) || must_abort.load(Ordering::Relaxed) {
            vitals.give_up();
            abort();
        }
        // Nothing is sent to a process that may be gone.
        self.pulse = None;
        let mut words: Vec<Outgoing> =
            (0..library.ranks()).map(|process| word(library, process, tags::LEAVE)).collect();
        complete(&mut words);
        if let Some(thread) = self.own_worker.take() {
            // A panic has ended all processes.
            let _ = thread.join();
        }
        let mut answers: Vec<Incoming> =
            others.map(|process| Incoming::of_any_crew(library, process, tags::GONE)).collect();
        let (mut asked, mut pause) = (AwakeClock::start(), Pause::default());
        while !answers.is_empty() {
            answers.retain_mut(|answer| matches!(answer.next(), Ok(None)));
            if asked.elapsed() > vitals::LOST_AFTER {
                abort();
            }
            pause.rest();
        }
    }
}

/// A message to process `to` that is nothing but its tag.
fn word(library: &Library, to: usize, tag: i32) -> Outgoing {
    let mut word = Outgoing::new(library, to, tag, 0);
    word.push(Kind::Message, &[]);
    word
}

/// Waits until MPI is done with all messages, or refuses them.
fn complete(messages: &mut [Outgoing]) {
    let mut pause = Pause::default();
    while !messages.iter_mut().all(|message| message.pump().is_err() || message.is_complete()) {
        pause.rest();
    }
}

impl MpiWorld {
    /// Serves crews until the order to leave, if it can serve. Returns whether the order came.
    fn obey(&self, serve: Option<Serve>) -> bool {
        let mut begin = Incoming::of_any_crew(&self.library, 0, tags::BEGIN);
        let mut leave = Incoming::of_any_crew(&self.library, 0, tags::LEAVE);
        let mut pause = Pause::default();
        loop {
            match begin.next() {
                Ok(Some((_, bytes))) => {
                    let words: Vec<u64> = bytes.chunks_exact(8).map(bytemuck::pod_read_unaligned).collect();
                    let [crew, rank, _, first] = words[..] else { continue };
                    let coordinator = self.hosts.names[0].clone();
                    let control = MpiWorker::new(&self.library, &self.vitals, crew as u32, coordinator);
                    let (crew, first, hosts) = (crew as u32, first as usize, &self.hosts.hosts);
                    let connect = MpiConnect::new(&self.library, crew, first, hosts, self.inside);
                    if let Some(serve) = serve {
                        serve(rank as usize, Box::new(control), Box::new(connect));
                    }
                    pause = Pause::default();
                }
                // An error of MPI is that of every other call, too; the others notice that this process ends.
                Err(_) => return false,
                Ok(None) => pause.rest(),
            }
            match leave.next() {
                Ok(None) => {}
                order => return order.is_ok(),
            }
        }
    }
}

impl World for MpiWorld {
    fn ranks(&self) -> usize {
        self.library.ranks()
    }

    fn machine(&self) -> Box<dyn Machine> {
        Box::new(ClusterMachine { hosts: self.hosts.clone(), inside: self.inside })
    }

    fn crew(&self, first: usize, ranks: usize) -> Result<WorldCrew, ControlError> {
        if first + ranks > self.library.ranks() {
            let (there, all) = (self.library.ranks(), first + ranks);
            return Err(format!("{all} workers, and {there} processes were started").into());
        }
        let number = self.crews.fetch_add(1, Ordering::Relaxed);
        let members = (0..ranks).map(|_| Seat::default()).collect();
        let crew = Arc::new(Crew { number, first, members });
        let control: Box<dyn ControlCoordinator> = Box::new(MpiCoordinator::new(&self.library, &self.vitals, &crew));
        let launcher: Box<dyn Launcher> = Box::new(MpiLauncher {
            library: self.library.clone(),
            vitals: self.vitals.clone(),
            crew,
            names: self.hosts.names.clone(),
            must_abort: self.must_abort.clone(),
            sent: Mutex::default(),
        });
        Ok((control, launcher))
    }
}

/// What happened if a launcher that was to start `expected` processes of one world has started worlds of `there`.
fn singletons(there: usize, expected: usize) -> String {
    format!(
        "the launcher was to start {expected} processes, and this one sees {there}: the launcher and the MPI library \
         of this program do not fit each other; under Slurm try srun --mpi=pmix (srun --mpi=list shows what there is), \
         else the mpirun of the library that this program was built with"
    )
}

/// From now on a panic, once printed, ends all processes: the others would wait for this one.
fn abort_on_panic(library: &Library) {
    let print = std::panic::take_hook();
    let library = library.clone();
    std::panic::set_hook(Box::new(move |panic| {
        print(panic);
        library.abort(101);
    }));
}
