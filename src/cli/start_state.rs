//! Meshes that a command writes when it refuses a start state: the crossing triangles, and the best state that
//! untangling reached. Files appear complete or not at all.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use crate::math::{DVec3, Vec3};
use crate::output::{WriteError, write_atomically};
use crate::scene::SceneError;

/// Files for the meshes of a refused start state.
#[derive(Clone, Debug, Default)]
pub(super) struct Places {
    /// For the crossing triangles.
    pub crossings: Option<PathBuf>,
    /// For the cloth at the best state of untangling.
    pub best: Option<PathBuf>,
}

impl Places {
    /// Files beside a run directory, or in the working directory if its parent does not exist.
    pub(super) fn beside(out: &Path) -> Places {
        let place = |ending: &str| {
            let mut name = out.file_name().unwrap_or("run".as_ref()).to_os_string();
            name.push(ending);
            let beside = out.with_file_name(&name);
            let folder = beside.parent().filter(|folder| !folder.as_os_str().is_empty());
            Some(if folder.is_none_or(Path::is_dir) { beside } else { PathBuf::from(name) })
        };
        Places { crossings: place(".crossings.obj"), best: place(".untangled.obj") }
    }

    /// The message of an error. If the error is about the start state, the meshes are written.
    pub(super) fn refuse(&self, error: &mut SceneError) -> String {
        let SceneError::Crossing { crossings, .. } = error else { return error.to_string() };
        let mut faults = Vec::new();
        if let Some(file) = &self.crossings {
            match write_mesh(file, crossings.origin_m, &crossings.positions, &crossings.triangles()) {
                Ok(()) => crossings.written = Some(file.clone()),
                Err(fault) => faults.push(fault.to_string()),
            }
        }
        if let (Some(file), Some(best)) = (&self.best, &mut crossings.best) {
            match write_mesh(file, crossings.origin_m, &best.positions, &best.triangles) {
                Ok(()) => best.written = Some(file.clone()),
                Err(fault) => faults.push(fault.to_string()),
            }
        }
        let faults: String = faults.iter().map(|fault| format!("; {fault}")).collect();
        format!("{error}{faults}")
    }
}

/// Writes an OBJ file of positions, which are relative to `origin_m`, and triangles with all digits of the positions.
pub(super) fn write_mesh(
    file: &Path,
    origin_m: DVec3,
    positions: &[Vec3],
    triangles: &[[u32; 3]],
) -> Result<(), WriteError> {
    write_atomically(file, |out: &mut dyn Write| -> io::Result<()> {
        for p in positions {
            let far = p.as_dvec3() + origin_m;
            match origin_m == DVec3::ZERO {
                true => writeln!(out, "v {} {} {}", p.x, p.y, p.z)?,
                false => writeln!(out, "v {} {} {}", far.x, far.y, far.z)?,
            }
        }
        for t in triangles {
            writeln!(out, "f {} {} {}", t[0] + 1, t[1] + 1, t[2] + 1)?;
        }
        Ok(())
    })
}

/// A sentence about the result of untangling.
pub(super) fn untangled_line(done: &crate::scene::Untangling) -> String {
    format!(
        "untangled: {} pairs of triangles crossed; {} vertices moved, the farthest by {:.3e} m, in {} rounds",
        done.pairs, done.vertices_moved, done.largest_m, done.rounds
    )
}
