//! `loomtree bench strain`: stretch of the cloths of a run, and what is beyond their strain limits.

use std::path::PathBuf;

use super::table::FigureTable;
use crate::cli::CliError;
use crate::coordinator::RunOptions;
use crate::os::console;
use crate::output::{FrameMesh, FrameSource, RunDirectory, RunManifest, beyond_limit, principal_stretches};
use crate::scene::{Overrides, Scene, StrainLimit, read_str};

/// Arguments of `loomtree bench strain`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct StrainBench {
    /// Run directory (what `loomtree run` was given as --out)
    run_dir: PathBuf,
    /// Strain beyond a limit from which on a triangle is counted
    #[arg(long, default_value_t = 0.005)]
    beyond: f64,
    /// Folder for the table as JSON
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Of one piece, over all frames.
#[derive(Clone, Debug)]
struct Figures {
    strain_limit: Option<StrainLimit>,
    limit: [f64; 2],
    largest: f64,
    smallest: f64,
    /// Largest of the frames' 99th percentiles of the largest stretch.
    percentile: f64,
    /// Strain beyond a limit, and its frame and triangle.
    beyond: f64,
    place: Option<(u32, usize)>,
    /// Triangles beyond a limit in the frame that has most, and those of them with a corner that a pin holds.
    counted: usize,
    counted_at_pins: usize,
}

pub(super) fn run(bench: &StrainBench) -> Result<(), CliError> {
    let bad = |error: &dyn std::fmt::Display| CliError::bad_input(error.to_string());
    let directory = RunDirectory::open(&bench.run_dir).map_err(|error| bad(&error))?;
    let manifest = RunManifest::load(&directory).map_err(|error| bad(&error))?;
    let options: RunOptions = manifest.flags().map_err(|error| bad(&error))?;
    let overrides = Overrides { resolution: options.resolution, frames: options.frames };
    let parsed = read_str(&manifest.text_to_read(), &manifest.scene_path).map_err(|error| bad(&error))?;
    let (scene, _) = parsed.untangled_at(&overrides).map_err(|error| bad(&error))?;
    let source = FrameSource::open(&directory).map_err(|error| bad(&error))?.about(scene.origin_m);
    let mut pieces = pieces(&scene);
    for frame in source.numbers() {
        let mesh = source.read(frame).map_err(|error| bad(&error))?;
        if mesh.triangles.len() != scene.mesh.triangles.len() {
            return Err(CliError::bad_input(format!(
                "frame {frame} of {} has {} triangles, its scene {}",
                bench.run_dir.display(),
                mesh.triangles.len(),
                scene.mesh.triangles.len()
            )));
        }
        for (triangles, figures) in &mut pieces {
            figures.add(&scene, &mesh, frame, triangles.clone(), bench.beyond);
        }
    }
    let title = format!("stretch in {}, pieces in the order of the scene", bench.run_dir.display());
    let columns = vec![
        "piece",
        "least_allowed",
        "most_allowed",
        "smallest",
        "largest",
        "largest_p99",
        "beyond_limit",
        "triangles_beyond",
        "of_them_at_pins",
    ];
    let mut table = FigureTable::new("strain", title, columns);
    for (piece, (_, figures)) in pieces.iter().enumerate() {
        table.push(vec![
            (piece + 1) as f64,
            figures.limit[0],
            figures.limit[1],
            figures.smallest,
            figures.largest,
            figures.percentile,
            figures.beyond,
            figures.counted as f64,
            figures.counted_at_pins as f64,
        ]);
        if let Some((frame, triangle)) = figures.place {
            let corners = scene.mesh.triangles[triangle];
            let held = held(&scene, triangle).map_or(String::new(), |pin| format!("; a pin holds {pin}"));
            let name = scene.vertex_name(corners[0]);
            console::note(format_args!(
                "piece {}: farthest beyond its limit in frame {frame}, triangle {triangle} at {name}{held}",
                piece + 1
            ));
        }
    }
    table.finish(bench.out.as_deref(), None)
}

/// Triangles of every piece, and figures without frames.
fn pieces(scene: &Scene) -> Vec<(std::ops::Range<usize>, Figures)> {
    let all = scene.mesh.triangles.len();
    let ranges: Vec<_> = match &scene.cloths[..] {
        [] => vec![0..all],
        cloths => cloths.iter().map(|cloth| cloth.triangles.start as usize..cloth.triangles.end as usize).collect(),
    };
    let figures = |triangles: std::ops::Range<usize>| {
        let fabric = &scene.fabrics[usize::from(scene.fabric_of_triangle[triangles.start])];
        let free = [0.0, f64::INFINITY];
        let strain_limit = fabric.strain_limit;
        let limit = match strain_limit {
            None => free,
            Some(StrainLimit::Every(range)) => range,
            // The wider of both: a stretch beyond it is beyond the other one, too.
            Some(StrainLimit::Along { warp, weft, .. }) => {
                let (warp, weft) = (warp.unwrap_or(free), weft.unwrap_or(free));
                [warp[0].min(weft[0]), warp[1].max(weft[1])]
            }
        };
        let (largest, smallest, percentile, beyond) = (0.0, f64::INFINITY, 0.0, 0.0);
        let figures = Figures {
            strain_limit,
            limit,
            largest,
            smallest,
            percentile,
            beyond,
            place: None,
            counted: 0,
            counted_at_pins: 0,
        };
        (triangles, figures)
    };
    ranges.into_iter().filter(|triangles| !triangles.is_empty()).map(figures).collect()
}

/// The name of a corner that a pin holds at some time.
fn held(scene: &Scene, triangle: usize) -> Option<String> {
    let corners = scene.mesh.triangles[triangle];
    scene.pins.iter().find(|pin| corners.contains(&pin.vertex)).map(|pin| scene.vertex_name(pin.vertex))
}

impl Figures {
    fn add(
        &mut self,
        scene: &Scene,
        mesh: &FrameMesh,
        frame: u32,
        triangles: std::ops::Range<usize>,
        counted_from: f64,
    ) {
        let (mut all, mut counted, mut at_pins) = (Vec::with_capacity(triangles.len()), 0, 0);
        for triangle in triangles {
            let corners = scene.mesh.triangles[triangle].map(|v| mesh.positions[v as usize]);
            let [largest, smallest] = principal_stretches(corners, scene.mesh.material_uv[triangle]);
            let of_limit = |limit| beyond_limit(limit, corners, scene.mesh.material_uv[triangle]);
            let beyond = self.strain_limit.as_ref().map_or(f64::NEG_INFINITY, of_limit);
            if beyond > self.beyond {
                (self.beyond, self.place) = (beyond, Some((frame, triangle)));
            }
            if beyond > counted_from {
                counted += 1;
                at_pins += usize::from(held(scene, triangle).is_some());
            }
            self.smallest = self.smallest.min(smallest);
            all.push(largest);
        }
        if counted > self.counted {
            (self.counted, self.counted_at_pins) = (counted, at_pins);
        }
        all.sort_unstable_by(f64::total_cmp);
        self.largest = self.largest.max(all[all.len() - 1]);
        self.percentile = self.percentile.max(all[(all.len() - 1) * 99 / 100]);
    }
}
