//! Pictures as one moving picture: mp4 through ffmpeg where that is installed, otherwise an animated PNG.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::image::{Image, io_from_png};
use crate::output::WriteError;

/// A movie that is asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct MovieOptions {
    /// The file. One that ends in .mp4 becomes an animated .png where there is no ffmpeg.
    pub path: PathBuf,
    /// Pictures per second.
    pub fps: f64,
}

/// The file that a movie will be, and whether ffmpeg writes it.
pub(super) fn choose(wanted: &Path) -> Result<(PathBuf, Option<PathBuf>), String> {
    let ending = wanted.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    match ending.as_deref() {
        Some("png" | "apng") => Ok((wanted.to_path_buf(), None)),
        Some("mp4" | "mov" | "mkv" | "webm") => match program("ffmpeg") {
            Some(ffmpeg) => Ok((wanted.to_path_buf(), Some(ffmpeg))),
            None => Ok((wanted.with_extension("png"), None)),
        },
        _ => Err(format!("{}: the name of a movie ends in .mp4, .mov, .mkv, .webm or .png", wanted.display())),
    }
}

/// A program in the folders of PATH.
fn program(name: &str) -> Option<PathBuf> {
    std::env::split_paths(&std::env::var_os("PATH")?).map(|folder| folder.join(name)).find(|file| file.is_file())
}

/// A movie that is being written. Pictures come from many threads in any order; they are written in theirs, and a
/// thread that is far ahead waits.
pub(super) struct Movie {
    path: PathBuf,
    part: PathBuf,
    state: Mutex<State>,
    room: Condvar,
    /// Largest distance of a picture from the one to be written next.
    ahead: usize,
}

struct State {
    next: usize,
    waiting: BTreeMap<usize, Image>,
    writer: Option<Writer>,
    failed: bool,
}

enum Writer {
    Ffmpeg(Child),
    Animated(Box<png::Writer<BufWriter<File>>>),
}

impl Movie {
    /// A movie of `pictures` pictures of `size` pixels; `ffmpeg`: the program that writes it.
    pub(super) fn create(
        (path, ffmpeg): (PathBuf, Option<PathBuf>),
        fps: f64,
        pictures: usize,
        (width, height): (usize, usize),
        threads: usize,
    ) -> Result<Movie, WriteError> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let part = path.with_file_name(format!(".{name}.part"));
        let open = || -> io::Result<Writer> {
            if let Some(ffmpeg) = ffmpeg {
                // A file that cannot be written is noticed here, with a better sentence than ffmpeg's.
                File::create(&part)?;
                let size = format!("{width}x{height}");
                let format = match path.extension().and_then(|ending| ending.to_str()) {
                    Some("mov") => "mov",
                    Some("mkv") => "matroska",
                    Some("webm") => "webm",
                    _ => "mp4",
                };
                let mut command = Command::new(ffmpeg);
                command.args(["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", &size]);
                command.args(["-r", &fps.to_string(), "-i", "-", "-pix_fmt", "yuv420p"]);
                command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-f", format]).arg(&part);
                command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
                return command.spawn().map(Writer::Ffmpeg);
            }
            let mut encoder = png::Encoder::new(BufWriter::new(File::create(&part)?), width as u32, height as u32);
            encoder.set_color(png::ColorType::Rgb);
            encoder.set_depth(png::BitDepth::Eight);
            encoder.set_compression(png::Compression::Balanced);
            encoder.set_animated(pictures as u32, 0).map_err(io_from_png)?;
            let delay_ms = (1000.0 / fps).round().clamp(1.0, f64::from(u16::MAX)) as u16;
            encoder.set_frame_delay(delay_ms, 1000).map_err(io_from_png)?;
            encoder.write_header().map(|writer| Writer::Animated(Box::new(writer))).map_err(io_from_png)
        };
        let writer = open().map_err(WriteError::at(&path))?;
        let state = State { next: 0, waiting: BTreeMap::new(), writer: Some(writer), failed: false };
        Ok(Movie { path, part, state: Mutex::new(state), room: Condvar::new(), ahead: 2 * threads.max(1) })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes picture `number` (from 0), and writes all that are in turn.
    pub(super) fn push(&self, number: usize, image: Image) -> Result<(), WriteError> {
        let mut state = self.state();
        while number > state.next + self.ahead && !state.failed {
            state = self.room.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        if state.failed {
            return Ok(());
        }
        state.waiting.insert(number, image);
        let next = state.next;
        let mut written = next;
        while let Some(image) = state.waiting.remove(&written) {
            let result = match &mut state.writer {
                Some(Writer::Ffmpeg(child)) => child.stdin.as_mut().map_or(Ok(()), |to| to.write_all(image.bytes())),
                Some(Writer::Animated(writer)) => writer.write_image_data(image.bytes()).map_err(io_from_png),
                None => Ok(()),
            };
            if let Err(error) = result {
                let why = self.why(&mut state, error);
                state.failed = true;
                self.room.notify_all();
                return Err(WriteError::at(&self.path)(why));
            }
            written += 1;
        }
        state.next = written;
        drop(state);
        self.room.notify_all();
        Ok(())
    }

    /// Lets threads that wait go on, because a picture will not come.
    pub(super) fn give_up(&self) {
        self.state().failed = true;
        self.room.notify_all();
    }

    /// Ends the movie and gives it its name.
    pub(super) fn finish(self) -> Result<PathBuf, WriteError> {
        let mut state = self.state();
        let end = match state.writer.take() {
            Some(Writer::Animated(writer)) => writer.finish().map_err(io_from_png),
            Some(Writer::Ffmpeg(child)) => ended(child),
            None => Ok(()),
        };
        drop(state);
        end.and_then(|()| std::fs::rename(&self.part, &self.path)).map_err(WriteError::at(&self.path))?;
        Ok(self.path.clone())
    }

    /// The reason of a failure: what ffmpeg says, if it has ended.
    fn why(&self, state: &mut State, error: io::Error) -> io::Error {
        match state.writer.take() {
            Some(Writer::Ffmpeg(child)) if error.kind() == io::ErrorKind::BrokenPipe => {
                ended(child).err().unwrap_or(error)
            }
            _ => error,
        }
    }
}

impl Drop for Movie {
    fn drop(&mut self) {
        let mut state = self.state();
        if let Some(Writer::Ffmpeg(mut child)) = state.writer.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
        // It has its name by now if the movie was finished.
        let _ = std::fs::remove_file(&self.part);
    }
}

/// Waits for ffmpeg; its last line is the error.
fn ended(mut child: Child) -> io::Result<()> {
    drop(child.stdin.take());
    let mut said = String::new();
    if let Some(from) = &mut child.stderr {
        let _ = from.read_to_string(&mut said);
    }
    let status = child.wait()?;
    if status.success() {
        return Ok(());
    }
    let line = said.lines().last().unwrap_or("it says nothing");
    Err(io::Error::other(format!("ffmpeg: {line}")))
}
