//! The socket of a live run: lines of JSON from clients of the same user, answers in the same order.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde_json::Value;
use thiserror::Error;

use super::desk::Desk;
use super::request::{Request, accepted, refused};
use super::saved::save;
use crate::os::signals;

/// Name of the socket in a run directory.
const SOCKET: &str = "live.sock";
/// Clients at a time.
const CLIENTS: usize = 64;
/// Longest request, bytes.
const LINE: u64 = 4 << 20;
/// A client that takes no answer for this long is left.
const PATIENCE: Duration = Duration::from_secs(20);
/// Longest wait for the last answers when the run has ended.
const FAREWELL: Duration = Duration::from_millis(300);
/// Between two looks for a new client.
const LOOK: Duration = Duration::from_millis(20);

/// Why a run cannot be steered.
#[derive(Debug, Error)]
pub enum LiveError {
    /// The socket cannot be made.
    #[error("cannot make the socket {}: {source}", path.display())]
    Bind {
        /// The socket.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// Nobody listens.
    #[error("no live run listens in {}; start one with loomtree run SCENE --live", .0.display())]
    Nobody(PathBuf),
    /// The connection was lost.
    #[error("the connection to the run was lost: {0}")]
    Lost(io::Error),
}

/// The socket of a run; removed when this is dropped.
pub struct LiveServer {
    path: PathBuf,
    desk: Arc<Desk>,
    ended: Arc<AtomicBool>,
    /// Requests that are not answered yet.
    under_way: Arc<AtomicUsize>,
}

impl LiveServer {
    /// Makes the socket in `run`, for which this process holds the lock, and answers there on threads of its own.
    ///
    /// # Errors
    /// The socket cannot be made.
    pub(crate) fn start(run: &Path, desk: Arc<Desk>) -> Result<LiveServer, LiveError> {
        let path = run.join(SOCKET);
        let bind = || -> io::Result<UnixListener> {
            // Nobody else can connect before the socket has its permissions, because the folder is closed to them. The
            // path of the folder by its descriptor is short, however long its name.
            let inner = tempfile::Builder::new().prefix(".live").tempdir_in(run)?;
            let folder = std::fs::File::open(inner.path())?;
            let listener = UnixListener::bind(by_descriptor(&folder, "socket"))?;
            std::fs::set_permissions(inner.path().join("socket"), std::fs::Permissions::from_mode(0o600))?;
            std::fs::rename(inner.path().join("socket"), &path)?;
            listener.set_nonblocking(true)?;
            Ok(listener)
        };
        let fault = |source| LiveError::Bind { path: path.clone(), source };
        let listener = bind().map_err(fault)?;
        signals::remove_at_once(Some(&path));
        let (ended, under_way) = (Arc::<AtomicBool>::default(), Arc::<AtomicUsize>::default());
        let server = LiveServer {
            path: path.clone(),
            desk: Arc::clone(&desk),
            ended: ended.clone(),
            under_way: under_way.clone(),
        };
        let run = run.to_path_buf();
        let clients = Arc::new(AtomicUsize::new(0));
        let accept = move || {
            while !ended.load(Ordering::Relaxed) {
                let Ok((stream, _)) = listener.accept() else {
                    std::thread::sleep(LOOK);
                    continue;
                };
                let (desk, under_way) = (Arc::clone(&desk), Arc::clone(&under_way));
                let client = Client { desk, run: run.clone(), clients: Arc::clone(&clients), under_way };
                if clients.fetch_add(1, Ordering::Relaxed) >= CLIENTS {
                    continue;
                }
                let thread = std::thread::Builder::new().name("live client".into());
                if let Err(error) = thread.spawn(move || client.serve(stream)) {
                    tracing::debug!("a client was lost: {error}");
                }
            }
        };
        std::thread::Builder::new().name("live".into()).spawn(accept).map_err(fault)?;
        Ok(server)
    }
}

impl Drop for LiveServer {
    fn drop(&mut self) {
        self.desk.close();
        self.ended.store(true, Ordering::Relaxed);
        let begun = Instant::now();
        while self.under_way.load(Ordering::Relaxed) > 0 && begun.elapsed() < FAREWELL {
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = std::fs::remove_file(&self.path);
        signals::remove_at_once(None);
    }
}

/// A client; counted as long as it is.
struct Client {
    desk: Arc<Desk>,
    run: PathBuf,
    clients: Arc<AtomicUsize>,
    under_way: Arc<AtomicUsize>,
}

impl Client {
    fn serve(&self, stream: UnixStream) {
        if let Err(error) = self.talk(stream) {
            // A client that has gone, most of the time.
            tracing::debug!("a client has gone: {error}");
        }
    }

    fn talk(&self, stream: UnixStream) -> io::Result<()> {
        stream.set_nonblocking(false)?;
        stream.set_write_timeout(Some(PATIENCE))?;
        let mut reader = BufReader::new(stream.try_clone()?);
        let mut out = stream;
        loop {
            let mut line = Vec::new();
            if reader.by_ref().take(LINE).read_until(b'\n', &mut line)? == 0 {
                return Ok(());
            }
            let is_long = line.len() as u64 >= LINE && line.last() != Some(&b'\n');
            if line.iter().all(u8::is_ascii_whitespace) {
                continue;
            }
            self.under_way.fetch_add(1, Ordering::Relaxed);
            let answer = if is_long { refused("a request has at most 4 MiB") } else { self.answer(&line) };
            let written = out.write_all(format!("{answer}\n").as_bytes());
            self.under_way.fetch_sub(1, Ordering::Relaxed);
            written?;
            if is_long {
                return Ok(());
            }
        }
    }

    fn answer(&self, line: &[u8]) -> Value {
        let text = std::str::from_utf8(line).map_err(|_| "this is not UTF-8".to_owned());
        match text.and_then(Request::read) {
            Ok(Request::Save(file)) => match save(&self.run, &file) {
                Ok(path) => {
                    let mut answer = accepted(self.desk.step());
                    answer["file"] = path.display().to_string().into();
                    answer
                }
                Err(why) => refused(&why),
            },
            Ok(request) => self.desk.answer(request),
            Err(why) => refused(&why),
        }
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.clients.fetch_sub(1, Ordering::Relaxed);
    }
}

/// A file in an open folder, by a path that is short however long the folder's own is: an address has 108 bytes.
fn by_descriptor(folder: &std::fs::File, name: &str) -> PathBuf {
    use std::os::fd::AsRawFd;
    Path::new("/proc/self/fd").join(folder.as_raw_fd().to_string()).join(name)
}

/// A connection to the live run in `run`.
///
/// # Errors
/// Nobody listens there.
pub fn connect(run: &Path) -> Result<UnixStream, LiveError> {
    let nobody = |_| LiveError::Nobody(run.to_path_buf());
    let folder = std::fs::File::open(run).map_err(nobody)?;
    UnixStream::connect(by_descriptor(&folder, SOCKET)).map_err(nobody)
}
