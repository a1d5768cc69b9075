//! What all pictures of a sequence have in common: camera, ground, lights, range of a scale. It is chosen from the
//! frames that are drawn, so that they can be compared.

use std::collections::BTreeMap;
use std::sync::Mutex;

use super::camera::{Camera, Fit, View};
use super::camera_file::CameraFile;
use super::error::PictureError;
use super::legend::Legend;
use super::look::Look;
use super::options::{Coloring, Ground, PictureOptions, Target};
use super::palette;
use super::subject::Subject;
use super::threads::for_each;
use crate::math::Vec3;
use crate::mesh::pieces;
use crate::output::FrameMesh;

/// How far from the cloth an obstacle counts, in diameters of the cloth.
const MARGIN: f32 = 0.25;
/// Size of an obstacle, in diameters of the cloth, from which on it counts neither for the view nor for the ground.
const HUGE: f32 = 6.0;
/// Size of an obstacle, in diameters of the cloth, up to which it is shown whole where it stands within the cloth: a
/// T-shirt is half as large as who wears it.
const WORN: f32 = 2.5;
/// Largest distance of a floor from its plane, in diameters of the cloth.
const FLAT: f32 = 1e-4;
/// How far cloth and obstacles may reach below a floor, in diameters of the cloth.
const SUNK: f32 = 0.03;
/// Frames that decide the range of strains.
const SAMPLED: usize = 8;

/// Camera by frame.
pub(super) enum Track {
    Still(Camera),
    Keys { file: CameraFile, first: Camera, options: Box<PictureOptions> },
}

impl Track {
    pub(super) fn at(&self, frame: u32) -> Camera {
        match self {
            Track::Still(camera) => camera.clone(),
            Track::Keys { file, first, options } => of_file(file, frame, options, first.extent_m),
        }
    }
}

fn of_file(file: &CameraFile, frame: u32, options: &PictureOptions, extent_m: f32) -> Camera {
    let up = options.up.vector();
    let (points, lens_mm) = file.at(frame, up, options.origin_m, options.lens_mm);
    Camera::looking(points, up, aspect(options), lens_mm, extent_m).zoomed(options.zoom)
}

fn aspect(options: &PictureOptions) -> f32 {
    options.width as f32 / options.height as f32
}

/// What the pictures of a sequence share.
pub(super) struct Survey {
    pub look: Look,
    pub track: Track,
    /// Values at the ends of the scale.
    pub range: [f32; 2],
    pub legend: Option<Legend>,
    /// By subject: for each vertex of its obstacles whether it belongs to a floor that the ground stands for.
    pub floors: Vec<Vec<bool>>,
    /// The camera of the first frame, for `--camera`.
    pub camera_file: CameraFile,
}

/// Looks through the frames.
pub(super) fn survey(
    subjects: &[Subject<'_>],
    numbers: &[u32],
    options: &PictureOptions,
) -> Result<Survey, PictureError> {
    let (first, last) = (numbers.first().copied().unwrap_or(0), numbers.last().copied().unwrap_or(0));
    let up = options.up.vector();
    let mut view = View::new(up);
    if let (Some(middle), Some(subject)) = (numbers.get(numbers.len() / 2), subjects.first()) {
        for frame in [first, *middle, last].into_iter().filter(|frame| subject.source.holds(*frame)) {
            view.add(&subject.cloth(frame)?);
        }
    }
    let (azimuth_deg, elevation_deg) = view.direction();
    let direction = (options.azimuth_deg.unwrap_or(azimuth_deg), options.elevation_deg.unwrap_or(elevation_deg));
    let start = Fit::new(up, direction, aspect(options), options.lens_mm);
    let cloth = fitted(&start, numbers, options.threads, |frame, fit| {
        for subject in subjects.iter().filter(|subject| subject.source.holds(frame)) {
            let mesh = subject.cloth(frame)?;
            fit.add(&subject.shown(frame, &mesh));
        }
        Ok(())
    })?;
    let nothing = || PictureError::NothingToSee { first, last };
    // Where all of the cloth is hidden, the rest is seen as with it.
    let cloth = match cloth.camera() {
        Some(_) => cloth,
        None => fitted(&start, numbers, options.threads, |frame, fit| {
            for subject in subjects.iter().filter(|subject| subject.source.holds(frame)) {
                fit.add(&subject.source.read(frame)?.positions);
            }
            Ok(())
        })?,
    };
    let whole = cloth.camera().ok_or_else(nothing)?;
    let surroundings = Surroundings::find(subjects, numbers, options, &cloth, whole.extent_m)?;
    let range_fit = |target: &(dyn Fn(u32, &mut Fit) -> Result<(), PictureError> + Sync)| {
        fitted(&start, numbers, options.threads, target)
    };
    let seen = match &options.target {
        Target::Cloth | Target::Point(_) => cloth.clone(),
        Target::Auto | Target::All => {
            let which = if options.target == Target::All { &surroundings.near } else { &surroundings.worn };
            let mut all = range_fit(&|frame, fit| add_obstacles(subjects, which, frame, fit))?;
            all.merge(&cloth);
            all
        }
        Target::Piece(range) => range_fit(&|frame, fit| {
            let mesh = subjects[0].source.read(frame)?;
            fit.add(mesh.positions.get(range.clone()).unwrap_or_default());
            Ok(())
        })?,
        Target::Obstacle(range) => range_fit(&|frame, fit| {
            let mesh = subjects[0].source.read_obstacle(frame)?.unwrap_or_default();
            fit.add(mesh.positions.get(range.clone()).unwrap_or_default());
            Ok(())
        })?,
    };
    let point = match options.target {
        Target::Point(point) => Some((point - options.origin_m).as_vec3()),
        _ => None,
    };
    let camera = match (&options.camera, point) {
        (Some(file), _) => of_file(file, first, options, whole.extent_m),
        (None, Some(point)) => cloth.camera_at(point).ok_or_else(nothing)?.zoomed(options.zoom),
        (None, None) => seen.camera().ok_or_else(nothing)?.zoomed(options.zoom),
    };
    let distance_m = point.unwrap_or_else(|| seen.middle()).distance(camera.eye);
    let camera_file = match &options.camera {
        Some(file) => file.clone(),
        None => CameraFile::of(&camera, distance_m, options.origin_m),
    };
    let mut look = Look::new(&camera, surroundings.ground_m(options));
    look.directions = options.coloring == Coloring::Normal;
    look.shadows = options.shadows;
    let (range, legend) = scale(subjects, numbers, options, cloth.heights_m())?;
    let track = match &options.camera {
        Some(file) if file.key.len() > 1 => {
            Track::Keys { file: file.clone(), first: camera, options: Box::new(options.clone()) }
        }
        _ => Track::Still(camera),
    };
    Ok(Survey { look, track, range, legend, floors: surroundings.floors, camera_file })
}

/// `start` with what `add` adds to it in all frames.
fn fitted(
    start: &Fit,
    numbers: &[u32],
    threads: usize,
    add: impl Fn(u32, &mut Fit) -> Result<(), PictureError> + Sync,
) -> Result<Fit, PictureError> {
    let fit = Mutex::new(start.clone());
    for_each(numbers, threads, |_, frame| {
        let mut own = start.clone();
        add(frame, &mut own)?;
        if let Ok(mut fit) = fit.lock() {
            fit.merge(&own);
        }
        Ok(())
    })?;
    Ok(fit.into_inner().unwrap_or_else(|_| start.clone()))
}

/// Obstacles around the cloth.
struct Surroundings {
    floors: Vec<Vec<bool>>,
    /// Height of the floors, meters.
    floor_m: Option<f32>,
    /// Lowest height of cloth and obstacles near it, meters.
    lowest_m: f32,
    /// By subject: for each vertex of the obstacles whether it belongs to one near the cloth.
    near: Vec<Vec<bool>>,
    /// The same for those near the cloth that stand within it, as who wears it does.
    worn: Vec<Vec<bool>>,
}

/// A connected part of the obstacles: all places where it is in the sequence.
type Boxes = BTreeMap<u32, [Vec3; 2]>;

impl Surroundings {
    fn find(
        subjects: &[Subject<'_>],
        numbers: &[u32],
        options: &PictureOptions,
        cloth: &Fit,
        extent_m: f32,
    ) -> Result<Surroundings, PictureError> {
        let up = options.up.vector();
        let [low, high] = cloth.bounds();
        let margin = Vec3::splat(MARGIN * extent_m);
        let mut lowest_m = cloth.heights_m().0;
        let (mut floors, mut near, mut worn, mut heights) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for subject in subjects {
            let Some(mesh) = numbers.first().map(|frame| subject.obstacle(*frame)).transpose()?.flatten() else {
                floors.push(Vec::new());
                near.push(Vec::new());
                worn.push(Vec::new());
                continue;
            };
            let root = pieces(mesh.positions.len(), &mesh.triangles);
            let boxes = boxes(subject, numbers, options.threads, &root)?;
            let is_near = |[a, b]: &[Vec3; 2]| {
                (*b - *a).length() <= HUGE * extent_m && a.cmple(high + margin).all() && b.cmpge(low - margin).all()
            };
            let is_worn = |[a, b]: &[Vec3; 2]| {
                // Heights do not matter: a head and feet are above and below the cloth.
                let middle = 0.5 * (*a + *b);
                let middle = middle + (cloth.middle() - middle).dot(up) * up;
                (*b - *a).length() <= WORN * extent_m && middle.cmpge(low).all() && middle.cmple(high).all()
            };
            let is_floor = |part: u32, [a, b]: &[Vec3; 2]| {
                (*b - *a).dot(up) <= FLAT * extent_m
                    && a.dot(up) <= cloth.heights_m().0 + SUNK * extent_m
                    && covers(&mesh, &root, part, [low, high], up)
            };
            let floor_parts: Vec<u32> =
                boxes.iter().filter(|(part, place)| is_floor(**part, place)).map(|(part, _)| *part).collect();
            heights.extend(floor_parts.iter().map(|part| boxes[part][0].dot(up)));
            for (part, place) in boxes.iter().filter(|(_, place)| is_near(place)) {
                if !floor_parts.contains(part) {
                    lowest_m = lowest_m.min(place[0].dot(up));
                }
            }
            floors.push(root.iter().map(|part| floor_parts.contains(part)).collect());
            let is_near = |part: &u32| !floor_parts.contains(part) && boxes.get(part).is_some_and(is_near);
            worn.push(root.iter().map(|part| is_near(part) && boxes.get(part).is_some_and(is_worn)).collect());
            near.push(root.iter().map(is_near).collect());
        }
        let floor_m = heights.iter().copied().reduce(f32::max);
        let alike = |height: f32| heights.iter().all(|other| (other - height).abs() <= SUNK * extent_m);
        let floor_m = floor_m
            .filter(|height| options.ground == Ground::Auto && alike(*height) && lowest_m >= height - SUNK * extent_m);
        if floor_m.is_none() {
            floors.iter_mut().for_each(|floor| floor.fill(false));
        }
        Ok(Surroundings { floors, floor_m, lowest_m, near, worn })
    }

    fn ground_m(&self, options: &PictureOptions) -> Option<f32> {
        match options.ground {
            Ground::Off => None,
            Ground::At(height_m) => Some((height_m - options.origin_m.dot(options.up.vector().as_dvec3())) as f32),
            Ground::Auto => Some(self.floor_m.unwrap_or(self.lowest_m)),
        }
    }
}

/// Adds the obstacles' vertices of a frame for which `which` is true. `which`: by subject.
fn add_obstacles(subjects: &[Subject<'_>], which: &[Vec<bool>], frame: u32, fit: &mut Fit) -> Result<(), PictureError> {
    for (subject, which) in subjects.iter().zip(which) {
        if let Some(mesh) = subject.obstacle(frame)? {
            let points = mesh.positions.iter().zip(which).filter(|(_, taken)| **taken);
            fit.add(&points.map(|(point, _)| *point).collect::<Vec<_>>());
        }
    }
    Ok(())
}

/// Where every part of a subject's obstacles is over all frames. `root`: the part of every vertex.
fn boxes(subject: &Subject<'_>, numbers: &[u32], threads: usize, root: &[u32]) -> Result<Boxes, PictureError> {
    let all = Mutex::new(Boxes::new());
    for_each(numbers, threads, |_, frame| {
        let Some(mesh) = subject.obstacle(frame)? else { return Ok(()) };
        let mut own = Boxes::new();
        for v in mesh.triangles.iter().flatten().map(|v| *v as usize) {
            let (Some(part), point) = (root.get(v), mesh.positions[v]) else { continue };
            if point.is_finite() {
                let [low, high] = own.entry(*part).or_insert([point; 2]);
                (*low, *high) = (low.min(point), high.max(point));
            }
        }
        if let Ok(mut all) = all.lock() {
            for (part, [low, high]) in own {
                let place = all.entry(part).or_insert([low, high]);
                *place = [place[0].min(low), place[1].max(high)];
            }
        }
        Ok(())
    })?;
    Ok(all.into_inner().unwrap_or_default())
}

/// Whether a flat part lies below the corners and the middle of a box.
fn covers(mesh: &FrameMesh, root: &[u32], part: u32, [low, high]: [Vec3; 2], up: Vec3) -> bool {
    let (x, y) = if up == Vec3::Z { (Vec3::X, Vec3::Y) } else { (Vec3::X, Vec3::Z) };
    let flat = |p: Vec3| (p.dot(x), p.dot(y));
    let ((x0, y0), (x1, y1)) = (flat(low), flat(high));
    let corners = [(x0, y0), (x1, y0), (x0, y1), (x1, y1), (0.5 * (x0 + x1), 0.5 * (y0 + y1))];
    let triangles: Vec<[(f32, f32); 3]> = mesh
        .triangles
        .iter()
        .filter(|t| root[t[0] as usize] == part)
        .map(|t| t.map(|v| flat(mesh.positions[v as usize])))
        .collect();
    corners.iter().all(|&(px, py)| {
        triangles.iter().any(|[a, b, c]| {
            let side = |p: &(f32, f32), q: &(f32, f32)| (q.0 - p.0) * (py - p.1) - (q.1 - p.1) * (px - p.0);
            let sides = [side(a, b), side(b, c), side(c, a)];
            sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0)
        })
    })
}

/// Range and legend of the scale, if there is one.
fn scale(
    subjects: &[Subject<'_>],
    numbers: &[u32],
    options: &PictureOptions,
    (low, high): (f32, f32),
) -> Result<([f32; 2], Option<Legend>), PictureError> {
    match options.coloring {
        Coloring::Height => {
            let base = options.origin_m.dot(options.up.vector().as_dvec3()) as f32;
            let ends = [low, high].map(|height| format!("{:.2} m", height + base));
            Ok(([low, high], Some(Legend { scale: &palette::HEIGHT, name: "height", ends })))
        }
        Coloring::Contact => {
            let ends = ["none".into(), "touching".into()];
            Ok(([0.0, 1.0], Some(Legend { scale: &palette::CONTACT, name: "nearest contact", ends })))
        }
        Coloring::Strain => {
            let every = numbers.len().div_ceil(SAMPLED).max(1);
            let mut sizes = Vec::new();
            for &frame in numbers.iter().rev().step_by(every) {
                let fine = |subject: &&Subject| subject.source.holds(frame) && !subject.source.is_coarse(frame);
                for subject in subjects.iter().filter(fine) {
                    let positions = subject.source.read(frame)?.positions;
                    let values = subject.known.map(|known| known.values(Coloring::Strain, frame, &positions));
                    let values = values.transpose().map_err(|what| PictureError::Values { frame, what })?;
                    sizes.extend(values.unwrap_or_default().into_iter().map(f32::abs).filter(|x| x.is_finite()));
                }
            }
            sizes.sort_by(f32::total_cmp);
            // Nearly all strains; single vertices shall not make the rest gray.
            let most = sizes.get(sizes.len().saturating_sub(1) * 98 / 100).copied().unwrap_or(0.0);
            let steps = [0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0];
            let end = steps.into_iter().find(|step| *step >= most).unwrap_or(1.0);
            let ends = [-end, end].map(|x| format!("{:+} %", (x * 1000.0).round() / 10.0));
            Ok(([-end, end], Some(Legend { scale: &palette::STRAIN, name: "strain", ends })))
        }
        _ => Ok(([0.0, 1.0], None)),
    }
}
