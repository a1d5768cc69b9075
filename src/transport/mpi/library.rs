//! The calls of MPI that this program makes: messages of bytes between processes, never waiting. Everything unsafe of
//! the module is here.
//!
//! One thread at a time is within MPI (`MPI_THREAD_SERIALIZED`, behind a lock): the coordinator, worker 0 and the
//! thread that gives signs of life share the first process. No call blocks, so nobody holds the lock for long. Errors
//! of MPI are returned, not fatal.

use std::mem::MaybeUninit;
use std::os::raw::{c_int, c_void};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytemuck::Pod;
use mpi::ffi;
use mpi::raw::AsRaw;
use mpi::traits::Communicator;
use mpi::{Threading, environment};

/// Most bytes of a message: MPI counts in 32 bits.
const BYTES_MAX: usize = c_int::MAX as usize;

/// MPI as this process is initialized. Clones are the same.
#[derive(Clone)]
pub(super) struct Library {
    shared: Arc<Shared>,
}

struct Shared {
    /// All processes.
    world: Handle,
    rank: usize,
    ranks: usize,
    inside: Mutex<()>,
}

/// A communicator. MPI frees it at its end.
#[derive(Clone, Copy)]
struct Handle(ffi::MPI_Comm);

// SAFETY: a handle is a number or an address that only MPI interprets, and every call that takes it holds the lock.
unsafe impl Send for Handle {}
// SAFETY: as above.
unsafe impl Sync for Handle {}

/// MPI between its initialization and its end. `main` holds it, and dropping it waits for the other processes.
pub(super) struct Universe {
    _universe: environment::Universe,
}

/// What every process says of itself at the start.
pub(super) struct Census {
    /// By rank: lowest rank of the processes that share memory with it.
    pub hosts: Vec<usize>,
    /// By rank: what it said.
    pub words: Vec<Vec<u8>>,
}

impl Library {
    /// Initializes MPI. Called once, by the main thread, before any other thread calls it.
    ///
    /// # Errors
    /// A sentence.
    pub(super) fn start() -> Result<(Library, Universe), String> {
        let started = environment::initialize_with_threading(Threading::Serialized);
        let (universe, given) = started.ok_or("MPI is initialized already")?;
        if given < Threading::Serialized {
            return Err(format!("this MPI lets only one thread call it ({given:?}); it needs MPI_THREAD_SERIALIZED"));
        }
        let communicator = universe.world();
        let world = Handle(communicator.as_raw());
        // SAFETY: MPI is initialized, and the handles are those of MPI.
        let code = unsafe { ffi::MPI_Comm_set_errhandler(world.0, ffi::RSMPI_ERRORS_RETURN) };
        checked(code, "MPI_Comm_set_errhandler")?;
        let (rank, ranks) = (communicator.rank() as usize, communicator.size() as usize);
        let shared = Shared { world, rank, ranks, inside: Mutex::new(()) };
        Ok((Library { shared: Arc::new(shared) }, Universe { _universe: universe }))
    }

    /// Number of this process.
    pub(super) fn rank(&self) -> usize {
        self.shared.rank
    }

    /// Number of processes.
    pub(super) fn ranks(&self) -> usize {
        self.shared.ranks
    }

    /// Tells every process `own`, which has the same length everywhere, and finds out who shares memory. Waits for all
    /// processes; called once, at the start.
    pub(super) fn census(&self, own: &[u8]) -> Result<Census, String> {
        let ranks = self.ranks();
        let _inside = self.enter();
        let mut words = vec![0_u8; own.len() * ranks];
        let mut lowest = c_int::MAX;
        let mut hosts = vec![0 as c_int; ranks];
        let own_rank = self.rank() as c_int;
        // SAFETY: the buffers have the lengths that the calls name, and outlive them.
        unsafe {
            let (world, byte, int) = (self.shared.world.0, ffi::RSMPI_UINT8_T, ffi::RSMPI_INT32_T);
            let mut host = ffi::RSMPI_COMM_NULL;
            let kind = ffi::RSMPI_COMM_TYPE_SHARED;
            checked(split_shared(world, kind, own_rank, &mut host), "MPI_Comm_split_type")?;
            let (from, to) = ((&raw const own_rank).cast::<c_void>(), (&raw mut lowest).cast::<c_void>());
            checked(ffi::MPI_Allreduce(from, to, 1, int, ffi::RSMPI_MIN, host), "MPI_Allreduce")?;
            checked(ffi::MPI_Comm_free(&mut host), "MPI_Comm_free")?;
            let (from, to) = ((&raw const lowest).cast::<c_void>(), hosts.as_mut_ptr().cast::<c_void>());
            checked(ffi::MPI_Allgather(from, 1, int, to, 1, int, world), "MPI_Allgather")?;
            let count = own.len() as c_int;
            let (from, to) = (own.as_ptr().cast::<c_void>(), words.as_mut_ptr().cast::<c_void>());
            checked(ffi::MPI_Allgather(from, count, byte, to, count, byte, world), "MPI_Allgather")?;
        }
        let words = words.chunks(own.len().max(1)).map(<[u8]>::to_vec).collect();
        Ok(Census { hosts: hosts.into_iter().map(|host| host as usize).collect(), words })
    }

    /// Begins to send `values` to process `to`. Messages of one tag arrive in the order in which they were sent.
    pub(super) fn send<T: Pod>(&self, to: usize, tag: i32, values: &Arc<Vec<T>>) -> Result<Sending<T>, String> {
        let count = count_of(size_of_val(&values[..]))?;
        let mut handle = self.no_request();
        let inside = self.enter();
        // SAFETY: the request holds `values`, so that they live as long as it, and nobody can write to them.
        let code = unsafe {
            let (from, byte) = (values.as_ptr().cast::<c_void>(), ffi::RSMPI_UINT8_T);
            ffi::MPI_Isend(from, count, byte, to as c_int, tag, self.shared.world.0, &mut handle)
        };
        drop(inside);
        checked(code, "MPI_Isend")?;
        Ok(Request { library: self.clone(), handle: Waiting(handle), buffer: Some(values.clone()), done: None })
    }

    /// Takes the next message of process `from` (none: of any) with this tag, if one is here, and begins to receive it.
    /// Returns its source, too.
    pub(super) fn take<T: Pod>(&self, from: Option<usize>, tag: i32) -> Result<Option<(usize, Receiving<T>)>, String> {
        let mut status = MaybeUninit::<ffi::MPI_Status>::zeroed();
        let mut found: c_int = 0;
        let mut handle = self.no_request();
        let inside = self.enter();
        // SAFETY: MPI writes the status and the message before they are read. The buffer has the length that MPI has
        // found, and outlives the request, which owns it.
        unsafe {
            let world = self.shared.world.0;
            let source = from.map_or(ffi::RSMPI_ANY_SOURCE, |from| from as c_int);
            let mut message = ffi::RSMPI_MESSAGE_NULL;
            let code = ffi::MPI_Improbe(source, tag, world, &mut found, &mut message, status.as_mut_ptr());
            checked(code, "MPI_Improbe")?;
            if found == 0 {
                return Ok(None);
            }
            let status = status.assume_init();
            let mut count: c_int = 0;
            checked(ffi::MPI_Get_count(&status, ffi::RSMPI_UINT8_T, &mut count), "MPI_Get_count")?;
            let mut values = vec![T::zeroed(); (count as usize).div_ceil(size_of::<T>())];
            let to = values.as_mut_ptr().cast::<c_void>();
            let code = ffi::MPI_Imrecv(to, count, ffi::RSMPI_UINT8_T, &mut message, &mut handle);
            checked(code, "MPI_Imrecv")?;
            drop(inside);
            let source = status.MPI_SOURCE as usize;
            let request = Request { library: self.clone(), handle: Waiting(handle), buffer: Some(values), done: None };
            Ok(Some((source, request)))
        }
    }

    /// Begins to receive the next message of process `from` with this tag into `buffer`, which must be long enough.
    pub(super) fn receive<T: Pod>(&self, from: usize, tag: i32, mut buffer: Vec<T>) -> Result<Receiving<T>, String> {
        let count = count_of(size_of_val(&buffer[..]))?;
        let mut handle = self.no_request();
        let inside = self.enter();
        // SAFETY: `buffer` has the length that the call names, and outlives the request, which owns it.
        let code = unsafe {
            let (to, byte) = (buffer.as_mut_ptr().cast::<c_void>(), ffi::RSMPI_UINT8_T);
            ffi::MPI_Irecv(to, count, byte, from as c_int, tag, self.shared.world.0, &mut handle)
        };
        drop(inside);
        checked(code, "MPI_Irecv")?;
        Ok(Request { library: self.clone(), handle: Waiting(handle), buffer: Some(buffer), done: None })
    }

    /// Ends all processes at once, whatever they do. Returns only where MPI cannot do it.
    pub(super) fn abort(&self, exit_code: i32) {
        // SAFETY: allowed at any time between the initialization of MPI and its end. The lock is not taken, since a
        // thread that panicked within a call would hold it.
        unsafe { ffi::MPI_Abort(self.shared.world.0, exit_code) };
    }

    fn no_request(&self) -> ffi::MPI_Request {
        // SAFETY: a constant of MPI.
        unsafe { ffi::RSMPI_REQUEST_NULL }
    }

    fn enter(&self) -> MutexGuard<'_, ()> {
        self.shared.inside.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Splits a communicator into those of processes that share memory.
///
/// # Safety
/// MPI is initialized.
unsafe fn split_shared(world: ffi::MPI_Comm, kind: c_int, key: c_int, host: &mut ffi::MPI_Comm) -> c_int {
    // SAFETY: the caller's; no hints are given.
    unsafe { ffi::MPI_Comm_split_type(world, kind, key, ffi::RSMPI_INFO_NULL, host) }
}

/// A message under way to another process.
pub(super) type Sending<T> = Request<Arc<Vec<T>>>;
/// A message under way from another process.
pub(super) type Receiving<T> = Request<Vec<T>>;

/// A message under way, with its buffer.
pub(super) struct Request<B> {
    library: Library,
    handle: Waiting,
    /// None once it has been handed over.
    buffer: Option<B>,
    /// Bytes of the message, once it is complete.
    done: Option<usize>,
}

struct Waiting(ffi::MPI_Request);

// SAFETY: as for `Handle`.
unsafe impl Send for Waiting {}

impl<B> Request<B> {
    /// Whether the message is complete. Also drives the messages of all others.
    pub(super) fn is_done(&mut self) -> Result<bool, String> {
        if self.done.is_some() {
            return Ok(true);
        }
        let mut status = MaybeUninit::<ffi::MPI_Status>::zeroed();
        let (mut flag, mut count): (c_int, c_int) = (0, 0);
        let inside = self.library.enter();
        // SAFETY: the request is one of MPI's, which writes the status of a completed one.
        let code = unsafe {
            let code = ffi::MPI_Test(&mut self.handle.0, &mut flag, status.as_mut_ptr());
            if code == 0 && flag != 0 {
                ffi::MPI_Get_count(status.as_ptr(), ffi::RSMPI_UINT8_T, &mut count);
            }
            code
        };
        drop(inside);
        checked(code, "MPI_Test")?;
        if flag != 0 {
            self.done = Some(count.max(0) as usize);
        }
        Ok(flag != 0)
    }

    /// The buffer of a complete message, and the bytes that it holds.
    ///
    /// # Panics
    /// It is not complete.
    pub(super) fn into_buffer(mut self) -> (B, usize) {
        let bytes = self.done.expect("a message that is complete");
        (self.buffer.take().expect("handed over once"), bytes)
    }
}

impl<B> Drop for Request<B> {
    /// A message that nobody waits for any more: MPI may still read or write the buffer, so it is left to it.
    fn drop(&mut self) {
        if self.done.is_none() {
            std::mem::forget(self.buffer.take());
        }
    }
}

fn count_of(bytes: usize) -> Result<c_int, String> {
    if bytes > BYTES_MAX {
        return Err(format!("a message of {bytes} bytes, MPI takes at most {BYTES_MAX}"));
    }
    Ok(bytes as c_int)
}

/// The error of MPI behind a code, in its words.
fn checked(code: c_int, call: &str) -> Result<(), String> {
    if code == 0 {
        return Ok(());
    }
    let mut text = [0_u8; ffi::MPI_MAX_ERROR_STRING as usize + 1];
    let mut length: c_int = 0;
    // SAFETY: the buffer is as long as MPI asks for.
    unsafe { ffi::MPI_Error_string(code, text.as_mut_ptr().cast(), &mut length) };
    Err(format!("{call}: {}", String::from_utf8_lossy(&text[..(length.max(0) as usize).min(text.len())])))
}
