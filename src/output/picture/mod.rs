//! Shaded pictures of a run's frames: good enough to judge folds; light and material are not physical.
//!
//! One camera for the whole sequence, so that pictures of different frames can be compared. Frames are drawn in
//! parallel; a picture depends on its frame and the camera only. A device draws through `gpu::Offscreen`, the native
//! executor with `raster` and `shade`: the same samples and shading, but not the same bits.

mod camera;
mod contact_sheet;
mod content;
mod font;
mod image;
mod look;
mod options;
mod painter;
mod raster;
mod shade;

use std::io;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use thiserror::Error;

use self::camera::{Fit, View};
use self::content::Content;
pub use self::image::Image;
use self::look::Look;
pub use self::options::{Coloring, PictureOptions, UpAxis};
use self::painter::Painter;
use super::{FrameSource, FramesError, RunDirectory, WriteError};
use crate::gpu::{Executor, GpuError};

/// Why pictures, or some of them, cannot be drawn.
#[derive(Debug, Error)]
pub enum PictureError {
    /// A frame cannot be read.
    #[error(transparent)]
    Frames(#[from] FramesError),
    /// The device cannot draw.
    #[error("{0}; --executor cpu draws without it")]
    Gpu(#[from] GpuError),
    /// A picture cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The folder for pictures cannot be made.
    #[error("cannot make {}: {source}", path.display())]
    Folder {
        /// Path of the folder.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// No frame has a vertex that a camera could see.
    #[error("frames {first} to {last} have no vertex with finite coordinates, so there is nothing to draw")]
    NothingToSee {
        /// First frame asked for.
        first: u32,
        /// Last frame asked for.
        last: u32,
    },
}

/// Color of the edge around pictures of a coarse run, sRGB.
const COARSE: [u8; 3] = [235, 140, 30];

/// Draws the frames `numbers` to `pictures/frame_%06d.png` and `pictures/contact_sheet.png`; returns the sheet's path.
/// Pictures of a coarse run have an orange edge.
/// The device of `executor` draws, if it has one. `drawn` is called after every picture, from any thread.
pub fn draw_frames(
    directory: &RunDirectory,
    source: &FrameSource,
    numbers: &[u32],
    options: &PictureOptions,
    executor: &Executor,
    drawn: &(dyn Fn(u32) + Sync),
) -> Result<PathBuf, PictureError> {
    let look = choose_look(source, numbers, options)?;
    let painter = Painter::new(executor, &look, options.width, options.height)?;
    let folder = directory.pictures();
    std::fs::create_dir_all(&folder).map_err(|source| PictureError::Folder { path: folder.clone(), source })?;

    let chosen = contact_sheet::choose(numbers);
    let thumbnails = Mutex::new(vec![None; chosen.len()]);
    for_each_frame(numbers, options.threads, |frame| {
        let content = Content::new(source.read(frame)?, source.read_obstacle(frame)?);
        let mut image = painter.draw(&content)?;
        if source.is_coarse(frame) {
            image.frame(COARSE);
        }
        image.save(&folder.join(format!("frame_{frame:06}.png")))?;
        if let Some(slot) = chosen.iter().position(|number| *number == frame) {
            let small = contact_sheet::thumbnail(&image);
            if let Ok(mut slots) = thumbnails.lock() {
                slots[slot] = Some((frame, small));
            }
        }
        drawn(frame);
        Ok(())
    })?;
    let thumbnails = thumbnails.into_inner().unwrap_or_default();
    let sheet = folder.join("contact_sheet.png");
    contact_sheet::compose(thumbnails.into_iter().flatten()).save(&sheet)?;
    Ok(sheet)
}

/// Draws the frames `numbers` and returns their pictures in this order, all with one camera.
///
/// # Errors
/// As [`draw_frames`], without those of writing.
pub fn draw_images(
    source: &FrameSource,
    numbers: &[u32],
    options: &PictureOptions,
    executor: &Executor,
) -> Result<Vec<(u32, Image)>, PictureError> {
    let look = choose_look(source, numbers, options)?;
    let painter = Painter::new(executor, &look, options.width, options.height)?;
    let images = Mutex::new(Vec::new());
    for_each_frame(numbers, options.threads, |frame| {
        let image = painter.draw(&Content::new(source.read(frame)?, source.read_obstacle(frame)?))?;
        if let Ok(mut images) = images.lock() {
            images.push((frame, image));
        }
        Ok(())
    })?;
    let mut images = images.into_inner().unwrap_or_default();
    images.sort_by_key(|(frame, _)| *frame);
    Ok(images)
}

/// Camera and range of heights for the whole sequence.
fn choose_look(source: &FrameSource, numbers: &[u32], options: &PictureOptions) -> Result<Look, PictureError> {
    let (first, last) = (numbers.first().copied().unwrap_or(0), numbers.last().copied().unwrap_or(0));
    let mut view = View::new(options.up.vector());
    if let Some(middle) = numbers.get(numbers.len() / 2) {
        for frame in [first, *middle, last] {
            view.add(&source.read(frame)?);
        }
    }
    let (azimuth_deg, elevation_deg) = view.direction();
    let direction = (options.azimuth_deg.unwrap_or(azimuth_deg), options.elevation_deg.unwrap_or(elevation_deg));
    let start = Fit::new(options.up.vector(), direction, options.width as f32 / options.height as f32);
    let cloth = fit_frames(&start, numbers, options.threads, |frame, fit| {
        fit.add(&source.read(frame)?.positions);
        Ok(())
    })?;
    let all = fit_frames(&cloth, numbers, options.threads, |frame, fit| {
        if let Some(obstacle) = source.read_obstacle(frame)? {
            fit.add_near(&obstacle.positions, &cloth);
        }
        Ok(())
    })?;
    let camera = all.camera().ok_or(PictureError::NothingToSee { first, last })?;
    Ok(Look::new(camera, options.coloring, cloth.heights_m()))
}

/// `start` with what `add` adds to it in all frames.
fn fit_frames(
    start: &Fit,
    numbers: &[u32],
    threads: usize,
    add: impl Fn(u32, &mut Fit) -> Result<(), FramesError> + Sync,
) -> Result<Fit, PictureError> {
    let fit = Mutex::new(start.clone());
    for_each_frame(numbers, threads, |frame| {
        let mut own = start.clone();
        add(frame, &mut own)?;
        if let Ok(mut fit) = fit.lock() {
            fit.merge(&own);
        }
        Ok(())
    })?;
    Ok(fit.into_inner().unwrap_or_else(|_| start.clone()))
}

/// Calls `f` for every frame on up to `threads` threads; the first error in frame order wins.
fn for_each_frame(
    numbers: &[u32],
    threads: usize,
    f: impl Fn(u32) -> Result<(), PictureError> + Sync,
) -> Result<(), PictureError> {
    let next = AtomicUsize::new(0);
    let failure: Mutex<Option<(usize, PictureError)>> = Mutex::new(None);
    std::thread::scope(|scope| {
        for _ in 0..threads.clamp(1, numbers.len().max(1)) {
            scope.spawn(|| {
                loop {
                    let at = next.fetch_add(1, Ordering::Relaxed);
                    let Some(frame) = numbers.get(at) else { break };
                    let Err(error) = f(*frame) else { continue };
                    next.store(numbers.len(), Ordering::Relaxed);
                    if let Ok(mut failure) = failure.lock()
                        && failure.as_ref().is_none_or(|(earlier, _)| at < *earlier)
                    {
                        *failure = Some((at, error));
                    }
                    break;
                }
            });
        }
    });
    match failure.into_inner() {
        Ok(Some((_, error))) => Err(error),
        _ => Ok(()),
    }
}
