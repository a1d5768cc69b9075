//! Shaded pictures of a run's frames: good enough to judge folds; light and material are not physical.
//!
//! One camera for the whole sequence, so that pictures of different frames can be compared. Frames are drawn in
//! parallel; a picture depends on its frame and on what the sequence has in common (`survey`) only. A device draws
//! through `gpu::Offscreen`, the native executor with `raster` and `shade`: the same samples, light and shading, but
//! not the same bits.

mod camera;
mod camera_file;
mod contact_sheet;
mod content;
mod error;
mod font;
mod image;
mod legend;
mod light;
mod look;
mod movie;
mod options;
mod painter;
mod palette;
mod raster;
mod shade;
mod smooth;
mod subject;
mod survey;
mod threads;

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

pub use self::camera_file::{CameraFile, CameraKey};
use self::content::Content;
pub use self::error::PictureError;
pub use self::image::Image;
use self::movie::Movie;
pub use self::movie::MovieOptions;
pub use self::options::{Coloring, Ground, LENS_MM, PictureOptions, Target, UpAxis};
use self::painter::Painter;
pub use self::subject::{Subject, VertexValues};
use self::survey::{Survey, survey};
use self::threads::for_each;
use super::FrameSource;
use crate::gpu::Executor;

/// Color of the edge around pictures of a coarse run, sRGB.
const COARSE: [u8; 3] = [235, 140, 30];

/// Where pictures go.
#[derive(Clone, Debug, Default)]
pub struct Destination {
    /// Folder of the pictures and of the sheet.
    pub folder: PathBuf,
    /// Start of the names of pictures, before the six digits of the frame.
    pub prefix: String,
    /// Name of the sheet of all frames.
    pub sheet: String,
    /// The only file that is written, for a sequence of one frame.
    pub file: Option<PathBuf>,
    /// A movie besides the pictures.
    pub movie: Option<MovieOptions>,
}

/// What was written.
#[derive(Clone, Debug)]
pub struct Drawn {
    /// Pictures, in the order of their frames.
    pub pictures: Vec<PathBuf>,
    /// The sheet of all frames.
    pub sheet: Option<PathBuf>,
    /// The movie.
    pub movie: Option<PathBuf>,
    /// The camera of the first picture.
    pub camera: CameraFile,
}

/// Draws the frames `numbers` of all subjects, side by side in one picture each, and a sheet of them.
/// Pictures of a coarse run have an orange edge.
/// The device of `executor` draws, if it has one. `drawn` is called after every picture, from any thread.
pub fn draw_frames(
    subjects: &[Subject<'_>],
    numbers: &[u32],
    options: &PictureOptions,
    executor: &Executor,
    to: &Destination,
    drawn: &(dyn Fn(u32) + Sync),
) -> Result<Drawn, PictureError> {
    let chosen_movie = to.movie.as_ref().map(|movie| movie::choose(&movie.path)).transpose();
    let chosen_movie = chosen_movie.map_err(PictureError::Name)?;
    let studio = Studio::new(subjects, numbers, options, executor)?;
    if to.file.is_none() {
        make_folder(&to.folder)?;
    }
    let path = |frame: u32| match &to.file {
        Some(file) => file.clone(),
        None => to.folder.join(format!("{}{frame:06}.png", to.prefix)),
    };
    let chosen = contact_sheet::choose(numbers);
    let thumbnails = Mutex::new(vec![None; chosen.len()]);
    // The size of the movie is that of the first picture.
    let first = numbers.first().map(|frame| studio.draw(*frame)).transpose()?;
    let movie = match (chosen_movie, &to.movie, &first) {
        (Some(chosen), Some(movie), Some(first)) => {
            let size = (first.width(), first.height());
            Some(Movie::create(chosen, movie.fps, numbers.len(), size, options.threads)?)
        }
        _ => None,
    };
    let first = Mutex::new(first);
    let draw = |place: usize, frame: u32| -> Result<(), PictureError> {
        let before = if place == 0 { first.lock().ok().and_then(|mut first| first.take()) } else { None };
        let image = before.map_or_else(|| studio.draw(frame), Ok)?;
        image.save(&path(frame))?;
        if let Some(slot) = chosen.iter().position(|number| *number == frame) {
            let small = contact_sheet::thumbnail(&image);
            if let Ok(mut slots) = thumbnails.lock() {
                slots[slot] = Some((frame, small));
            }
        }
        if let Some(movie) = &movie {
            movie.push(place, image)?;
        }
        drawn(frame);
        Ok(())
    };
    for_each(numbers, options.threads, |place, frame| {
        draw(place, frame).inspect_err(|_| {
            if let Some(movie) = &movie {
                movie.give_up();
            }
        })
    })?;
    let movie = movie.map(Movie::finish).transpose()?;
    let sheet = match to.file {
        Some(_) => None,
        None => {
            let sheet = to.folder.join(&to.sheet);
            let thumbnails = thumbnails.into_inner().unwrap_or_default();
            contact_sheet::compose(thumbnails.into_iter().flatten()).save(&sheet)?;
            Some(sheet)
        }
    };
    let pictures = numbers.iter().map(|frame| path(*frame)).collect();
    Ok(Drawn { pictures, sheet, movie, camera: studio.survey.camera_file })
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
    let subjects = [Subject::new(source)];
    let studio = Studio::new(&subjects, numbers, options, executor)?;
    let images = Mutex::new(Vec::new());
    for_each(numbers, options.threads, |_, frame| {
        let image = studio.draw(frame)?;
        if let Ok(mut images) = images.lock() {
            images.push((frame, image));
        }
        Ok(())
    })?;
    let mut images = images.into_inner().unwrap_or_default();
    images.sort_by_key(|(frame, _)| *frame);
    Ok(images)
}

/// Draws a sheet with a row of pictures for each subject, with one camera, and their names in front: those of the
/// frames `numbers` that a subject has.
///
/// # Errors
/// As [`draw_frames`].
pub fn draw_rows(
    subjects: &[Subject<'_>],
    numbers: &[u32],
    options: &PictureOptions,
    executor: &Executor,
    path: &Path,
) -> Result<(), PictureError> {
    let studio = Studio::new(subjects, numbers, options, executor)?;
    let rows: Vec<Mutex<Vec<(u32, Image)>>> = subjects.iter().map(|_| Mutex::default()).collect();
    for_each(numbers, options.threads, |_, frame| {
        for ((subject, floors), row) in subjects.iter().zip(&studio.survey.floors).zip(&rows) {
            if subject.source.holds(frame) {
                let image = studio.of_subject(subject, floors, frame)?;
                row.lock().unwrap_or_else(PoisonError::into_inner).push((frame, image));
            }
        }
        Ok(())
    })?;
    let named = subjects.iter().zip(rows).map(|(subject, row)| {
        let mut row = row.into_inner().unwrap_or_else(PoisonError::into_inner);
        row.sort_by_key(|(frame, _)| *frame);
        (subject.name.clone(), row)
    });
    Ok(contact_sheet::rows(&named.collect::<Vec<_>>()).save(path)?)
}

fn make_folder(folder: &Path) -> Result<(), PictureError> {
    let wrong = |source| PictureError::Folder { path: folder.to_path_buf(), source };
    std::fs::create_dir_all(folder).map_err(wrong)
}

/// Everything that the pictures of a sequence need.
struct Studio<'a> {
    subjects: &'a [Subject<'a>],
    options: &'a PictureOptions,
    survey: Survey,
    painter: Painter<'a>,
}

impl<'a> Studio<'a> {
    fn new(
        subjects: &'a [Subject<'a>],
        numbers: &[u32],
        options: &'a PictureOptions,
        executor: &'a Executor,
    ) -> Result<Studio<'a>, PictureError> {
        let survey = survey(subjects, numbers, options)?;
        let painter = Painter::new(executor, options.width, options.height)?;
        Ok(Studio { subjects, options, survey, painter })
    }

    /// The picture of a frame.
    fn draw(&self, frame: u32) -> Result<Image, PictureError> {
        let mut pictures = Vec::with_capacity(self.subjects.len());
        for (subject, floors) in self.subjects.iter().zip(&self.survey.floors) {
            pictures.push((&subject.name[..], self.of_subject(subject, floors, frame)?));
        }
        match pictures.pop() {
            Some((_, only)) if pictures.is_empty() => Ok(only),
            Some(last) => {
                pictures.push(last);
                Ok(contact_sheet::beside(&pictures))
            }
            None => Ok(Image::new(self.options.width as usize, self.options.height as usize)),
        }
    }

    fn of_subject(&self, subject: &Subject<'_>, floors: &[bool], frame: u32) -> Result<Image, PictureError> {
        let (options, survey) = (self.options, &self.survey);
        let cloth = subject.cloth(frame)?;
        let colors = subject.colors(options.coloring, frame, &cloth, options.up.vector(), survey.range);
        let colors = colors.map_err(|what| PictureError::Values { frame, what })?;
        let mut obstacle = subject.obstacle(frame)?;
        if let Some(obstacle) = &mut obstacle {
            obstacle.triangles.retain(|t| !floors.get(t[0] as usize).copied().unwrap_or(false));
        }
        let content = Content::new(cloth, colors, options.smooth, obstacle.as_ref());
        let mut image = self.painter.draw(&survey.look, &content, &survey.track.at(frame))?;
        if let Some(legend) = &survey.legend {
            legend.draw(&mut image);
        }
        if subject.source.is_coarse(frame) {
            image.frame(COARSE);
        }
        Ok(image)
    }
}
