//! Connection of the workers of a crew to each other: shared memory inside a host, MPI between hosts.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;

use super::data::{MpiOptions, MpiTransport};
use super::hosted::{HostedTransport, Hosting};
use super::library::Library;
use super::pause::Pause;
use super::tags;
use crate::os::clock::AwakeClock;
use crate::transport::{
    Connect, Connection, IceoryxOptions, IceoryxTransport, RunMember, RunName, SoloTransport, Transport,
    TransportError, WaitHook, worker_role,
};

/// Connections of a crew that have tags of their own; crews follow each other in steps of this number.
const CONNECTIONS_OF_CREW: u32 = 16;

/// Way of the messages between ranks of one host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Inside {
    /// The shared memory of this program's processes on one machine.
    SharedMemory,
    /// MPI, as between hosts.
    Mpi,
}

/// Connects the workers of a crew.
pub(super) struct MpiConnect {
    library: Library,
    /// Number of the crew.
    crew: u32,
    /// Process of worker 0.
    first: usize,
    /// By process: lowest process of its host.
    hosts: Vec<usize>,
    inside: Inside,
    /// Once it is connected.
    of_host: Option<OfHost>,
}

impl Connect for MpiConnect {
    fn connect(&mut self, connection: Connection) -> Result<Box<dyn Transport>, TransportError> {
        let Connection { rank, ranks, epoch, max_len, deadline, on_wait, links } = connection;
        if links.is_some() {
            let message = "links are emulated on one machine only".into();
            return Err(TransportError::Mechanism { rank, message });
        }
        let hosts = &self.hosts[self.first..self.first + ranks];
        let hosting = Hosting::new(rank, hosts);
        let own_host = hosts[rank];
        let sharing = self.hosts.iter().filter(|&&host| host == own_host).count();
        let number = self.crew * CONNECTIONS_OF_CREW + epoch % CONNECTIONS_OF_CREW;
        let [across, inside] = tags::of_connection(number);
        let hook = Rc::new(RefCell::new(on_wait));
        let hooks = || -> WaitHook {
            let hook = hook.clone();
            Box::new(move || hook.borrow_mut()())
        };
        let library = self.library.clone();
        let group = |rank: usize, processes: Vec<usize>, tags: [i32; 2]| {
            let options = MpiOptions { rank, processes, tags, max_len, deadline, sharing, on_wait: hooks() };
            MpiTransport::connect(&library, options)
        };
        let locals = hosting.locals().to_vec();
        let place = locals.iter().position(|&local| local == rank).unwrap_or_default();
        let local_processes: Vec<usize> = locals.iter().map(|local| self.first + local).collect();
        let within: Box<dyn Transport> = match self.inside {
            _ if locals.len() == 1 => Box::new(SoloTransport::new(hooks())),
            Inside::Mpi => Box::new(group(place, local_processes, inside)?),
            Inside::SharedMemory => {
                let of_host = match self.of_host.take() {
                    Some(there) => there,
                    None => self.meet(rank, place, &local_processes, inside[0], &hook)?,
                };
                let run = &self.of_host.insert(of_host).run;
                let options =
                    IceoryxOptions { rank: place, ranks: locals.len(), epoch, max_len, deadline, on_wait: hooks() };
                Box::new(IceoryxTransport::connect(run, options)?)
            }
        };
        if hosting.count() == 1 {
            return Ok(within);
        }
        let processes = (self.first..self.first + ranks).collect();
        let outside = group(rank, processes, across)?;
        Ok(Box::new(HostedTransport::new(hosting, within, outside)))
    }
}

impl MpiConnect {
    /// Connects the workers of crew `crew`, the first of which is process `first`. `hosts`: by process of the world,
    /// the lowest process of its host.
    pub(super) fn new(library: &Library, crew: u32, first: usize, hosts: &[usize], inside: Inside) -> MpiConnect {
        MpiConnect { library: library.clone(), crew, first, hosts: hosts.to_vec(), inside, of_host: None }
    }

    /// The run in shared memory of the workers of this host: the first of them makes it, and tells the others its name.
    fn meet(
        &self,
        rank: usize,
        place: usize,
        processes: &[usize],
        tag: i32,
        hook: &Rc<RefCell<WaitHook>>,
    ) -> Result<OfHost, TransportError> {
        let fail = |message: String| TransportError::Mechanism { rank, message };
        if place == 0 {
            let (run, member) = RunName::create(&worker_role(rank)).map_err(|error| fail(error.to_string()))?;
            let name = Arc::new(run.to_string().into_bytes());
            let mut sending = Vec::new();
            for &process in &processes[1..] {
                sending.push(self.library.send(process, tag, &name).map_err(fail)?);
            }
            for sent in &mut sending {
                self.poll(rank, rank, hook, || sent.is_done())?;
            }
            return Ok(OfHost { run, member: Some(member) });
        }
        let mut arriving = None;
        let source = processes[0] - self.first;
        self.poll(rank, source, hook, || {
            if arriving.is_none() {
                arriving = self.library.take::<u8>(Some(processes[0]), tag)?.map(|(_, name)| name);
            }
            arriving.as_mut().map_or(Ok(false), |name| name.is_done())
        })?;
        let name = arriving.map(|name| name.into_buffer().0).unwrap_or_default();
        let run: RunName = String::from_utf8_lossy(&name).parse().map_err(|error| fail(format!("{error}")))?;
        let member = run.join(&worker_role(rank)).map_err(|error| fail(error.to_string()))?;
        Ok(OfHost { run, member: Some(member) })
    }

    fn poll(
        &self,
        rank: usize,
        source_rank: usize,
        hook: &Rc<RefCell<WaitHook>>,
        mut is_done: impl FnMut() -> Result<bool, String>,
    ) -> Result<(), TransportError> {
        let what = "the name of the run on this host";
        let (mut pause, mut clock, mut counted) = (Pause::default(), AwakeClock::start(), 0);
        while !is_done().map_err(|message| TransportError::Mechanism { rank, message })? {
            // The hook is cheap, and at most called every millisecond after the first fifty looks.
            counted += 1;
            if counted % 20 == 0 && hook.borrow_mut()() {
                return Err(TransportError::Aborted { rank, source_rank, what });
            }
            let waited = clock.elapsed();
            if waited.as_secs() >= 60 {
                return Err(TransportError::TimedOut { rank, source_rank, what, waited_s: waited.as_secs_f64() });
            }
            pause.rest();
        }
        Ok(())
    }
}

/// The run in shared memory of the workers of one host. The last of them to leave removes its files.
struct OfHost {
    run: RunName,
    member: Option<RunMember>,
}

impl Drop for OfHost {
    fn drop(&mut self) {
        self.member = None;
        if let Err(error) = self.run.purge_if_last() {
            tracing::warn!("cannot remove the run's files: {error}");
        }
    }
}
