//! What the recorded scene of a run says about its vertices: pieces and obstacles by name, ranks, strain, contacts.

use serde_json::json;

use super::contacts::Contacts;
use crate::coordinator::RunOptions;
use crate::math::Vec3;
use crate::model::GlobalModel;
use crate::output::{FrameSource, Report, RunDirectory, RunManifest, principal_stretches};
use crate::partition::RowPartition;
use crate::scene::{self, Obstacles, Overrides, Scene};

/// The scene of a run, at its resolution.
pub struct Known {
    scene: Scene,
    model: GlobalModel,
    partition: RowPartition,
    /// Made when somebody asks for contacts.
    contacts: Option<Contacts>,
}

impl Known {
    /// Reads the scene that a run has recorded; frame 0 is its start state.
    ///
    /// # Errors
    /// The recorded scene cannot be read, or the frames are not of its mesh.
    pub fn load(directory: &RunDirectory) -> Result<Known, String> {
        let text = |error: &dyn std::fmt::Display| error.to_string();
        let manifest = RunManifest::load(directory).map_err(|error| text(&error))?;
        let options: RunOptions = manifest.flags().map_err(|error| text(&error))?;
        let overrides = Overrides { resolution: options.resolution, frames: options.frames };
        let parsed = scene::read_str(&manifest.text_to_read(), &manifest.scene_path).map_err(|error| text(&error))?;
        let mut scene = parsed.unchecked_at(&overrides).map_err(|error| text(&error))?;
        // An untangled start is not that of the scene.
        if let Ok(frames) = FrameSource::open(directory)
            && let Some(first) = frames.numbers().first().copied()
        {
            let frames = frames.about(scene.origin_m);
            let first_frame = frames.read(first).map_err(|error| text(&error))?;
            if first_frame.triangles != scene.mesh.triangles {
                return Err("the frames are not of the mesh that the recorded scene makes today".into());
            }
            if first == 0 {
                scene.mesh.positions = first_frame.positions;
            }
        }
        // A resumed run may have other workers than run.toml had at first; the report names the last ones.
        let workers = Report::load(&directory.report()).map_or(options.workers, |report| report.header.workers);
        let rows = scene.mesh.positions.len();
        if workers == 0 || workers > rows {
            return Err(format!("{workers} workers for {rows} vertices"));
        }
        let model = GlobalModel::new(&scene);
        Ok(Known { partition: RowPartition::new(rows, workers), model, scene, contacts: None })
    }

    /// Names and ranges of pieces (vertices) and obstacles (triangles).
    pub fn names(&self) -> serde_json::Value {
        let cloths = self.scene.cloths.iter();
        let pieces = cloths.map(|c| json!({ "name": c.name, "from": c.vertices.start, "to": c.vertices.end }));
        let obstacles = Obstacles::new(&self.scene.obstacles);
        let ranges = obstacles.ranges().into_iter().enumerate();
        let obstacles = ranges.map(
            |(i, [_, triangles])| json!({ "name": obstacles.name(i), "from": triangles.start, "to": triangles.end }),
        );
        json!({
            "pieces": pieces.collect::<Vec<_>>(),
            "obstacles": obstacles.collect::<Vec<_>>(),
            "ranks": self.partition.ranks(),
            "thickness_m": self.scene.settings.thickness_m,
            "collisions": self.scene.settings.collisions,
        })
    }

    /// The rank that owns each vertex.
    pub fn ranks(&self) -> Vec<f32> {
        let mut ranks = vec![0.0; self.model.rows()];
        for (row, vertex) in self.model.original_from_global.iter().enumerate() {
            ranks[*vertex as usize] = self.partition.owner(row) as f32;
        }
        ranks
    }

    /// Of every vertex: the mean over its triangles of their largest stretch minus one, or of their smallest minus
    /// one, whichever is farther from zero.
    ///
    /// # Errors
    /// The positions are not of the scene's mesh.
    pub fn strain(&self, positions: &[Vec3]) -> Result<Vec<f32>, String> {
        self.check(positions)?;
        let mut sums = vec![[0.0_f64; 3]; positions.len()];
        let mesh = &self.scene.mesh;
        for (corners, uv) in mesh.triangles.iter().zip(&mesh.material_uv) {
            let [largest, smallest] = principal_stretches(corners.map(|v| positions[v as usize]), *uv);
            for &v in corners {
                let [out, pressed, triangles] = &mut sums[v as usize];
                (*out, *pressed, *triangles) = (*out + largest - 1.0, *pressed + smallest - 1.0, *triangles + 1.0);
            }
        }
        let mean = |[out, pressed, triangles]: [f64; 3]| {
            let most = if out.abs() >= pressed.abs() { out } else { pressed };
            (most / triangles.max(1.0)) as f32
        };
        Ok(sums.into_iter().map(mean).collect())
    }

    /// Of every vertex: how near its nearest contact is, from 0 (none within the thickness) to 1 (touching).
    /// `positions`: about the local origin.
    ///
    /// # Errors
    /// The positions are not of the scene's mesh, or the scene has no collisions.
    pub fn contact(&mut self, positions: &[Vec3], frame: u32) -> Result<Vec<f32>, String> {
        self.check(positions)?;
        let time_s = self.time_s(frame);
        self.look()?;
        match &mut self.contacts {
            Some(contacts) => contacts.near(&self.model, positions, time_s),
            None => Err("no detector".into()),
        }
    }

    /// Of every vertex: the sum of the normal forces of its contacts, N. `positions`: about the local origin.
    ///
    /// # Errors
    /// As [`Known::contact`].
    pub fn contact_force(&mut self, positions: &[Vec3], frame: u32) -> Result<Vec<Vec3>, String> {
        self.check(positions)?;
        let time_s = self.time_s(frame);
        self.look()?;
        match &mut self.contacts {
            Some(contacts) => contacts.forces(&self.model, positions, time_s),
            None => Err("no detector".into()),
        }
    }

    /// Makes the detector.
    fn look(&mut self) -> Result<(), String> {
        if !self.scene.settings.collisions {
            return Err("this scene has collisions = false".into());
        }
        if self.contacts.is_none() {
            self.contacts = Some(Contacts::new(&self.model)?);
        }
        Ok(())
    }

    fn time_s(&self, frame: u32) -> f64 {
        let settings = &self.scene.settings;
        f64::from(frame) * f64::from(settings.steps_per_frame) * settings.step_s
    }

    /// World positions about the local origin of the run.
    pub fn about_origin(&self, positions: &[Vec3]) -> Vec<Vec3> {
        positions.iter().map(|p| (p.as_dvec3() - self.scene.origin_m).as_vec3()).collect()
    }

    /// The frames of the run, about its local origin.
    pub(super) fn frames(&self, frames: FrameSource) -> FrameSource {
        frames.about(self.scene.origin_m)
    }

    fn check(&self, positions: &[Vec3]) -> Result<(), String> {
        let (there, here) = (positions.len(), self.scene.mesh.positions.len());
        if there == here { Ok(()) } else { Err(format!("the frame has {there} vertices and the scene {here}")) }
    }
}
