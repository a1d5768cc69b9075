//! Signs of life between the processes of a world. A thread of each process sends one every 100 ms, whatever the others
//! of the process do: the first process to all, all others to the first. A process that hears nothing for 5 s takes the
//! other one for lost: the first process says so to its crews, every other process ends itself. So no process outlives
//! a cut link, on either side.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use super::library::{Library, Sending};
use super::tags;
use crate::os::clock::AwakeClock;
use crate::os::console::complain;
use crate::transport::Heartbeat;
use crate::transport::process::{thread_is_busy, ticks_of};

/// Pause between two signs of life.
const BEAT: Duration = Duration::from_millis(100);
/// Silence after which a process counts as lost.
pub(super) const LOST_AFTER: Duration = Duration::from_secs(5);

/// What a process says of its worker in a sign of life: crew, counter, step and work.
const WORDS: usize = 4;
/// In place of the crew, in a sign of life of the first process: it gives up, and all others are to end at once. Not
/// every launcher ends them.
const GIVEN_UP: u64 = u64::MAX;

/// The signs of life of this process and of those that it listens to.
pub(super) struct Vitals {
    /// Number of the crew of this process's worker, and the worker's signs of life.
    crew: AtomicU32,
    counter: AtomicU64,
    step: AtomicU64,
    /// By process; of the first process only, anywhere else.
    others: Mutex<Vec<Other>>,
    is_over: AtomicBool,
    has_given_up: AtomicBool,
}

#[derive(Clone, Debug)]
struct Other {
    heard: AwakeClock,
    is_lost: bool,
    words: [u64; WORDS],
}

impl Vitals {
    pub(super) fn new(ranks: usize) -> Arc<Vitals> {
        let other = Other { heard: AwakeClock::start(), is_lost: false, words: [0; WORDS] };
        Arc::new(Vitals {
            crew: AtomicU32::new(0),
            counter: AtomicU64::new(0),
            step: AtomicU64::new(0),
            others: Mutex::new(vec![other; ranks]),
            is_over: AtomicBool::new(false),
            has_given_up: AtomicBool::new(false),
        })
    }

    /// The worker of this process begins in a crew.
    pub(super) fn begin(&self, crew: u32) {
        self.counter.store(0, Ordering::Relaxed);
        self.step.store(0, Ordering::Relaxed);
        self.crew.store(crew, Ordering::Relaxed);
    }

    /// A sign of life of the worker of this process.
    pub(super) fn beat(&self) {
        self.counter.fetch_add(1, Ordering::Relaxed);
    }

    /// The step of the worker of this process.
    pub(super) fn set_step(&self, step: u64) {
        self.step.store(step, Ordering::Relaxed);
        self.beat();
    }

    /// The newest sign of life of the worker of a process in a crew.
    pub(super) fn heartbeat(&self, process: usize, crew: u32) -> Heartbeat {
        match self.others().get(process).map(|other| other.words) {
            Some([of, counter, step, _]) if of == u64::from(crew) => Heartbeat { counter, step },
            _ => Heartbeat::default(),
        }
    }

    /// A number that grows while the worker of a process computes.
    pub(super) fn work(&self, process: usize) -> Option<u64> {
        self.others().get(process).map(|other| other.words[3])
    }

    /// Whether a process has not been heard for too long.
    pub(super) fn is_lost(&self, process: usize) -> bool {
        self.others().get(process).is_some_and(|other| other.is_lost)
    }

    /// Tells the other processes to end at once, as far as they can be reached. For the first process, while its pulse
    /// lasts.
    pub(super) fn give_up(&self) {
        self.has_given_up.store(true, Ordering::Relaxed);
        std::thread::sleep(3 * BEAT);
    }

    fn others(&self) -> MutexGuard<'_, Vec<Other>> {
        self.others.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The thread that gives signs of life and listens to those of others.
pub(super) struct Pulse {
    vitals: Arc<Vitals>,
    thread: Option<JoinHandle<()>>,
}

impl Pulse {
    /// Starts the thread. `first`: what the first process is called.
    pub(super) fn start(library: &Library, vitals: &Arc<Vitals>, first: String) -> std::io::Result<Pulse> {
        let main_thread = own_thread();
        let (library, shared) = (library.clone(), vitals.clone());
        let thread = std::thread::Builder::new().name("signs of life".into()).spawn(move || {
            let mut excluded = vec![own_thread()];
            // The thread of the coordinator looks for messages all the time, which is no work of its worker.
            if library.rank() == 0 {
                excluded.push(main_thread);
            }
            let mut beats = Beats { library, vitals: shared, excluded, busy: 0, under_way: Vec::new() };
            while !beats.vitals.is_over.load(Ordering::Relaxed) {
                let news = beats.exchange();
                if matches!(news, News::GivenUp) {
                    // The first process has said why.
                    std::process::exit(1);
                }
                if matches!(news, News::Lost) && beats.library.rank() > 0 {
                    let (own, s) = (beats.library.rank(), LOST_AFTER.as_secs());
                    complain(format_args!("error: rank {own}: nothing heard from {first} for {s} s; this rank ends"));
                    // Neither the end of MPI nor its abort returns where the other side cannot be reached.
                    std::process::exit(1);
                }
                std::thread::sleep(BEAT);
            }
        })?;
        Ok(Pulse { vitals: vitals.clone(), thread: Some(thread) })
    }
}

impl Drop for Pulse {
    fn drop(&mut self) {
        self.vitals.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic has been printed.
            let _ = thread.join();
        }
    }
}

/// What the signs of life say.
enum News {
    Fine,
    /// A process that this one listens to has been silent for too long.
    Lost,
    GivenUp,
}

struct Beats {
    library: Library,
    vitals: Arc<Vitals>,
    /// Threads whose work does not count.
    excluded: Vec<u32>,
    busy: u64,
    /// Sent signs of life that are not complete, with their readers.
    under_way: Vec<(usize, Sending<u64>)>,
}

impl Beats {
    /// Sends a sign of life and takes those that are here.
    fn exchange(&mut self) -> News {
        let (work, busy) = self.work();
        self.busy += u64::from(busy);
        let Vitals { crew, counter, step, has_given_up, .. } = &*self.vitals;
        let crew = if has_given_up.load(Ordering::Relaxed) { GIVEN_UP } else { crew.load(Ordering::Relaxed).into() };
        let words = [crew, counter.load(Ordering::Relaxed), step.load(Ordering::Relaxed), work + self.busy];
        let (own, ranks) = (self.library.rank(), self.library.ranks());
        let readers = if own == 0 { 1..ranks } else { 0..1 };
        // A test that fails says that the reader is gone, which its silence will say, too.
        self.under_way.retain_mut(|(_, request)| matches!(request.is_done(), Ok(false)));
        let sign = Arc::new(words.to_vec());
        for reader in readers.clone() {
            if self.under_way.iter().any(|(to, _)| *to == reader) {
                continue;
            }
            if let Ok(request) = self.library.send(reader, tags::ALIVE, &sign) {
                self.under_way.push((reader, request));
            }
        }
        let mut heard = vec![(own, words)];
        while let Ok(Some((source, mut request))) = self.library.take::<u64>(None, tags::ALIVE) {
            // It is as short as a message can be, so it is here.
            while let Ok(false) = request.is_done() {
                std::thread::yield_now();
            }
            if let Ok(words) = request.into_buffer().0.try_into() {
                heard.push((source, words));
            }
        }
        if own > 0 && heard.iter().any(|(_, words)| words[0] == GIVEN_UP) {
            return News::GivenUp;
        }
        let mut others = self.vitals.others();
        for (source, words) in heard {
            if let Some(other) = others.get_mut(source) {
                (other.heard, other.words) = (AwakeClock::start(), words);
            }
        }
        for other in readers.clone() {
            let other = &mut others[other];
            other.is_lost |= other.heard.elapsed() > LOST_AFTER;
        }
        if readers.into_iter().any(|other| others[other].is_lost) { News::Lost } else { News::Fine }
    }

    /// Processor time of the threads that work, in clock ticks, and whether one of them is busy now.
    fn work(&self) -> (u64, bool) {
        let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
        let numbered = threads.filter_map(|thread| thread.file_name().to_str()?.parse::<u32>().ok());
        let counted = numbered.filter(|thread| !self.excluded.contains(thread));
        counted.fold((0, false), |(ticks, busy), thread| {
            let path = PathBuf::from(format!("/proc/self/task/{thread}/stat"));
            (ticks + ticks_of(&path).unwrap_or(0), busy || thread_is_busy(&path))
        })
    }
}

/// Number of the calling thread.
fn own_thread() -> u32 {
    rustix::thread::gettid().as_raw_nonzero().get() as u32
}
